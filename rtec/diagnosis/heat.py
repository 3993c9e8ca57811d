"""Heat that no sensor, or the wrong one, recorded: what a slow residual and a thermal finding leave open."""

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis.doubts import Doubt
from rtec.diagnosis.result import label_of
from rtec.effects import Effect
from rtec.estimation.candidates import real
from rtec.estimation.flexible import flexible_columns
from rtec.estimation.gls import Fit, without_runs
from rtec.estimation.noise import Whitener, found_on_stretches, minutes
from rtec.estimation.readings import Readings, Series
from rtec.wording import number

Floats = NDArray[np.float64]

INSTRUMENT = 5.0
"""What an instrument drifts by at the most while it warms up, µm or µrad, as the catalogue of effects has it."""
WARM, OFF = (0.03, 0.06, 0.12, 0.2, 0.35, 0.6, 3.0), (math.inf, 0.4, 0.5, 0.6, 0.7, 0.8)
"""Time constants, and when it was switched off, as shares of the record; searched for."""
SLOW_S, RECORD_S = 600.0, 3600.0
"""A drift with at least so long a memory, in a record of at least so long, may be heat."""
LARGE = 1.0
"""Where it is at least so many times the white noise."""
BODIES = {
    "axis_expansion": (("screw", "nut", "scale"), "on the screw, nut or scale of {axis}"),
    "axis_expansion_nonuniform": (("screw", "nut", "scale"), "on the screw, nut or scale of {axis}"),
    "backlash_temperature": (("screw", "nut"), "on the screw or nut of {axis}"),
    "spindle_growth": (("spindle", "bearing", "head"), "on the spindle or its bearings"),
    "spindle_tilt": (("spindle", "bearing", "head"), "on the spindle or its bearings"),
}
"""What a sensor should be on for an effect to be its own: words in its name, and the place in words."""
PAUSE_S, LONG_PAUSE = 120.0, 0.2
"""A pause of so long, and of so many time constants, is one that a lag remembers."""
MUCH_WARMER = 5.0
"""Kelvin between the medians of files from which on they are cold and warm ones."""
UNITS = {"um": "µm", "urad": "µrad"}


def stands_for(readings: Readings, effect: Effect) -> Doubt | None:
    """That a sensor stands for a body that no recorded sensor is on; None where one is, or the effect has none.

    Args:
        readings: the readings.
        effect: that was named.
    """
    sensor = getattr(effect, "sensor", None)
    if sensor is None or effect.effect not in BODIES:
        return None
    known, where = BODIES[effect.effect]
    axis = str(getattr(effect, "axis", ""))
    recorded = [n for n in readings.machine.sensor_names if any(n in s.channels for s in readings.states)]
    on_it = [n for n in recorded if any(w in n.lower() for w in known) or (axis and n.lower() == f"t_{axis.lower()}")]
    if on_it:
        return None
    place = where.format(axis=axis)
    message = f"{effect.effect} follows {sensor}; no sensor {place} was recorded, which moves alike."
    return Doubt("other_sensor", message, "Record one there before the compensation relies on this sensor.")


def lag_assumed(readings: Readings, effect: Effect, theta: Mapping[str, float]) -> tuple[str, ...]:
    """What an effect that lags takes for granted where nothing was recorded; empty for one that does not lag.

    Args:
        readings: the readings.
        effect: that was named.
        theta: its non-linear parameters.
    """
    names = [n for n in effect.channels(readings.machine) if n == "spindle_rpm" or n in readings.machine.sensor_names]
    if "tau" not in theta or not names:
        return ()
    pause = max(float(np.diff(s.time_s).max(initial=0.0)) for s in readings.series)
    said = f"{effect.effect} lags by {minutes(theta['tau'])}: {' and '.join(names)} counted as settled before the first"
    said += " reading"
    if pause > max(PAUSE_S, LONG_PAUSE * theta["tau"]):
        said += f", and as a straight line over pauses (up to {minutes(pause)}), of which the record says nothing"
    return (said,)


def warm_up_curves(readings: Readings, effect: Effect, part: Floats) -> Sequence[Floats]:
    """How an instrument itself may warm up, and cool down once it is off, where an effect may be no more than that.

    Args:
        readings: the readings.
        effect: that explains them; what depends on a position is no instrument's.
        part: what it adds to the readings, (m,).

    Returns:
        A column for each series that the effect moves, for each time constant, (m, series); none where it is too large.
    """
    machine = readings.machine
    places = {c for a in machine.axes for c in a.moving_channels}
    moved = [s for s in readings.series if float(np.ptp(part[s.part])) > 0.0]
    if set(effect.channels(machine)) & places or any(float(np.ptp(part[s.part])) > INSTRUMENT for s in moved):
        return ()
    return [np.stack([_warming(readings, s, *at) for s in moved], axis=1) for at in itertools.product(WARM, OFF)]


def _warming(readings: Readings, s: Series, warm: float, off: float) -> Floats:
    """One exponential from the first reading on, and back from when it is off, (m,)."""
    out = np.zeros(len(readings))
    share = (s.time_s - s.time_s[0]) / max(float(s.time_s[-1] - s.time_s[0]), 1e-9)
    risen = 1.0 - np.exp(-np.minimum(share, off) / warm)
    out[s.part] = risen * np.exp(-np.maximum(share - off, 0.0) / warm) if math.isfinite(off) else risen
    return out


def only_between_files(readings: Readings, effect: Effect) -> Doubt:
    """That an effect explains only what differs between files; fatal unless a temperature differs there by much.

    Cold on one day and warm on another is a way to measure an expansion. Where both days were nearly as warm, a machine
    that has changed between them is as likely.
    """
    machine = readings.machine
    read = [n for n in machine.sensor_names if n in effect.channels(machine)]
    states = [s for s in readings.states if all(n in s.channels for n in read)]
    middles = {n: [float(np.nanmedian(s.channels[n])) for s in states] for n in read}
    apart = max((max(v) - min(v) for v in middles.values() if v), default=0.0)
    names = " and ".join(m.name for m in readings.measurements[:3])
    message = (
        f"{label_of(effect)} explains only what differs between {names}: within each of them the readings do not "
        f"follow {' and '.join(read) or 'it'}. The machine or the set-up may have changed between them."
    )
    step = "Measure while that changes, or once more as it was at first."
    return Doubt("between_files", message, step, fatal=apart < MUCH_WARMER)


def dead_sensor(readings: Readings, effect: Effect, known: Sequence[Effect]) -> Doubt | None:
    """That an effect stands for one that the model has by a sensor that stood still; None where none did.

    Args:
        readings: the readings.
        effect: that would be named.
        known: effects of the model.
    """
    mine = getattr(effect, "sensor", None)
    for other in known:
        sensor = str(getattr(other, "sensor", None))
        if (other.effect, other.component) != (effect.effect, effect.component) or mine is None:
            continue
        values = [s.channels[sensor] for s in readings.states if sensor in s.channels]
        if not values or any(float(np.ptp(v)) > 0.0 for v in values) or sensor == mine:
            continue
        message = (
            f"{sensor}, which {label_of(other)} of the model reads, stood at {values[0][0]:.4g} °C in every row, while "
            f"the readings follow {mine}: is the sensor connected?"
        )
        return Doubt("dead_sensor", message, "Check it, and measure again.", fatal=True)
    return None


def own_warm_up(effect: Effect) -> Doubt:
    """That an instrument that warms up by itself draws the curve of an effect as well."""
    message = (
        f"{label_of(effect)} explains the residual no better than an instrument that warms up by itself from its first "
        "reading on."
    )
    step = "Measure again once the instrument has been on for hours, or record it capped for the same time."
    return Doubt("instrument_warm_up", message, step, fatal=True)


def unrecorded_heat(readings: Readings, fit: Fit, named_um: float | None = None) -> Doubt | None:
    """That the residual grows and falls over hours, unexplained by anything recorded; None where it does not.

    Args:
        readings: the readings.
        fit: of the model, with the effect that is named.
        named_um: what the effect that is named explains (root mean square), where that is no heat; the doubt is raised
            beside it if more grows and falls, and no smooth dependence on positions, directions, speeds and load
            explains that. None where nothing is named: then it is raised if no temperature varied.
    """
    machine = readings.machine
    if named_um is None and _temperature_varied(readings):
        return None
    slow, memory, s = max((_slow(fit, fit.whitener, i) for i in range(len(readings.series))), key=lambda f: f[0])
    if slow <= (named_um or 0.0):
        return None
    if named_um is not None:
        noise = found_on_stretches(readings, lambda few, keep: flexible_columns(few, fit.columns[keep], warm=False))
        slow, memory, s = max((_slow(fit, noise, i) for i in range(len(readings.series))), key=lambda f: f[0])
        if slow <= named_um:
            return None
    m = readings.measurements[s.source]
    message = (
        f"{m.name} {s.column} grows and falls by {number(slow)} {UNITS.get(s.unit, s.unit)} with a memory of "
        f"{minutes(memory)}: slow, and unexplained by anything recorded."
    )
    moves = [a.name for a in machine.axes if float(np.ptp(readings.states[s.source].value(a.channel)[s.row])) > 0.0]
    bodies = [f"the screw or scale of {a}" for a in moves[:1]] + ["spindle", "column", "bed", "air"]
    step = f"Record temperatures of {', '.join(bodies)}."
    return Doubt("no_temperature", message, step, fatal=True)


def _slow(fit: Fit, noise: Whitener, number: int) -> tuple[float, float, Series]:
    """Root mean square of what grows and falls slowly in a series, its memory in s, and the series; 0 where none does.

    Args:
        fit: whose residual it is.
        noise: of that residual.
        number: of the series.
    """
    s, n = noise.readings.series[number], noise.noises[number]
    slow = n.sigma * math.sqrt(n.drift + n.offset)
    long = float(s.time_s[-1] - s.time_s[0]) >= RECORD_S and n.tau_s >= SLOW_S
    if not long or slow <= LARGE * n.sigma:
        return 0.0, n.tau_s, s
    # A drift of long memory may swing further than it did in this record.
    residual = without_runs(s, fit.left[s.part])
    return min(slow, float(np.sqrt(np.mean((residual - residual.mean()) ** 2)))), n.tau_s, s


def _temperature_varied(readings: Readings) -> bool:
    """Whether a recorded temperature changed."""
    machine = readings.machine
    there = [(n, s.channels[n]) for n in machine.sensor_names for s in readings.states if n in s.channels]
    return any(np.nanmax(v, initial=-np.inf) - np.nanmin(v, initial=np.inf) > real(machine, n) for n, v in there)

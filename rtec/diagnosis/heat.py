"""Heat that no sensor, or the wrong one, recorded: doubts about a slow residual and about a thermal finding."""

import itertools
import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from rtec.arrays import Floats
from rtec.diagnosis.doubts.doubt import ALONE, Doubt
from rtec.effects import Effect
from rtec.effects.base import component_kind
from rtec.effects.thermal import AxisExpansion
from rtec.estimation.candidates import real
from rtec.estimation.flexible import flexible_columns
from rtec.estimation.gls import Fit, without_runs
from rtec.estimation.judge import Judgement
from rtec.estimation.noise import Whitener, noise_on_stretches
from rtec.estimation.readings import Readings, Series
from rtec.estimation.warmth import SENSOR_S, expands_much
from rtec.metrology.instruments.laser import LaserLinear
from rtec.model import FittedEffect
from rtec.wording import ERROR_UNITS, duration, listed, number, significant

INSTRUMENT = 5.0
"""Largest drift of an instrument that warms up, µm or µrad, as in the catalogue of effects."""
WARM, OFF = (0.03, 0.06, 0.12, 0.2, 0.35, 0.6, 3.0), (math.inf, 0.4, 0.5, 0.6, 0.7, 0.8)
"""Grid of time constants, and of the time of switching off, as shares of the record."""
SLOW_S, RECORD_S = 600.0, 3600.0
"""A drift with at least this memory, in a record of at least this length, may be heat."""
LARGE = 1.0
"""Where it is at least this many times the white noise."""
BY_FAR = 3.0
"""A drift that no channel explains, in multiples of the noise, from which on nothing says that no effect is missing."""
BODIES = {
    "axis_expansion": (("screw", "nut", "scale"), "on the screw, nut or scale of {axis}"),
    "axis_expansion_nonuniform": (("screw", "nut", "scale"), "on the screw, nut or scale of {axis}"),
    "backlash_temperature": (("screw", "nut"), "on the screw or nut of {axis}"),
    "spindle_growth": (("spindle", "bearing", "head"), "on the spindle or its bearings"),
    "spindle_tilt": (("spindle", "bearing", "head"), "on the spindle or its bearings"),
}
"""Where a sensor should be for an effect to be direct: words in its name, and the place in words."""
PAUSE_S, LONG_PAUSE = 120.0, 0.2
"""A lag remembers a pause of at least this length, and of this many time constants."""
MUCH_WARMER = 5.0
"""From this difference of the medians of files on, in K, one file is cold and the other warm."""


def substitute_sensor(readings: Readings, effect: Effect, known: Sequence[Effect]) -> Doubt | None:
    """Doubt where a sensor represents a body without a sensor; None where the body has one, or the effect has none.

    A guideway that bends has no place of its own for a sensor.

    Args:
        readings: the readings.
        effect: the named one.
        known: effects of the model: a sensor by which it has the same effect is on the body.
    """
    sensor = getattr(effect, "sensor", None)
    if sensor is None or effect.effect not in BODIES or component_kind(effect.component, readings.machine) == "tilt":
        return None
    words, where = BODIES[effect.effect]
    axis = str(getattr(effect, "axis", ""))
    recorded = [n for n in readings.machine.sensor_names if any(n in s.channels for s in readings.states)]
    on_it = [n for n in recorded if any(w in n.lower() for w in words) or (axis and n.lower() == f"t_{axis.lower()}")]
    same = [k for k in known if (k.effect, k.component) == (effect.effect, effect.component)]
    if on_it or any(getattr(k, "sensor", None) in recorded for k in same):
        return None
    place = where.format(axis=axis)
    message = f"{effect.effect} follows {sensor}; no sensor {place} was recorded, which moves alike."
    return Doubt("other_sensor", message, "Record one there before the compensation relies on this sensor.")


def lag_assumed(readings: Readings, effect: Effect, theta: Mapping[str, float]) -> tuple[str, ...]:
    """Assumptions of a delayed effect where nothing was recorded, in words; empty for an immediate one.

    Args:
        readings: the readings.
        effect: the named one.
        theta: its non-linear parameters.
    """
    names = [n for n in effect.channels(readings.machine) if n == "spindle_rpm" or n in readings.machine.sensor_names]
    if "tau" not in theta or not names:
        return ()
    pause = max(float(np.diff(s.time_s).max(initial=0.0)) for s in readings.series)
    lags = f"{effect.effect} lags by {duration(theta['tau'])}"
    text = f"{lags}: {' and '.join(names)} counted as settled before the first reading"
    if pause > max(PAUSE_S, LONG_PAUSE * theta["tau"]):
        text += f", and as a straight line over pauses (up to {duration(pause)}), of which the record says nothing"
    return (text,)


def warm_up_curves(readings: Readings, channels: Collection[str], part: Floats) -> Sequence[Floats]:
    """Warm-up curves of an instrument, and its cooling once it is off, where they may explain an effect.

    Args:
        readings: the readings.
        channels: of what explains the readings; what depends on a position is no instrument's.
        part: its contribution to the readings, (m,).

    Returns:
        A column for each series that the effect moves, for each time constant, (m, series); none where it is too large.
    """
    machine = readings.machine
    places = {c for a in machine.axes for c in a.moving_channels}
    moved = [s for s in readings.series if float(np.ptp(part[s.part])) > 0.0]
    if set(channels) & places or any(float(np.ptp(part[s.part])) > INSTRUMENT for s in moved):
        return ()
    return [np.stack([_warming(readings, s, *at) for s in moved], axis=1) for at in itertools.product(WARM, OFF)]


def _warming(readings: Readings, s: Series, warm: float, off: float) -> Floats:
    """One exponential from the first reading on, and back from the time of switching off, (m,)."""
    out = np.zeros(len(readings))
    share = (s.time_s - s.time_s[0]) / max(float(s.time_s[-1] - s.time_s[0]), 1e-9)
    risen = 1.0 - np.exp(-np.minimum(share, off) / warm)
    out[s.part] = risen * np.exp(-np.maximum(share - off, 0.0) / warm) if math.isfinite(off) else risen
    return out


def only_between_files(readings: Readings, label: str, channels: Collection[str]) -> Doubt:
    """Doubt where an effect explains only differences between files; fatal unless a temperature differs much there.

    Two days, one cold and one warm, are a way to measure an expansion. Where both were nearly as warm, a change of the
    machine between them is as likely.

    Args:
        readings: the readings.
        label: of the effect.
        channels: that it reads.
    """
    read = [n for n in readings.machine.sensor_names if n in channels]
    states = [s for s in readings.states if all(n in s.channels for n in read)]
    middles = {n: [float(np.nanmedian(s.channels[n])) for s in states] for n in read}
    apart = max((max(v) - min(v) for v in middles.values() if v), default=0.0)
    names = " and ".join(m.name for m in readings.measurements[:3])
    message = (
        f"{label} explains only what differs between {names}: within each of them the readings do not "
        f"follow {' and '.join(read) or 'it'}. The machine or the set-up may have changed between them."
    )
    step = f"Measure while that changes, or once more as it was at first. {ALONE}"
    return Doubt("between_files", message, step, fatal=apart < MUCH_WARMER)


def dead_sensor(readings: Readings, effect: Effect, known: Sequence[Effect]) -> Doubt | None:
    """Doubt where an effect may replace one of the model whose sensor was dead; None where no sensor was.

    Args:
        readings: the readings.
        effect: the candidate for a name.
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
            f"{sensor}, which {other.label} of the model reads, stood at {values[0][0]:.4g} °C in every row, while "
            f"the readings follow {mine}: is the sensor connected?"
        )
        return Doubt("dead_sensor", message, "Check it, and measure again.", fatal=True)
    return None


def late_sensor(effect: Effect, delay_s: float, value: float, known: Sequence[FittedEffect]) -> Doubt | None:
    """Doubt where an effect that the model has would follow the same sensor with one more short delay; None elsewhere.

    Both together follow the temperature and how fast it changes: the sensor, or the part, is late by that.

    Args:
        effect: the candidate for a name.
        delay_s: its delay.
        value: its number.
        known: effects of the model.
    """
    sensor = getattr(effect, "sensor", None)
    for f in known if sensor is not None else ():
        late = {"lag": True} if getattr(f.effect, "lag", None) is False else {}
        soon = max(delay_s, f.theta.get("tau", 0.0)) < SLOW_S
        if not soon or f.effect.model_copy(update=late) != effect or len(f.values) != 1:
            continue
        (own,) = f.values.values()
        lead = -value * (delay_s - f.theta.get("tau", 0.0))
        if abs(lead) >= SENSOR_S * abs(own):
            continue
        by_s = lead / own
        late_one, other = ("sensor", "part") if by_s > 0.0 else ("part", "sensor")
        message = (
            f"The residual follows how fast {sensor} changes, as if the {late_one} were {abs(by_s):.0f} s later than "
            f"the {other}: no other effect than {f.label} of the model is needed."
        )
        step = f"Fix {sensor} closer to its part, or heat the machine more slowly."
        return Doubt("late_sensor", message, step, fatal=True)
    return None


def more_than_any_material(readings: Readings, effect: Effect, fit: Fit, place: int) -> Doubt | None:
    """Doubt where a screw or scale would have to expand more than any material does; None where it would not.

    Args:
        readings: the readings.
        effect: the candidate for a name.
        fit: with it.
        place: of its number in the fit.
    """
    if not isinstance(effect, AxisExpansion):
        return None
    k, error = float(fit.values[place]), math.sqrt(fit.covariance[place, place])
    if not expands_much(effect, k, error):
        return None
    message = (
        f"{effect.label} would need {significant(k)} µm/(m·K), and no material of a machine expands so much: the "
        f"readings follow heat that {effect.sensor} does not show."
    )
    return Doubt("beyond_materials", message, _to_record(readings, readings.series[0]), fatal=True)


def sensor_offset(readings: Readings, label: str, file: int, sensor: str, off_k: float) -> Doubt:
    """Doubt that a sensor reads otherwise in one of several files; it decides what an effect of this name would."""
    here, names = readings.measurements[file].name, listed([m.name for m in readings.measurements[:3]])
    message = (
        f"{label} is only what differs between {names}, and a reading of {sensor} that is {abs(off_k):.2f} K "
        f"{'higher' if off_k < 0.0 else 'lower'} in {here} than the part is explains that as well."
    )
    step = f"Record both set-ups in one day, in turn, or check {sensor} against another thermometer."
    return Doubt("sensor_offset", message, step, fatal=True)


def own_warm_up(label: str) -> Doubt:
    """Doubt that the warm-up of an instrument itself gives the same curve as an effect of this name."""
    message = (
        f"{label} explains the residual no better than an instrument that warms up by itself from its first reading on."
    )
    step = "Measure again once the instrument has been on for hours, or record it capped for the same time."
    return Doubt("instrument_warm_up", message, step, fatal=True)


def beam_in_air(readings: Readings, named: Sequence[Effect]) -> Doubt | None:
    """Doubt where an effect follows the air that a laser's beam goes through, and the file does not say how."""
    lasers = [
        m.name
        for m in readings.measurements
        if isinstance(m.instrument, LaserLinear) and m.instrument.setup.air_sensor is None
    ]
    read = {c for e in named for c in e.channels(readings.machine)}
    air = [s for s in readings.machine.sensor_names if s in read and "air" in s.lower()]
    if not lasers or not air:
        return None
    message = (
        f"{listed(air)} is also the air of the beam of {listed(lasers)}, which changes by {AIR_UM_PER_M_DEGC:g} µm per "
        "metre and kelvin, dead path included, where nothing corrects it."
    )
    step = "If nothing did, give air_sensor and interferometer_mm in [setup] of the file."
    return Doubt("beam_in_air", message, step)


AIR_UM_PER_M_DEGC = 0.93
"""Change of a wavelength in air per metre and kelvin, µm: that of the index of air."""


def only_time(readings: Readings) -> Doubt:
    """Doubt where the residual depends smoothly on the time of the record, and on no channel."""
    known = "that rtec reads" if any(m.unread for m in readings.measurements) else "that was recorded"
    message = (
        f"The residual changes smoothly with the time of the record and with nothing else {known}: an instrument that "
        "warms up looks like this, or heat that no sensor recorded."
    )
    step = f"Measure again once the instrument has been on for hours. {_to_record(readings, readings.series[0])}"
    return Doubt("instrument_warm_up", message, step, fatal=True)


def unrecorded_heat(
    readings: Readings, fit: Fit, named_um: float | None = None, named: Floats | None = None
) -> Doubt | None:
    """Doubt where the residual grows and falls over hours, unexplained by any recorded channel; None where it does not.

    Args:
        readings: the readings.
        fit: of the model, with the named effect.
        named_um: contribution of the named effect (root mean square), where that is no heat; the doubt is raised
            beside it if more grows and falls, and no smooth function of positions, directions, speeds and load explains
            that. None where nothing is named: then it is raised if no temperature varied.
        named: columns of the named effects, (m, k): only series that they move are looked at; None for all.
    """
    if named_um is None and _temperature_varied(readings):
        return None
    looked = [i for i, s in enumerate(readings.series) if named is None or np.ptp(named[s.part], axis=0).any()]
    if not looked:
        return None
    slow, memory, s = max((_slow(fit, fit.whitener, i) for i in looked), key=lambda f: f[0])
    if slow <= (named_um or 0.0):
        return None
    if named_um is not None:
        noise = noise_on_stretches(readings, lambda few, keep: flexible_columns(few, fit.columns[keep], warm=False))
        slow, memory, s = max((_slow(fit, noise, i) for i in looked), key=lambda f: f[0])
        if slow <= named_um:
            return None
    return _grows_and_falls(readings, s, slow, memory)


def drift_by_far(judged: Judgement, fit: Fit) -> Doubt | None:
    """Doubt that nothing is missing where a series drifts by many times its noise; None where none does.

    An instrument seldom does, a body without a sensor does, though others were recorded.

    Args:
        judged: the model, whose numbers are not out of date.
        fit: of the model.
    """
    readings = judged.readings
    found = [(f.drift, *_slow(fit, fit.whitener, i)) for i, f in enumerate(judged.floors) if f.drift > BY_FAR * f.value]
    drift, slow, memory, s = max(found, key=lambda d: d[:2], default=(0.0, 0.0, 0.0, readings.series[0]))
    return _grows_and_falls(readings, s, drift, memory) if slow > 0.0 else None


def _grows_and_falls(readings: Readings, s: Series, slow: float, memory_s: float) -> Doubt:
    m = readings.measurements[s.source]
    message = (
        f"{m.name} {s.column} grows and falls by {number(slow)} {ERROR_UNITS.get(s.unit, s.unit)} with a memory of "
        f"{duration(memory_s)}: slow, and unexplained by anything recorded."
    )
    return Doubt("no_temperature", message, _to_record(readings, s), fatal=True)


def heat_by_time(readings: Readings) -> Doubt | None:
    """Doubt beside an unnamed error that depends on time, where no recorded temperature changed; None where one did."""
    if _temperature_varied(readings):
        return None
    there = any(n in s.channels for n in readings.machine.sensor_names for s in readings.states)
    which = "The recorded temperatures did not change" if there else "No temperature was recorded"
    message = f"{which}, and heat that comes and goes looks like this."
    return Doubt("no_temperature", message, _to_record(readings, readings.series[0]))


def _to_record(readings: Readings, s: Series) -> str:
    """Sentence on the temperatures to record for the heat of a series, in addition to the recorded ones."""
    state = readings.states[s.source]
    moves = [a.name for a in readings.machine.axes if float(np.ptp(state.value(a.channel)[s.row])) > 0.0]
    there = [n for n in readings.machine.sensor_names if n in state.channels]
    axis = {f"the screw or scale of {a}": ("screw", "scale") for a in moves[:1]}
    bodies = {**axis, **{b: (b,) for b in ("spindle", "column", "bed", "air")}}
    more = [b for b, words in bodies.items() if not any(w in n.lower() for n in there for w in words)]
    if not there:
        return f"Record temperatures of {', '.join(bodies)}."
    return f"In addition to {', '.join(there)}, record temperatures of {', '.join(more or ('other parts',))}."


def _slow(fit: Fit, noise: Whitener, number: int) -> tuple[float, float, Series]:
    """Root mean square of the slow part of a series, its memory in s, and the series; 0 where there is none.

    Args:
        fit: the residual is this fit's.
        noise: of that residual.
        number: of the series.
    """
    s, n = noise.readings.series[number], noise.noises[number]
    slow = n.sigma * math.sqrt(n.drift + n.offset)
    long = float(s.time_s[-1] - s.time_s[0]) >= RECORD_S and n.tau_s >= SLOW_S
    if not long or slow <= LARGE * n.sigma:
        return 0.0, n.tau_s, s
    # A drift of long memory may exceed the range that it had in this record.
    residual = without_runs(s, fit.left[s.part])
    return min(slow, float(np.sqrt(np.mean((residual - residual.mean()) ** 2)))), n.tau_s, s


def _temperature_varied(readings: Readings) -> bool:
    """Whether a recorded temperature changed."""
    machine = readings.machine
    there = [(n, s.channels[n]) for n in machine.sensor_names for s in readings.states if n in s.channels]
    return any(np.nanmax(v, initial=-np.inf) - np.nanmin(v, initial=np.inf) > real(machine, n) for n, v in there)

"""Records that begin while the machine is still warm: what a delayed effect remembers from before is not in them.

A body that lags behind its sensor is warmer than the sensor while this cools, and colder while it warms up. By how much
at the first reading is one unknown of each record and delayed effect, which fades with the effect's own delay.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rtec.arrays import Bools, Floats
from rtec.effects import State
from rtec.estimation import floor
from rtec.estimation.candidates import simple_effects
from rtec.estimation.changed_delay import AS_GOOD
from rtec.estimation.gls import solve
from rtec.estimation.judge import Judgement
from rtec.estimation.outliers import Clean
from rtec.estimation.readings import Readings
from rtec.model import FittedEffect, Model
from rtec.wording import duration, listed

TAKES = 0.5
"""Least share of a record's squared residual that the unknown starts take away."""
ABOVE_NOISE = 2.0
"""A record whose residual is below this many times its noise needs no start of its own."""
PART = 0.2
"""Starts whose part is below this share of the largest are not judged by their sign."""
SOON, FEWEST = 0.25, 3
"""How fast the sensor changes at first is seen in this part of a delay, and in so many rows at least."""
FARTHEST, RATES = 3.0, 10.0
"""Most that a body is away from its sensor at the first reading: in spans of the sensor within the record, and in what
the sensor would change in a delay at its first rate."""
START = "start "
"""So begin the names of the unknowns among those of the set-up."""
STEP = "Begin records while the machine rests, before spindle and axes run."
COOLS = 0.2
"""A sensor that falls by this share of its span in a delay, at its first rate, cools."""
COLDER_K = 1.0
"""A body is colder than the coldest sensor by no more, K."""


@dataclass(frozen=True)
class WarmStart:
    """A record that begins while the machine is warm: delayed effects of the model, and sensors that still change."""

    name: str
    late: tuple[FittedEffect, ...]
    sensors: tuple[str, ...]


def in_words(starts: Sequence[WarmStart], assumed: str) -> str:
    """What is assumed of records that begin warm."""
    late = list({id(f): f for s in starts for f in s.late}.values())
    sensors = listed(list(dict.fromkeys(n for s in starts for n in s.sensors)))
    effects = listed(list(dict.fromkeys(f"{f.effect.effect}({f.effect.component})" for f in late)))
    begin, it = ("begins", "it") if len(starts) == 1 else ("begin", "they")
    lag, state = ("lag by up to", "their states") if len(late) > 1 else ("lags by", "its state")
    longest = duration(max(f.theta["tau"] for f in late))
    return (
        f"{listed([s.name for s in starts])} {begin} while the machine is warm ({sensors}). {effects} {lag} {longest}; "
        f"{state} when {it} {begin} cannot be known from the temperatures, and {assumed}."
    )


class _Started(State):
    """The state with every delayed value one unit higher at the first instant than its undelayed one."""

    def lagged(self, value: object, tau_s: object) -> Floats:
        """As of the state, and a start that fades, (n,)."""
        fades = np.exp(-(self.time_s - self.time_s[0]) / float(np.asarray(tau_s)))
        return np.asarray(super().lagged(value, tau_s) + fades)


def with_starts(model: Model, given: Clean) -> Clean:
    """The same readings with unknown starts; unchanged where no record shows that it needs one."""
    judged = Judgement(model, given)
    readings = judged.readings
    late = [f for f in model.effects if _sensor(f) in readings.machine.sensor_names and "tau" in f.theta]
    if not late:
        return given
    out, columns = list[WarmStart](), list[Floats]()
    whole = np.stack([_start(judged, f) for f in late], axis=1)
    source = np.concatenate([np.full(len(s), s.source) for s in readings.series])
    for i in range(len(readings.measurements)):
        mine = np.where((source == i)[:, None], whole, 0.0)
        found = _found(judged, i, late, mine, source == i)
        if found is not None:
            out.append(found)
            columns.append(mine[:, np.abs(mine).max(axis=0) > 0.0])
    if not out:
        return given
    setup = np.hstack([readings.setup, *columns])
    names = tuple(f"{START}{k} of {w.name}" for w, c in zip(out, columns, strict=True) for k in range(c.shape[1]))
    opened = replace(readings, setup=setup, setup_names=(*readings.setup_names, *names))
    return replace(given, readings=opened, starts=in_words(out, "the residual is without what follows from that"))


def without_starts(readings: Readings) -> tuple[Readings, Floats]:
    """Readings without unknown starts, and the columns of these, (m, k)."""
    begun = np.array([n.startswith(START) for n in readings.setup_names], dtype=np.bool_)
    names = tuple(n for n, b in zip(readings.setup_names, begun, strict=True) if not b)
    return replace(readings, setup=readings.setup[:, ~begun], setup_names=names), readings.setup[:, begun]


def cooling(model: Model, readings: Readings) -> list[WarmStart]:
    """Records that begin while the sensor of a delayed effect cools."""
    begun = list[WarmStart]()
    for state, m in zip(readings.states, readings.measurements, strict=True):
        late = tuple(f for f in model.effects if "tau" in f.theta and _sensor(f) in state.channels)
        falls = {f.effect: _first_change(state, _sensor(f), f.theta["tau"]) for f in late}
        late = tuple(f for f in late if falls[f.effect] < -COOLS * float(np.ptp(state.channels[_sensor(f)])))
        if late:
            begun.append(WarmStart(m.name, late, tuple(dict.fromkeys(map(_sensor, late)))))
    return begun


def _sensor(fitted: FittedEffect) -> str:
    return str(getattr(fitted.effect, "sensor", ""))


def _start(judged: Judgement, fitted: FittedEffect) -> Floats:
    """What one kelvin at the start of every record adds to the prediction, (m,)."""
    readings = judged.readings
    started = readings.with_states([_Started(**{n: getattr(s, n) for n in _FIELDS}) for s in readings.states])
    more = started.columns(fitted.effect, fitted.theta) - readings.columns(fitted.effect, fitted.theta)
    values = [fitted.values[c.name] for c in fitted.effect.coefficients(readings.machine)]
    return np.asarray(more @ np.array(values))


_FIELDS = ("machine", "time_s", "channels", "reference_degc", "dead_band_mm", "at_rest")


def _found(judged: Judgement, number: int, late: Sequence[FittedEffect], mine: Floats, rows: Bools) -> WarmStart | None:
    """The start of one record, if it explains most of the residual there and no simple cause does as well."""
    readings, left = judged.readings, np.where(rows, judged.left, 0.0)
    columns = floor.cleaned(readings, mine)
    started = solve(columns, left)
    rest = left - columns @ started
    if float(rest @ rest) > (1.0 - TAKES) * float(left @ left) or float(left @ left) == 0.0:
        return None
    parts = np.sqrt(np.sum((columns * started) ** 2, axis=0))
    weighty = [k for k in range(len(late)) if parts[k] > PART * parts.max()]
    moving = [_still_moving(judged, number, late[k], float(started[k])) for k in weighty]
    if not all(moving):
        return None
    noise = [f.value for f, s in zip(judged.floors, readings.series, strict=True) if s.source == number]
    size = [float(np.sqrt(np.mean(left[s.part] ** 2))) for s in readings.series if s.source == number]
    if not any(one > ABOVE_NOISE * its for one, its in zip(size, noise, strict=True)):
        return None
    if any(_squares(left[rows], c[rows]) < AS_GOOD**2 * float(rest @ rest) for c in _simpler(judged)):
        return None
    sensors = tuple(dict.fromkeys(n for names in moving for n in names))
    taking_part = tuple(f for f, c in zip(late, mine.T, strict=True) if c.any())
    return WarmStart(readings.measurements[number].name, taking_part, sensors)


def _simpler(judged: Judgement) -> Iterator[Floats]:
    """What a start must explain better than: new numbers of the model's effects, or one new number."""
    yield floor.cleaned(judged.readings, judged.base.columns)
    for effect in simple_effects(judged.readings):
        yield judged.columns_of(effect)


def _squares(left: Floats, columns: Floats) -> float:
    """Sum of squares of a residual, (n,), with columns, (n, k), fitted to it."""
    rest = left - columns @ solve(columns, left)
    return float(rest @ rest)


def _still_moving(judged: Judgement, number: int, fitted: FittedEffect, start_k: float) -> tuple[str, ...]:
    """Sensors that change at first as they do while the effect's body is so much warmer than its own sensor.

    While they cool, the body is warmer; while they warm up, colder, but not than every other thing nearby.
    """
    state, own = judged.readings.states[number], _sensor(fitted)
    there = {n: state.channels[n] for n in judged.model.machine.sensor_names if n in state.channels}
    if own not in there or (start_k < 0.0 and there[own][0] + start_k < min(v[0] for v in there.values()) - COLDER_K):
        return ()
    tau = fitted.theta["tau"]
    out = []
    for name, degc in there.items():
        change = _first_change(state, name, tau)
        most = min(FARTHEST * float(np.ptp(degc)), RATES * abs(change))
        if start_k * change < 0.0 and abs(start_k) < most:
            out.append(name)
    return tuple(out)


def _first_change(state: State, sensor: str, tau_s: float) -> float:
    """What a sensor would change in a delay at its first rate, K."""
    time_s, degc = state.time_s - state.time_s[0], state.channels[sensor]
    soon = slice(max(int(np.searchsorted(time_s, SOON * tau_s)), FEWEST))
    since = time_s[soon] - time_s[soon].mean()
    return float(since @ degc[soon]) / max(float(since @ since), 1e-9) * tau_s

"""The record itself in doubt: what must be put right, or measured otherwise, before an effect is blamed.

Each doubt comes with the next step. Those that are `fatal` stand before every answer, and no effect is named beside a
contradiction.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis.wrong_scale import odd_scales
from rtec.errors import ModelError
from rtec.estimation import floor
from rtec.estimation.judge import Judgement
from rtec.estimation.readings import Readings, Series
from rtec.model import Model

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

Kind = Literal["wrong_scale", "wrong_channel", "contradiction", "corrected", "one_pass", "few_runs"]

TOGETHER = 0.98
"""Correlation of position and time from which on they are one."""
MOVES = 0.05
"""Share of the travel from which on an axis moves."""
COMMON, OPPOSITE = 5, -0.8
"""Places that two files share at the least, and the correlation of their means from which on they contradict."""
BETTER = 0.5
"""A factor in a channel is proposed where it leaves less than this share of the residual,"""
NEAR_FLOOR, ABOVE = 1.25, 3.0
"""and no more than so many times the noise; it is asked only where the model leaves more than so many times that."""
CHANNEL_FACTORS = (60.0, 1 / 60.0, 1000.0, 1e-3, 25.4, 1 / 25.4, 10.0, 0.1, 5.0, 0.2, 2.0, 0.5, -1.0)
FLAT, MUCH = 1.5, 5.0
"""Readings of less than so many times the noise are flat; a model that says more than so many times has much to say."""
FEW_RUNS = 4


@dataclass(frozen=True)
class Doubt:
    """A reason to doubt the record.

    Attributes:
        kind: which.
        message: in words.
        next_step: what to do.
        fatal: whether it stands before every answer.
    """

    kind: Kind
    message: str
    next_step: str
    fatal: bool = False

    @property
    def words(self) -> str:
        """Message and next step."""
        return f"{self.message} {self.next_step}".strip()


def doubts(judged: Judgement) -> tuple[Doubt, ...]:
    """All doubts about the readings of a model, those that stand before every answer first."""
    readings = judged.readings
    measured, predicted = (floor.cleaned(readings, v) for v in (readings.values, judged.base.predicted))
    found = [Doubt("wrong_scale", said, "", fatal=True) for said in odd_scales(readings, measured, predicted)]
    found = found or _contradictions(readings, measured)
    found += _corrected(judged, measured, predicted)
    if not found:
        found += _wrong_channels(judged)
    found += [*_one_pass(readings), *_few_runs(readings)]
    return tuple(found)


def _name(readings: Readings, s: Series) -> str:
    return f"{readings.measurements[s.source].name} {s.column}"


def _contradictions(readings: Readings, measured: Floats) -> list[Doubt]:
    """Files that read the same places with opposite signs."""
    out = []
    for one, two in itertools.combinations(readings.series, 2):
        same = one.column == two.column and readings.measurements[one.source].instrument.component == (
            readings.measurements[two.source].instrument.component
        )
        if one.source == two.source or not same:
            continue
        r = _agreement(readings, one, two, measured)
        if r is not None and r < OPPOSITE:
            out.append((one, two, r))
    if not out:
        return []
    # The file that contradicts most of the others is the odd one.
    count: dict[int, int] = {}
    for one, two, _ in out:
        for s in (one, two):
            count[s.source] = count.get(s.source, 0) + 1
    odd = max(count, key=lambda k: (count[k], k))
    others = sorted({s.source for one, two, _ in out for s in (one, two)} - {odd})
    names = ", ".join(readings.measurements[i].name for i in others)
    message = (
        f"{readings.measurements[odd].name} contradicts {names}: at the same places its readings go the other way "
        f"(correlation {min(r for _, _, r in out):.2f})."
    )
    step = (
        "Look at its sign, its set-up and whether it is of the same machine; without it or with it turned, try again."
    )
    return [Doubt("contradiction", message, step, fatal=True)]


def _agreement(readings: Readings, one: Series, two: Series, measured: Floats) -> float | None:
    """Correlation of what two series read at the places that they share; None where these are few."""
    means = [_means(readings, s, measured[s.part]) for s in (one, two)]
    common = sorted(set(means[0]) & set(means[1]))
    if len(common) < COMMON:
        return None
    a, b = (np.array([m[k] for k in common]) for m in means)
    a, b = a - a.mean(), b - b.mean()
    size = math.sqrt(float(a @ a) * float(b @ b))
    return float(a @ b) / size if size > 0.0 else None


def _means(readings: Readings, s: Series, values: Floats) -> Mapping[tuple[float, ...], float]:
    """Mean reading at each place, passed in each direction."""
    state = readings.states[s.source]
    pose = np.round(readings.poses_mm[s.source][s.row], 1)
    ways = [np.sign(state.value(a.direction_channel)[s.row]) for a in readings.machine.axes]
    rows, place = np.unique(np.column_stack([pose, *ways]), axis=0, return_inverse=True)
    mean = np.bincount(place.ravel(), values) / np.bincount(place.ravel())
    return {tuple(map(float, row)): float(v) for row, v in zip(rows, mean, strict=True)}


def _corrected(judged: Judgement, measured: Floats, predicted: Floats) -> list[Doubt]:
    """Series that are flat where the model says much: the loop was on while they were read."""
    out = []
    for s, noise in zip(judged.readings.series, judged.floors, strict=True):
        read, said = (float(np.sqrt(np.mean(v[s.part] ** 2))) for v in (measured, predicted))
        if read < FLAT * noise.value and said > MUCH * max(noise.value, read):
            message = (
                f"{_name(judged.readings, s)} is flat ({read:.2g} µm) where the model says {said:.2g} µm: was the "
                "correction on while it was measured?"
            )
            step = "Put the inserted corrections back into the readings, or measure with the correction held at zero."
            out.append(Doubt("corrected", message, step, fatal=True))
    return out


def _wrong_channels(judged: Judgement) -> list[Doubt]:
    """Channels that fit the model far better when they are multiplied with a factor that only a file can have."""
    model, readings = judged.model, judged.readings
    if judged.residual < ABOVE * judged.noise_floor:
        return []
    channels = {c for f in model.effects for c in f.effect.channels(model.machine)}
    best: tuple[float, str, float] | None = None
    for channel in sorted(channels - {"time_s"}):
        if channel.startswith("d_"):
            continue
        for factor in CHANNEL_FACTORS:
            left = _with_factor(model, readings, channel, factor)
            if left is not None:
                rms = judged.pooled(floor.cleaned(readings, left))
                if best is None or rms < best[0]:
                    best = rms, channel, factor
    if best is None or best[0] > min(BETTER * judged.residual, NEAR_FLOOR * judged.noise_floor):
        return []
    rms, channel, factor = best
    by = f"{factor:g}" if abs(factor) >= 1.0 else f"1/{1.0 / factor:g}"
    message = (
        f"with {channel} times {by} the model leaves {rms:.2g} instead of {judged.residual:.2g}: its unit or its scale "
        "in the file may be wrong."
    )
    return [Doubt("wrong_channel", message, "Check that column before a new effect is blamed.", fatal=True)]


def _with_factor(model: Model, readings: Readings, channel: str, factor: float) -> Floats | None:
    """Residual with one channel times a factor, (m,); None where no state holds it."""
    states = []
    for state in readings.states:
        channels = dict(state.channels)
        if channel not in channels:
            return None
        channels[channel] = factor * channels[channel]
        states.append(type(state)(state.machine, state.time_s, channels, state.reference_degc))
    changed = replace(readings, states=tuple(states), _arms={})
    out = readings.values.copy()
    try:
        with np.errstate(all="ignore"):
            for f in model.effects:
                columns = changed.columns(f.effect, f.theta)
                out -= columns @ np.array([f.values[p.name] for p in f.effect.coefficients(readings.machine)])
    except ModelError:
        return None
    return out if np.isfinite(out).all() else None


def _one_pass(readings: Readings) -> list[Doubt]:
    """Axes whose position rises with time from beginning to end of all that sees them."""
    out = []
    for axis in readings.machine.axes:
        passes = [_pass(readings, s, axis.channel, axis.travel_mm) for s in readings.series]
        moving = [p for p in passes if p is not None]
        files = {readings.series[i].source for i, p in enumerate(passes) if p is not None}
        if len(files) == 1 and min(abs(r) for r in moving) > TOGETHER:
            message = (
                f"{axis.name} went through once, in one direction: position and time are one in this record, so an "
                f"error along {axis.name}, a drift and a reversal cannot be distinguished."
            )
            out.append(Doubt("one_pass", message, "Measure there and back, at least twice."))
    return out


def _pass(readings: Readings, s: Series, channel: str, travel_mm: Sequence[float]) -> float | None:
    """Correlation of position and time; None where the axis hardly moves."""
    place = readings.states[s.source].value(channel)[s.row]
    if float(np.ptp(place)) < MOVES * (travel_mm[1] - travel_mm[0]) or len(place) < COMMON:
        return None
    if not np.ptp(s.time_s):
        return None
    return float(np.corrcoef(place, s.time_s)[0, 1])


def _few_runs(readings: Readings) -> list[Doubt]:
    """Files that are read in runs, of which there are too few to hold any out."""
    out = []
    for s in readings.series:
        runs = int(s.run[-1]) + 1
        if 1 < runs < FEW_RUNS and s.nuisance.shape[1]:
            message = f"{_name(readings, s)} has {runs} runs, each with a zero of its own: too few to separate them."
            out.append(Doubt("few_runs", message, f"Measure at least {FEW_RUNS} runs."))
    return out

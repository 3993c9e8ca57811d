"""The noise floor: the residual that noise alone would give. And root mean squares of residuals.

The floor comes from repeats where there are enough of them, else from a fitted noise model.

Repeats are readings of other runs at the same pose, in the same direction, at the same speeds and load, at nearly the
same temperatures; also of other files by the same instrument in the same set-up. Their differences are noise, whatever
the model is. What the model predicts of the small changes of temperature between them is subtracted.

The fitted noise model is white noise, drift and an offset of each run, estimated by restricted maximum likelihood.
So that drift does not absorb what the model misses, every smooth function of position, direction, speeds, load and
temperatures is projected out first.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.estimation.flexible import NEAR_DEGC, flexible_columns
from rtec.estimation.gls import solve, without_nuisance
from rtec.estimation.noise import Noise, Whitener, noise_on_stretches
from rtec.estimation.readings import Readings, Series, row_codes
from rtec.estimation.visible import same_place_mm
from rtec.estimation.whitening import drift_draws
from rtec.jit import njit

SAME_RPM = 1.0
FEWEST = 20
"""Degrees of freedom ("differences between repeats") below which repeats do not determine the floor."""
CHANGED = 1.5
"""Something changed between repeats that scatter by this factor more than neighbours: noise alone makes less."""
SHARE = 0.1
"""At least this share of the readings must have a repeat."""
SMALL = 1e-12


def repeats_floor(readings: Readings, series: Sequence[Series], left: Floats) -> float | None:
    """Root mean square of the noise from repeats; None where there are too few.

    Args:
        readings: that the series belong to.
        series: one reading column, or those of several files by one instrument in one set-up.
        left: residuals of all readings, nuisances projected out, (m,).
    """
    run = np.concatenate([readings.run[s.part] for s in series])
    if run[0] == run[-1]:
        return None
    values, warm = np.concatenate([left[s.part] for s in series]), _temperatures(readings, series)
    if warm is None:
        return None
    pose = _pose_codes(readings, series)
    square, freedom, held = group_differences(np.argsort(pose, kind="stable"), pose, run, warm, values)
    if freedom < FEWEST or held < SHARE * len(run):
        return None
    return math.sqrt(square / (freedom * _kept(series)))


def _kept(series: Sequence[Series]) -> float:
    """Share of the noise that remains when the unknowns of each run (zero, slope) are fitted."""
    unknown = [np.minimum(np.bincount(s.run), s.nuisance.shape[1]).sum() for s in series]
    return max(1.0 - float(sum(unknown)) / sum(map(len, series)), SMALL)


@njit
def group_differences(order: Ints, pose: Ints, run: Ints, warm: Floats, values: Floats) -> tuple[float, int, int]:
    """Sum of squares of readings about the mean of their group, its degrees of freedom, and the number of readings.

    A group has readings at one pose, in order of time, while temperatures stay near; one of each run.

    Args:
        order: readings pose by pose, in order of time, (n,).
        pose, run, values: of each reading, (n,).
        warm: its temperatures, (n, sensors).
    """
    n = len(order)
    mine = np.empty(n)
    square, freedom, held, count = 0.0, 0, 0, 0
    first, last = 0, 0
    for k in range(n + 1):
        near = 0 < k < n and pose[order[k]] == pose[first]
        if near:
            for j in range(warm.shape[1]):
                near = near and abs(warm[order[k], j] - warm[first, j]) < NEAR_DEGC
        if near:
            if run[order[k]] != run[last]:
                last = order[k]
                mine[count] = values[last]
                count += 1
            continue
        if count > 1:
            square += np.sum((mine[:count] - np.mean(mine[:count])) ** 2)
            freedom += count - 1
            held += count
        if k < n:
            first = last = order[k]
            mine[0] = values[first]
            count = 1
    return square, freedom, held


def _pose_codes(readings: Readings, series: Sequence[Series]) -> Ints:
    """A number for each pose with direction, speeds and load, (n,); an unrecorded channel counts as zero."""
    axes = readings.machine.axes
    steps = {a.velocity_channel: 1.0 for a in axes} | {"spindle_rpm": SAME_RPM, "load_kg": 0.1, "feed_mm_min": 1.0}
    rows = []
    for s in series:
        state = readings.states[s.source]
        keys = [*np.round(readings.poses_mm[s.source][s.row] / same_place_mm(readings.measurements[s.source])).T]
        keys += [np.sign(state.value(a.direction_channel)[s.row]) for a in axes]
        for name, step in steps.items():
            value = state.channels[name][s.row] if name in state.channels else np.zeros(len(s))
            keys.append(np.round(np.nan_to_num(value) / step))
        rows.append(np.stack(keys))
    return row_codes(np.concatenate(rows, axis=1))


def _temperatures(readings: Readings, series: Sequence[Series]) -> Floats | None:
    """Temperatures, (n, sensors); a missing one counts as unchanged in its file.

    None for files without a common temperature: it may have changed between two days.
    """
    states = [readings.states[s.source] for s in series]
    names = [t for t in readings.machine.sensor_names if all(t in state.channels for state in states)]
    if len(states) > 1 and readings.machine.sensor_names and not names:
        return None
    columns = [
        np.concatenate([np.nan_to_num(state.channels[t][s.row]) for state, s in zip(states, series, strict=True)])
        for t in names
    ]
    return np.stack(columns, axis=1) if columns else np.zeros((sum(len(s) for s in series), 0))


def draws(whitener: Whitener, tails: Floats, count: int, rng: np.random.Generator) -> Floats:
    """Random draws of noise for all readings, nuisances projected out, (m, count).

    Args:
        whitener: the noise of each series.
        tails: degrees of freedom of Student's t for the white part of each series; infinite for a normal one.
        count: number of draws.
        rng: random numbers.
    """
    readings = whitener.readings
    parts = [_of(s, n, t, count, rng) for s, n, t in zip(readings.series, whitener.noises, tails, strict=True)]
    return flattened(readings, np.concatenate(parts))


def _of(series: Series, noise: Noise, tail: float, count: int, rng: np.random.Generator) -> Floats:
    drift = rng.standard_normal((len(series), count))
    drift_draws(series.time_s, noise.tau_s, drift)
    offset = rng.standard_normal((int(series.run[-1]) + 1, count))[series.run]
    white = rng.standard_normal((len(series), count))
    if math.isfinite(tail):
        white *= np.sqrt((tail - 2.0) / rng.chisquare(tail, (len(series), count)))
    return np.asarray(noise.sigma * (white + math.sqrt(noise.drift) * drift + math.sqrt(noise.offset) * offset))


def tails_of(whitener: Whitener, left: Floats) -> Floats:
    """Degrees of freedom of Student's t with the kurtosis of the whitened readings, (series,); infinite if normal."""
    white = whitener(left)
    out = []
    for s in whitener.readings.series:
        w = white[s.part]
        w = w - w.mean()
        excess = float(np.mean(w**4)) / max(float(np.mean(w**2)) ** 2, SMALL) - 3.0
        # The kurtosis of n normal numbers scatters by sqrt(24 / n); an excess below twice that does not count.
        out.append(4.0 + 6.0 / excess if excess > 2.0 * math.sqrt(24.0 / len(w)) else math.inf)
    return np.asarray(np.maximum(np.array(out), 4.5))


def flattened(readings: Readings, columns: Floats) -> Floats:
    """Columns less what the instruments cannot know: terms of each run and of the set-up, (m, p) or (m,).

    Each term is removed by its own least squares, so that the result is linear in the columns.
    """
    flat: Floats = without_nuisance(readings, columns)
    if not readings.setup.shape[1]:
        return flat
    setup = without_nuisance(readings, readings.setup)
    u, s, _ = np.linalg.svd(setup, full_matrices=False)
    seen = u[:, s > 1e-9 * max(float(s[0]), SMALL)]
    return np.asarray(flat - seen @ (seen.T @ flat))


Unit = Literal["um", "urad", "noise"]
FloorFrom = Literal["repeats", "short-time differences"]
DRAWS = 24


def unit_of(readings: Readings) -> Unit:
    """Unit for all readings together: µm, µrad, or multiples of the noise where there are both."""
    units = {s.unit for s in readings.series}
    if len(units) > 1:
        return "noise"
    return "um" if units == {"um"} else "urad"


def floors(whitener: Whitener, seed: int = 1) -> Floats:
    """Root mean square that noise alone gives each series once the nuisances of each run are fitted, (series,).

    From random draws: drift within a run remains, drift between runs is fitted by their zeros.
    """
    readings = whitener.readings
    rng = np.random.default_rng([seed, 77])
    total = np.zeros(len(readings.series))
    drawn = [_draws(whitener, i, rng) for i in range(len(readings.series))]
    for k in range(DRAWS):
        left = without_nuisance(readings, np.concatenate([d[:, k] for d in drawn]))
        total += [float(np.mean(left[s.part] ** 2)) for s in readings.series]
    return np.sqrt(total / DRAWS)


@dataclass(frozen=True)
class Floor:
    """The noise of one series.

    Attributes:
        value: root mean square of the part that does not repeat, in the unit of the series.
        source: what the value was estimated from.
        drift: root mean square of the slow drift that no recorded channel explains; no part of `value`.
        repeats: from repeats; None where there are too few, or where something changed slowly between them.
        fitted: the fitted noise model with its drift.
    """

    value: float
    source: FloorFrom
    drift: float
    repeats: float | None
    fitted: float


def flexible_noise(readings: Readings, columns: Floats) -> Whitener:
    """Noise fitted together with every smooth function of the channels.

    Args:
        readings: the readings.
        columns: of the model and the set-up, (m, p).
    """
    return noise_on_stretches(readings, lambda few, keep: flexible_columns(few, columns[keep]))


def noise_floors(readings: Readings, left: Floats, flexible: Whitener) -> list[Floor]:
    """The floor of each series: from repeats where there are enough and nothing changed between them, else neighbours.

    Drift is slow compared with the readings, and so is what a model misses: neither counts as noise of a reading. A
    slow change that follows no recorded channel is reported separately.

    Args:
        readings: the readings.
        left: residual of the model, nuisances projected out, (m,).
        flexible: from `flexible_noise`.
    """
    rms = rms_by_series(readings, left)
    out, across = [], _across_files(readings, left)
    for s, n, whole, most, other in zip(readings.series, flexible.noises, floors(flexible), rms, across, strict=True):
        # Noise is never more than the residual.
        quick = min(_quick(s, n), float(most))
        repeated = repeats_floor(readings, [s], left)
        if repeated is None and other is not None and other < quick:
            repeated = other
        if repeated is not None and repeated > CHANGED * quick:
            repeated = None  # a slow change from one visit to the next is drift
        fitted = min(float(whole), float(most))
        drift = math.sqrt(max(fitted**2 - quick**2, 0.0))
        source: FloorFrom = "short-time differences" if repeated is None else "repeats"
        value = quick if repeated is None else repeated
        out.append(Floor(value, source, drift, repeated, fitted))
    return out


def _across_files(readings: Readings, left: Floats) -> list[float | None]:
    """Noise of each series from repeats in other files; None where there are too few.

    It may lower the floor, never raise it: files that differ by more than their readings scatter contradict each other,
    or something changed between them, and that is no noise.
    """
    known: dict[int, float | None] = {}
    out = []
    for s in readings.series:
        made_by = readings.measurements[s.source].instrument
        same = [
            x for x in readings.series if x.column == s.column and readings.measurements[x.source].instrument == made_by
        ]
        first = same[0].start
        if first not in known:
            known[first] = repeats_floor(readings, same, left) if len(same) > 1 else None
        out.append(known[first])
    return out


def _quick(series: Series, noise: Noise) -> float:
    """Difference of neighbouring readings over √2: the white noise, and the drift from one reading to the next."""
    inside = np.diff(series.time_s)[np.diff(series.run) == 0]
    apart = float(np.median(inside)) if len(inside) else 0.0
    return noise.sigma * math.sqrt(1.0 + noise.drift * -math.expm1(-apart / noise.tau_s))


def _draws(whitener: Whitener, number: int, rng: np.random.Generator) -> Floats:
    series, noise = whitener.readings.series[number], whitener.noises[number]
    steps = rng.standard_normal((len(series), DRAWS))
    drift_draws(series.time_s, noise.tau_s, steps)
    offset = rng.standard_normal((int(series.run[-1]) + 1, DRAWS))[series.run] * math.sqrt(noise.offset)
    white = rng.standard_normal((len(series), DRAWS))
    return np.asarray(noise.sigma * (white + math.sqrt(noise.drift) * steps + offset))


def cleaned(readings: Readings, left: Floats) -> Floats:
    """Residuals less what the instruments cannot know: terms of the set-up, then those of each run, (m,) or (m, p)."""
    if readings.setup.shape[1]:
        setup = np.stack([without_nuisance(readings, c) for c in readings.setup.T], axis=1)
        flat = without_nuisance(readings, left)
        return np.asarray(flat - setup @ solve(setup, flat))
    return without_nuisance(readings, left)


def rms_by_series(readings: Readings, left: Floats) -> Floats:
    """Root mean square of each series, (series,)."""
    return np.array([float(np.sqrt(np.mean(left[s.part] ** 2))) for s in readings.series])


def pooled(readings: Readings, by_series: Floats, scale: Floats) -> float:
    """Root mean square of all readings from that of each series, each multiplied by its scale."""
    sizes = np.array([len(s) for s in readings.series], dtype=np.float64)
    return float(np.sqrt(np.average((by_series * scale) ** 2, weights=sizes)))

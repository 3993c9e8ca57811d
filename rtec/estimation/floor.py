"""What noise alone would leave of the readings, and what a model leaves of them.

The noise floor: from repeats where there are enough of them, else from a fitted noise model.

Repeats are readings of other runs at the same pose, in the same direction, at the same speeds and load, at nearly the
same temperatures. What they differ by is noise, whatever the model is; what the model predicts of the small changes of
temperature between them is taken out.

The fitted noise model is white noise, drift and an offset of each run, found by restricted maximum likelihood. So
that what the model misses is not taken for drift, everything that goes smoothly with position, direction, speeds,
load and temperatures is projected out first.

Columns that follow anything smooth in the recorded channels: what they can reach is not counted as noise.
"""

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rtec.estimation.gls import solve, without_nuisance
from rtec.estimation.noise import Noise, Whitener, find_noise
from rtec.estimation.outliers import without_runs
from rtec.estimation.readings import Readings, Series
from rtec.estimation.whitening import drift_draws

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

NEAR_DEGC = 0.3
"""Temperatures that differ by less than this from those of the first of a group count as the same."""
SAME_MM = 0.02
SAME_RPM = 1.0
FEWEST = 20
"""Differences between repeats below which they do not decide the floor, "degrees of freedom"."""
SHARE = 0.1
"""And at least this share of the readings must have a repeat."""
SMALL = 1e-12


def repeats_floor(readings: Readings, series: Series, left: Floats) -> float | None:
    """Root mean square of the noise from repeats; None where there are too few.

    Args:
        readings: that the series belongs to.
        series: reading column.
        left: its residuals, nuisances taken out, (n,).
    """
    if series.run[-1] == 0:
        return None
    pose, warm = _pose_codes(readings, series), _temperatures(readings, series)
    square, freedom, held = 0.0, 0, 0
    order = np.lexsort((np.arange(len(series)), pose))
    for place in np.split(order, np.flatnonzero(np.diff(pose[order])) + 1):
        for group in _groups(place, series.run, warm):
            off = left[group] - left[group].mean()
            square, freedom, held = square + float(off @ off), freedom + len(group) - 1, held + len(group)
    if freedom < FEWEST or held < SHARE * len(series):
        return None
    return math.sqrt(square / freedom)


def _groups(place: Ints, run: Ints, warm: Floats) -> list[Ints]:
    """Readings at one pose, in order of time, put together while temperatures stay near; one of each run."""
    out: list[list[int]] = []
    for i in place.tolist():
        if out and np.abs(warm[i] - warm[out[-1][0]]).max(initial=0.0) < NEAR_DEGC:
            if run[i] != run[out[-1][-1]]:
                out[-1].append(i)
        else:
            out.append([i])
    return [np.array(g) for g in out if len(g) > 1]


def _pose_codes(readings: Readings, series: Series) -> Ints:
    """A number for each pose with direction, speeds and load, (n,)."""
    state = readings.states[series.source]
    keys = [np.round(readings.poses_mm[series.source][series.row] / SAME_MM)]
    for axis in readings.machine.axes:
        keys.append(np.sign(state.value(axis.direction_channel)[series.row])[:, None])
        if axis.velocity_channel in state.channels:
            keys.append(np.round(state.channels[axis.velocity_channel][series.row])[:, None])
    for name, step in (("spindle_rpm", SAME_RPM), ("load_kg", 0.1), ("feed_mm_min", 1.0)):
        if name in state.channels:
            keys.append(np.round(np.nan_to_num(state.channels[name][series.row]) / step)[:, None])
    return np.asarray(np.unique(np.concatenate(keys, axis=1), axis=0, return_inverse=True)[1].ravel(), dtype=np.int64)


def _temperatures(readings: Readings, series: Series) -> Floats:
    """Temperatures, (n, sensors); a missing one counts as unchanged."""
    state = readings.states[series.source]
    names = [s for s in readings.machine.sensor_names if s in state.channels]
    columns = [np.nan_to_num(state.channels[s][series.row]) for s in names]
    return np.stack(columns, axis=1) if columns else np.zeros((len(series), 0))


def draws(whitener: Whitener, tails: Floats, count: int, rng: np.random.Generator) -> Floats:
    """Draw noise for all readings, nuisances taken out, (m, count).

    Args:
        whitener: the noise of each series.
        tails: degrees of freedom of Student's t for the white part of each series; infinite for a normal one.
        count: how many.
        rng: where from.
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
    """How heavy the tails are: degrees of freedom of a Student's t with the kurtosis of the whitened readings."""
    white = whitener(left)
    out = []
    for s in whitener.readings.series:
        w = white[s.part]
        w = w - w.mean()
        excess = float(np.mean(w**4)) / max(float(np.mean(w**2)) ** 2, SMALL) - 3.0
        # The kurtosis of n normal numbers scatters by sqrt(24 / n); less than twice that is none.
        out.append(4.0 + 6.0 / excess if excess > 2.0 * math.sqrt(24.0 / len(w)) else math.inf)
    return np.asarray(np.maximum(np.array(out), 4.5))


def flattened(readings: Readings, columns: Floats) -> Floats:
    """Columns less what the instruments cannot know: terms of each run and of the set-up, (m, p) or (m,).

    The terms go one at a time by least squares, so that the result is linear in the columns.
    """
    flat: Floats = without_nuisance(readings, columns)
    if not readings.setup.shape[1]:
        return flat
    setup = without_nuisance(readings, readings.setup)
    u, s, _ = np.linalg.svd(setup, full_matrices=False)
    seen = u[:, s > 1e-9 * max(float(s[0]), SMALL)]
    return np.asarray(flat - seen @ (seen.T @ flat))


KNOTS, WARM_KNOTS = 9, 4
FEW_VALUES = 9
REAL_DEGC = 0.5
"""A sensor that varies by less has nothing to say."""
MOST_WARM, SMALL_PART = 40, 1e-10
"""Columns of temperatures; the strongest directions of all that were made."""
READINGS_PER_COLUMN, STATES_PER_COLUMN = 8, 3
"""Temperatures that differ by less are one state of the machine."""


def flexible_columns(readings: Readings, base: Floats) -> Floats:
    """Columns of the model and of the set-up, (m, q), and those that follow anything smooth in the channels, (m, p).

    Each series has coefficients of its own, so that those of different series stand in the same columns.
    """
    columns = [smooth_columns(readings, s) for s in readings.series]
    width = max(c.shape[1] for c in columns)
    padded = [np.pad(c, ((0, 0), (0, width - c.shape[1]))) for c in columns]
    return np.concatenate([base, np.concatenate(padded)], axis=1)


def smooth_columns(readings: Readings, series: Series) -> Floats:
    """Hat functions of positions by direction, of speeds and load; of temperatures, also times positions, (n, p)."""
    state, rows = readings.states[series.source], series.row
    room = max(len(series) // READINGS_PER_COLUMN, 1)
    parts: list[Floats] = []
    moving: list[Floats] = []
    for axis in readings.machine.axes:
        place = state.value(axis.channel)[rows]
        if np.ptp(place) <= 0.01 * (axis.travel_mm[1] - axis.travel_mm[0]):
            continue
        moving.append((place - place.mean()) / np.ptp(place))
        direction = np.sign(state.value(axis.direction_channel)[rows])
        hats = _hats(place, KNOTS)
        parts += [hats * (direction == d)[:, None] for d in np.unique(direction)]
    for name in ("spindle_rpm", "load_kg", "feed_mm_min", *(a.velocity_channel for a in readings.machine.axes)):
        if name in state.channels and np.isfinite(state.channels[name][rows]).all():
            parts.append(_hats(state.channels[name][rows], WARM_KNOTS))
    plain = np.concatenate(parts, axis=1) if parts else np.zeros((len(series), 0))
    warm = _warm(readings, series, moving)
    return np.concatenate([plain, warm[:, : max(room - plain.shape[1], 0)]], axis=1)[:, :room]


def _warm(readings: Readings, series: Series, moving: list[Floats]) -> Floats:
    state, rows = readings.states[series.source], series.row
    columns: list[Floats] = []
    found: list[Floats] = []
    for sensor in readings.machine.sensor_names:
        value = state.channels.get(sensor)
        if value is None or not np.isfinite(value[rows]).all() or np.ptp(value[rows]) < REAL_DEGC:
            continue
        found.append(value[rows])
        hats = _hats(value[rows], WARM_KNOTS)
        columns += [hats, *(hats * m[:, None] for m in moving)]
    if not columns:
        return np.zeros((len(series), 0))
    # What goes with the zero of each run anyway must not take the place of what is seen.
    seen = without_runs(series, np.concatenate(columns, axis=1))
    size, turn = np.linalg.eigh(seen.T @ seen)
    most = min(MOST_WARM, _states(np.stack(found, axis=1)) // STATES_PER_COLUMN)
    kept = size[::-1][:most] > SMALL_PART * size[-1]
    return np.asarray(seen @ turn[:, ::-1][:, :most][:, kept])


def _states(degc: Floats) -> int:
    """How many states of temperature were gone through, one after the other; (n, sensors).

    Not readings but these are what a dependence on temperature is judged by: more columns than a part of them would
    follow the drift of the noise.
    """
    count, first = 1, degc[0]
    for now in degc:
        if np.abs(now - first).max() > NEAR_DEGC:
            count, first = count + 1, now
    return count


def _hats(value: Floats, knots: int) -> Floats:
    """Hat functions on evenly spaced knots, or one column for each of a few values, (n, k)."""
    levels = np.unique(value)
    if len(levels) == 1:
        return np.zeros((len(value), 0))
    if len(levels) <= FEW_VALUES:
        return np.asarray(value[:, None] == levels[None, :], dtype=np.float64)
    place = (value - levels[0]) / (levels[-1] - levels[0]) * (knots - 1)
    return np.asarray(np.clip(1.0 - np.abs(place[:, None] - np.arange(knots)[None, :]), 0.0, None))


Unit = Literal["um", "urad", "noise"]
DRAWS = 24


def unit_of(readings: Readings) -> Unit:
    """Unit in which all readings can be told: µm, µrad, or multiples of the noise where there are both."""
    units = {s.unit for s in readings.series}
    if len(units) > 1:
        return "noise"
    return "um" if units == {"um"} else "urad"


def floors(whitener: Whitener, seed: int = 1) -> Floats:
    """Root mean square that noise alone leaves of each series once the nuisances of each run are taken out.

    Drawn: the drift within a run is left, that between runs goes with their zeros.
    """
    readings = whitener.readings
    rng = np.random.default_rng([seed, 77])
    total = np.zeros(len(readings.series))
    drawn = [_draws(whitener, i, rng) for i in range(len(readings.series))]
    for k in range(DRAWS):
        left = without_nuisance(readings, np.concatenate([d[:, k] for d in drawn]))
        total += [float(np.mean(left[s.part] ** 2)) for s in readings.series]
    return np.sqrt(total / DRAWS)


def as_compared(readings: Readings, left: Floats, columns: Floats) -> tuple[Floats, tuple[str, ...]]:
    """The floor of each series as `rtec compare` has it, and where it comes from: repeats where there are enough.

    A noise fitted along with a wrong model holds a part of what the model misses; what differs between repeats does
    not.

    Args:
        readings: the readings.
        left: what the model leaves of them, nuisances taken out, (m,).
        columns: of the model and the set-up, (m, p).

    Returns:
        Root mean square, (series,), and "repeats" or "fitted noise model" for each.
    """
    repeated = [repeats_floor(readings, s, left[s.part]) for s in readings.series]
    if None in repeated:
        # Noise is never more than what is left.
        fitted = np.minimum(
            floors(find_noise(readings, flexible_columns(readings, columns))), rms_by_series(readings, left)
        )
    else:
        fitted = np.zeros(len(repeated))
    values = np.array([f if r is None else r for r, f in zip(repeated, fitted, strict=True)])
    return values, tuple("fitted noise model" if r is None else "repeats" for r in repeated)


def _draws(whitener: Whitener, number: int, rng: np.random.Generator) -> Floats:
    series, noise = whitener.readings.series[number], whitener.noises[number]
    steps = rng.standard_normal((len(series), DRAWS))
    drift_draws(series.time_s, noise.tau_s, steps)
    offset = rng.standard_normal((int(series.run[-1]) + 1, DRAWS))[series.run] * math.sqrt(noise.offset)
    white = rng.standard_normal((len(series), DRAWS))
    return np.asarray(noise.sigma * (white + math.sqrt(noise.drift) * steps + offset))


def cleaned(readings: Readings, left: Floats) -> Floats:
    """Residuals less what the instruments cannot know: terms of the set-up, then those of each run, (m,)."""
    if readings.setup.shape[1]:
        setup = np.stack([without_nuisance(readings, c) for c in readings.setup.T], axis=1)
        flat = without_nuisance(readings, left)
        return np.asarray(flat - setup @ solve(setup, flat))
    return without_nuisance(readings, left)


def rms_by_series(readings: Readings, left: Floats) -> Floats:
    """Root mean square of each series, (series,)."""
    return np.array([float(np.sqrt(np.mean(left[s.part] ** 2))) for s in readings.series])


def pooled(readings: Readings, by_series: Floats, scale: Floats) -> float:
    """Root mean square of all readings from that of each series; each times its scale."""
    sizes = np.array([len(s) for s in readings.series], dtype=np.float64)
    return float(np.sqrt(np.average((by_series * scale) ** 2, weights=sizes)))

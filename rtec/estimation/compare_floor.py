"""The noise floor: from repeats where there are enough of them, else from a fitted noise model.

Repeats are readings of other runs at the same pose, in the same direction, at the same speeds and load, at nearly the
same temperatures. What they differ by is noise, whatever the model is; what the model predicts of the small changes of
temperature between them is taken out.

The fitted noise model is white noise, drift and an offset of each run, found by restricted maximum likelihood. So
that what the model misses is not taken for drift, everything that goes smoothly with position, direction, speeds,
load and temperatures is projected out first.
"""

import math

import numpy as np
from numpy.typing import NDArray

from rtec.estimation.gls import without_nuisance
from rtec.estimation.noise import Noise, Whitener
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

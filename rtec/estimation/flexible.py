"""Columns that follow anything smooth in the recorded channels: what they can reach is not counted as noise."""

import numpy as np
from numpy.typing import NDArray

from rtec.estimation.gls import solve, without_runs
from rtec.estimation.readings import Readings, Series

Floats = NDArray[np.float64]

NEAR_DEGC = 0.3
"""Temperatures that differ by less than this from those of the first of a group count as the same."""
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


def less(readings: Readings, columns: Floats, values: Floats) -> Floats:
    """Values less what the columns explain of them by least squares, series by series, (m,).

    Args:
        readings: of all series.
        columns: (m, p).
        values: (m,).
    """
    out = values.copy()
    for s in readings.series:
        mine = without_runs(s, columns[s.part])
        out[s.part] -= mine @ solve(mine, values[s.part])
    return out

"""Columns that follow any smooth function of the recorded channels: what they can explain does not count as noise."""

import numpy as np

from rtec.arrays import Floats
from rtec.estimation.gls import solve, without_runs
from rtec.estimation.readings import Readings, Series
from rtec.estimation.visible import moves
from rtec.jit import njit

NEAR_DEGC = 0.3
"""Temperatures that differ by less than this from those of the first of a group count as equal."""
KNOTS, WARM_KNOTS = (9, 5, 3, 2), 4
FEW_VALUES = 9
REAL_DEGC = 0.5
"""A sensor that varies by less gives no information."""
MOST_WARM, SMALL_PART = 40, 1e-10
"""Number of columns of temperatures; the strongest directions of all."""
READINGS_PER_PLACE, READINGS_PER_COLUMN, STATES_PER_COLUMN = 4, 8, 3
"""Temperatures that differ by less are one state of the machine."""


def flexible_columns(readings: Readings, base: Floats, warm: bool = True) -> Floats:
    """Columns of the model and the set-up, (m, q), and those that follow any smooth function of the channels, (m, p).

    Each series has its own coefficients, so all series share the columns of the array.

    Args:
        readings: the readings.
        base: columns of the model and of the set-up, (m, q).
        warm: also functions of temperatures.
    """
    columns = [smooth_columns(readings, s, warm) for s in readings.series]
    width = max(c.shape[1] for c in columns)
    padded = [np.pad(c, ((0, 0), (0, width - c.shape[1]))) for c in columns]
    return np.concatenate([base, np.concatenate(padded)], axis=1)


def smooth_columns(readings: Readings, series: Series, warm: bool = True) -> Floats:
    """Hat functions of positions by direction, of speeds and load; of temperatures, also times positions, (n, p).

    Args:
        readings: the readings.
        series: one of these.
        warm: also functions of temperatures.
    """
    state, rows = readings.states[series.source], series.row
    moving = []
    for axis in readings.machine.axes:
        place = state.value(axis.channel)[rows]
        if moves(readings.measurements[series.source], axis, rows):
            moving.append((place, np.sign(state.value(axis.direction_channel)[rows])))
    names = ("spindle_rpm", "load_kg", "feed_mm_min", *(a.velocity_channel for a in readings.machine.axes))
    speeds = [state.channels[n][rows] for n in names if n in state.channels]
    most = max(len(series) // READINGS_PER_PLACE, 1)
    # Fewer knots where there are few readings, equal in both directions.
    plain = np.zeros((len(series), 0))
    for knots in KNOTS:
        few = FEW_VALUES if knots == KNOTS[0] else knots
        parts = [_hats(p, knots, few) * (d == way)[:, None] for p, d in moving for way in np.unique(d)]
        parts += [_hats(v, min(knots, WARM_KNOTS), few) for v in speeds if np.isfinite(v).all()]
        plain = np.concatenate([plain[:, :0], *parts], axis=1)
        if plain.shape[1] <= most:
            break
    if not warm:
        return np.asarray(plain[:, :most])
    thermal = _warm(readings, series, [(p - p.mean()) / np.ptp(p) for p, _ in moving])
    room = max(len(series) // READINGS_PER_COLUMN - plain.shape[1], 0)
    return np.concatenate([plain[:, :most], thermal[:, :room]], axis=1)


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
    # A temperature that the zero of each run absorbs must not replace one that the readings see.
    seen = without_runs(series, np.concatenate(columns, axis=1))
    size, turn = np.linalg.eigh(seen.T @ seen)
    most = min(MOST_WARM, _states(np.stack(found, axis=1)) // STATES_PER_COLUMN)
    kept = size[::-1][:most] > SMALL_PART * size[-1]
    return np.asarray(seen @ turn[:, ::-1][:, :most][:, kept])


@njit
def _states(degc: Floats) -> int:
    """Number of successive temperature states; `degc` is (n, sensors).

    They, not the readings, determine a dependence on temperature: more columns than a part of their number would follow
    the drift of the noise.
    """
    count, first = 1, 0
    for i in range(len(degc)):
        for j in range(degc.shape[1]):
            if abs(degc[i, j] - degc[first, j]) > NEAR_DEGC:
                count, first = count + 1, i
                break
    return count


def _hats(value: Floats, knots: int, few: int = FEW_VALUES) -> Floats:
    """Hat functions on evenly spaced knots, or one column for each of at most `few` values, (n, k)."""
    levels = np.unique(value)
    if len(levels) == 1:
        return np.zeros((len(value), 0))
    if len(levels) <= few:
        return np.asarray(value[:, None] == levels[None, :], dtype=np.float64)
    place = (value - levels[0]) / (levels[-1] - levels[0]) * (knots - 1)
    return np.asarray(np.clip(1.0 - np.abs(place[:, None] - np.arange(knots)[None, :]), 0.0, None))


def unexplained(readings: Readings, columns: Floats, values: Floats) -> Floats:
    """Residual of values after a least-squares fit of the columns, series by series, (m,).

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

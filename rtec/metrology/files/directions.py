"""Motion of an axis without such a column: direction of approach, and velocity where it was read in motion."""

import itertools
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from rtec.effects.derived import direction_update
from rtec.machine import Axis, Machine
from rtec.metrology.instruments.base import Instrument

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
LIKE, MOST = 0.05, 0.8
"""An axis moved at its feed if its speed agrees within the first share, in the second share of readings."""
LEAST = 3
"""Fewest targets between two ends whose number of readings shows an order."""


@np.errstate(over="ignore", invalid="ignore")  # huge numbers give no direction
def on_the_run(
    instrument: Instrument, machine: Machine, channels: Mapping[str, Floats], run: Ints, time_s: Floats
) -> dict[str, Floats]:
    """Velocity, by channel, of an axis that was read in motion: its positions and times agree with its feed.

    An axis that stops at its targets takes longer from one to the next than at its feed. Another axis may have moved
    between the runs.

    Returns:
        mm/s with the sign of the motion, (n,); empty where the feed was not recorded or a velocity was.
    """
    moving = _moving(machine, channels, run)
    if not instrument.at_rest or "feed_mm_min" not in channels or len(moving) != 1:
        return {}
    if moving[0].velocity_channel in channels:
        return {}
    feed = np.abs(channels["feed_mm_min"])
    position = channels[moving[0].channel]
    way = np.sign(np.diff(position))
    # Ways: consecutive readings in one direction at one feed. The axis may have been at rest before the first of them.
    new = np.concatenate([[True], (way[1:] != way[:-1]) | (feed[2:] != feed[1:-1]), [False]])
    out, like = np.zeros(len(feed)), 0
    edges = [*np.flatnonzero(new).tolist(), len(feed) - 1]
    for a, b in itertools.pairwise(edges):
        first = a + 1 if a else 0
        lasted, went = time_s[b] - time_s[first], abs(position[b] - position[first])
        if lasted > 0.0 and abs(60.0 * went - lasted * feed[b]) < LIKE * lasted * feed[b]:
            like += b - first
            out[first if out[a] else a : b + 1] = way[a] * feed[b] / 60.0
    return {moving[0].velocity_channel: out} if like >= max(LEAST, MOST * (len(feed) - 2 * len(edges))) else {}


def _moving(machine: Machine, channels: Mapping[str, Floats], run: Ints) -> list[Axis]:
    """Axes that move within a run."""
    runs = [run == r for r in np.unique(run)]
    recorded = [a for a in machine.axes if a.channel in channels]
    return [a for a in recorded if any(np.ptp(channels[a.channel][r]) > a.dead_band_mm for r in runs)]


@np.errstate(over="ignore", invalid="ignore")  # huge numbers give no direction
def by_velocity(machine: Machine, channels: Mapping[str, Floats], run: Ints) -> dict[str, Floats]:
    """Directions by the sign of the recorded velocity, by direction channel, of the one axis that moves within runs.

    A reading at velocity zero has the direction of `approached`, else of the last motion. A velocity without a sign, or
    with the wrong one, contradicts the positions between two turns, and gives no result.

    Returns:
        -1 or +1 for each reading, 0 before the first motion, (n,), of the axis if it has no direction of its own.
    """
    moving = _moving(machine, channels, run)
    if len(moving) != 1 or moving[0].direction_channel in channels or moving[0].velocity_channel not in channels:
        return {}
    axis = moving[0]
    position, sign = channels[axis.channel], np.sign(channels[axis.velocity_channel])
    way = np.where(np.abs(np.diff(position)) > axis.dead_band_mm, np.sign(np.diff(position)), 0.0)
    agrees = (np.where(way[1:] == way[:-1], way[1:], 0.0) * sign[1:-1]).astype(np.int64)
    if not sign.any() or np.count_nonzero(agrees > 0) < MOST * np.count_nonzero(agrees):
        return {}
    at_rest = _approach(axis, position)
    last = _last(axis, position, sign) if at_rest is None else at_rest
    return {axis.direction_channel: np.where(sign == 0.0, last, sign)}


def _last(axis: Axis, position_mm: Floats, sign: Floats) -> Floats:
    """Last direction of motion at each reading, by its velocity, or by the positions where that is zero, (n,)."""
    out, direction, extreme = np.zeros(len(sign)), 0.0, float(position_mm[0])
    for i, (at, way) in enumerate(zip(position_mm.tolist(), sign.tolist(), strict=True)):
        if way:
            direction, extreme = way, at
        else:
            direction, extreme = direction_update(direction, extreme, at, axis.dead_band_mm)
        out[i] = direction
    return out


@np.errstate(over="ignore", invalid="ignore")  # huge numbers give no direction
def approached(machine: Machine, channels: Mapping[str, Floats], run: Ints) -> dict[str, Floats]:
    """Directions of approach of an axis that is read at targets, by direction channel.

    Between two readings of the target at the end of a way the axis has gone past it and returned (ISO 230-2). An axis
    that jumps back to repeat the same way has gone past the first target. The positions alone show neither: by them the
    axis has not moved, or moved the other way. Both cases are recognised where each end is read exactly twice as often
    as a target between them, or where every way has the same direction. Any other order gives no result. Another axis
    may have moved between the runs.

    Returns:
        -1 or +1 for each reading, (n,), of the one axis that moves within runs, if it has no direction of its own and
        no velocity but zero.
    """
    moving = _moving(machine, channels, run)
    if len(moving) != 1 or moving[0].direction_channel in channels:
        return {}
    axis = moving[0]
    if axis.velocity_channel in channels and channels[axis.velocity_channel].any():
        return {}
    found = _approach(axis, channels[axis.channel])
    return {} if found is None else {axis.direction_channel: found}


def _approach(axis: Axis, position_mm: Floats) -> Floats | None:
    first = np.flatnonzero(np.append(True, np.abs(np.diff(position_mm)) > axis.dead_band_mm))
    count = np.diff(np.append(first, len(position_mm)))
    way = np.sign(np.diff(position_mm[first]))
    turns = np.flatnonzero(way[1:] != way[:-1]) + 1  # stops at which the axis reverses
    between = np.setdiff1d(np.arange(1, len(first) - 1), turns)
    if len(between) < LEAST or len(set(count[between])) > 1:
        return None
    once = int(count[between[0]])
    if len(turns) and np.all(count[turns] == 2 * once):
        arriving = np.append(way[0], way)
        out = np.repeat(arriving, count)
        for stop in turns:
            out[first[stop] + once : first[stop] + 2 * once] = way[stop]
        return out
    side = way[between[0]]
    if np.all(count == once) and np.all(way[between] == side) and np.all(way[between - 1] == side):
        return np.full(len(position_mm), side)
    return None

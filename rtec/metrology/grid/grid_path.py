"""Straight pieces of a path in a plane, found in positions that may be rounded, jitter, or lie closer than either."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
EXACT_MM = 1e-6
STEP_MM = 0.1
"""Way between two looks at where a path goes: far above the rounding and the jitter of positions that were read off a
display or an encoder, far below what is trimmed."""
STRAIGHT = 5.0
"""So many times more way along one direction than along the other is straight along the first."""


def straight_pieces(place: Floats) -> Iterator[tuple[int, int, int, int]]:
    """Direction, way, first and last row of each stretch along one direction, one way.

    The path is looked at every `STEP_MM`, or at every reading where those are farther apart.
    """
    looks = _looks(place)
    if len(looks) < 2:
        return
    step = np.diff(place[:, looks], axis=1)
    far = np.abs(step)
    which = np.where(far[0] > STRAIGHT * far[1], 0, np.where(far[1] > STRAIGHT * far[0], 1, -1))
    way = np.where(np.where(which == 1, step[1], step[0]) > 0.0, 1, -1)
    label = np.where(which >= 0, 3 * which + way, -9)
    starts = np.flatnonzero(np.diff(label, prepend=-8) != 0)
    for first, last in zip(starts, [*starts[1:], len(label)], strict=True):
        along = int(which[first])
        if along < 0:
            continue
        across = place[1 - along]
        begin, end = _to_corners(across, looks, int(first), int(last))
        if np.ptp(across[begin : end + 1]) < STEP_MM:
            yield along, int(way[first]), begin, end


def _looks(place: Floats) -> NDArray[np.int64]:
    """Rows at which the path has gone `STEP_MM` on from the row before in the list."""
    out = [0]
    first, second = (p.tolist() for p in place)
    for row, (u, v) in enumerate(zip(first, second, strict=True)):
        here = out[-1]
        if abs(u - first[here]) > STEP_MM - EXACT_MM or abs(v - second[here]) > STEP_MM - EXACT_MM:
            out.append(row)
    return np.array(out, dtype=np.int64)


def _to_corners(across: Floats, looks: NDArray[np.int64], first: int, last: int) -> tuple[int, int]:
    """Rows where a piece between two looks begins and ends: on to the corner, which may lie between looks."""
    begin, end = int(looks[first]), int(looks[last])
    beside = float(np.median(across[begin : end + 1]))
    lowest = int(looks[first - 1]) if first else 0
    highest = int(looks[last + 1]) if last + 1 < len(looks) else len(across)
    while begin - 1 > lowest and abs(across[begin - 1] - beside) < STEP_MM / STRAIGHT:
        begin -= 1
    while end + 1 < highest and abs(across[end + 1] - beside) < STEP_MM / STRAIGHT:
        end += 1
    return begin, end

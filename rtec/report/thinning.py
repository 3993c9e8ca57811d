"""Which of very many readings a plot draws, and means by place and by cell.

What is drawn looks the same as all readings. All count in the numbers, and zooming in draws more of the visible ones.
"""

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.report.figures import WHOLE, Zoom

MOST, EVENLY = 7_000, 3_000
"""Largest number of drawn readings; of these, the number that is drawn at random, to show their density."""
ACROSS, UP = 96, 40
"""Number of cells of a plot, each a little larger than a marker; every cell with readings has at least one drawn."""
CELLS, LEAST = 24, 3
LINE = 300
"""Number of parts of a temperature's line; the lowest and the highest value of each are drawn."""


def drawn(left: Floats, over: Floats, up: Floats, zoom: Zoom = WHOLE) -> Ints:
    """Rows of the drawn readings, rising, (k,): in each small cell of the plot the one with the largest residual.

    This keeps the outline of the cloud and every isolated reading. Further ones are chosen at random, the same in every
    plot of a series.

    Args:
        left: its residual, (n,).
        over, up: horizontal and vertical values, (n,).
        zoom: visible ends of the horizontal axis, "x", and of the vertical one, "y", where they are not whole.
    """
    inside = np.isfinite(over) & np.isfinite(up)
    if len(left) <= MOST:
        return np.flatnonzero(inside)
    for axis, values in (("x", over), ("y", up)):
        low, high = sorted(zoom.get(axis, (-np.inf, np.inf)))
        inside &= (values >= low) & (values <= high)
    rows = np.flatnonzero(inside)
    if len(rows) <= MOST:
        return rows
    cell = _part_of(over[rows], ACROSS) * UP + _part_of(up[rows], UP)
    outward = np.lexsort((np.abs(left[rows]), cell))  # the largest of a cell is the last one
    last = np.append(np.diff(cell[outward]) > 0, True)
    evenly = np.random.default_rng(0).permutation(len(left)) * len(rows) < EVENLY * len(left)
    return np.union1d(rows[outward[last]], rows[evenly[rows]])


def _part_of(values: Floats, parts: int) -> Ints:
    """Index of each value's part among `parts` equal parts of the range, (n,)."""
    low, wide = float(values.min()), float(np.ptp(values)) or 1.0
    return np.minimum(((values - low) * (parts / wide)).astype(np.int64), parts - 1)


def is_position(title: str) -> bool:
    """Whether a channel is a position, by its title: over another one the prediction at different places is no line."""
    return title.endswith(", mm")


def by_place(x: Floats, y: Floats, most: int = 120) -> tuple[Floats, Floats]:
    """Mean at each place, or in intervals where there are many places, (k,) each."""
    good = np.isfinite(x) & np.isfinite(y)
    x, y = x[good], y[good]
    if not len(x):
        return x, y
    levels, code = np.unique(np.round(x, 2), return_inverse=True)
    if len(levels) > most:
        edges = np.linspace(float(x.min()), float(x.max()), most + 1)
        code = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, most - 1)
    count = np.bincount(code)
    full = count > 0
    return tuple(np.bincount(code, weights=v)[full] / count[full] for v in (x, y))  # type: ignore[return-value]


def line_ends(values: Floats) -> Ints:
    """Rows of the lowest and the highest value of each part of a line, rising; all of a short one."""
    if len(values) <= 2 * LINE:
        return np.arange(len(values))
    parts = np.array_split(np.where(np.isfinite(values), values, values[np.isfinite(values)][:1].sum()), LINE)
    first = np.cumsum([0, *map(len, parts[:-1])])
    ends = [[k + p.argmin(), k + p.argmax()] for k, p in zip(first, parts, strict=True)]
    return np.unique(np.array(ends, dtype=np.int64))


def cells_of(x: Floats, y: Floats, left: Floats) -> tuple[tuple[Floats, Floats], Floats]:
    """Mean residual in each cell of two channels.

    Args:
        x, y: the channels, (n,).
        left: the residual, (n,).

    Returns:
        Edges of the cells along both channels, (k + 1,) and (m + 1,), and the means, (m, k); NaN where there are few
        readings.
    """
    cuts = [np.linspace(float(v.min()), float(v.max()), _cells(v) + 1) for v in (x, y)]
    code = [np.clip(np.searchsorted(c, v, side="right") - 1, 0, len(c) - 2) for c, v in zip(cuts, (x, y), strict=True)]
    width, height = (len(c) - 1 for c in cuts)
    cell, size = code[1] * width + code[0], width * height
    count = np.bincount(cell, minlength=size)
    with np.errstate(invalid="ignore"):
        mean = np.where(count >= LEAST, np.bincount(cell, weights=left, minlength=size) / np.maximum(count, 1), np.nan)
    return (cuts[0], cuts[1]), mean.reshape(height, width)


def _cells(v: Floats) -> int:
    return int(min(CELLS, max(len(np.unique(np.round(v, 2))), 1)))

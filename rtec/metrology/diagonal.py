"""Axes that move together along a line, as along the diagonals of a machine [ISO 230-6]."""

from collections.abc import Sequence

import numpy as np

from rtec.arrays import Floats

STRAIGHT, LEAST = 1e-3, 0.05
"""Largest distance of the places from the line, as a share of its length; least share of an axis that takes part."""
FARTHEST_MM = 1e9


def diagonal(places_mm: Floats, directions: Sequence[str]) -> tuple[float, ...] | None:
    """Direction of the line along which several axes move together, from the first place on; else None.

    Args:
        places_mm: positions of the axes, (n, axes).
        directions: "X", "Y" or "Z" of each axis.

    Returns:
        Its parts in X, Y and Z; together they have a length of one.
    """
    known = places_mm[np.isfinite(places_mm).all(axis=1)]
    if len(known) < 3:
        return None
    with np.errstate(over="ignore"):
        known = known - known[0]
    if not 0.0 < (reach := np.abs(known).max()) < FARTHEST_MM:
        return None
    known = known / reach
    _, size, lines = np.linalg.svd(known - known.mean(axis=0), full_matrices=False)
    if len(size) < 2 or size[1] > STRAIGHT * size[0]:
        return None
    far = known[np.argmax(np.linalg.norm(known, axis=1))]
    line = lines[0] * np.sign(lines[0] @ far) * (np.abs(lines[0]) > LEAST)
    if np.count_nonzero(line) < 2:
        return None
    return tuple(round(float(line[[d == letter for d in directions]].sum()), 4) for letter in "XYZ")

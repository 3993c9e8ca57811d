"""Axes that move together along a line, as along the diagonals of a machine [ISO 230-6]."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

STRAIGHT, LEAST = 1e-3, 0.05
"""Largest distance of the places from the line, as a share of its length; least share of an axis that takes part."""


def diagonal(places_mm: Floats) -> Floats | None:
    """Direction of the line along which several axes move together, from the first place on; else None.

    Args:
        places_mm: positions of the axes, (n, axes).

    Returns:
        A vector of length one, (axes,).
    """
    known = places_mm[np.isfinite(places_mm).all(axis=1)]
    if len(known) < 3:
        return None
    _, size, lines = np.linalg.svd(known - known.mean(axis=0), full_matrices=False)
    if not size[0] > 0.0 or (size[1:].any() and size[1] > STRAIGHT * size[0]):
        return None
    way = known - known[0]
    far = way[np.argmax(np.linalg.norm(way, axis=1))]
    line: Floats = lines[0] * np.sign(lines[0] @ far)
    taking_part = np.abs(line) > LEAST
    return np.where(taking_part, line, 0.0) if taking_part.sum() > 1 else None

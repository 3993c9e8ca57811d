"""Weights of readings that are far off: the same robust weights in every least-squares fit.

Wrong readings are rejected before (`outliers`). Readings that are still far off get Huber's weight: their influence on
the fit is that of a reading six standard deviations off. Three would be too few: what a model misses is not normally
distributed, and a fit that discounts the largest residuals makes them larger. Equal instruments share the standard
deviation (`kinds`).
"""

from collections.abc import Hashable, Sequence

import numpy as np

from rtec.arrays import Floats, Ints, robust_sigma
from rtec.estimation.kinds import alike, neighbour_noise

HUBER = 6.0
"""Residuals beyond this many robust standard deviations of their series count less."""
LEAST_SHARE = 0.02
"""The robust standard deviation is at least this share of the plain one: quantised residuals are mostly equal."""
SMALLEST = 1e-9
SETTLED = 0.05
"""Weights have converged where the influence of readings changes by fewer standard deviations than this (rms)."""


def sigmas(kinds: Sequence[Hashable], left: Sequence[Floats], runs: Sequence[Ints]) -> Floats:
    """Robust standard deviation of each series of residuals, shared by equal instruments, (series,).

    A quiet run gets no more weight than others: one run is not worth a hundred.

    Args:
        kinds: of the series.
        left: residuals of each series, unknowns of each run projected out, (n,); NaN where there is none.
        runs: of its readings, (n,).
    """
    own = np.array([_sigma(values[np.isfinite(values)]) for values in left])
    quick = np.array([neighbour_noise(values, run) for values, run in zip(left, runs, strict=True)])
    return alike(kinds, own, quick, np.array([np.count_nonzero(np.isfinite(values)) for values in left]))


def _sigma(left: Floats) -> float:
    if not len(left):
        return SMALLEST
    return max(robust_sigma(left), LEAST_SHARE * float(np.sqrt(np.mean(left**2))), SMALLEST)


def huber(left: Floats, sigma: float) -> Floats:
    """Factor of each reading's row in least squares, (n,): 1, or the root of Huber's weight where it is far off."""
    far = np.maximum(np.abs(np.nan_to_num(left)), 1e-300)
    return np.asarray(np.sqrt(np.minimum(1.0, HUBER * sigma / far)))


def settled(before: Floats, now: Floats, left: Floats, sigma: float) -> bool:
    """Whether factors of rows, (n,), changed so little that another fit would give the same."""
    pull = (before**2 - now**2) * np.nan_to_num(left) / sigma
    return bool(np.sqrt(np.mean(pull**2)) < SETTLED) if len(pull) else True

"""How far off readings count: the one robust weighing of every least-squares fit.

Wrong readings are left out before (`outliers`). What is still far off counts less, as Huber has it: its pull on the fit
is that of a reading six standard deviations off. Not three: what a model misses is not normally distributed, and a fit
that makes little of the largest residuals leaves larger ones. How large a standard deviation is, equal instruments say
together (`kinds`).
"""

from collections.abc import Hashable, Sequence

import numpy as np
from numpy.typing import NDArray

from rtec.estimation.kinds import SIGMA_PER_MAD, alike, neighbour_noise

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

HUBER = 6.0
"""Residuals beyond so many robust standard deviations of their series count less."""
LEAST_SHARE = 0.02
"""The robust standard deviation is never below this share of the plain one: quantised residuals are mostly equal."""
SMALLEST = 1e-9
SETTLED = 0.05
"""Weights are settled where the pull of the readings changes by less than this many standard deviations (rms)."""


def sigmas(kinds: Sequence[Hashable], left: Sequence[Floats], runs: Sequence[Ints]) -> Floats:
    """Robust standard deviation of each series of residuals, as equal instruments have it together, (series,).

    A quiet run weighs no more than others: what one run shows is not worth a hundred.

    Args:
        kinds: which series are of equal instruments.
        left: residuals of each series, unknowns of each run taken out, (n,); NaN where there is none.
        runs: of its readings, (n,).
    """
    own = np.array([_sigma(values[np.isfinite(values)]) for values in left])
    quick = np.array([neighbour_noise(values, run) for values, run in zip(left, runs, strict=True)])
    return alike(kinds, own, quick, np.array([np.count_nonzero(np.isfinite(values)) for values in left]))


def _sigma(left: Floats) -> float:
    if not len(left):
        return SMALLEST
    robust = SIGMA_PER_MAD * float(np.median(np.abs(left)))
    return max(robust, LEAST_SHARE * float(np.sqrt(np.mean(left**2))), SMALLEST)


def huber(left: Floats, sigma: float) -> Floats:
    """Factor of each reading's row in least squares, (n,): 1, or the root of Huber's weight where it is far off."""
    far = np.maximum(np.abs(np.nan_to_num(left)), 1e-300)
    return np.asarray(np.sqrt(np.minimum(1.0, HUBER * sigma / far)))


def settled(before: Floats, now: Floats, left: Floats, sigma: float) -> bool:
    """Whether factors of rows, (n,), changed so little that another fit would be the same."""
    pull = (before**2 - now**2) * np.nan_to_num(left) / sigma
    return bool(np.sqrt(np.mean(pull**2)) < SETTLED) if len(pull) else True

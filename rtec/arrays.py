"""Types of arrays, and what is robustly said of one."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

SIGMA_PER_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


def robust_sigma(values: Floats) -> float:
    """Robust standard deviation about zero; zero for no values."""
    return SIGMA_PER_MAD * float(np.median(np.abs(values))) if len(values) else 0.0


def robust_scatter(values: Floats) -> float:
    """Robust standard deviation about the median; zero for no values."""
    return robust_sigma(values - np.median(values)) if len(values) else 0.0

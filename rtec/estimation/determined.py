"""Terms that the readings do not determine, though their sum fits the readings.

Two delays of one temperature, with opposite signs and any size, follow its rate of change; two polynomials fit the same
targets. Each alone may then contribute many times the readings, and on another day they no longer cancel. A model must
not have both.
"""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SURE = 3.0
"""A contribution must be this many standard errors from zero, where it or its error exceeds the readings."""


def undetermined(gram: Floats, values: Floats, covariance: Floats, owner: Ints, left: Floats) -> list[int]:
    """Terms that alone contribute, or may contribute, more than all readings, and whose size is uncertain.

    Args:
        gram: products of the columns, instrument unknowns projected out, of each measurement, (n, k, k). A term's
            slopes by its non-linear parameters are columns of its own.
        values: coefficients, zero for slopes, (k,).
        covariance: of coefficients and slopes, (k, k).
        owner: number of the term of each column, (k,).
        left: sum of squared residuals of all terms, of each measurement, (n,).

    Returns:
        The numbers of those terms.
    """
    out = []
    for i in np.unique(owner).tolist():
        own = np.flatnonzero(owner == i)
        mine = gram[:, own[:, None], own[None, :]]
        there = np.trace(mine, axis1=1, axis2=2) > 0.0
        part, whole = mine[there].sum(axis=0), gram[there].sum(axis=0)
        size, read = values[own] @ part @ values[own], values @ whole @ values + left[there].sum()
        error = float(np.sum(part * covariance[np.ix_(own, own)]))
        if max(size, error) > read and size < SURE**2 * error:
            out.append(i)
    return out

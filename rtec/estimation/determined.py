"""Terms that nothing determines, though their sum meets the readings.

Two delays of one temperature follow, with opposite signs and at any size, how fast it changes; two polynomials meet the
same targets. Each alone may then make many times what was read, and on another day they no longer cancel. A model must
not have both.
"""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SURE = 3.0
"""Standard errors that what a term makes must be away from zero, where it or its error exceeds what was read."""


def undetermined(gram: Floats, values: Floats, covariance: Floats, owner: Ints, left: Floats) -> list[int]:
    """Terms that alone make, or may make, more than all that was read, and whose size is not sure.

    Args:
        gram: products of the columns, unknowns of the instruments taken out, of each measurement, (n, k, k). A term's
            slopes by its non-linear parameters are columns of its own.
        values: coefficients, zero for slopes, (k,).
        covariance: of coefficients and slopes, (k, k).
        owner: which term each column belongs to, (k,).
        left: sum of squares that all terms leave of each measurement, (n,).

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

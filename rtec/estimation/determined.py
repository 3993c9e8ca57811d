"""Terms that the readings do not determine, though their sum fits the readings.

Two delays of one temperature, with opposite signs and any size, follow its rate of change; two polynomials fit the same
targets. Each alone may then contribute many times the readings, and on another day they no longer cancel. A model must
not have both.

Nor do targets at one phase of a wave, or at two that are half a period apart, determine its other phase: it is zero at
all of them, and anything between them.
"""

from collections.abc import Collection, Sequence

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.effects import Effect
from rtec.effects.cyclic import Cyclic

SURE = 3.0
"""A contribution must be this many standard errors from zero, where it or its error exceeds the readings."""


def phases_of(effect: Effect, columns: Sequence[int]) -> list[tuple[int, int]]:
    """Columns of an effect in pairs, of which each is one wave at two phases; none unless it is a wave."""
    return list(zip(columns[::2], columns[1::2], strict=True)) if isinstance(effect, Cyclic) else []


def undetermined(
    gram: Floats,
    values: Floats,
    covariance: Floats,
    owner: Ints,
    left: Floats,
    phases: Collection[tuple[int, int]] = (),
) -> list[int]:
    """Terms that alone contribute, or may contribute, more than all readings, and whose size is uncertain.

    Args:
        gram: products of the columns, instrument unknowns projected out, of each measurement, (n, k, k). A term's
            slopes by its non-linear parameters are columns of its own.
        values: coefficients, zero for slopes, (k,).
        covariance: of coefficients and slopes, (k, k).
        owner: number of the term of each column, (k,).
        left: sum of squared residuals of all terms, of each measurement, (n,).
        phases: columns in pairs, of which each is one wave at two phases, a quarter of its period apart: what the wave
            makes between the targets counts, as at them.

    Returns:
        The numbers of those terms.
    """
    out = []
    for i in np.unique(owner).tolist():
        own = np.flatnonzero(owner == i)
        mine = gram[:, own[:, None], own[None, :]]
        there = np.trace(mine, axis1=1, axis2=2) > 0.0
        part, whole = mine[there].sum(axis=0), gram[there].sum(axis=0)
        pairs = [[*own].index(column) for pair in phases if owner[pair[0]] == i for column in pair]
        if pairs:
            evened = np.zeros(len(own))
            evened[pairs] = np.repeat(np.diag(part)[pairs].reshape(-1, 2).mean(axis=1), 2)
            part = np.diag(evened)
        size, read = values[own] @ part @ values[own], values @ whole @ values + left[there].sum()
        error = float(np.sum(part * covariance[np.ix_(own, own)]))
        if max(size, error) > read and size < SURE**2 * error:
            out.append(i)
    return out

"""Tells terms that the readings show for sure from those that chance or slow drift would bring forth.

Drift that no sensor sees goes on from run to run. Then a run says less than its standard error lets one believe, and
the error on left-out runs falls for any temperature that resembles the drift. So a term must be far from zero twice:
with one block left out after another, and with the longer parts left out that the choice was made on.
"""

import numpy as np
from numpy.typing import NDArray

from rtec.characterise.choose import NEAR
from rtec.estimation.gram.fit import Estimate
from rtec.estimation.gram.normal import Normal

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

CHANCE = 0.05
"""A term that chance would bring forth among so many candidates with this probability, or more, is not sure."""
ROUNDING = 1e-12


def surety(fit: Estimate, candidates: int) -> Floats:
    """How sure each coefficient of the terms is, (coefficients,); below one it is not.

    That is its distance from zero over the distance that chance hardly reaches; the smaller one counts of that from
    blocks and that from whole left-out parts.

    Args:
        fit: the terms, fitted; non-linear parameters are held.
        candidates: among how many the terms were chosen.
    """
    ways = [fit.linear, fit.linear.by_part]
    ratios = [_distances(way, fit) / far_for_chance(candidates, len(way.gram)) for way in ways]
    return np.asarray(np.min(ratios, axis=0), dtype=np.float64)


def spared(fit: Estimate, columns: Ints) -> bool:
    """Whether coefficients stay although they are not sure: left-out stretches of hours miss them by `choose.NEAR`.

    They are long against quick drift and few, so the test above has little power there. Left-out runs are no
    such witness: their neighbours share their drift. Nor are one or two of the stretches: with the signs of what each
    misses drawn by lot, as much would rarely be missed together.
    """
    if not _told_by_stretches(fit, columns) or missed(fit, columns) < NEAR:
        return False
    folds = np.unique([c.fold for c in fit.linear.cells], return_inverse=True)[1]
    more = np.bincount(folds, _without(fit, columns) - fit.cells[0])
    signs = 1.0 - 2.0 * (np.arange(2 ** len(more))[:, None] >> np.arange(len(more)) & 1)
    return float(np.mean(signs @ more >= (1.0 - ROUNDING) * more.sum())) <= CHANCE


def far_for_chance(candidates: int, blocks: int) -> float:
    """Standard errors from zero that the best of so many useless candidates hardly reaches (Bonferroni, Student)."""
    from scipy.special import stdtrit

    return -float(stdtrit(max(blocks - 1, 1), CHANCE / 2.0 / max(candidates, 1)))


def missed(fit: Estimate, columns: Ints) -> float:
    """By what share the held-out error grows without some coefficients."""
    return fit.rms(_without(fit, columns)) / max(fit.held_out, 1e-300) - 1.0


def _without(fit: Estimate, columns: Ints) -> Floats:
    """Sum of squared weighted residuals of each cell held out, without some coefficients, (cells,)."""
    return fit.linear.pick(np.setdiff1d(np.arange(fit.linear.width), columns)).held_out()[0]


def _distances(normal: Normal, fit: Estimate) -> Floats:
    spread = np.sqrt(np.maximum(np.diag(normal.covariance(fit.values)), 1e-300))[: normal.width]
    return np.asarray(np.abs(fit.values[: normal.width]) / np.hypot(spread, fit.by_common_lag), dtype=np.float64)


def _told_by_stretches(fit: Estimate, columns: Ints) -> bool:
    """Whether most of what the readings tell of coefficients lies in measurements that are cut into hours."""
    normal = fit.linear
    told = normal.gram[:, columns, columns].sum(axis=1)
    stretches = np.array([fit.sources[s].blocks.by_time for s in normal.source])
    return bool(told[stretches].sum() > 0.5 * told.sum())

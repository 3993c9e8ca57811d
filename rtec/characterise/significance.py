"""Tells terms that the readings show for sure from those that chance or slow drift would bring forth.

Drift that no sensor sees goes on from run to run. Then a run says less than its standard error lets one believe, and
the error on left-out runs falls for any temperature that resembles the drift. So a term must be far from zero twice:
with one block left out after another, and with the longer parts left out that the choice was made on.
"""

import numpy as np

from rtec.characterise.choose import NEAR
from rtec.estimation.gram.fit import Estimate
from rtec.estimation.gram.normal import Normal

CHANCE = 0.05
"""A term that chance would bring forth among so many candidates with this probability, or more, is not sure."""


def surety(fit: Estimate, candidates: int) -> list[float]:
    """How sure each term is: its distance from zero over that which chance hardly reaches; below one it is not.

    The distance is the largest of its coefficients over their standard errors, non-linear parameters held; the smaller
    ratio counts of that from blocks and that from whole left-out parts.

    Args:
        fit: the terms, fitted.
        candidates: among how many the terms were chosen.
    """
    ways = [fit.linear, fit.linear.by_part]
    ratios = [_distances(way, fit) / far_for_chance(candidates, len(way.gram)) for way in ways]
    return [float(r) for r in np.min(ratios, axis=0)]


def spared(fit: Estimate, term: int) -> bool:
    """Whether a term stays although it is not sure: left-out stretches of hours miss it by `rivals.NEAR`, or more.

    They are long against quick drift and few, so the test above has little power there. Left-out runs are no
    such witness: their neighbours share their drift.
    """
    return _told_by_stretches(fit, term) and missed(fit, term) >= NEAR


def far_for_chance(candidates: int, blocks: int) -> float:
    """Standard errors from zero that the best of so many useless candidates hardly reaches (Bonferroni, Student)."""
    from scipy.special import stdtrit

    return -float(stdtrit(max(blocks - 1, 1), CHANCE / 2.0 / max(candidates, 1)))


def missed(fit: Estimate, term: int) -> float:
    """By what share the held-out error grows without a term."""
    without = fit.linear.pick(np.flatnonzero(fit.linear.owner != term)).held_out()[0]
    return fit.rms(without) / max(fit.held_out, 1e-300) - 1.0


def _distances(normal: Normal, fit: Estimate) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    spread = np.sqrt(np.maximum(np.diag(normal.covariance(fit.values)), 1e-300))
    ratio = (np.abs(fit.values) / spread)[: normal.width]
    return np.array([ratio[normal.owner == i].max() for i in range(len(fit.terms))])


def _told_by_stretches(fit: Estimate, term: int) -> bool:
    """Whether most of what the readings tell of a term lies in measurements that are cut into stretches of hours."""
    normal = fit.linear
    own = np.flatnonzero(normal.owner == term)
    told = normal.gram[:, own, own].sum(axis=1)
    stretches = np.array([fit.sources[s].blocks.by_time for s in normal.source])
    return bool(told[stretches].sum() > 0.5 * told.sum())

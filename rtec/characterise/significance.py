"""Separates significant terms from those that noise or slow drift would produce.

Drift that no sensor reads continues from run to run. A run then has less information than its standard error suggests,
and any temperature that resembles the drift lowers the error on held-out runs. So a term must be far from zero in two
tests: with single blocks held out, and with the longer parts held out on which the choice was made.
"""

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.characterise.candidates import EVERY_MACHINE, every_machine_has
from rtec.effects.thermal import AxisExpansion
from rtec.estimation.gram.fit import Estimate
from rtec.estimation.gram.normal import Normal
from rtec.metrology.instruments.ball_bar import BallBar

CHANCE = 0.05
"""Accepted false-positive rate of a term, over all candidates."""
ROUNDING = 1e-12
HELD_OUT = 0.15
"""A term that is not significant stays where held-out hours lose this share without it."""


def surety(fit: Estimate, candidates: int) -> Floats:
    """Significance of each coefficient of the terms, (coefficients,); a value below one is not significant.

    It is the distance from zero over the distance that noise alone hardly reaches: the smaller one of the test with
    blocks and the test with longer held-out parts.

    Args:
        fit: the fitted terms, with fixed non-linear parameters.
        candidates: number of candidates from which the terms were chosen.
    """

    # What every machine has is one of few candidates. But a scale error may be the warmth of the day, where no
    # expansion beside it is significant; a ball bar shows the difference of two, which are as warm.
    def among(count: int) -> Floats:
        ways = [fit.linear, fit.linear.by_part]
        return np.asarray(np.min([_distances(way, fit) / far_for_chance(count, len(way.gram)) for way in ways], axis=0))

    of_all, of_few, owner = among(candidates), among(min(len(EVERY_MACHINE), candidates)), fit.linear.owner
    grows = {
        t.effect.component
        for i, t in enumerate(fit.terms)
        if isinstance(t.effect, AxisExpansion) and of_all[owner == i].max() >= 1.0
    }
    bars = all(isinstance(s.measurement.instrument, BallBar) for s in fit.sources)
    effects = [t.effect for t in fit.terms]
    plain = [every_machine_has(e) and (e.effect != "scale" or bars or e.component in grows) for e in effects]
    return np.where(np.array(plain, dtype=np.bool_)[owner], of_few, of_all)


def spared(fit: Estimate, columns: Ints) -> bool:
    """Whether coefficients stay although not significant: without them the error on held-out hours rises.

    Such stretches of hours are few, so that the test above has little power, and they are long compared with fast
    drift. Held-out runs are not accepted for this: their neighbours have the same drift. Nor is an increase in one or
    two stretches only: with random signs of the increases, as large a sum must be rare.
    """
    if not _mostly_in_stretches(fit, columns) or missed(fit, columns) < HELD_OUT:
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
    """Relative increase of the held-out error without some coefficients."""
    return fit.rms(_without(fit, columns)) / max(fit.held_out, 1e-300) - 1.0


def _without(fit: Estimate, columns: Ints) -> Floats:
    """Sum of squared weighted residuals of each cell held out, without some coefficients, (cells,)."""
    return fit.linear.pick(np.setdiff1d(np.arange(fit.linear.width), columns)).held_out()[0]


def _distances(normal: Normal, fit: Estimate) -> Floats:
    spread = np.sqrt(np.maximum(np.diag(normal.covariance(fit.values)), 1e-300))[: normal.width]
    return np.asarray(np.abs(fit.values[: normal.width]) / np.hypot(spread, fit.by_common_lag), dtype=np.float64)


def _mostly_in_stretches(fit: Estimate, columns: Ints) -> bool:
    """Whether most of the information on coefficients is in measurements whose blocks are hours."""
    normal = fit.linear
    information = normal.gram[:, columns, columns].sum(axis=1)
    stretches = np.array([fit.sources[s].blocks.by_time for s in normal.source])
    return bool(information[stretches].sum() > 0.5 * information.sum())

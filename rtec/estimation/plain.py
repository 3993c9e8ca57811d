"""Ordinary robust least squares: the check on generalised least squares.

A noise model with drift weighs quick changes more than slow ones. Where the drift has absorbed what the model misses,
such a fit follows small quick changes and predicts the readings worse than the model did before. Ordinary least squares
cannot: it minimises the residual itself. Its standard errors still account for the drift, by
`(X'X)⁻¹ X'ΣX (X'X)⁻¹`.
"""

from dataclasses import dataclass, replace

import numpy as np

from rtec.arrays import Floats
from rtec.estimation.gls import HeldOut, inverse, solve, without_nuisance
from rtec.estimation.kinds import kinds_of
from rtec.estimation.noise import Whitener, refine
from rtec.estimation.readings import Readings
from rtec.estimation.robust import huber, sigmas

ROUNDS = 4
STEPS = 30
BEYOND = 1.959964
"""Standard errors within which 95 % of all results are."""
LEAST_FREEDOM = 3.0
CLEARLY = 0.06
"""Share by which ordinary least squares is worse about the means of runs where the weighted fit is clearly better."""
WORSE = 1.04
"""Mean squares on held-out runs within this factor are equally good."""


@dataclass(frozen=True)
class Plain:
    """Weights of ordinary least squares; a call with columns, (m,) or (m, p), returns them weighted.

    Attributes:
        readings: all readings.
        noise: of the residual of the fit.
        sigma: residual of each series, (series,).
        huber: square root of the weight of each reading, (m,).
        shrink: square root of the information of such readings relative to independent ones.
    """

    readings: Readings
    noise: Whitener
    sigma: Floats
    huber: Floats
    shrink: float = 1.0

    @property
    def rows(self) -> Floats:
        """Factor of each reading, (m,)."""
        return self.huber * (self.shrink / self.sigma)[self.readings.series_of]

    def __call__(self, columns: Floats) -> Floats:
        """Columns less the unknowns of each run, weighted."""
        rows = self.rows
        return without_nuisance(self.readings, columns) * (rows if columns.ndim == 1 else rows[:, None])

    def refined(self, left: Floats, columns: Floats) -> "Plain":
        """The same weights from the residual, (m,), of a fit of columns, (m, p)."""
        made = replace(weights(self.readings, refine(self.noise, left, STEPS), left), shrink=1.0)
        no_prior = np.zeros((1, columns.shape[1]))
        supposed, there = inverse(made(columns)), covariance(made, columns, no_prior)
        known = np.diag(supposed) > 0.0
        if not known.any():
            return made
        factor = float(np.median(np.diag(there)[known] / np.diag(supposed)[known]))
        return replace(made, shrink=1.0 / np.sqrt(max(factor, 1.0)))


def telling(share: Floats) -> Floats:
    """Effective number of blocks that determine numbers, `(Σ w)² / Σ w²`, (p,).

    Args:
        share: contribution `w` of each block to the variance of each number, (blocks, p).
    """
    squares = (share**2).sum(axis=0)
    return np.asarray(share.sum(axis=0) ** 2 / np.where(squares > 0, squares, 1.0))


def widening(blocks: Floats, far: float = BEYOND) -> Floats:
    """Factor by which a standard error from this many blocks is wider: Student's quantile over the normal one.

    Args:
        blocks: effective number of blocks, (p,).
        far: in standard errors, what is asked about.
    """
    from scipy.special import ndtr, stdtrit

    freedom = np.maximum(blocks - 1.0, LEAST_FREEDOM)
    return np.asarray(stdtrit(freedom, ndtr(far)) / far, dtype=np.float64)


def covariance(by: Whitener | Plain, columns: Floats, prior: Floats) -> Floats:
    """Covariance of coefficients under the noise, (p, p).

    Args:
        by: weights of the fit.
        columns: of the fit, (m, p).
        prior: rows that stand for what is known of the coefficients, (k, p); zeros for nothing.
    """
    white = by(columns)
    bread = inverse(np.concatenate([white, prior]))
    if isinstance(by, Whitener):
        return bread
    pulled = without_nuisance(by.readings, white * by.rows[:, None])
    meat = pulled.T @ by.noise.covary(pulled) + prior.T @ prior
    return np.asarray(bread @ meat @ bread)


def weights(readings: Readings, noise: Whitener, left: Floats) -> Plain:
    """Weights from the residual of a fit, (m,): one for each series, less for readings that are far off."""
    flat = without_nuisance(readings, left)
    parts = [flat[s.part] for s in readings.series]
    sigma = sigmas(kinds_of(readings), parts, [s.run for s in readings.series])
    rows = np.concatenate([huber(part, float(size)) for part, size in zip(parts, sigma, strict=True)])
    return Plain(readings, noise, sigma, rows)


def plain_fit(readings: Readings, noise: Whitener, columns: Floats) -> tuple[Plain, Floats]:
    """Fit columns, (m, p), by robust least squares; weights and coefficients, (p,)."""
    flat = without_nuisance(readings, columns)
    values = solve(flat, without_nuisance(readings, readings.values))
    for _ in range(ROUNDS):
        made = weights(readings, noise, readings.values - columns @ values)
        values = solve(made(columns), made(readings.values))
    return made, values


def as_good(weighed: HeldOut, plain: HeldOut) -> bool:
    """Whether a weighted fit predicts held-out runs as well as ordinary least squares does.

    It does not where its mean square is clearly larger, by `WORSE` and by more than the standard error of the
    difference over the folds.
    """
    more = weighed.folds - plain.folds
    if float(more.sum()) <= (WORSE - 1.0) * float(plain.folds.sum()):
        return True
    return len(more) > 1 and float(more.sum()) <= float(np.std(more, ddof=1)) * np.sqrt(len(more))


def better_within_runs(weighed: HeldOut, plain: HeldOut) -> bool:
    """Whether a weighted fit predicts held-out runs clearly better about the mean of each.

    A drift from run to run does not change these errors. Ordinary least squares follows it: it predicts runs between
    others better than the machine's own numbers do, but no other day.
    """
    more = plain.within - weighed.within
    if float(more.sum()) <= CLEARLY * float(weighed.within.sum()):
        return False
    return len(more) > 1 and float(more.sum()) > float(np.std(more, ddof=1)) * np.sqrt(len(more))

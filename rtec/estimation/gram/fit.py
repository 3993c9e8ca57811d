"""Fits chosen terms to measurements: weights, outliers, non-linear parameters, coefficients, standard errors."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rtec.errors import ModelError
from rtec.estimation.gram.identifiable import check_seen
from rtec.estimation.gram.normal import Normal
from rtec.estimation.gram.projection import Polished, polish
from rtec.estimation.gram.source import Source, flat, thinned
from rtec.estimation.gram.stream import Progress, Term, gather, predict
from rtec.estimation.gram.weights import Outlier, describe, from_run_medians, huber_weights, residuals_of, rough_noise
from rtec.estimation.kinds import alike, neighbour_noise

Floats = NDArray[np.float64]

ROUNDS = 6
"""At most so many fits, each with the outliers and the noise that the one before found."""
THREE = 0.00135
"""What is beyond three standard deviations, on one side."""
LEAST_FREEDOM = 4.0
SAME = 0.2
"""Noise of columns that changed against each other by less than this share is not worth another fit."""
FEWER = 10_000
"""A first look at very many readings takes so many instants."""


@dataclass(frozen=True)
class Estimate:
    """A fit of chosen terms.

    Attributes:
        sources: with the weights of the fit.
        found: terms, normal equations, parameters.
        noise: of each reading column, a (readings,) for each source, in the column's unit.
        outliers: readings that are off.
        residuals: readings minus prediction and nuisances, a (readings, n) for each source; NaN where none.
    """

    sources: tuple[Source, ...]
    found: Polished
    noise: tuple[Floats, ...]
    outliers: tuple[Outlier, ...] = ()
    residuals: tuple[Floats, ...] = field(default=(), repr=False)

    @property
    def terms(self) -> tuple[Term, ...]:
        """The terms with their parameters."""
        return self.found.terms

    @cached_property
    def linear(self) -> Normal:
        """Normal equations without slopes."""
        return self.found.linear

    @cached_property
    def values(self) -> Floats:
        """Coefficients of the terms, then of the explicit nuisances."""
        return self.linear.values()

    @cached_property
    def errors(self) -> Floats:
        """Standard errors of the coefficients, then of the parameters that are on no bound.

        Widened where few blocks tell of a number, by Student's quantile over the normal one, so that three of them
        hold what three are believed to hold, 99.7 %.
        """
        normal, width = self.found.normal, self.found.normal.width
        variance = np.diag(normal.covariance(normal.values()))[:width]
        return np.sqrt(np.maximum(variance, 0.0)) * widening(normal.blocks_telling()[:width])

    @cached_property
    def cells(self) -> tuple[Floats, Floats]:
        """Sum of squared weighted residuals of each cell of the normal equations, held out and in sample."""
        return self.linear.held_out()

    @property
    def inside(self) -> float:
        """Root mean square of the residuals in sample, in units of the weights' noise."""
        return self.rms(self.cells[1])

    @property
    def held_out(self) -> float:
        """The same on blocks that were left out of the fit."""
        return self.rms(self.cells[0])

    def rms(self, squares: Floats, source: int | None = None) -> float:
        """Root mean square over all cells, or over those of one measurement."""
        here = np.array([source is None or c.source == source for c in self.linear.cells])
        freedom = np.array([c.freedom for c in self.linear.cells])
        return float(np.sqrt(squares[here].sum() / max(freedom[here].sum(), 1.0)))


def widening(blocks: Floats) -> Floats:
    """How much wider a standard error is when it comes from so many blocks."""
    from scipy.special import ndtri, stdtrit

    freedom = np.maximum(blocks - 1.0, LEAST_FREEDOM)
    return np.asarray(stdtrit(freedom, THREE) / ndtri(THREE), dtype=np.float64)


def estimate(
    sources: Sequence[Source], terms: Sequence[Term], *, search: bool = True, progress: Progress | None = None
) -> Estimate:
    """Fit terms, beginning with the parameters that they have.

    Readings whose residual is far off count less (`huber_weights`); the noise of each reading column is what the fit
    leaves in it. Both are found again until they stay.

    Args:
        sources: measurements; their weights say what is left out from the start.
        terms: with parameters.
        search: whether parameters are searched for, or stay.
        progress: told readings done, of how many, of each walk.

    Raises:
        ModelError: too few readings, a term that no reading shows, or terms that cannot be told apart.
    """
    sigma, terms = _first_look(sources, terms, search)
    judged = [s.weight.copy() for s in sources]
    current = [_weigh(s, j, n) for s, j, n in zip(sources, judged, sigma, strict=True)]
    found = _polished(current, terms, search, progress)
    check_seen(found.linear, found.terms)
    outliers: dict[tuple[int, int], Outlier] = {}
    for last in (False,) * (ROUNDS - 1) + (True,):
        residuals = _residuals(current, found)
        spread = _noise(current, residuals, found.linear)
        if last or not (_judge(current, residuals, judged, outliers) or _reweigh(spread, sigma)):
            break
        sigma = spread
        current = [_weigh(s, j, n) for s, j, n in zip(sources, judged, sigma, strict=True)]
        found = _polished(current, found.terms, search, progress)
    told = tuple(outliers[k] for k in sorted(outliers))
    return Estimate(tuple(current), found, tuple(spread), told, tuple(residuals))


def _first_look(sources: Sequence[Source], terms: Sequence[Term], search: bool) -> tuple[list[Floats], Sequence[Term]]:
    """Noise and parameters to begin with: of a fit to fewer readings where there are very many, else roughly."""
    few = [thinned(s, FEWER // len(sources)) for s in sources]
    rough = [rough_noise(s) for s in few]
    if sum(len(s.weight) for s in sources) < 3 * sum(len(s.weight) for s in few):
        return rough, terms
    try:
        look = estimate(few, terms, search=search)
    except ModelError:  # the few readings may not show what all of them do
        return rough, terms
    return list(look.noise), look.terms


def _reweigh(spread: Sequence[Floats], sigma: Sequence[Floats]) -> bool:
    """Whether the weights of the columns against each other changed by much; a common factor is nothing."""
    ratio = np.log(np.concatenate(spread) / np.concatenate(sigma))
    return bool(np.ptp(ratio) > SAME)


def _polished(sources: Sequence[Source], terms: Sequence[Term], search: bool, progress: Progress | None) -> Polished:
    return (
        polish(sources, terms, progress) if search else Polished(tuple(terms), (), gather(sources, terms, progress), ())
    )


def _weigh(source: Source, judged: Floats, sigma: Floats) -> Source:
    return source.weighted((judged.reshape(-1, source.count) / sigma).ravel())


def _residuals(sources: Sequence[Source], found: Polished) -> list[Floats]:
    values, k = found.linear.values(), found.linear.width
    out = []
    for source in sources:
        explicit = []
        for extra in source.explicit:
            column = np.zeros_like(extra.nuisance.values)
            column[:, extra.rows] = extra.nuisance.values[:, extra.rows]
            explicit.append((flat(column) * source.weight, float(values[k])))
            k += 1
        out.append(residuals_of(source, predict(source, found.terms, values), explicit))
    return out


def _judge(
    sources: Sequence[Source], residuals: Sequence[Floats], judged: list[Floats], told: dict[tuple[int, int], Outlier]
) -> bool:
    """Weigh readings by their residuals; give whether any weight changed by much."""
    changed = False
    told.clear()
    for i, (source, left) in enumerate(zip(sources, residuals, strict=True)):
        weight = huber_weights(left, source.measurement.run)
        now = np.where(judged[i] > 0, weight.T.ravel(), 0.0)
        changed |= bool(np.any(np.abs(now - judged[i]) > 0.1))
        for item in describe(source, from_run_medians(left, source.measurement.run), weight):
            column = source.measurement.instrument.columns().index(item.column)
            told[i, item.row * source.count + column] = item
        judged[i] = now
    return changed


def _noise(sources: Sequence[Source], residuals: Sequence[Floats], normal: Normal) -> list[Floats]:
    """What the fit leaves in each reading column, counting what it found from them as evenly spent."""
    share = np.sqrt(max(normal.freedom, 1.0) / max(float(normal.readings.sum()), 1.0))
    out = []
    for source, left in zip(sources, residuals, strict=True):
        weight = (source.weight.reshape(-1, source.count)).T
        full = weight.max(axis=1, keepdims=True)
        trust = np.where(full > 0, weight / np.where(full > 0, full, 1.0), 0.0) ** 2
        squares = (np.nan_to_num(left) ** 2 * trust).sum(axis=1) / np.maximum(trust.sum(axis=1), 1.0)
        least = np.maximum(1e-9 * np.nanmax(np.abs(source.measurement.matrix()), axis=1, initial=0.0), 1e-12)
        out.append(np.maximum(np.sqrt(squares) / max(share, 1e-3), least))
    return _alike(sources, residuals, out)


def _alike(sources: Sequence[Source], residuals: Sequence[Floats], spread: Sequence[Floats]) -> list[Floats]:
    """Noise of each reading column that the weights take: what equal instruments' residuals have in common."""
    made_by = [s.measurement.instrument for s in sources]
    kinds = [(m.name, m.axis, m.component, c) for m in made_by for c in m.columns()]
    rows = [(row, s.measurement.run) for r, s in zip(residuals, sources, strict=True) for row in r]
    quick = np.array([neighbour_noise(row, run) for row, run in rows])
    count = np.array([np.count_nonzero(np.isfinite(row)) for row, _ in rows])
    out = alike(kinds, np.concatenate(spread), quick, count)
    return np.split(out, np.cumsum([len(s) for s in spread])[:-1])

"""Fits chosen terms to measurements: weights, non-linear parameters, coefficients, standard errors."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from rtec.arrays import Floats
from rtec.errors import ModelError
from rtec.estimation.determined import phases_of, undetermined
from rtec.estimation.gram.identifiable import check_seen
from rtec.estimation.gram.late import shift_by_common_lag
from rtec.estimation.gram.normal import Normal
from rtec.estimation.gram.projection import Polished, polish
from rtec.estimation.gram.source import Source, flat, thinned
from rtec.estimation.gram.stream import Progress, Term, gather, predict
from rtec.estimation.gram.weights import residuals_of, rough_noise
from rtec.estimation.plain import widening
from rtec.estimation.robust import huber, settled, sigmas

ROUNDS = 6
"""Most fits, each with the weights from the one before."""
SAME = 0.2
"""A smaller relative change of the noise of columns against each other is not worth another fit."""
FEWER = 10_000
"""Number of instants of a first fit to very many readings."""


@dataclass(frozen=True)
class Estimate:
    """A fit of chosen terms.

    Attributes:
        sources: with the weights of the fit.
        found: terms, normal equations, parameters.
        noise: of each reading column, a (readings,) for each source, in the column's unit.
        residuals: readings minus prediction and nuisances, a (readings, n) for each source; NaN where none.
    """

    sources: tuple[Source, ...]
    found: Polished
    noise: tuple[Floats, ...]
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

        Widened where few blocks determine a number, by Student's quantile over the normal one, so that twice an error
        covers 95 %. It includes what a common lag of the axes may have added to a number.
        """
        normal, width = self.found.normal, self.found.normal.width
        variance = np.diag(normal.covariance(normal.values()))[:width]
        errors = np.sqrt(np.maximum(variance, 0.0)) * widening(normal.blocks_telling()[:width])
        return np.hypot(errors, np.append(self.by_common_lag, np.zeros(width - self.linear.width)))

    @cached_property
    def covariance(self) -> Floats:
        """Covariance of the same numbers, (width, width)."""
        normal, width = self.found.normal, self.found.normal.width
        covariance = normal.covariance(normal.values())[:width, :width]
        wider = self.errors / np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        return np.asarray(covariance * np.outer(wider, wider))

    @cached_property
    def undetermined(self) -> list[int]:
        """Terms, by number, of which only the sum with others is determined."""
        normal, width = self.found.normal, self.found.normal.width
        values = np.append(self.values[: self.linear.width], np.zeros(width - self.linear.width))
        terms = np.array([*range(len(self.terms)), *(self.terms.index(s.term) for s in self.found.slopes)])
        shown = normal.by_source()
        left = np.zeros(len(shown))
        np.add.at(left, [c.source for c in self.linear.cells], self.cells[1])
        phases = [
            pair
            for i, term in enumerate(self.terms)
            if term.only is None
            for pair in phases_of(term.effect, np.flatnonzero(self.linear.owner == i).tolist())
        ]
        return undetermined(shown, values, self.covariance, terms[normal.owner], left, phases)

    @cached_property
    def by_common_lag(self) -> Floats:
        """Possible contribution of a lag of all axes, which no reading shows, to each coefficient of the terms."""
        return shift_by_common_lag(self.sources, self.terms, self.values)

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
        """The same on held-out blocks."""
        return self.rms(self.cells[0])

    def rms(self, squares: Floats, source: int | None = None) -> float:
        """Root mean square over all cells, or over those of one measurement."""
        here = np.array([source is None or c.source == source for c in self.linear.cells])
        freedom = np.array([c.freedom for c in self.linear.cells])
        return float(np.sqrt(squares[here].sum() / max(freedom[here].sum(), 1.0)))


def estimate(
    sources: Sequence[Source], terms: Sequence[Term], *, search: bool = True, progress: Progress | None = None
) -> Estimate:
    """Fit terms, starting with their current parameters.

    Readings whose residual is far off count less (`robust`); the noise of each reading column comes from its residual.
    Both are re-estimated until they converge.

    Args:
        sources: measurements; their weights exclude readings from the start.
        terms: with parameters.
        search: whether parameters are searched or stay constant.
        progress: called with the readings done and in total, for each pass.

    Raises:
        ModelError: too few readings, a term that no reading shows, or terms that cannot be distinguished.
    """
    sigma, terms = _first_look(sources, terms, search)
    rows = [np.ones(len(s.weight)) for s in sources]
    current = _weighed(sources, rows, sigma)
    found = _polished(current, terms, search, progress)
    check_seen(found.linear, found.terms)
    for last in (False,) * (ROUNDS - 1) + (True,):
        residuals = _residuals(current, found)
        spread = _sigmas(current, residuals)
        now = [_rows(left, size) for left, size in zip(residuals, spread, strict=True)]
        if last or not (_changed(rows, now, residuals, spread) or _reweigh(spread, sigma)):
            break
        rows, sigma = now, spread
        current = _weighed(sources, rows, sigma)
        found = _polished(current, found.terms, search, progress)
    return Estimate(tuple(current), found, tuple(_noise(current, residuals, found.linear)), tuple(residuals))


def _first_look(sources: Sequence[Source], terms: Sequence[Term], search: bool) -> tuple[list[Floats], Sequence[Term]]:
    """Noise and parameters to start with: from a fit to some of very many readings, else a rough estimate."""
    few = [thinned(s, FEWER // len(sources)) for s in sources]
    rough = [rough_noise(s) for s in few]
    if sum(len(s.weight) for s in sources) < 3 * sum(len(s.weight) for s in few):
        return rough, terms
    try:
        look = estimate(few, terms, search=search)
    except ModelError:  # the few readings may not show what all of them do
        return rough, terms
    return _sigmas(look.sources, look.residuals), look.terms


def _reweigh(spread: Sequence[Floats], sigma: Sequence[Floats]) -> bool:
    """Whether the weights of the columns against each other changed by much; a common factor has no influence."""
    ratio = np.log(np.concatenate(spread) / np.concatenate(sigma))
    return bool(np.ptp(ratio) > SAME)


def _polished(sources: Sequence[Source], terms: Sequence[Term], search: bool, progress: Progress | None) -> Polished:
    return (
        polish(sources, terms, progress) if search else Polished(tuple(terms), (), gather(sources, terms, progress), ())
    )


def _weighed(sources: Sequence[Source], rows: Sequence[Floats], sigma: Sequence[Floats]) -> list[Source]:
    """Sources with their given weights, times those of the rows, over the noise of each column."""
    return [
        s.weighted(((s.weight * row).reshape(-1, s.count) / size).ravel())
        for s, row, size in zip(sources, rows, sigma, strict=True)
    ]


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


def _sigmas(sources: Sequence[Source], residuals: Sequence[Floats]) -> list[Floats]:
    """Robust standard deviation of each reading column, (readings,) for each source."""
    made_by = [s.measurement.instrument for s in sources]
    kinds = [(m.name, m.axis, m.component, c) for m in made_by for c in m.columns()]
    rows = [(row, s.measurement.run) for r, s in zip(residuals, sources, strict=True) for row in r]
    out = sigmas(kinds, [row for row, _ in rows], [run for _, run in rows])
    return np.split(out, np.cumsum([len(r) for r in residuals])[:-1])


def _rows(left: Floats, sigma: Floats) -> Floats:
    """Factor of each reading by its residual, (n · readings,)."""
    return flat(np.stack([huber(row, float(size)) for row, size in zip(left, sigma, strict=True)]))


def _changed(
    rows: Sequence[Floats], now: Sequence[Floats], residuals: Sequence[Floats], sigma: Sequence[Floats]
) -> bool:
    """Whether the influence of the readings changed."""
    return not all(
        settled(before.reshape(left.shape[::-1])[:, j], after.reshape(left.shape[::-1])[:, j], row, float(size[j]))
        for before, after, left, size in zip(rows, now, residuals, sigma, strict=True)
        for j, row in enumerate(left)
    )


def _noise(sources: Sequence[Source], residuals: Sequence[Floats], normal: Normal) -> list[Floats]:
    """Noise from the residual of each reading column; the degrees of freedom of the fit are shared evenly."""
    share = np.sqrt(max(normal.freedom, 1.0) / max(float(normal.readings.sum()), 1.0))
    out = []
    for source, left in zip(sources, residuals, strict=True):
        weight = (source.weight.reshape(-1, source.count)).T
        full = weight.max(axis=1, keepdims=True)
        trust = np.where(full > 0, weight / np.where(full > 0, full, 1.0), 0.0) ** 2
        squares = (np.nan_to_num(left) ** 2 * trust).sum(axis=1) / np.maximum(trust.sum(axis=1), 1.0)
        least = np.maximum(1e-9 * np.nanmax(np.abs(source.measurement.matrix()), axis=1, initial=0.0), 1e-12)
        out.append(np.maximum(np.sqrt(squares) / max(share, 1e-3), least))
    return out

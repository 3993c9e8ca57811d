"""Normal equations, block by block: fit, held-out error, standard errors, all without the readings.

Symbols: `G = XᵀX`, `b = Xᵀy` of a block's weighted readings y and columns X, stored as one matrix with y as the last
column. Sums over blocks give the fit; sums without a fold give the fit without it, and the fold's own sums then give
its error, `yᵀy - 2θᵀb + θᵀGθ`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rtec.arrays import Bools, Floats, Ints
from rtec.estimation.plain import telling

PARTS = 10
"""Neighbouring blocks of a measurement are joined into this many parts."""
RIDGE = 1e-11
"""Added to the scaled diagonal: a column that a part of the data does not show at all gets a zero there."""
NOTHING = 1e-12
"""A column of which nuisances leave less than this share is not seen."""
UNSEEN = 1e-9
"""A direction whose share of the scaled normal equations is below this is not seen by the readings."""


@dataclass(frozen=True)
class Cell:
    """Contribution of one measurement to one fold.

    Attributes:
        fold: index of the fold.
        source: number of the measurement.
        gram: sum over its blocks.
        freedom: readings less projected nuisances.
    """

    fold: int
    source: int
    gram: Floats
    freedom: float


@dataclass(frozen=True)
class Normal:
    """Normal equations of weighted readings.

    Attributes:
        gram: (blocks, columns + 1, columns + 1): terms' columns, explicit nuisances, the readings.
        fold: number of each block's held-out fold, (blocks,).
        source: number of each block's measurement, (blocks,).
        readings: number of readings, (blocks,).
        lost: degrees of freedom of the nuisances that were projected out, (blocks,).
        owner: number of the term of each of the terms' columns, (terms' columns,).
        raw: sum of squares of each column before nuisances were projected out, (columns + 1,).
        extra: names of the explicit nuisances.
    """

    gram: Floats
    fold: Ints
    source: Ints
    readings: Ints
    lost: Floats
    owner: Ints
    raw: Floats
    extra: tuple[str, ...] = ()

    @cached_property
    def total(self) -> Floats:
        """Sum over the blocks."""
        return np.asarray(self.gram.sum(axis=0))

    @property
    def width(self) -> int:
        """Number of the terms' columns."""
        return len(self.owner)

    @cached_property
    def fold_numbers(self) -> Ints:
        """Numbers of the folds, rising."""
        return np.unique(self.fold)

    @cached_property
    def by_fold(self) -> Floats:
        """Sum over the blocks of each fold, (folds, columns + 1, columns + 1)."""
        if np.array_equal(self.fold, self.fold_numbers):
            return self.gram  # every block is a fold; the sums are large, and each copy takes its time
        return np.stack([self.gram[self.fold == f].sum(axis=0) for f in self.fold_numbers])

    def by_source(self) -> Floats:
        """Products of the terms' columns, explicit nuisances projected out, of each measurement, (sources, k, k)."""
        extra = np.arange(self.width, self.gram.shape[1] - 1)
        cross = self.total[np.ix_(extra, np.arange(self.width))]
        beside = np.eye(self.width)
        if len(extra):
            inverse = np.linalg.pinv(self.total[np.ix_(extra, extra)], rcond=RIDGE, hermitian=True)
            beside = np.concatenate([beside, -inverse @ cross])
        sums = [self.gram[self.source == s, :-1, :-1].sum(axis=0) for s in range(int(self.source.max()) + 1)]
        return np.asarray(beside.T @ np.stack(sums) @ beside)

    @cached_property
    def part(self) -> Ints:
        """Part of each block, (blocks,): of each measurement `PARTS` parts, in order of time."""
        part = np.zeros(len(self.fold), dtype=np.int64)
        for s in np.unique(self.source):
            mine = np.flatnonzero(self.source == s)
            part[mine] = np.arange(len(mine)) * min(PARTS, len(mine)) // len(mine)
        return part

    @cached_property
    def by_part(self) -> "Normal":
        """Parts joined, those of all measurements in the same order of time.

        Drift that no sensor sees continues from block to block: single blocks would give too small standard errors.
        """
        part = self.part
        number, place = np.unique(part, return_inverse=True)
        return replace(
            self,
            gram=np.stack([self.gram[part == p].sum(axis=0) for p in number]),
            fold=number,
            source=np.zeros_like(number),
            readings=np.bincount(place, self.readings).astype(np.int64),
            lost=np.bincount(place, self.lost).astype(np.float64),
        )

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """Contribution of each measurement to each fold."""
        pairs = sorted(set(zip(self.fold.tolist(), self.source.tolist(), strict=True)))
        free = self.readings - self.lost
        out = []
        for fold, source in pairs:
            here = np.flatnonzero((self.fold == fold) & (self.source == source))
            number = int(np.searchsorted(self.fold_numbers, fold))
            gram = self.gram[here[0]] if len(here) == 1 else np.asarray(self.gram[here].sum(axis=0))
            out.append(Cell(number, source, gram, max(float(free[here].sum()), 1.0)))
        return tuple(out)

    @property
    def freedom(self) -> float:
        """Degrees of freedom: readings less all numbers estimated from them."""
        return float(self.readings.sum() - self.lost.sum() - self.width - len(self.extra))

    def only(self, blocks: Bools) -> "Normal":
        """The normal equations of some of the blocks, (blocks,)."""
        kept = {n: getattr(self, n)[blocks] for n in ("gram", "fold", "source", "readings", "lost")}
        return replace(self, **kept)

    def pick(self, columns: Sequence[int] | Ints) -> "Normal":
        """The normal equations of some of the terms' columns; nuisances stay."""
        chosen = np.asarray(columns, dtype=np.int64)
        index = np.concatenate([chosen, np.arange(self.width, self.gram.shape[1])])
        return replace(
            self, gram=self.gram[:, index[:, None], index[None, :]], owner=self.owner[chosen], raw=self.raw[index]
        )

    def share_left(self) -> Floats:
        """Share of each column's sum of squares that the nuisances leave, (terms' columns,); zero: not seen."""
        diagonal, raw = np.diag(self.total)[: self.width], self.raw[: self.width]
        share = diagonal / np.where(raw > 0, raw, 1.0)
        return np.asarray(share)

    @property
    def floor(self) -> Floats:
        """Sums of squares below which a column is only rounding, (columns,)."""
        return NOTHING * self.raw[:-1]

    def values(self) -> Floats:
        """Least squares, (columns,): terms' columns, then explicit nuisances."""
        return np.asarray(solve(self.total[None], self.floor)[0])

    def squares(self, values: Floats) -> float:
        """Sum of squared weighted residuals in sample."""
        return float(squares_left(self.total[None], values[None])[0])

    @cached_property
    def alone(self) -> Bools:
        """Which explicit nuisances occur in only one fold, (folds, nuisances)."""
        whole = np.diag(self.total)[self.width : -1]
        own = np.diagonal(self.by_fold, axis1=1, axis2=2)[:, self.width : -1]
        return np.asarray((whole - own <= UNSEEN * whole) & (whole > 0))

    def held_out(self) -> tuple[Floats, Floats]:
        """Squared weighted residuals of each cell, by the fit without its fold and by the fit to all, (cells,)."""
        without = solve(self.total[None] - self.by_fold, self.floor)
        full = self.values()
        out = np.array([self._left(c, without[c.fold]) for c in self.cells])
        inside = np.array([self._left(c, full) for c in self.cells])
        return out, inside

    def _left(self, cell: Cell, values: Floats) -> float:
        """Sum of squared residuals of a cell; nuisances that only its fold has are fitted to it."""
        gram, alone = cell.gram, self.width + np.flatnonzero(self.alone[cell.fold])
        if len(alone):
            gram, values = _without(gram, alone), np.delete(values, alone)
        return max(float(squares_left(gram[None], values[None])[0]), 0.0)

    def leave_one_out(self) -> Floats:
        """Values without each block, (blocks, columns)."""
        return np.concatenate([solve((self.total - g)[None], self.floor) for g in self.gram])

    def covariance(self, values: Floats) -> Floats:
        """Covariance of the values from leaving out block by block (jackknife), (columns, columns).

        Holds whatever the correlation of the readings within a block: `(B - 1)/B Σ (θ₋b - θ)(θ₋b - θ)ᵀ`
        (Bell and McCaffrey's CR3, which errs on the large side with few blocks).
        """
        off = self.leave_one_out() - values
        blocks = len(self.gram)
        return np.asarray((blocks - 1) / blocks * (off.T @ off))

    def blocks_telling(self) -> Floats:
        """Effective number of blocks that determine each number beside the others, (columns,); small ones count less.

        `(Σ w_b)² / Σ w_b²`, where `w_b`, the diagonal of `N⁻¹ G_b N⁻¹`, is a block's contribution to the variance.
        """
        inverse = self.inverse()
        share = np.maximum(np.einsum("ij,bjk,ki->bi", inverse, self.gram[:, :-1, :-1], inverse, optimize=True), 0.0)
        return telling(share)

    def scaled(self) -> tuple[Floats, Floats]:
        """Correlation matrix of the columns, and their sizes."""
        gram = self.total[:-1, :-1]
        size = np.sqrt(np.maximum(np.diag(gram), 0.0))
        scale = np.where(size > 0, size, 1.0)
        return gram / np.outer(scale, scale), size

    def inverse(self) -> Floats:
        """Inverse of the normal equations; unseen directions are zero in it."""
        scaled, size = self.scaled()
        scale = np.where(size > 0, size, 1.0)
        return np.asarray(np.linalg.pinv(scaled, rcond=1e-13, hermitian=True) / np.outer(scale, scale))

    def condition(self) -> float:
        """Condition number of the scaled columns: 1 is ideal, above 30 some are hard to separate."""
        if len(self.total) == 1:
            return 1.0
        parts = np.linalg.eigvalsh(self.scaled()[0])
        return float(np.sqrt(parts[-1] / max(parts[0], 1e-18)))


def solve(gram: Floats, floor: Floats | float = 0.0, *, refine: bool = True) -> Floats:
    """Least squares of stacked normal equations, (n, columns + 1, columns + 1) to (n, columns).

    Args:
        gram: the readings are the last column.
        floor: a column with a smaller sum of squares is only rounding, and gets a zero, (columns,).
        refine: remove the influence of the small ridge by a step of refinement.
    """
    scaled, scale = ridged(gram, floor)
    inner, target = scaled[:, :-1, :-1], scaled[:, :-1, -1:]
    found = np.linalg.solve(inner, target)
    if refine:
        dead = scale[:, :-1] == 0.0
        there = inner - np.eye(inner.shape[1]) * (RIDGE + dead)[:, None, :]
        found += np.linalg.solve(inner, target - there @ found)
    return np.asarray(found[:, :, 0] * scale[:, :-1])


def ridged(gram: Floats, floor: Floats | float = 0.0) -> tuple[Floats, Floats]:
    """Stacked normal equations of columns of size one, with a small ridge; a column that is only rounding is decoupled.

    Args:
        gram: the readings are the last column, (n, columns + 1, columns + 1).
        floor: as for `solve`.

    Returns:
        The equations, and the factor of each column, (n, columns + 1): 0 where it is only rounding, 1 for the readings.
    """
    diagonal = np.diagonal(gram, axis1=1, axis2=2)[:, :-1]
    dead = diagonal <= floor
    own = np.where(dead, 0.0, 1.0 / np.sqrt(np.where(dead, 1.0, diagonal)))
    scale = np.concatenate([own, np.ones((len(own), 1))], axis=1)
    scaled = gram * scale[:, :, None] * scale[:, None, :]
    place = np.arange(dead.shape[1])
    scaled[:, place, place] += RIDGE + dead
    return scaled, scale


def squares_left(gram: Floats, values: Floats) -> Floats:
    """Sum of squared residuals, `yᵀy - 2θᵀb + θᵀGθ`, (n,)."""
    whole = np.concatenate([-values, np.ones((len(values), 1))], axis=1)[:, :, None]
    return np.asarray((whole.transpose(0, 2, 1) @ (gram @ whole))[:, 0, 0])


def _without(gram: Floats, gone: Ints) -> Floats:
    """Normal equations with some columns projected out."""
    keep = np.setdiff1d(np.arange(len(gram)), gone)
    cross = gram[np.ix_(gone, keep)]
    return np.asarray(gram[np.ix_(keep, keep)] - cross.T @ np.linalg.pinv(gram[np.ix_(gone, gone)]) @ cross)

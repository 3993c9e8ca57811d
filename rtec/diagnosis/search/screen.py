"""Evidence for every candidate at once: whitened, the current model taken out, Zellner's g-prior.

For a candidate with k columns, let D be the orthonormal directions that remain after the base is projected out, and r
the whitened residual of the base. Then `R² = |Dᵀr|² / |r|²`, and with g = n the log evidence over the base alone is
`½ (n - k_B - k) ln(1 + n) - ½ (n - k_B) ln(1 + n (1 - R²))`  (Liang et al. 2008). Over the grid of non-linear
parameters it is the mean, which is the cost of a search: large for a period, small for a time constant that the
readings hardly determine.

All readings are weighed. Of very many readings the directions of only some are kept, for random draws and for
comparisons of shapes.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rtec.arrays import Bools, Floats, Ints
from rtec.errors import ModelError
from rtec.estimation.candidates import EffectCandidate
from rtec.estimation.noise import Whitener
from rtec.estimation.readings import Readings
from rtec.parallel import each

Single = NDArray[np.float32]
Progress = Callable[[int, int], None]
ABSORBED = 2e-3
"""A direction is absorbed where the base leaves less than this share of its norm."""
UNMOVED = 1e-3
"""Readings that an effect of its usual size moves by less than this, µm or µrad, give no information about it."""
CHUNK, NUMBERS = 96, 1_000_000
"""Columns that are whitened together at most, and how many numbers these may hold to fit into the cache."""


@dataclass(frozen=True)
class Projected:
    """Whitened readings less the base, and the basis that removes it from columns.

    Attributes:
        whitener: the noise.
        q: orthonormal basis of the whitened base, (m, k_B).
        left: whitened readings less the base, (m,).
    """

    whitener: Whitener
    q: Floats
    left: Floats

    @classmethod
    def of(cls, whitener: Whitener, base: Floats, values: Floats) -> "Projected":
        """Whiten and project."""
        q = orthonormal(whitener(base))
        white = whitener(values)
        return cls(whitener, q, white - q @ (q.T @ white))

    def take_out(self, white: Floats) -> Floats:
        """Whitened columns less the base, (m, p)."""
        return np.asarray(white - self.q @ (self.q.T @ white))

    @cached_property
    def squares(self) -> float:
        """Sum of squares of the whitened residual."""
        return float(self.left @ self.left)

    @cached_property
    def freedom(self) -> float:
        """Readings less all numbers estimated from them."""
        readings = self.whitener.readings
        lost = sum(s.nuisance.shape[1] * (int(s.run[-1]) + 1) for s in readings.series)
        return float(max(len(readings) - self.q.shape[1] - lost, 4))


@dataclass(frozen=True)
class Variant:
    """A candidate at one value of its non-linear parameters.

    Attributes:
        candidate: its number.
        theta: number among the candidate's values.
        first, count: its directions in `Screen.directions`.
        size: norm of each of its whitened columns before and after the base is taken out, (k, 2).
        squares: sums of squares of each of its columns over each series of readings, (k, series).
    """

    candidate: int
    theta: int
    first: int
    count: int
    size: Floats
    squares: Floats


@dataclass(frozen=True)
class WeighedChunk:
    """Variants of a chunk that the base does not absorb.

    Attributes:
        variants: with the first direction of each among those of the chunk.
        directions: of all, at the readings that are kept, (directions, kept).
        along: their products with the residual, (directions,).
    """

    variants: list[Variant]
    directions: Single
    along: Floats


@dataclass(frozen=True)
class Screen:
    """Evidence of the readings for every candidate.

    Attributes:
        projected: readings, whitened, less the base.
        candidates: as given.
        variants: those that the base does not absorb.
        directions: orthonormal directions of all, at the readings that are kept, (kept, columns).
        along: inner product of each direction with the whitened residual, over all readings, (columns,).
        log_evidence: of each variant, (variants,).
        absorbed: candidates that the base absorbs entirely.
    """

    projected: Projected
    candidates: tuple[EffectCandidate, ...]
    variants: tuple[Variant, ...]
    directions: Single
    along: Floats
    log_evidence: Floats
    absorbed: tuple[int, ...]

    @cached_property
    def counts(self) -> Ints:
        """Directions of each variant."""
        return np.array([v.count for v in self.variants], dtype=np.int64)

    @cached_property
    def starts(self) -> Ints:
        """First variant of each candidate that has any."""
        owner = np.array([v.candidate for v in self.variants], dtype=np.int64)
        return np.concatenate([[0], np.flatnonzero(np.diff(owner)) + 1]) if len(owner) else owner

    @cached_property
    def score(self) -> dict[int, float]:
        """Log evidence of each candidate: the mean over the grid of its non-linear parameters."""
        if not self.variants:
            return {}
        means = mean_evidence(self.log_evidence[:, None], self.starts)[:, 0]
        return {self.variants[first].candidate: float(v) for first, v in zip(self.starts, means, strict=True)}

    def search_cost(self, candidate: int) -> float:
        """Cost of the search for non-linear parameters: the best log evidence less the mean."""
        return float(self.log_evidence[self.best[candidate]] - self.score[candidate])

    @cached_property
    def best(self) -> dict[int, int]:
        """Best variant of each candidate."""
        out: dict[int, int] = {}
        for i, v in enumerate(self.variants):
            if v.candidate not in out or self.log_evidence[i] > self.log_evidence[out[v.candidate]]:
                out[v.candidate] = i
        return out

    @cached_property
    def order(self) -> list[int]:
        """Candidates by evidence, best first."""
        return sorted(self.score, key=lambda c: -self.score[c])

    def contribution(self, candidate: int) -> Floats:
        """The part of the whitened residual that a candidate explains, at the readings that are kept, (kept,)."""
        v = self.variants[self.best[candidate]]
        part = slice(v.first, v.first + v.count)
        return np.asarray(self.directions[:, part].astype(np.float64) @ self.along[part])

    def family_p(self, draws: int, rng: np.random.Generator) -> tuple[float, Floats]:
        """Probability that noise alone gives an equally good best candidate, and the evidences of the random draws.

        Each draw is white noise less the base; its best evidence over the whole library counts.
        """
        if not self.variants:
            return 1.0, np.zeros(0)
        tops = []
        # Readings that are not kept are noise beside the directions; the kept ones represent all.
        skipped = len(self.projected.left) - len(self.directions)
        rest = max(skipped - self.projected.q.shape[1], 0)
        directions, base = self.directions, None
        if skipped:
            directions = directions / np.maximum(np.linalg.norm(directions, axis=0), 1e-12)
        else:
            base = self.projected.q.astype(np.float32)
        for start in range(0, draws, 100):
            noise = rng.standard_normal((len(directions), min(100, draws - start)), dtype=np.float32)
            t2 = (directions.T @ noise) ** 2
            total = (noise**2).sum(axis=0)
            if base is not None:
                total -= ((base.T @ noise) ** 2).sum(axis=0)
            elif rest:
                total += rng.chisquare(rest, len(total)).astype(np.float32)
            r2 = _sums(t2, self.variants) / total
            made = evidence(r2, self.counts[:, None], self.projected)
            tops.append(mean_evidence(made, self.starts).max(axis=0))
        chance = np.concatenate(tops).astype(np.float64)
        return float((1 + np.sum(chance >= max(self.score.values()))) / (draws + 1)), chance


@dataclass(frozen=True)
class Chunk:
    """Columns of some variants, side by side.

    Attributes:
        which: candidate and number of its values, (variants, 2).
        widths: columns of each, (variants,).
        columns: (m, columns).
    """

    which: Ints
    widths: Ints
    columns: Floats


class Bank:
    """Columns of all candidates, computed by the first screen and kept for later ones.

    Args:
        readings: all.
        candidates: effects that are searched.
        keep: at which readings columns are kept, (m,): all, unless they are many.
    """

    def __init__(self, readings: Readings, candidates: Sequence[EffectCandidate], keep: Bools) -> None:
        self.readings, self.candidates, self.keep = readings, tuple(candidates), keep
        self.chunks: list[Chunk] = []
        machine = readings.machine
        self.usual = [np.array([p.typical for p in c.effect.coefficients(machine)]) for c in candidates]

    def groups(self) -> list[list[tuple[int, int]]]:
        """Candidates and numbers of their grid values whose columns are computed together."""
        most = min(CHUNK, NUMBERS // max(len(self.readings), 1) + 1)
        out: list[list[tuple[int, int]]] = [[]]
        width = 0
        for i, c in enumerate(self.candidates):
            for j in range(len(c.thetas)):
                if width >= most:
                    out.append([])
                    width = 0
                out[-1].append((i, j))
                width += len(self.usual[i])
        return out

    def made(self, group: Sequence[tuple[int, int]]) -> Chunk | None:
        """Columns of a group at all readings; None where none can be computed."""
        made = {which: columns for which in group if (columns := self._columns(*which)) is not None}
        return _chunk(list(made), list(made.values())) if made else None

    def kept(self, chunk: Chunk) -> Chunk:
        """Columns at the kept readings."""
        return chunk if self.keep.all() else replace(chunk, columns=chunk.columns[self.keep])

    def _columns(self, number: int, theta: int) -> Floats | None:
        candidate = self.candidates[number]
        try:
            columns = self.readings.columns(candidate.effect, candidate.thetas[theta])
        except ModelError:
            return None  # a measurement that sees the component lacks a channel: reported by `library`
        return columns if np.isfinite(columns).all() else None


def _chunk(which: Sequence[tuple[int, int]], columns: Sequence[Floats]) -> Chunk:
    return Chunk(np.array(which), np.array([c.shape[1] for c in columns]), np.concatenate(columns, axis=1))


def screen(bank: Bank, projected: Projected) -> Screen:
    """Weigh every candidate by the kept readings.

    Args:
        bank: the candidates; their columns are already computed.
        projected: the whitened readings less the current model.
    """
    weighed = _Weighed(bank, projected, None)
    for chunk in bank.chunks:
        weighed.append(weighed.weigh(chunk))
    return weighed.screen()


def screen_all(bank: Bank, projected: Projected, progress: Progress | None = None) -> Screen:
    """Weigh every candidate by all readings.

    Args:
        bank: the candidates; their columns are computed and kept.
        projected: the whitened readings less the current model.
        progress: called with the candidates done and in total.
    """
    weighed = _Weighed(bank, projected, None if bank.keep.all() else bank.keep)
    groups = bank.groups()
    total, counted = sum(map(len, groups)), itertools.count()

    def weigh(group: Sequence[tuple[int, int]]) -> tuple[Chunk, WeighedChunk] | None:
        chunk = bank.made(group)
        if progress:
            progress(sum(map(len, groups[: next(counted) + 1])), total)
        return None if chunk is None else (bank.kept(chunk), weighed.weigh(chunk))

    bank.chunks = []
    for found in each(weigh, groups, len(projected.left)):
        if found is not None:
            bank.chunks.append(found[0])
            weighed.append(found[1])
    return weighed.screen()


def mean_evidence(values: Floats, starts: Ints) -> Floats:
    """Logarithm of the mean evidence over stretches of rows that begin at `starts`, (rows, k) to (stretches, k)."""
    top = np.maximum.reduceat(values, starts, axis=0)
    sizes = np.diff(np.append(starts, len(values)))
    total = np.add.reduceat(np.exp(np.maximum(values - np.repeat(top, sizes, axis=0), -60.0)), starts, axis=0)
    return np.asarray(top + np.log(total / sizes[:, None]))


def evidence(r2: Floats, columns: Ints, projected: Projected) -> Floats:
    """Log evidence over the base alone, Zellner's g-prior with g = n."""
    n, free = float(len(projected.left)), projected.freedom
    left = np.maximum(1.0 - r2, 1e-12)
    return np.asarray(0.5 * (free - columns) * np.log1p(n) - 0.5 * free * np.log1p(n * left))


def orthonormal(columns: Floats) -> Floats:
    """An orthonormal basis of columns, (m, rank)."""
    size = np.linalg.norm(columns, axis=0)
    kept = columns[:, size > 0] / size[size > 0]
    if not kept.shape[1]:
        return np.asarray(kept)
    gram = kept.T @ kept
    value, vector = np.linalg.eigh(gram)
    good = value > 1e-9 * value[-1]
    q = kept @ (vector[:, good] / np.sqrt(value[good]))
    # A second pass restores the precision that the Gram matrix lost.
    return np.asarray(np.linalg.qr(q)[0], dtype=np.float64)


class _Weighed:
    """Directions of all variants, computed chunk by chunk, those of equal width together."""

    def __init__(self, bank: Bank, projected: Projected, keep: Bools | None) -> None:
        self.bank, self.projected, self.keep = bank, projected, keep
        self.variants: list[Variant] = []
        most = sum(len(c.thetas) * len(u) for c, u in zip(bank.candidates, bank.usual, strict=True))
        rows = len(projected.left) if keep is None else int(keep.sum())
        # The kept readings represent all.
        self.more = math.sqrt(len(projected.left) / rows)
        # Column-major memory, filled chunk by chunk: two copies of it would be most of a search's memory.
        self.directions: Single = np.empty((rows, most), dtype=np.float32, order="F")
        self.along: Floats = np.empty(most)
        self.width = 0

    def screen(self) -> Screen:
        """The screen of all variants added so far."""
        projected, variants, along = self.projected, tuple(self.variants), self.along[: self.width]
        r2 = _sums((along**2)[:, None], variants)[:, 0] / max(projected.squares, 1e-300)
        counts = np.array([v.count for v in variants], dtype=np.int64)
        there = {v.candidate for v in variants}
        absorbed = tuple(i for i in range(len(self.bank.candidates)) if i not in there)
        found = evidence(r2, counts, projected)
        return Screen(
            projected, self.bank.candidates, variants, self.directions[:, : self.width], along, found, absorbed
        )

    def weigh(self, chunk: Chunk) -> WeighedChunk:
        """Weigh the variants of a chunk; other chunks may be weighed at the same time."""
        first = np.cumsum(chunk.widths) - chunk.widths
        usual = np.concatenate([self.bank.usual[int(i)] for i in chunk.which[:, 0]])
        parts = [chunk.columns[s.part] for s in self.projected.whitener.readings.series]
        squares = np.stack([np.einsum("ij,ij->j", c, c) for c in parts], axis=1)
        moves = np.sqrt(squares.sum(axis=1) / len(chunk.columns))
        moved = np.maximum.reduceat(moves * usual, first) > UNMOVED
        white = self.projected.whitener(chunk.columns)
        before = norms(white)
        # A column's readings one after the other in memory: the columns of a variant are multiplied with each other.
        left = np.ascontiguousarray(self.projected.take_out(white).T)
        size = np.stack([before, np.sqrt(np.einsum("ij,ij->i", left, left))], axis=1)
        left /= np.where(before > 0, before, 1.0)[:, None]
        along = left @ self.projected.left
        kept = left if self.keep is None else left[:, self.keep] * self.more
        turned: dict[int, tuple[Single, Floats]] = {}
        for width in np.unique(chunk.widths[moved]).tolist():
            mine = np.flatnonzero(moved & (chunk.widths == width))
            at = first[mine][:, None] + np.arange(width)
            for good, turn in _turns(left[at]):
                new = turn.transpose(0, 2, 1)
                times = np.multiply if width == 1 else np.matmul
                made = times(new, kept[at[good]]).astype(np.float32), times(new, along[at[good]][:, :, None])[:, :, 0]
                turned |= zip(mine[good].tolist(), zip(*made, strict=True), strict=True)
        variants, there = [], sorted(turned)
        for v, start in zip(there, itertools.accumulate((len(turned[v][1]) for v in there), initial=0), strict=False):
            part, (candidate, theta) = slice(first[v], first[v] + chunk.widths[v]), chunk.which[v].tolist()
            variants.append(Variant(candidate, theta, start, len(turned[v][1]), size[part], squares[part]))
        if not there:
            return WeighedChunk([], np.empty((0, kept.shape[1]), dtype=np.float32), np.empty(0))
        return WeighedChunk(variants, *(np.concatenate([turned[v][i] for v in there]) for i in (0, 1)))

    def append(self, weighed: WeighedChunk) -> None:
        """Append the result of a chunk to those of earlier chunks."""
        here = slice(self.width, self.width + len(weighed.along))
        for v in weighed.variants:
            self.variants.append(Variant(v.candidate, v.theta, self.width + v.first, v.count, v.size, v.squares))
        self.directions[:, here] = weighed.directions.T
        self.along[here] = weighed.along
        self.width = here.stop


def _turns(left: Floats) -> Iterator[tuple[Ints, Floats]]:
    """Matrices that turn columns into orthonormal directions, for variants with the same number of these at a time.

    Args:
        left: columns less the base, divided by their norms before, (variants, k, readings).

    Yields:
        Numbers of some variants, (some,), and their matrices, (some, k, count); none for a variant without directions.
    """
    value, vector = np.linalg.eigh(left @ left.transpose(0, 2, 1))
    # In rising order, so the directions that the base absorbs come first.
    counts = (value > ABSORBED**2).sum(axis=1)
    for count in np.unique(counts[counts > 0]).tolist():
        good = np.flatnonzero(counts == count)
        yield good, vector[good, :, -count:] / np.sqrt(value[good, None, -count:])


def norms(columns: Floats) -> Floats:
    """Norm of each column, (p,)."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->j", columns, columns)))


def _sums(squares: NDArray[np.floating], variants: Sequence[Variant]) -> Floats:
    """Sum of squares over the directions of each variant, (columns, draws) to (variants, draws)."""
    first = np.array([v.first for v in variants], dtype=np.int64)
    return np.asarray(np.add.reduceat(squares, first, axis=0)) if len(first) else np.zeros((0, squares.shape[1]))

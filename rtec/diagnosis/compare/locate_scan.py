"""Scans all stretches of a channel, and rectangles of two, for the one that is worst beyond chance.

The score of a region is that of a change of variance: twice the log likelihood ratio of "the mean square inside is
another than outside" over "the same everywhere", its root signed; so the region that holds all bad readings and no
others is best. It is divided by its root mean square over draws of noise, which do to that very region what drift
and the nuisances do; the largest over all regions, draw by draw, is what chance can do.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis.compare.bins import Variable

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

LARGEST = 0.6
"""A region with more of the readings is not "where", it is nearly everywhere."""
FEWEST, SHARE = 8, 0.015
TINY = 1e-12


@dataclass(frozen=True)
class Spot:
    """A region and its score.

    Attributes:
        variables: one or two.
        first, last: stretches of each, both included.
        score: over what noise makes of it; large is worse.
    """

    variables: tuple[Variable, ...]
    first: tuple[int, ...]
    last: tuple[int, ...]
    score: float

    @cached_property
    def inside(self) -> Bools:
        """Which readings lie in it, (n,)."""
        whole = [(v.code >= a) & (v.code <= b) for v, a, b in zip(self.variables, self.first, self.last, strict=True)]
        return np.asarray(np.logical_and.reduce(whole))

    def only(self, which: int) -> "Spot":
        """The region of one of its variables."""
        return Spot((self.variables[which],), (self.first[which],), (self.last[which],), 0.0)


@dataclass(frozen=True)
class Scan:
    """The best region of each kind, and what chance made of all.

    Attributes:
        single, pair: best of one channel, and of two; None where there is none at all.
        singles: the best region of each channel.
        chance: best score of each draw, (draws,).
    """

    single: Spot | None
    pair: Spot | None
    singles: tuple[Spot, ...]
    chance: Floats


def scan(fine: Sequence[Variable], pairs: Sequence[tuple[Variable, Variable]], squares: Any, free: Bools) -> Scan:
    """Score every region.

    Args:
        fine: channels by themselves.
        pairs: channels two by two.
        squares: of the residuals, then of each draw of noise, (n, 1 + draws); single precision will do.
        free: readings that count, (n,); the others lie in regions that were found before.
    """
    chance = np.full(squares.shape[1] - 1, -np.inf)
    singles, best_pair = [], None
    whole = np.where(free[:, None], squares, 0.0)
    for v in fine:
        sums, counts = _cells([v], whole, free)
        a, b = _stretches(len(v))
        spot = _best([v], [a], [b], sums[b + 1] - sums[a], counts[b + 1] - counts[a], whole, free, chance)
        singles += [spot] if spot else []
    for pair in pairs:
        spot = _rectangles(pair, whole, free, chance)
        if spot and (best_pair is None or spot.score > best_pair.score):
            best_pair = spot
    single = max(singles, key=lambda s: s.score, default=None)
    return Scan(single, best_pair, tuple(singles), chance)


def _cells(variables: Sequence[Variable], whole: Floats, free: Bools) -> tuple[Floats, Floats]:
    """Running sums of squares, (k + 1, …, 1 + draws), and of counts, over the stretches of one or two variables."""
    from scipy.sparse import csr_array

    shape = [len(v) for v in variables]
    code = np.ravel_multi_index([v.code for v in variables], shape)
    n, cells = len(code), int(np.prod(shape))
    index = csr_array((np.ones(n, dtype=whole.dtype), (code, np.arange(n))), shape=(cells, n))
    sums = np.asarray(index @ whole, dtype=np.float64).reshape(*shape, -1)
    counts = np.bincount(code[free], minlength=cells).astype(np.float64).reshape(shape)
    for axis in range(len(shape)):
        sums = np.concatenate([np.zeros_like(np.take(sums, [0], axis)), np.cumsum(sums, axis)], axis)
        counts = np.concatenate([np.zeros_like(np.take(counts, [0], axis)), np.cumsum(counts, axis)], axis)
    return sums, counts


def _stretches(k: int) -> tuple[Ints, Ints]:
    """First and last of every run of neighbouring stretches."""
    a, b = np.triu_indices(k)
    return a.astype(np.int64), b.astype(np.int64)


def _rectangles(pair: tuple[Variable, Variable], whole: Floats, free: Bools, chance: Floats) -> Spot | None:
    sums, counts = _cells(pair, whole, free)
    (a, b), (c, d) = _stretches(len(pair[0])), _stretches(len(pair[1]))
    # All of one channel is a region of the other by itself.
    a, b = (x[(b - a) < len(pair[0]) - 1] for x in (a, b))
    c, d = (x[(d - c) < len(pair[1]) - 1] for x in (c, d))
    i, j = (g.ravel() for g in np.meshgrid(np.arange(len(a)), np.arange(len(c)), indexing="ij"))
    a, b, c, d = a[i], b[i], c[j], d[j]

    def over(x: Floats) -> Floats:
        return np.asarray(x[b + 1, d + 1] - x[a, d + 1] - x[b + 1, c] + x[a, c])

    return _best(list(pair), [a, c], [b, d], over(sums), over(counts), whole, free, chance)


def _best(
    variables: list[Variable],
    first: list[Ints],
    last: list[Ints],
    inside: Floats,
    count: Floats,
    whole: Floats,
    free: Bools,
    chance: Floats,
) -> Spot | None:
    """Best region; raises `chance` to the best score of each draw."""
    total, n = whole.sum(axis=0, dtype=np.float64), float(free.sum())
    good = (count >= max(FEWEST, SHARE * n)) & (count <= LARGEST * n)
    if not good.any():
        return None
    signed = _signed(inside[good], count[good], total, n)
    usual = np.sqrt(np.mean(signed[:, 1:] ** 2, axis=1))
    score = signed / np.maximum(usual, 1.0)[:, None]
    np.maximum(chance, score[:, 1:].max(axis=0), out=chance)
    best = int(np.argmax(score[:, 0]))
    place = np.flatnonzero(good)[best]
    return Spot(
        tuple(variables),
        tuple(int(x[place]) for x in first),
        tuple(int(x[place]) for x in last),
        float(score[best, 0]),
    )


def _signed(inside: Floats, count: Floats, total: Floats, n: float) -> Floats:
    """Signed root of the log likelihood ratio of two variances over one, (regions, 1 + draws)."""
    k = count[:, None]
    within = np.maximum(inside, 0.0) / k + TINY
    without = np.maximum(total - inside, 0.0) / (n - k) + TINY
    everywhere = np.maximum(total, 0.0) / n + TINY
    ratio = n * np.log(everywhere) - k * np.log(within) - (n - k) * np.log(without)
    return np.asarray(np.sign(within - without) * np.sqrt(np.maximum(ratio, 0.0)))

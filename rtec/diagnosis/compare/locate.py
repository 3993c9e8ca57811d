"""Where the model is worst: stretches of a channel, or of two, with a larger residual than noise alone explains.

Random draws come from the fitted noise model, with its drift and tails, and are treated as the readings are. A region
is reported only where its score beats the best of all regions, of all series, in 98 % of the draws; where it has at
least 1.5 % of the readings; and where its residual is at least a fifth larger than elsewhere. A pair of channels is
reported only where it beats the best single channel and has a clearly larger residual than the rest of either stretch.

Where the readings in direction + and those in direction - differ by the same amount everywhere, that is no place.

The module scans all stretches of a channel, and rectangles of two, for the worst one beyond noise alone.

The score of a region is that of a change of variance: twice the log likelihood ratio of "the mean square inside differs
from that outside" over "the same everywhere", its root signed. So the region with all bad readings and no others is
best. The score is divided by its root mean square over draws of noise, in which drift and nuisances affect that region
as they do in the readings; the largest over all regions, draw by draw, is what noise alone can reach.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np

from rtec.arrays import Bools, Floats, Ints
from rtec.diagnosis.compare.bins import COARSE, FINE, Variable, variables_of, words_of
from rtec.diagnosis.compare.result import Bound, Region
from rtec.estimation.floor import draws
from rtec.estimation.noise import Whitener
from rtec.estimation.readings import Readings, Series
from rtec.wording import ERROR_UNITS, number

STRETCHES, READINGS = 4, 3
"""Fewest stretches of the way, and fewest readings in each direction in each."""
EVEN = 0.25
"""Standard deviation of the gap from stretch to stretch, as a share of the gap, at most."""
MOST_OF_IT = 0.5
"""Least share of the residual's mean square that the gap explains."""
APART_LEVEL = 0.02


def both_ways(
    readings: Readings, series: Series, left: Floats, noise: Floats, fine: Sequence[Variable]
) -> Region | None:
    """The axis whose directions differ by the same amount everywhere; None where no axis does, or places explain more.

    Args:
        readings: that were compared.
        series: reading column.
        left: measured minus predicted, (n,).
        noise: drawn, (n, draws).
        fine: channels of the series, cut.
    """
    by_name = {v.name: v for v in fine}
    found = [
        region
        for axis in readings.machine.axes
        if (place := by_name.get(axis.channel)) is not None and (way := by_name.get(axis.direction_channel)) is not None
        if (region := _of_axis(axis.name, place, way, left, noise, series.unit, _several(fine))) is not None
    ]
    return min(found, key=lambda r: r.elsewhere, default=None)


def _several(fine: Sequence[Variable]) -> bool:
    return sum(v.name.startswith("d_") for v in fine) > 1


def _of_axis(
    name: str, place: Variable, way: Variable, left: Floats, noise: Floats, unit: str, several: bool
) -> Region | None:
    sign = np.asarray(way.low)[way.code]
    plus, minus = sign > 0, sign < 0
    gaps = _gaps(place, plus, minus, left)
    if len(gaps) < STRETCHES:
        return None
    gap = float(np.mean(gaps))
    if float(np.std(gaps)) > EVEN * abs(gap):
        return None
    rest = left - 0.5 * gap * np.sign(sign)
    before, after = float(np.mean(left**2)), float(np.mean(rest**2))
    chance = np.abs(noise[plus].mean(axis=0) - noise[minus].mean(axis=0))
    p = (1.0 + float((chance >= abs(gap)).sum())) / (1.0 + noise.shape[1])
    if 1.0 - after / max(before, 1e-30) < MOST_OF_IT or p > APART_LEVEL:
        return None
    of = f" of {name}" if several else ""
    words = f"moving + and moving −{of} differ by {number(abs(gap))} {ERROR_UNITS.get(unit, unit)} everywhere"
    bound = Bound(way.name, -1.0, 1.0, way.unit)
    return Region((bound,), before**0.5, float(left.mean()), after**0.5, len(left), p, words, (), gap)


def _gaps(place: Variable, plus: Bools, minus: Bools, left: Floats) -> Floats:
    """Mean in direction + less mean in direction -, in each stretch of the way with enough of both."""
    sizes, sums = [], []
    for mask in (plus, minus):
        sizes.append(np.bincount(place.code[mask], minlength=len(place)))
        sums.append(np.bincount(place.code[mask], weights=left[mask], minlength=len(place)))
    full = (sizes[0] >= READINGS) & (sizes[1] >= READINGS)
    return np.asarray(sums[0][full] / sizes[0][full] - sums[1][full] / sizes[1][full])


LARGEST = 0.6
"""A region with more of the readings is no place: it is nearly everywhere."""
FEWEST, SHARE = 8, 0.015
TINY = 1e-12


@dataclass(frozen=True)
class Spot:
    """A region and its score.

    Attributes:
        variables: one or two.
        first, last: stretches of each, both included.
        score: relative to the scores of noise alone; large is worse.
    """

    variables: tuple[Variable, ...]
    first: tuple[int, ...]
    last: tuple[int, ...]
    score: float

    @cached_property
    def inside(self) -> Bools:
        """Which readings are in it, (n,)."""
        whole = [(v.code >= a) & (v.code <= b) for v, a, b in zip(self.variables, self.first, self.last, strict=True)]
        return np.asarray(np.logical_and.reduce(whole))

    def only(self, which: int) -> "Spot":
        """The region of one of its variables."""
        return Spot((self.variables[which],), (self.first[which],), (self.last[which],), 0.0)


@dataclass(frozen=True)
class Scan:
    """The best region of each kind, and the best scores of noise alone.

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
        fine: single channels.
        pairs: pairs of channels.
        squares: of the residuals, then of each draw of noise, (n, 1 + draws); single precision suffices.
        free: readings that count, (n,); the others are in earlier regions.
    """
    chance = np.full(squares.shape[1] - 1, -np.inf)
    singles, best_pair = [], None
    whole = np.where(free[:, None], squares, 0.0)
    n = float(free.sum())
    # Over the mean square of all, so that single precision suffices for sums and logarithms.
    whole /= np.maximum(whole.sum(axis=0, dtype=np.float64) / max(n, 1.0), TINY)
    for v in fine:
        sums, counts = _cells([v], whole, free)
        a, b = _stretches(len(v))
        spot = _best([v], [a], [b], _within_stretch, sums, counts, n, chance)
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
    return sums.astype(whole.dtype), counts


def _stretches(k: int) -> tuple[Ints, Ints]:
    """First and last of every run of neighbouring stretches."""
    a, b = np.triu_indices(k)
    return a.astype(np.int64), b.astype(np.int64)


def _rectangles(pair: tuple[Variable, Variable], whole: Floats, free: Bools, chance: Floats) -> Spot | None:
    sums, counts = _cells(pair, whole, free)
    (a, b), (c, d) = _stretches(len(pair[0])), _stretches(len(pair[1]))
    # The whole of one channel is a region of the other by itself.
    a, b = (x[(b - a) < len(pair[0]) - 1] for x in (a, b))
    c, d = (x[(d - c) < len(pair[1]) - 1] for x in (c, d))
    i, j = (g.ravel() for g in np.meshgrid(np.arange(len(a)), np.arange(len(c)), indexing="ij"))
    a, b, c, d = a[i], b[i], c[j], d[j]

    return _best(list(pair), [a, c], [b, d], _within_rectangle, sums, counts, float(free.sum()), chance)


def _within_stretch(x: Floats, first: Sequence[Ints], last: Sequence[Ints]) -> Floats:
    """Sums over stretches of one variable, off its running sums."""
    return np.asarray(x[last[0] + 1] - x[first[0]])


def _within_rectangle(x: Floats, first: Sequence[Ints], last: Sequence[Ints]) -> Floats:
    """Sums over rectangles of two variables, off their running sums."""
    (a, c), (b, d) = first, last
    return np.asarray(x[b + 1, d + 1] - x[a, d + 1] - x[b + 1, c] + x[a, c])


AT_ONCE = 15_000
"""Scores that are reckoned at a time: so many stay in the processor's cache."""


def _best(
    variables: list[Variable],
    first: list[Ints],
    last: list[Ints],
    within: Callable[[Floats, Sequence[Ints], Sequence[Ints]], Floats],
    sums: Any,
    counts: Floats,
    n: float,
    chance: Floats,
) -> Spot | None:
    """Best region; raises `chance` to the best score of each draw. `n` readings are free."""
    count = within(counts, first, last)
    good = np.flatnonzero((count >= max(FEWEST, SHARE * n)) & (count <= LARGEST * n))
    best: Spot | None = None
    rows = max(AT_ONCE // sums.shape[-1], 1)
    for i in range(0, len(good), rows):
        some = good[i : i + rows]
        a, b = [x[some] for x in first], [x[some] for x in last]
        score = _signed(within(sums, a, b), count[some], n)
        usual = np.sqrt(np.mean(score[:, 1:] ** 2, axis=1))
        score /= np.maximum(usual, 1.0)[:, None]
        np.maximum(chance, score[:, 1:].max(axis=0), out=chance)
        k = int(np.argmax(score[:, 0]))
        if best is None or score[k, 0] > best.score:
            best = Spot(tuple(variables), tuple(int(x[k]) for x in a), tuple(int(x[k]) for x in b), float(score[k, 0]))
    return best


def _signed(inside: Floats, count: Floats, n: float) -> Floats:
    """Signed root of the log likelihood ratio of two variances over one, (regions, 1 + draws).

    Args:
        inside: sums of squares, over the mean square of all readings.
        count: readings inside.
        n: all readings.
    """
    k = count[:, None].astype(inside.dtype)
    rest = n - k
    without = n - inside
    within = np.maximum(inside, 0.0, out=inside)
    within /= k
    within += TINY
    np.maximum(without, 0.0, out=without)
    without /= rest
    without += TINY
    sign = np.sign(within - without)
    ratio = np.log(within, out=within)
    ratio *= -k
    ratio -= rest * np.log(without, out=without)
    np.maximum(ratio, 0.0, out=ratio)
    sign *= np.sqrt(ratio, out=ratio)
    return np.asarray(sign)


Stage = Callable[[str, int, int], None]

MOST = 5
DRAWS, MOST_NUMBERS = 300, 8_000_000
LEVEL = 0.98
WORSE = 1.2
"""A residual less than a fifth larger is of no use in a search for causes."""
PAIR_WORSE, PAIR_BETTER = 1.3, 1.1
FURTHER, WEIGHT = 0.5, 0.05
"""A further region has at least half of the first one's residual, and this share of the mean square."""
ALIKE = 0.7
"""Two regions are the same from this share of common readings on."""


def locate(
    readings: Readings, left: Floats, whitener: Whitener, tails: Floats, seed: int, stage: Stage | None
) -> list[tuple[Region, ...]]:
    """Find the worst regions of every series, best evidence first.

    Args:
        readings: that were compared.
        left: residual, nuisances projected out, (m,).
        whitener: noise of every series.
        tails: as for `draws`.
        seed: of the random draws.
        stage: progress callback: called with the stage, steps done, steps in total.
    """
    progress = stage or (lambda *_: None)
    count = int(np.clip(MOST_NUMBERS // max(len(readings), 1), 60, DRAWS))
    noise = draws(whitener, tails, count, np.random.default_rng([seed, 500]))
    searches, scans = [], []
    for i, s in enumerate(readings.series):
        progress("looking where it is worst", i, len(readings.series))
        search = _Search(readings, s, left[s.part], noise[s.part])
        searches.append(search)
        scans.append(search.scan())
    chance = np.max([x.chance for x in scans], axis=0)
    return [search.regions(first, chance) for search, first in zip(searches, scans, strict=True)]


class _Search:
    """The search in one series."""

    def __init__(self, readings: Readings, series: Series, left: Floats, noise: Floats) -> None:
        self.readings, self.series, self.left = readings, series, left
        self.noise = noise
        self.squares = np.concatenate([left[:, None] ** 2, noise**2], axis=1).astype(np.float32)
        self.fine = variables_of(readings, series, FINE)
        self.pairs = _pairs(self.fine, variables_of(readings, series, COARSE))
        self.free = np.ones(len(left), dtype=bool)

    def scan(self) -> Scan:
        """Score all regions of the free readings."""
        return scan(self.fine, self.pairs, self.squares, self.free)

    def regions(self, first: Scan, chance: Floats) -> tuple[Region, ...]:
        """Take the best region, set its readings aside, and repeat; where both directions differ, report only that."""
        apart = both_ways(self.readings, self.series, self.left, self.noise, self.fine)
        if apart is not None:
            return (apart,)
        limit = float(np.quantile(chance, LEVEL)) if np.isfinite(chance).all() else np.inf
        found: list[tuple[Spot, Bools, tuple[str, ...], float]] = []
        now = first
        while len(found) < MOST:
            spot = self._choose(now)
            if spot is None or spot.score <= limit or not self._worse(spot):
                break
            inside = spot.inside & self.free
            if found and not self._matters(inside, found[0][1]):
                break
            p = (1.0 + float((chance >= spot.score).sum())) / (1.0 + len(chance))
            found.append((spot, inside, self._same(spot, now, limit), p))
            self.free &= ~inside
            now = self.scan()
        elsewhere = _rms(self.left[self.free])
        return tuple(self._region(*one, elsewhere) for one in found)

    def _choose(self, now: Scan) -> Spot | None:
        single, pair = now.single, now.pair
        if pair is not None and (single is None or self._clearly(pair, single)):
            return pair
        return single

    def _clearly(self, pair: Spot, single: Spot) -> bool:
        """Whether a pair beats the best single channel, and the rest of either of its own stretches."""
        if pair.score < PAIR_BETTER * single.score:
            return False
        inside = pair.inside & self.free
        rest = [pair.only(k).inside & self.free & ~inside for k in range(2)]
        here = _rms(self.left[inside])
        return all(r.any() and here > PAIR_WORSE * _rms(self.left[r]) for r in rest)

    def _worse(self, spot: Spot) -> bool:
        inside = spot.inside & self.free
        return _rms(self.left[inside]) > WORSE * _rms(self.left[self.free & ~inside])

    def _matters(self, inside: Bools, first: Bools) -> bool:
        """Whether a further region is of the same order as the first, and of weight in the whole."""
        share = float(np.sum(self.left[inside] ** 2)) / max(float(np.sum(self.left**2)), 1e-30)
        return _rms(self.left[inside]) > FURTHER * _rms(self.left[first]) and share > WEIGHT

    def _same(self, spot: Spot, now: Scan, limit: float) -> tuple[str, ...]:
        """Regions of other channels with nearly the same readings."""
        mine = spot.inside & self.free
        names = {v.name for v in spot.variables}
        out = []
        for other in sorted(now.singles, key=lambda s: -s.score):
            theirs = other.inside & self.free
            if other.variables[0].name in names or other.score <= limit:
                continue
            if (mine & theirs).sum() >= ALIKE * (mine | theirs).sum():
                out.append(self._words(other))
        return tuple(out)

    def _words(self, spot: Spot) -> str:
        moving = sum(v.name.startswith("d_") for v in self.fine)
        span = float(self.series.time_s[-1] - self.series.time_s[0])
        return words_of(_bounds(spot), self.readings.machine, moving, span)

    def _region(self, spot: Spot, inside: Bools, same: tuple[str, ...], p: float, elsewhere: float) -> Region:
        here = self.left[inside]
        return Region(
            _bounds(spot), _rms(here), float(here.mean()), elsewhere, int(inside.sum()), p, self._words(spot), same
        )


def _bounds(spot: Spot) -> tuple[Bound, ...]:
    return tuple(v.bound(a, b) for v, a, b in zip(spot.variables, spot.first, spot.last, strict=True))


def _pairs(fine: list[Variable], coarse: list[Variable]) -> list[tuple[Variable, Variable]]:
    """Pairs of channels: cut finely where the other has few values, coarsely else; time and run are one."""
    by_name = {v.name: v for v in fine}
    out = []
    for one, two in combinations(coarse, 2):
        if {one.name, two.name} == {"time_s", "run"}:
            continue
        few = [v.stepped and len(v) <= 3 for v in (one, two)]
        a = by_name[one.name] if few[1] and not few[0] else one
        b = by_name[two.name] if few[0] and not few[1] else two
        out.append((a, b) if not few[0] else (b, a))
    return out


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0

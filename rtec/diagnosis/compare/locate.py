"""Where the model is worst: stretches of a channel, or of two, in which more is left than chance explains.

Chance is drawn from the fitted noise model, with its drift and tails, and treated as the readings are. A region is told
only where its score beats the best of all regions, of all series, in 98 % of the draws; where it holds at least 1.5 %
of the readings; and where at least a fifth more is left there than elsewhere. A pair of channels is told only where it
beats the best single channel and leaves clearly more than the rest of either channel's stretch.
"""

from collections.abc import Callable
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis.compare.bins import COARSE, FINE, Variable, variables_of, words_of
from rtec.diagnosis.compare.locate_apart import both_ways
from rtec.diagnosis.compare.locate_scan import Bools, Scan, Spot, scan
from rtec.diagnosis.compare.result import Bound, Region
from rtec.estimation.floor import draws
from rtec.estimation.noise import Whitener
from rtec.estimation.readings import Readings, Series

Floats = NDArray[np.float64]
Stage = Callable[[str, int, int], None]

MOST = 5
DRAWS, MOST_NUMBERS = 300, 20_000_000
LEVEL = 0.98
WORSE = 1.2
"""Less than a fifth more is nothing that anybody would look for."""
PAIR_WORSE, PAIR_BETTER = 1.3, 1.1
FURTHER, WEIGHT = 0.5, 0.05
"""A further region is told where at least half as much is left as in the first, and this share of the mean square."""
ALIKE = 0.7
"""Share of the readings that two regions hold in common, from which on they are told as the same."""


def locate(
    readings: Readings, left: Floats, whitener: Whitener, tails: Floats, seed: int = 1, stage: Stage | None = None
) -> list[tuple[Region, ...]]:
    """Find the worst regions of every series, best evidence first.

    Args:
        readings: that were compared.
        left: measured minus predicted, nuisances taken out, (m,).
        whitener: noise of every series.
        tails: as for `draws`.
        seed: of the draws of chance.
        stage: told how far it is.
    """
    tell = stage or (lambda *_: None)
    count = int(np.clip(MOST_NUMBERS // max(len(readings), 1), 60, DRAWS))
    noise = draws(whitener, tails, count, np.random.default_rng([seed, 500]))
    searches, scans = [], []
    for i, s in enumerate(readings.series):
        tell("looking where it is worst", i, len(readings.series))
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
        """Score all regions of what is free."""
        return scan(self.fine, self.pairs, self.squares, self.free)

    def regions(self, first: Scan, chance: Floats) -> tuple[Region, ...]:
        """Take the best region, set its readings aside, and look again; where both ways lie apart, tell that alone."""
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
        """Regions of other channels that hold nearly the same readings."""
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
    """Channels two by two: cut finely where the other has few values, coarsely else; time and run are the same."""
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

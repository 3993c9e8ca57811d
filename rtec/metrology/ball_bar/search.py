"""Significant causes beyond [BB]'s in some ball-bar tests, by backward elimination.

Forward selection fails: while half of the causes are missing, the residual looks like noise that is correlated over a
quarter of the circle, and hides the others. So all separated candidates are fitted together, and the noise is estimated
with all of them in the mean. Then the least significant cause is dropped, again and again, until each remaining one has
a false-positive rate below `FAMILY` divided by the number of candidates. [BB]'s own bent guides are always in the fit.

Readings near the quadrants have a noise of their own: where the spikes differ from the catalogue's shape, the residual
there must not influence the other parameters.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rtec.arrays import Floats
from rtec.metrology.ball_bar.beyond import ExtraCause
from rtec.metrology.ball_bar.causes import Cause
from rtec.metrology.ball_bar.circle import CircleTest
from rtec.metrology.ball_bar.design import CandidateTable, Centre, NotLookedFor, stacked_design, table_of
from rtec.metrology.ball_bar.fit import Beyond, Fitted, Pick, in_a_row, solve
from rtec.metrology.ball_bar.noise import NOISE_UM, WHITE, AngleNoise, find_noise

MORE = 1.2
"""The quadrants have a noise of their own if it is at least this many times that of the rest."""
SWEEPS = 2


@dataclass(frozen=True)
class Least:
    """Least-squares solution of whitened columns.

    Attributes:
        coefficients: (k,).
        inverse: inverse of the normal matrix, (k, k).
        residual: whitened, (n,).
        sigma: standard deviation of the residual, µm.
    """

    coefficients: Floats
    inverse: Floats
    residual: Floats
    sigma: float


@dataclass(frozen=True)
class SearchState:
    """State of the search.

    Attributes:
        table: columns of [BB]'s parameters and the candidates.
        reading: readings to first order, (n,).
        noise: noise of the readings.
        base: [BB]'s whitened columns, (n, k).
        own: whitened columns of each candidate, for each distance to the top of a spike.
        white: whitened readings, (n,).
        way: place of each candidate's current distance among its distances.
    """

    table: CandidateTable
    reading: Floats
    noise: AngleNoise
    base: Floats
    own: tuple[tuple[Floats, ...], ...]
    white: Floats
    way: tuple[int, ...]

    @property
    def everything(self) -> tuple[int, ...]:
        """Places of all candidates."""
        return tuple(range(len(self.own)))

    def columns(self, places: Sequence[int]) -> Floats:
        """Whitened columns of [BB]'s parameters and of some candidates."""
        return np.concatenate([self.base, *(self.own[i][self.way[i]] for i in places)], axis=1)

    def white_of(self, places: Sequence[int]) -> Floats:
        """Whitened columns of some candidates."""
        return np.concatenate([self.own[i][self.way[i]] for i in places], axis=1)

    def plain(self, places: Sequence[int]) -> Floats:
        """Columns of [BB]'s parameters and of some candidates, not whitened."""
        return np.concatenate([self.table.base, *(self.table.columns[i][self.way[i]] for i in places)], axis=1)

    def beside(self, places: Sequence[int]) -> tuple[Floats, Floats]:
        """Orthonormal basis of [BB]'s parameters and some candidates, and the residual of a fit with it."""
        basis = np.linalg.qr(self.columns(places))[0]
        return basis, self.white - basis @ (basis.T @ self.white)


def work_of(table: CandidateTable, reading: Floats, noise: AngleNoise, way: tuple[int, ...]) -> SearchState:
    """The state of the search with everything whitened by a noise."""
    flat = [table.base, *(c for ways in table.columns for c in ways), reading[:, None]]
    white = np.split(noise.whiten(table.circles, np.concatenate(flat, axis=1)),
                     np.cumsum([c.shape[1] for c in flat])[:-1], axis=1)  # fmt: skip
    rest = iter(white[1:-1])
    own = tuple(tuple(next(rest) for _ in ways) for ways in table.columns)
    return SearchState(table, reading, noise, white[0], own, white[-1][:, 0], way)


def least(work: SearchState, places: Sequence[int]) -> Least:
    """Fit [BB]'s parameters and some candidates."""
    columns = work.columns(places)
    size = np.linalg.norm(columns, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    basis, triangle = np.linalg.qr(columns / size)
    inverse = np.linalg.pinv(triangle) / size[:, None]
    coefficients = inverse @ (basis.T @ work.white)
    residual = work.white - columns @ coefficients
    sigma = float(np.sqrt(residual @ residual / max(len(residual) - len(coefficients), 1)))
    return Least(coefficients, inverse @ inverse.T, residual, max(sigma, NOISE_UM))


def best_ways(work: SearchState) -> SearchState:
    """The state with the distance to the top of each spike that gives the smallest residual, in two sweeps."""
    spikes = [i for i, c in enumerate(work.own) if len(c) > 1]
    for _ in range(SWEEPS):
        for i in spikes:
            basis, residual = work.beside([k for k in work.everything if k != i])
            best = int(np.argmax([gain(basis, residual, c) for c in work.own[i]]))
            work = replace(work, way=(*work.way[:i], best, *work.way[i + 1 :]))
    return work


def gain(basis: Floats, residual: Floats, own: Floats) -> float:
    """Reduction of the residual sum of squares of a basis by further columns."""
    own = own - basis @ (basis.T @ own)
    return float(residual @ own @ np.linalg.lstsq(own, residual, rcond=None)[0])


def judged(work: SearchState, window_deg: float) -> tuple[AngleNoise, AngleNoise]:
    """The noise with every candidate in the mean: the likeliest one and the worst one that is still likely."""
    near = np.concatenate([c.near_quadrant(window_deg) for c in work.table.circles])
    columns = work.plain(work.everything)
    residual = work.reading - columns @ least(work, work.everything).coefficients
    weight = 1.0
    if near.any() and not near.all():
        spread = [max(float(np.sqrt(np.mean(residual[k] ** 2))), NOISE_UM) for k in (near, ~near)]
        weight = 1.0 if spread[0] < MORE * spread[1] else spread[1] / spread[0]
    if float(np.sqrt(np.mean(residual**2))) <= NOISE_UM:
        none = AngleNoise(near=weight, window_deg=window_deg)
        return none, none
    return find_noise(work.table.circles, columns, work.reading, weight, window_deg)


FAMILY = 0.001
"""Accepted false-positive rate: how often a machine without any of these causes gets one, if the noise is right."""
SMALLEST_UM = 0.05
"""A cause is dropped if its curve on a circle is smaller than this."""
SURE_SE = 4.0
"""A size of at least this many standard errors is certain."""
SURE_ODDS = 6.0
"""Twice the logarithm of the odds at which the readings decide between two causes: 20 to 1."""
HIDDEN = 1.25
"""Two causes hide each other if one increases the standard error of the other by this factor."""
RIVALS = 4
"""Largest number of alternatives that are fitted."""
SEEN = 0.99
"""Probability that a cause as large as its stated limit is significant."""
SWAPS, SMALLEST_SWAP = 3, 0.1
"""Causes are exchanged for others that explain more: at most so many times, for at least so many variances."""
NOISE_ROUNDS = 2
CLOSE = 1e-3
"""Tolerance of the logarithm of the distance to a spike's top."""


@dataclass(frozen=True)
class NotFound:
    """A cause that was tested and is not significant.

    Attributes:
        candidate: the cause.
        limit: a parameter of this size would have been significant.
        unit: unit of the limit.
        with_: causes that are not separated from it: the test is for all of them together.
    """

    candidate: ExtraCause
    limit: float
    unit: str
    with_: tuple[ExtraCause, ...] = ()


@dataclass(frozen=True)
class CausesFound:
    """Result of a search.

    Attributes:
        beyond: the significant causes, for the fit.
        not_found: causes that were tested and are not significant.
        left_out: causes that were not tested, each with the reason.
        instead: alternatives to `beyond` between which the readings do not decide.
    """

    beyond: Beyond = field(default_factory=Beyond)
    not_found: tuple[NotFound, ...] = ()
    left_out: tuple[NotLookedFor, ...] = ()
    instead: tuple[Beyond, ...] = ()


def search(
    circles: Sequence[CircleTest], still: Fitted, window_deg: float, centre: Centre, late_s: float
) -> CausesFound:
    """Search for significant causes beyond [BB]'s parameters.

    Args:
        circles: tests of one plane.
        still: fit of [BB]'s parameters away from the quadrants.
        window_deg: readings nearer than this to a quadrant have a noise of their own.
        centre: see `design_of`.
        late_s: largest time by which the axes may reverse later than commanded.
    """
    clearance = clearance_of(still, circles)
    table = table_of([c.rows(~c.taking_up(clearance, late_s)) for c in circles], centre)
    count = sum(len(c) for c in table.circles)
    if not table.separated or count < 2 * (table.base.shape[1] + sum(c[0].shape[1] for c in table.columns)):
        beyond = Beyond(clearance_um=clearance, late_s=late_s)
        return CausesFound(beyond, (), (*table.left_out, *_too_few(table, count)))
    reading = _reading(table)
    work = work_of(table, reading, replace(WHITE, window_deg=window_deg), tuple(len(c) // 2 for c in table.columns))
    for _ in range(NOISE_ROUNDS):
        work = best_ways(work)
        likeliest, worst = judged(work, window_deg)
        work = work_of(table, reading, likeliest, work.way)
    work = work_of(table, reading, worst, work.way)
    rows = in_a_row(least(work, work.everything).residual, [len(c) for c in table.circles])
    stays, chance = _eliminate(work, rows, work.everything)
    for _ in range(SWAPS):
        better = min(_instead(work, stays, rows), key=lambda i: i.lost, default=None)
        if better is None or better.lost > -SMALLEST_SWAP:
            break
        kept = [i for i in stays if i not in better.unit]
        stays, chance = _eliminate(work, rows, sorted([*kept, *better.other]))
    swaps = sorted((s for s in _instead(work, stays, rows) if s.lost < s.limit), key=lambda s: s.lost)
    rivals = tuple(_rivals(work, stays, swaps))
    picks = tuple(_pick(work, stays, i, p) for i, p in zip(stays, chance, strict=True))
    # `_pick` has refined the distances to the tops beyond those of the list.
    best = replace(table, columns=tuple(_at_best(work, picks)))
    noise = judged(work_of(best, reading, work.noise, (0,) * len(work.way)), window_deg)[0]

    def beyond_of(stays: Sequence[int], picks: tuple[Pick, ...]) -> Beyond:
        beside, dropped = _beside(picks, table.left_out), _dropped(work, stays)
        return Beyond(picks, noise, clearance, late_s, tuple(beside), tuple(dropped))

    others = [sorted([*(i for i in stays if i not in swap.unit), *swap.other]) for swap in swaps[:RIVALS]]
    instead = tuple(beyond_of(other, tuple(_pick(work, other, i, 1.0) for i in other)) for other in others)
    open_ = {r.candidate.name for r in rivals}
    not_found = tuple(n for n in _limits(work, stays, rows) if n.candidate.name not in open_)
    return CausesFound(beyond_of(stays, picks), not_found, (*table.left_out, *rivals), instead)


def _beside(picks: Sequence[Pick], left_out: Sequence[NotLookedFor]) -> Iterator[Cause]:
    """Plain causes that are not separated from one of the picks."""
    names = {p.candidate.name for p in picks}
    for other in left_out:
        if other.candidate.kind == "plain" and names & set(other.twins):
            yield from other.candidate.make(0.0)


def _dropped(work: SearchState, stays: Sequence[int]) -> Iterator[tuple[Cause, ...]]:
    """The dropped causes, each alone, and each pair that hide each other."""
    alone = _alone(work, stays)
    tried = {i: work.table.separated[i] for i in alone}
    causes = {i: c.make((c.ways_mm or (0.0,))[work.way[i]]) for i, c in tried.items()}
    yield from causes.values()
    for i, j in itertools.combinations(alone, 2):
        if tried[i].kind == tried[j].kind == "plain" and _hidden(alone[i], alone[j]) > HIDDEN:
            yield (*causes[i], *causes[j])


def _alone(work: SearchState, stays: Sequence[int]) -> dict[int, Floats]:
    """Whitened columns of the dropped causes, by their places, orthogonal to the ones that stay."""
    basis = work.beside(stays)[0]
    dropped = (i for i in work.everything if i not in stays)
    return {i: own - basis @ (basis.T @ own) for i in dropped for own in (work.own[i][work.way[i]],)}


def _hidden(own: Floats, other: Floats) -> float:
    """Factor by which another cause increases the standard error of one."""
    return _spread(own, other) / _spread(own)


def _too_few(table: CandidateTable, count: int) -> Iterator[NotLookedFor]:
    why = f"{count} readings are too few for so many causes"
    for candidate in table.separated:
        yield NotLookedFor(replace(candidate, missing=why), why)


def clearance_of(fitted: Fitted, circles: Sequence[CircleTest]) -> tuple[float, float]:
    """Clearance of both axes, µm; zero where it is not determined."""
    a, b = (fitted.value(f"clearance_{letter}".lower()).value for letter in circles[0].setup.letters[:2])
    return float(np.nan_to_num(a)), float(np.nan_to_num(b))


def residual_of_all(
    circles: Sequence[CircleTest], clearance_um: tuple[float, float], late_s: float, centre: Centre
) -> float:
    """Standard deviation of the residual of [BB]'s parameters and all candidates together, µm."""
    table = table_of([c.rows(~c.taking_up(clearance_um, late_s)) for c in circles], centre)
    work = work_of(table, _reading(table), WHITE, tuple(len(c) // 2 for c in table.columns))
    return least(work, work.everything).sigma


def _reading(table: CandidateTable) -> Floats:
    """Readings minus the second order of [BB]'s parameters, which is nearly all from a large centre offset."""
    reading = np.concatenate([c.reading_um for c in table.circles])
    kept = list(table.design.rank.kept)
    coefficients = solve(table.design, kept, reading, table.circles, WHITE).coefficients
    return reading - table.design.second_order_um(kept, coefficients)


@dataclass(frozen=True)
class Swap:
    """Other causes that could replace some that stay.

    Attributes:
        unit, other: places of those that stay and of the others.
        lost: loss of explained sum of squares, in variances of the noise, with a penalty for more parameters.
        limit: loss above which the readings exclude the others.
    """

    unit: tuple[int, ...]
    other: tuple[int, ...]
    lost: float
    limit: float


def _instead(work: SearchState, stays: Sequence[int], rows: float) -> Iterator[Swap]:
    """Replacements of one cause, or two of the same effect, by one other, or two of the same effect."""
    others = tuple(_units(work, [i for i in work.everything if i not in stays]))
    power = least(work, stays).sigma ** 2 * rows
    # Schwarz' penalty for one parameter; more alternatives raise the limit, as the best of many gains by chance.
    price = math.log(len(work.white) / rows)
    limit = SURE_ODDS + 2.0 * math.log(max(len(others), 1))
    for unit in _units(work, stays):
        basis, residual = work.beside([i for i in stays if i not in unit])
        most = gain(basis, residual, work.white_of(unit))
        for other in others:
            lost = (most - gain(basis, residual, work.white_of(other))) / power
            yield Swap(unit, other, lost + price * (len(other) - len(unit)), limit)


def _units(work: SearchState, places: Sequence[int]) -> Iterator[tuple[int, ...]]:
    """Plain causes one by one, and the same effect of both axes together."""
    plain = [i for i in places if work.table.separated[i].kind == "plain"]
    yield from ((i,) for i in plain)
    for i, j in itertools.combinations(plain, 2):
        one, other = work.table.separated[i], work.table.separated[j]
        if one.effect == other.effect and one.axis != other.axis:
            yield i, j


def _rivals(work: SearchState, stays: Sequence[int], swaps: Sequence[Swap]) -> Iterator[NotLookedFor]:
    """Causes that explain the readings nearly as well as some that stay: the readings do not decide between them."""
    twins: dict[int, list[str]] = {}
    for swap in swaps:
        for i in swap.other:
            twins.setdefault(i, []).extend(work.table.separated[k].name for k in swap.unit)
    for i, names in twins.items():
        titles = " and ".join(work.table.separated[k].title for k in stays if work.table.separated[k].name in names)
        why = f"it does as well as {titles}"
        yield NotLookedFor(work.table.separated[i], why, tuple(dict.fromkeys(names)), rival=True)


def _eliminate(work: SearchState, rows: float, start: Sequence[int]) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Drop the least significant cause until all are significant; places and false-positive rates of the remaining."""
    stays = list(start)
    tried = len(work.everything)
    while stays:
        chance = _chances(work, stays, least(work, stays), rows)
        worst = int(np.argmax(chance))
        if chance[worst] < FAMILY / tried:
            return tuple(stays), tuple(p * tried for p in chance)
        stays.pop(worst)
    return (), ()


def _chances(work: SearchState, places: Sequence[int], fitted: Least, rows: float) -> list[float]:
    """Probability that noise alone gives as much of each cause."""
    from scipy.special import fdtrc

    free = max(len(fitted.residual) / rows - len(fitted.coefficients), 1.0)
    out, start = [], work.base.shape[1]
    for i in places:
        columns = work.table.columns[i][work.way[i]]
        at = slice(start, start + columns.shape[1])
        start += columns.shape[1]
        sizes = fitted.coefficients[at]
        if np.ptp(columns @ sizes) < SMALLEST_UM:
            out.append(1.0)
            continue
        gained = float(sizes @ np.linalg.solve(fitted.inverse[at, at], sizes)) / len(sizes)
        tries = len(work.own[i])
        out.append(min(1.0, tries * float(fdtrc(len(sizes), free, gained / (fitted.sigma**2 * rows)))))
    return out


def _pick(work: SearchState, stays: Sequence[int], place: int, chance: float) -> Pick:
    candidate = work.table.separated[place]
    if candidate.kind != "spike":
        return Pick(candidate, chance=chance)
    from scipy.optimize import minimize_scalar

    basis, left = work.beside([i for i in stays if i != place])

    def made(log_way: float) -> Floats:
        causes = candidate.make(float(np.exp(log_way)))
        return work.noise.whiten(work.table.circles, stacked_design(causes, work.table.circles))

    ways, at = np.log(candidate.ways_mm), work.way[place]
    ends = float(ways[max(at - 1, 0)]), float(ways[min(at + 1, len(ways) - 1)])
    way = minimize_scalar(
        lambda x: -gain(basis, left, made(x)), bounds=ends, method="bounded", options={"xatol": CLOSE}
    ).x
    own = made(way)
    heights = np.linalg.lstsq(own - basis @ (basis.T @ own), left, rcond=None)[0]
    return Pick(candidate, float(np.exp(way)), tuple(float(h) for h in heights), chance)


def _at_best(work: SearchState, picks: Sequence[Pick]) -> Iterator[tuple[Floats, ...]]:
    """Columns of every candidate at the best known distance to its top."""
    ways = {p.candidate.name: p.way_mm for p in picks if p.candidate.kind == "spike"}
    for i, candidate in enumerate(work.table.separated):
        own = work.table.columns[i][work.way[i]]
        if candidate.name in ways:
            own = stacked_design(candidate.make(ways[candidate.name]), work.table.circles)
        yield (own,)


def _limits(work: SearchState, stays: Sequence[int], rows: float) -> Iterator[NotFound]:
    """Limit of each dropped cause: its size that would be significant beside the others, dropped ones included."""
    alone = _alone(work, stays)
    for i, own in alone.items():
        candidate, sigma = work.table.separated[i], least(work, [*stays, i]).sigma
        hidden = max((_spread(own, other) for j, other in alone.items() if j != i), default=_spread(own))
        smallest = SMALLEST_UM / float(np.ptp(work.table.columns[i][work.way[i]], axis=0).max())
        limit = max(_needed(work, i, rows) * sigma * np.sqrt(rows) * hidden, smallest)
        with_ = tuple(x.candidate for x in work.table.left_out if candidate.name in x.twins)
        yield NotFound(candidate, float(limit), candidate.make(1.0)[0].unit, with_)


def _needed(work: SearchState, place: int, rows: float) -> float:
    """Size, in standard errors, of a cause that is significant with the probability `SEEN`."""
    from scipy.special import fdtri, ndtri

    count, tries = work.own[place][0].shape[1], len(work.own[place])
    free = max(len(work.white) / rows - work.columns(work.everything).shape[1], 1.0)
    chance = FAMILY / (len(work.everything) * tries)
    return float(np.sqrt(count * fdtri(count, free, 1.0 - chance)) + ndtri(SEEN))


def _spread(own: Floats, *others: Floats) -> float:
    """Largest standard error of some columns' coefficients beside others, in standard deviations of a reading."""
    both = np.concatenate([own, *others], axis=1)
    size = np.linalg.norm(both, axis=0)
    inverse = np.linalg.pinv((both / size).T @ (both / size))
    return float((np.sqrt(np.diag(inverse)) / size)[: own.shape[1]].max())

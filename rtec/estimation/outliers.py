"""Wrong readings: the one rule by which every command rejects readings.

The rule uses no model, so every command, and every step of `improve`, gets the same readings from the same file. A
reading is wrong where it is far from

- a smooth function of the recorded channels, fitted robustly,
- the other visits to the same place in the same direction, and
- its neighbours in time,

and where this does not recur. Single readings count, and bursts of up to five where other visits near the place, or
a machine at rest, show that nothing was there. At an end of the record, or of a run that has unknowns of its own, the
neighbours of one side decide. More than a few in a hundred are an effect of the machine. So are readings that recur;
but no law is fitted to one or two targets at an end that stand out (`end_targets`).
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rtec.arrays import SIGMA_PER_MAD, Bools, Floats, Ints, robust_scatter, robust_sigma
from rtec.estimation.end_targets import EndTargets, end_targets
from rtec.estimation.flexible import smooth_columns
from rtec.estimation.gls import solve, without_runs
from rtec.estimation.held_out import STILL_MM
from rtec.estimation.readings import Readings, Series, read, row_codes
from rtec.estimation.visible import same_place_mm
from rtec.jit import njit
from rtec.metrology.measurement import Measurement
from rtec.parallel import MANY
from rtec.wording import ERROR_UNITS, counted, significant

FAR, NEAR, COMPANY = 7.0, 3.0, 0.3
"""Robust standard deviations; and the deviation of neighbours, as a share of a wrong reading's, at most."""
BURST = 3
"""Largest number of consecutive wrong readings."""
LONG_BURST, LONG_REACH = 5, 12
"""Or this many, far from the median of this many readings on either side, where visits within a step show nothing."""
GROSS, GROSS_BURST, GROSS_REACH = 25.0, 12, 30
"""Or this many there, of either sign, one of them this many robust standard deviations away, and far from each other:
an interrupted beam. A machine that was elsewhere for a while deviates equally in each."""
VISITS = 3
"""Visits to a place, in the same direction, whose median shows what the machine does there."""
AGAIN, HALF = 1.0 / 3.0, 0.5
"""A reading recurs where this share of the other visits deviates by at least half as much, in the same direction."""
SPEEDS = 10.0
"""Speeds within one divided by this number are equal."""
MOST, FEW = 0.05, 3
"""More than this share of a series, and more than a few, are no mistakes of reading."""
MOST_WILD = 0.1
"""With wild bursts: more than this share."""
ROUNDS = 4
"""Number of fits of the smooth part; wrong readings bend it, so far ones get less weight in the next fit."""
LINE = 8
"""Fewest readings of a way that get a line of their own."""
REACH = 5
AROUND, SHORT = 21, 14
QUARTILE, QUARTILE_SIGMA = 0.75, 1.1503
"""Readings around one that give the local noise level, by their third quartile: bursts are fewer."""
SMALL = 0.02
EVEN = 0.01
"""Share of a step of the display by which readings may miss its multiples: files hold rounded numbers."""
TOLD = 12


@dataclass(frozen=True)
class WrongReading:
    """A rejected reading.

    Attributes:
        measurement, column: its place.
        row: counted from 0; run: its number.
        off: deviation from its neighbours, in the unit of the column.
        unit: "um" or "urad".
        why: reason of the rejection, in words.
    """

    measurement: str
    column: str
    row: int
    run: int
    off: float
    unit: str
    why: str


@dataclass(frozen=True)
class Clean:
    """Readings of several measurements without the wrong ones, with the channels that the loop has.

    Attributes:
        readings: the readings that count.
        wrong: the rejected ones.
        kept: which of all readings count.
        ends: end targets that stand out among the readings that count.
        starts: in words, which records begin while the machine is warm: there, what a delayed effect remembers from
            before is among the unknowns of `readings`. Empty where none does.
        delays: delays in s of the model's effects that these readings show in place of the model's, by the number of
            the effect; a refit begins there.
    """

    readings: Readings
    wrong: tuple[WrongReading, ...]
    kept: Bools
    ends: tuple[EndTargets, ...] = ()
    starts: str = ""
    delays: Mapping[int, float] = field(default_factory=dict)

    def smoothed(self) -> Readings:
        """The same readings with temperatures smoothed in time."""
        return self.readings.smoothed()

    def rejecting(self, off: Floats, why: str) -> "Clean":
        """The same with further readings rejected.

        Args:
            off: deviation of each of `readings` that is rejected, (m,); NaN for the others.
            why: reason of the rejection, in words.
        """
        wrong, kept = np.isfinite(off), self.kept.copy()
        if not wrong.any():
            return self
        kept[np.flatnonzero(kept)[wrong]] = False
        rejected = (*self.wrong, *_rejected(self.readings, off, why))
        return replace(self, readings=self.readings.without(wrong), wrong=rejected, kept=kept)

    def without_ends(self) -> "Clean":
        """The same without the end targets that stand out, for fitting a law. Call it only once."""
        off = np.full(len(self.readings), np.nan)
        for found in self.ends:
            off = np.fmax(off, found.readings)
        return self.rejecting(off, "at an end that stands out")


def _rejected(readings: Readings, off: Floats, why: str) -> Iterator[WrongReading]:
    for s in readings.series:
        m = readings.measurements[s.source]
        for i in np.flatnonzero(np.isfinite(off[s.part])):
            row = int(s.row[i])
            yield WrongReading(m.name, s.column, row, int(m.run[row]), float(off[s.part][i]), s.unit, why)


def clean(measurements: Sequence[Measurement], reference_degc: float = 20.0, leave_out_h: float | None = None) -> Clean:
    """Read measurements, reject wrong readings, and find end targets that stand out.

    Args:
        measurements, reference_degc, leave_out_h: as `read`.

    Raises:
        MeasurementError: as `read`.
    """
    whole = read(measurements, reference_degc, smooth=False, leave_out_h=leave_out_h)
    every = Clean(whole, (), np.ones(len(whole), dtype=np.bool_))
    given = every.rejecting(wrong_readings(whole), "far from all neighbours")
    return replace(given, ends=tuple(end_targets(given.readings)))


def outlier_words(wrong: Sequence[WrongReading]) -> tuple[str, ...]:
    """Rejected readings in words: a line for each reading column and reason."""
    out = []
    for key in dict.fromkeys((w.measurement, w.column, w.why) for w in wrong):
        mine = [w for w in wrong if (w.measurement, w.column, w.why) == key]
        unit = ERROR_UNITS[mine[0].unit]
        rows = ", ".join(
            f"row {w.row + 1} of run {w.run} ({significant(w.off, sign=True)} {unit})" for w in mine[:TOLD]
        )
        more = f" and {len(mine) - TOLD} more" if len(mine) > TOLD else ""
        count = "1 wrong reading was" if len(mine) == 1 else f"{len(mine)} wrong readings were"
        out.append(f"{key[0]} {key[1]}: {count} left out, {key[2]}: {rows}{more}")
    return tuple(out)


def left_out(wrong: Sequence[WrongReading]) -> str:
    """Number of rejected readings: a sentence to follow others; empty where none was."""
    if not wrong:
        return ""
    return f" {counted(len(wrong), 'wrong reading')} {'was' if len(wrong) == 1 else 'were'} left out."


def wrong_readings(readings: Readings) -> Floats:
    """Deviation of wrong readings from their neighbours, (m,); NaN of the others."""
    out = np.full(len(readings), np.nan)
    for s in readings.series:
        out[s.part] = _of_series(readings, s, readings.values[s.part])
    return out


def _of_series(readings: Readings, s: Series, values: Floats) -> Floats:
    n = len(s)
    place, still = _places(readings, s)
    near, anyway, starts = [place], [], None
    if not still:
        near, anyway, starts = *_near_places(readings, s), _first_of_ways(readings, s)
    linked = _linked(s)
    rough = _rough(readings, s, values, linked)
    flat = values if still else _without_slopes(readings, s, values)
    rough, flat = (r - _of_visits(r, place) for r in (rough, flat))
    spread = robust_scatter(values)
    least = max(SMALL * spread, HALF * _display_step(values), 1e-9)
    off, (wrong, far, before) = np.zeros(n), (np.zeros(n, dtype=bool) for _ in range(3))
    kinds = [(rough, _Kind(REACH, 1, BURST)), (rough, _Kind(LONG_REACH, 2, LONG_BURST))]
    kinds += [] if still else [(rough, _Kind(GROSS_REACH, 2, GROSS_BURST, wild=True)), (flat, _Kind(REACH, 1, BURST))]
    for seen, kind in kinds:
        for _ in range(ROUNDS):
            known = np.where(wrong, np.nan, seen)
            off = seen - neighbours(known, seen, linked, kind.reach)
            sigma = max(robust_sigma(off), least)
            found = _bursts(off, known, _sigmas(off, sigma, s.run, wrong, kind), linked, near, still, kind)
            if seen is flat:
                found &= _sets_off(rough, off, found)
            if still:
                found &= ~_on_the_way(np.where(wrong, np.nan, values), off, found, linked)
            else:
                found &= ~np.logical_or.reduce([_again(off, p, found) for p in (place, *near)])
            if not kind.wild:
                far |= found
            found &= ~_mostly(_again_elsewhere(off, anyway, starts, found), found)
            if not found.any():
                break
            wrong |= found
        if seen is rough:
            before = wrong.copy()
    alone = wrong & ~before
    wrong &= ~alone | (np.bincount(place[wrong], minlength=n)[place] < 2)  # twice at a place: the machine
    most = MOST_WILD if far.any() and float(np.median(np.abs(off[far]))) > GROSS * sigma else MOST
    few = far.sum() <= max(most * n, FEW) and wrong.sum() <= max(MOST_WILD * n, FEW)
    return np.where(wrong & few, off, np.nan)


@dataclass(frozen=True)
class _Kind:
    """Bursts that are searched together.

    Attributes:
        reach: neighbours on either side that a reading is compared with.
        least, most: consecutive readings.
        wild: of either sign, one of them `GROSS`, and far from each other.
    """

    reach: int
    least: int
    most: int
    wild: bool = False

    def signs(self, off: Floats, far: Bools) -> Floats:
        """Common sign of consecutive readings, (n,), or 1 where either sign counts; 0 if not far."""
        return np.where(far, 1.0 if self.wild else np.sign(off), 0.0)


def _on_the_way(values: Floats, off: Floats, found: Bools, linked: Ints) -> Bools:
    """Suspect readings near the straight line from the reading before their burst to the one after it, (n,).

    A sensor jumps where a spindle stops, and what lags behind it does not: only a fit by the sensor deviates there.

    Args:
        values: readings, NaN where they are known to be wrong, (n,).
        off: deviation from the neighbours, (n,).
        found: suspect readings, (n,).
        linked: as of `_linked`.
    """
    out, edges = np.zeros(len(found), dtype=bool), np.flatnonzero(np.diff(found, prepend=False, append=False))
    for a, b in edges.reshape(-1, 2).tolist():
        if a > 0 and b < len(values) and linked[a - 1] == linked[b]:
            line = np.interp(np.arange(a, b), [a - 1, b], values[[a - 1, b]])
            out[a:b] = bool((np.abs(values[a:b] - line) < HALF * np.abs(off[a:b])).all())
    return out


def _sets_off(rough: Floats, off: Floats, found: Bools) -> Bools:
    """Which readings of bursts differ from the reading before and from that after their burst, (n,).

    A line through a way of which half is elsewhere is far from what is beside that half, too.
    """
    out, edges = np.zeros(len(found), dtype=bool), np.flatnonzero(np.diff(found, prepend=False, append=False))
    for a, b in edges.reshape(-1, 2).tolist():
        level, size = float(np.median(rough[a:b])), HALF * float(np.median(np.abs(off[a:b])))
        out[a:b] = all(abs(rough[k] - level) > size for k in (a - 1, b) if 0 <= k < len(rough))
    return out


def _linked(s: Series) -> Ints:
    """Stretch number of each reading, (n,): runs where each has unknowns of its own, else the whole series."""
    return s.run if s.nuisance.shape[1] else np.zeros(len(s), dtype=np.int64)


def _places(readings: Readings, s: Series) -> tuple[Ints, bool]:
    """A number for each place and direction, (n,), and whether no axis moves at all."""
    state = readings.states[s.source]
    pose = readings.poses_mm[s.source][s.row]
    if not len(pose) or float(np.ptp(pose, axis=0).max(initial=0.0)) < STILL_MM:
        return np.zeros(len(s), dtype=np.int64), True
    columns = [*np.round(pose / same_place_mm(readings.measurements[s.source])).T]
    columns += [np.sign(state.value(a.direction_channel)[s.row]) for a in readings.machine.axes]
    return row_codes(np.stack(columns)), False


def _rough(readings: Readings, s: Series, values: Floats, linked: Ints) -> Floats:
    """Residual of a robust fit of smooth functions of the recorded channels, (n,).

    Of very many readings, which are close to each other, the difference from their neighbours counts instead.
    """
    off = values - neighbours(values, values, linked)
    columns = np.zeros((len(s), 0))
    if len(s) <= MANY:
        columns = smooth_columns(readings, s)
    sigma = max(robust_sigma(off), 1e-12)
    weight = 1.0 / (1.0 + (off / (NEAR * sigma)) ** 2)
    out = values
    for _ in range(ROUNDS):
        root = np.sqrt(weight)[:, None]
        flat = _without_runs(s, np.concatenate([columns, values[:, None]], axis=1), weight)
        out = flat[:, -1] - flat[:, :-1] @ solve(flat[:, :-1] * root, flat[:, -1] * root[:, 0])
        sigma = max(robust_sigma(out), 1e-12)
        weight = 1.0 / (1.0 + (out / (NEAR * sigma)) ** 2)
    return out


def _without_slopes(readings: Readings, s: Series, values: Floats) -> Floats:
    """Values less a robust straight line over the place for each way of the only axis that moves, (n,).

    A screw that grows gives every way a slope of its own, and the end of a way would be far from its neighbours.
    """
    moving = _moving(readings, s)
    if len(moving) != 1:
        return values
    axis = readings.machine.axes[moving[0][0]]
    at = readings.poses_mm[s.source][s.row, moving[0][0]]
    way = np.sign(readings.states[s.source].value(axis.direction_channel)[s.row])
    first = np.flatnonzero(np.concatenate([[True], (np.diff(way) != 0) | (np.diff(s.run) != 0)]))
    counts = np.diff(first, append=len(at))
    spans = np.maximum.reduceat(at, first) - np.minimum.reduceat(at, first)
    of = np.repeat(np.arange(len(first)), counts)
    lines = (counts >= LINE) & (spans > STILL_MM)
    if not lines.any():
        return values

    def means(v: Floats, weight: Floats) -> Floats:
        """Weighted mean of each way, at each reading, (n,)."""
        return np.asarray((np.add.reduceat(v * weight, first) / np.add.reduceat(weight, first))[of])

    weight, left = np.ones(len(at)), values
    for _ in range(ROUNDS):
        u, y = at - means(at, weight), values - means(values, weight)
        square = np.maximum(means(u * u, weight), 1e-300)
        left = y - means(u * y, weight) / square * u
        sigma = SIGMA_PER_MAD * np.maximum(_middles(np.abs(left), of, first, counts), 1e-12)
        weight = 1.0 / (1.0 + (left / (NEAR * sigma[of])) ** 2)
    return np.where(lines[of], left, values)


def _middles(values: Floats, of: Ints, first: Ints, counts: Ints) -> Floats:
    """Median of each stretch, (stretches,).

    Args:
        values: all, (n,).
        of: the stretch of each, rising, (n,).
        first, counts: where each stretch begins, and how many values it has.
    """
    ordered = values[np.lexsort((values, of))]
    return np.asarray(0.5 * (ordered[first + (counts - 1) // 2] + ordered[first + counts // 2]))


def _without_runs(s: Series, columns: Floats, weight: Floats) -> Floats:
    """Columns less the unknowns of each run, by weighted least squares, (n, p); without unknowns, less their mean."""
    if not s.nuisance.shape[1]:
        return np.asarray(columns - weight @ columns / weight.sum())
    return without_runs(s, columns, weight)


def _of_visits(rough: Floats, place: Ints) -> Floats:
    """Median of all other visits to the place of each reading, (n,); zero where there are few.

    Without the reading itself: the median of three could be that reading, and its noise would be zero.
    """
    order = np.lexsort((rough, place))
    count = np.bincount(place)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    ordered, group = rough[order], place[order]
    rank, others = np.arange(len(rough)) - first[group], count[group] - 1
    low, high = (others - 1) // 2, others // 2
    # In order without the reading itself: those behind it move up by one.
    at = [first[group] + k + (k >= rank) for k in (low, high)]
    last = len(rough) - 1
    middle = 0.5 * (ordered[np.minimum(at[0], last)] + ordered[np.minimum(at[1], last)])
    out = np.empty(len(rough))
    out[order] = np.where(count[group] >= VISITS, middle, 0.0)
    return out


def _sigmas(off: Floats, sigma: float, run: Ints, wrong: Bools, kind: _Kind) -> Floats:
    """Robust standard deviation around each reading, (n,), at least that of all: a noisy run is no series of mistakes.

    It comes from the nearest readings of the same run that are not known to be wrong; for a short run also from those
    before and after it. It matters only where a reading is far by the standard deviation of all.
    """
    n, out = len(off), np.full(len(off), sigma)
    sign = kind.signs(off, np.abs(off) > FAR * sigma)
    far, row = np.flatnonzero(sign), np.cumsum(np.diff(sign, prepend=0.0) != 0)
    long = np.isin(np.bincount(row)[row], range(BURST + 1, max(kind.most, LONG_BURST) + 1))
    edges = np.concatenate([[0], np.flatnonzero(np.diff(run)) + 1, [n]])
    mine = np.searchsorted(edges, far, side="right")
    begin, end = edges[mine - 1], edges[mine]
    short = end - begin < SHORT
    begin, end = np.where(short, 0, begin), np.where(short, n, end)
    first = np.maximum(np.minimum(far - AROUND // 2, end - AROUND), begin)
    for part in np.array_split(np.arange(len(far)), 1 + len(far) // MANY):
        near = first[part, None] + np.arange(AROUND)
        mine, near = near < end[part, None], np.minimum(near, n - 1)
        # A long burst would be a third of a short run, and make the run look noisy.
        mine &= ~(long[near] & (row[near] == row[far[part], None])) & ~wrong[near]
        size = np.sort(np.where(mine, np.abs(off[near]), np.inf), axis=1)
        place = np.rint(QUARTILE * np.maximum(mine.sum(axis=1) - 1, 0)).astype(np.int64)
        out[far[part]] = np.maximum(sigma, size[np.arange(len(part)), place] / QUARTILE_SIGMA)
    return out


def _bursts(
    off: Floats,
    known: Floats,
    sigma: Floats,
    linked: Ints,
    near: Sequence[Ints],
    still: bool,
    burst: _Kind,
) -> Bools:
    """Far readings, single or a few consecutive ones, whose neighbours on both sides are not far, (n,).

    Several count only in a stretch that is much longer, where other visits were at the place or nearby.

    Args:
        off: deviation from the neighbours, (n,).
        known: readings, NaN where they are known to be wrong, (n,).
        sigma, linked, near: as of `_sigmas`, `_linked`, `_near_places`, (n,).
        still: nothing moves.
        burst: what is searched.
    """
    reach = burst.reach
    size, out = np.where(np.isfinite(known), np.abs(off), 0.0), np.zeros(len(off), dtype=bool)
    # Sign within one stretch: 0 where a reading is not far.
    kind = burst.signs(off, size > FAR * sigma)
    edge = np.flatnonzero(np.concatenate([[True], (np.diff(kind) != 0) | (np.diff(linked) != 0), [True]]))
    visits, stretch = [np.bincount(p)[p] for p in near], np.bincount(linked)
    for a, b in itertools.pairwise(edge.tolist()):
        if not kind[a] or not burst.least <= b - a <= burst.most or stretch[linked[a]] < 3 * (b - a):
            continue
        others = [v[a:b] - _own(p[a:b]) for v, p in zip(visits, near, strict=True)] if b - a > 1 and not still else []
        if others and np.max(others, axis=0).min() < VISITS:
            continue
        if burst.wild and not _wild(known[a:b], size[a:b], float(sigma[a:b].min())):
            continue
        before, after = known[max(a - reach, 0) : a], known[b : b + reach]
        sides = before[linked[max(a - reach, 0) : a] == linked[a]], after[linked[b : b + reach] == linked[a]]
        middles = [float(np.nanmedian(v)) for v in sides if np.isfinite(v).any()]
        if any((np.sign(off[a:b]) * (known[a:b] - m) <= HALF * size[a:b]).any() for m in middles):
            continue
        usual = np.median if burst.wild else np.min
        limit = max(NEAR * float(sigma[a:b].max()), COMPANY * float(usual(size[a:b])))
        here = [i for i in (a - 1, b) if 0 <= i < len(off) and linked[i] == linked[a]]
        out[a:b] = max((float(size[i]) for i in here), default=0.0) < limit
    return out


def _wild(values: Floats, size: Floats, sigma: float) -> bool:
    """Whether consecutive readings, (k,), are no step of the machine: one is very far, and they differ greatly."""
    return float(size.max()) > GROSS * sigma and float(np.ptp(values)) > FAR * sigma


def _own(near: Ints) -> Ints:
    """Number of these readings at the place of each, (k,)."""
    return np.asarray((near[:, None] == near).sum(axis=1))


def _near_places(readings: Readings, s: Series) -> tuple[list[Ints], list[Ints]]:
    """Numbers for neighbourhoods, of the axes that move from reading to reading: by direction, and for both together.

    Two of each, (n,): those of the second begin in the middle of those of the first, so that a place near the edge of
    one is inside the other.
    """
    pose, state = readings.poses_mm[s.source][s.row], readings.states[s.source]
    places, ways = [], []
    for i, step in _moving(readings, s):
        places.append(pose[:, i] / step)
        ways.append(np.sign(state.value(readings.machine.axes[i].direction_channel)[s.row]))
    if not places:
        return [np.arange(len(s), dtype=np.int64)], []
    rows = [[np.floor(p + off) for p in places] for off in (0.0, 0.5)]
    return [row_codes(np.stack([*r, *ways])) for r in rows], [row_codes(np.stack(r)) for r in rows]


def _moving(readings: Readings, s: Series) -> list[tuple[int, float]]:
    """Axes that move from reading to reading within runs, and their usual step, mm."""
    moves = np.abs(np.diff(readings.poses_mm[s.source][s.row], axis=0))[np.diff(s.run) == 0]
    steps = np.median(moves, axis=0) if len(moves) else np.zeros(moves.shape[1])
    return [(i, float(step)) for i, step in enumerate(steps) if step > STILL_MM]


def _first_of_ways(readings: Readings, s: Series) -> tuple[Ints, Floats] | None:
    """Numbers for the first readings after a reversal, one for each speed, and the direction at each reading, (n,).

    Every other reading has a number of its own. None where nothing moves, or more than one axis.
    """
    moving = _moving(readings, s)
    if len(moving) != 1:
        return None
    axis, state = readings.machine.axes[moving[0][0]], readings.states[s.source]
    way = np.sign(state.value(axis.direction_channel)[s.row])
    speed = np.zeros(len(s))
    if state.has(axis.velocity_channel):
        speed = np.rint(SPEEDS * np.log(np.maximum(np.abs(state.value(axis.velocity_channel)[s.row]), STILL_MM)))
    first = (np.diff(way, prepend=np.nan) != 0) | (np.diff(s.run, prepend=-1) != 0)
    own = np.where(first, 0, 1 + np.arange(len(s)))
    return row_codes(np.stack([own, np.where(first, speed, 0.0)])), way


def _again_elsewhere(off: Floats, any_way: Sequence[Ints], starts: tuple[Ints, Floats] | None, found: Bools) -> Bools:
    """Whether suspect readings recur where a place is passed in either direction, or after each reversal, (n,).

    Args:
        off: deviation from the neighbours, (n,).
        any_way: numbers of places, (n,) each.
        starts: as of `_first_of_ways`.
        found: suspect readings, (n,).
    """
    again = [_again(off, p, found, LONG_BURST) for p in any_way]
    if starts is not None:
        again += [_again(off * turned, starts[0], found) for turned in (1.0, starts[1])]
    return np.asarray(np.logical_or.reduce([np.zeros(len(off), dtype=bool), *again]))


def _mostly(again: Bools, found: Bools) -> Bools:
    """What holds for at least half of each row of consecutive suspect readings, (n,): a burst is one mistake."""
    row = np.cumsum(np.diff(found, prepend=found[:1]))
    share = np.bincount(row, again) / np.bincount(row)
    return np.asarray(found & (share[row] >= HALF))


def _display_step(values: Floats) -> float:
    """Step of the display of which all readings, (n,), are multiples; 0 where there is none."""
    apart = np.diff(np.unique(np.round(values, 6)))
    if not len(apart):
        return 0.0
    step = float(apart.min())
    return step if np.abs(apart / step - np.rint(apart / step)).max() < EVEN else 0.0


def _again(off: Floats, place: Ints, found: Bools, apart: int = 1) -> Bools:
    """Whether enough other readings of the same number deviate in the same direction as the suspect ones, (n,).

    Args:
        off: deviation from the neighbours, (n,).
        place: numbers, (n,).
        found: suspect readings, (n,).
        apart: readings closer in order than this are the same visit.
    """
    out = np.zeros(len(off), dtype=bool)
    for p in np.unique(place[found]):
        group = np.flatnonzero(place == p)
        mine = group[found[group]]
        sign, least = np.sign(off[mine]), HALF * np.abs(off[mine])
        order = np.sort(off[group])
        alike = np.where(
            sign > 0, len(group) - np.searchsorted(order, least), np.searchsorted(order, -least, side="right")
        )
        others = np.full(len(mine), len(group))
        for k in range(1 - apart, apart):
            near = np.clip(mine + k, 0, len(off) - 1)
            here = (near == mine + k) & (place[near] == p)
            others -= here
            alike -= here & (sign * off[near] >= least)
        out[mine] = (alike > 0) & (alike >= AGAIN * others)
    return out


def neighbours(values: Floats, own: Floats, linked: Ints, reach: int = REACH) -> Floats:
    """Median of the nearest readings on both sides, without the reading itself, (n,).

    Args:
        values: NaN where a reading is known to be wrong, (n,).
        own: each reading, (n,); returned where it has no neighbours.
        linked: stretches that neighbours do not reach across, (n,).
        reach: number on either side.
    """
    out = np.empty(len(values))
    _medians(values, own, linked, reach, out)
    return out


@njit
def _medians(values: Floats, own: Floats, linked: Ints, reach: int, out: Floats) -> None:
    n = len(values)
    near = np.empty(2 * reach)
    for i in range(n):
        count = 0
        for k in range(max(i - reach, 0), min(i + reach + 1, n)):
            if k != i and linked[k] == linked[i] and not np.isnan(values[k]):
                at = count
                while at > 0 and near[at - 1] > values[k]:
                    near[at] = near[at - 1]
                    at -= 1
                near[at] = values[k]
                count += 1
        out[i] = own[i]
        if count:
            out[i] = 0.5 * (near[(count - 1) // 2] + near[count // 2])

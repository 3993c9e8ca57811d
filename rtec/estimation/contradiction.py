"""Measurements that contradict each other: they differ at the same places, and no recorded channel explains it.

Between the targets of a file its readings are interpolated, so that files at other targets can be compared.

The sign of a file may be reversed, or it may be of another machine or set-up. No model is right for both, so no effect
is named, and none is fitted to them.
"""

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from rtec.arrays import Bools, Floats, Ints
from rtec.estimation import floor
from rtec.estimation.candidates import real
from rtec.estimation.judge import Judgement
from rtec.estimation.readings import Readings, row_codes
from rtec.wording import ERROR_UNITS, significant

COMMON, OPPOSITE = 5, -0.8
"""Fewest places that two files share, and the correlation of their means from which on they contradict."""
DISAGREE, MUCH_OF, UNLIKE = 4.0, 0.5, 3.0
"""Or their difference is this many times the one that noise allows, and this share of the readings, while recorded
channels differ by less than this many times the least change."""
ELSEWHERE = 0.25
"""Or the medians of such a channel differ by less than this share of its range."""
MET = 1.5
"""A model meets a file where its residual is less than this many times the file's noise: it has all that changed."""
MIRROR = 0.25
"""A file is the mirror image of another where their sum is less than this share of their readings."""
CLEARLY = 1.2
"""Of two files that contradict each other, the odd one differs this many times more from the others."""
GROWS = 24.0
"""Expansion of aluminium, µm/(m·K): what two files at other temperatures may differ by, even if they differ little."""
PER_MM = 10.0
"""Places within 1 mm divided by this number are equal."""
LINE = 10_000_000
"""More places than a line can have."""


@dataclass(frozen=True)
class Contradiction:
    """Measurements that contradict each other.

    Attributes:
        odd: numbers of those that contradict the others; empty where it is unknown which are right.
        message: in words, without a full stop.
        check: what the user should check.
        again: what to do afterwards.
        turned: whether one is the mirror image of another; if not, the machine may have changed between them.
    """

    odd: tuple[int, ...]
    message: str
    check: str
    again: str
    turned: bool


@dataclass(frozen=True)
class _Pair:
    """Two series by equal instruments at the places that they share.

    Attributes:
        sources: numbers of their measurements.
        unit: of the readings.
        off, measured_off: root mean square of their difference, in the residuals and in the readings.
        turned, apart: whether one is the mirror image of the other; whether they differ by far too much.
    """

    sources: tuple[int, int]
    unit: str
    off: float
    measured_off: float
    turned: bool
    apart: bool


def contradiction(judged: Judgement) -> Contradiction | None:
    """Files whose readings differ at the same places: in sign, or by far more than their noise."""
    readings = judged.readings
    series, made_by = readings.series, [readings.measurements[s.source].instrument for s in readings.series]
    # In another set-up, as with a beam at another offset, an instrument reads another value at the same place.
    comparable = [
        (i, j)
        for (i, one), (j, two) in itertools.combinations(enumerate(series), 2)
        if one.source != two.source and one.column == two.column and made_by[i] == made_by[j]
    ]
    if not comparable:
        return None
    means = _means(judged)
    pairs = [p for two in comparable if (p := _compared(judged, two, means)) is not None]
    turned, apart = [p for p in pairs if p.turned], [p for p in pairs if p.apart]
    met = {s.source for s in series} - {s.source for k, s in enumerate(series) if not _met(judged, k)}
    if turned:
        return _described(readings, turned, pairs, met, "readings go the other way")
    if apart:
        unit = ERROR_UNITS[apart[0].unit]
        worst = max(p.off for p in apart)
        return _described(
            readings,
            apart,
            pairs,
            met,
            f"readings differ by {significant(worst, 2)} {unit}, although every other recorded channel took much "
            "the same values in both",
        )
    return None


@dataclass(frozen=True)
class _Means:
    """Mean reading and residual of a series at each of its places.

    Attributes:
        place: number of the line of travel times `LINE`, plus the position on it times `PER_MM`; rising, (k,).
        value: mean reading and residual there, (k, 2).
        known: places of lines with enough places for interpolation, (k,).
        bent: root mean square deviation of a place from the straight line through both neighbours.
    """

    place: Ints
    value: Floats
    known: Bools
    bent: float

    @classmethod
    def of(cls, place: Ints, values: Floats) -> "_Means":
        """Means of readings at their places, (n,) and (2, n)."""
        there, which, count = np.unique(place, return_inverse=True, return_counts=True)
        value = np.stack([np.bincount(which, v) / count for v in values], axis=1)
        line, size = np.unique(there // LINE, return_inverse=True, return_counts=True)[1:]
        known, bent = (size >= COMMON)[line], 0.0
        inside = np.flatnonzero(known[1:-1] & (line[:-2] == line[2:])) + 1
        if len(inside):
            share = ((there[inside] - there[inside - 1]) / (there[inside + 1] - there[inside - 1]))[:, None]
            straight = (1.0 - share) * value[inside - 1] + share * value[inside + 1]
            bent = float(np.sqrt(np.mean((straight - value[inside]) ** 2, axis=0)).max())
        return cls(there, value, known, bent)

    def at(self, place: Ints) -> tuple[Bools, Floats, Bools]:
        """Which places, (k,), are known or interpolated; their values, (c, 2); which of them are interpolated, (c,)."""
        after = np.minimum(np.searchsorted(self.place, place), len(self.place) - 1)
        same = self.place[after] == place
        before = np.where(same, after, np.maximum(after - 1, 0))
        inside = (self.place[before] < place) & (place < self.place[after])
        inside &= (self.place[before] // LINE == self.place[after] // LINE) & self.known[after]
        there = same | inside
        low, high = before[there], after[there]
        gap = np.maximum(self.place[high] - self.place[low], 1)
        share = ((place[there] - self.place[low]) / gap)[:, None]
        return there, (1.0 - share) * self.value[low] + share * self.value[high], inside[there]


def _means(judged: Judgement) -> list[_Means]:
    """Means of each series, by the places along the axis that moves most, for each direction."""
    readings = judged.readings
    rows, along = [], []
    for s in readings.series:
        state, pose = readings.states[s.source], np.round(PER_MM * readings.poses_mm[s.source][s.row])
        ways = [np.sign(state.value(a.direction_channel)[s.row]) for a in readings.machine.axes]
        axis = int(np.argmax(np.ptp(pose, axis=0)))
        along.append(pose[:, axis].copy())
        pose[:, axis] = 0.0
        rows.append(np.stack([np.full(len(s), axis), *pose.T, *ways]))
    position = np.concatenate(along).astype(np.int64)
    place = LINE * row_codes(np.concatenate(rows, axis=1)) + position - position.min()
    both = np.stack([floor.cleaned(readings, readings.values), judged.left])
    return [_Means.of(place[s.part], both[:, s.part]) for s in readings.series]


def _compared(judged: Judgement, two: tuple[int, int], means: Sequence[_Means]) -> _Pair | None:
    """Two series, each about its mean at the places that they share; None where those are too few.

    The one with more places is interpolated.
    """
    few, many = sorted((means[k] for k in two), key=lambda m: len(m.place))
    there, other, between = many.at(few.place)
    if len(other) < COMMON:
        return None
    one, other = (m - m.mean(axis=0) for m in (few.value[there], other))
    measured_off, off = np.sqrt(np.mean((one - other) ** 2, axis=0)).tolist()
    larger, left_larger = np.maximum(one.std(axis=0), other.std(axis=0)).tolist()
    a, b = one[:, 1], other[:, 1]
    size = math.sqrt(float(a @ a) * float(b @ b))
    opposite = size > 0.0 and float(a @ b) / size < OPPOSITE
    series = [judged.readings.series[k] for k in two]

    def noise() -> float:
        """Difference of the means that noise and interpolation allow; takes long for many readings."""
        variances = [judged.floors[k].value ** 2 * len(means[k].place) / len(judged.readings.series[k]) for k in two]
        return DISAGREE * math.sqrt(sum(variances) + float(between.mean()) * many.bent**2)

    # A warmer machine may bend the other way, but hardly by as much: only a reversed file is the mirror image.
    together, grown = float(np.sqrt(np.mean((one + other)[:, 0] ** 2))), _grown_um(judged, *two)
    turned = opposite and off > grown and (together < MIRROR * larger or together < noise())
    # A wrong law of the model makes days differ whose readings differ little.
    differs = not turned and off > MUCH_OF * left_larger and _alike(judged, *two)
    apart = differs and min(off, measured_off) > max(noise(), grown)
    sources = (series[0].source, series[1].source)
    return _Pair(sources, series[0].unit, off, measured_off, turned, apart)


def _described(
    readings: Readings, pairs: Sequence[_Pair], compared: Sequence[_Pair], met: set[int], how: str
) -> Contradiction:
    """Message about files that contradict each other; with the odd ones, where they are known."""

    def names(sources: Iterable[int]) -> str:
        return ", ".join(readings.measurements[i].name for i in sorted(set(sources)))

    odd, how = _odd(pairs, compared, met), f"at the same places {{}}{how}"
    turned = any(p.turned for p in pairs)
    if not odd:
        message = f"{names(i for p in pairs for i in p.sources)} contradict each other: {how.format('')}"
        check = "look at their signs, their set-ups and whether they are of one machine"
        return Contradiction(odd, message, check, "without the wrong one, try again", turned)
    verb, its, it, they = ("contradicts", "its", "it", "it is") if len(odd) == 1 else _MANY
    others = names(i for p in pairs for i in p.sources if i not in odd)
    message = f"{names(odd)} {verb} {others}: {how.format(its + ' ')}"
    check = f"look at {its} sign, {its} set-up and whether {they} of the same machine"
    or_turned = f" or with {it} turned" if turned else ""
    return Contradiction(odd, message, check, f"without {it}{or_turned}, try again", turned)


_MANY = ("contradict", "their", "them", "they are")


def _odd(pairs: Sequence[_Pair], compared: Sequence[_Pair], met: set[int]) -> tuple[int, ...]:
    """The sources that the model does not meet while it meets all that they contradict.

    Otherwise those that contradict most of the others, one after the other, until no contradiction remains. Of two that
    contradict equally many it is the one that is clearly farther from those that contradict none.
    """
    if all(len(met & set(p.sources)) == 1 for p in pairs):
        return tuple(sorted({i for p in pairs for i in p.sources} - met))
    out: list[int] = []
    rest = list(pairs)
    while rest:
        count = Counter(i for p in rest for i in p.sources)
        most = {i for i, n in count.items() if n == max(count.values())}
        if any(set(p.sources) <= most for p in rest):
            most = _farther(most, compared)
        if not most:
            return ()
        out += most
        rest = [p for p in rest if not most & set(p.sources)]
    return tuple(sorted(out))


def _farther(tied: set[int], compared: Sequence[_Pair]) -> set[int]:
    """The sources that are clearly farther from all others; empty where none is."""
    far = dict.fromkeys(tied, 0.0)
    for p in compared:
        mine = tied & set(p.sources)
        if len(mine) == 1:
            far[mine.pop()] += p.measured_off
    first, second, *_ = sorted(tied, key=lambda i: -far[i])
    return {first} if far[first] > CLEARLY * far[second] > 0.0 else set()


def _met(judged: Judgement, series: int) -> bool:
    """Whether the residual of a series is no larger than its noise."""
    left = judged.left[judged.readings.series[series].part]
    return float(np.sqrt(np.mean(left**2))) < MET * judged.floors[series].value


def _grown_um(judged: Judgement, one: int, two: int) -> float:
    """What a part grows at most along the way of two series, by the largest difference of a sensor; root mean square.

    A sensor that changed as much within a file that the model meets has shown its effect there.
    """
    readings, both = judged.readings, [judged.readings.series[k] for k in (one, two)]
    states, met = [readings.states[s.source] for s in both], [_met(judged, k) for k in (one, two)]
    apart_degc = 0.0
    for name in readings.machine.sensor_names:
        if not all(name in s.channels for s in states):
            continue
        a, b = (state.channels[name][s.row] for state, s in zip(states, both, strict=True))
        low, high = ([float(f(v)) for v in (a, b)] for f in (np.nanmin, np.nanmax))
        least = real(readings.machine, name)
        if any(m and low[k] < low[1 - k] + least and high[k] > high[1 - k] - least for k, m in enumerate(met)):
            continue
        apart_degc = max(apart_degc, abs(float(np.nanmedian(a) - np.nanmedian(b))))
    way_mm = max(float(np.ptp(readings.poses_mm[s.source][s.row], axis=0).max()) for s in both)
    return GROWS * apart_degc * way_mm * 1e-3 / math.sqrt(12.0)


def _alike(judged: Judgement, one: int, two: int) -> bool:
    """Whether all other channels agree in two series, so that nothing recorded explains a difference.

    Where the model meets a file, a channel that changes within that file has shown its effect there.
    """
    readings, machine = judged.readings, judged.readings.machine
    both = [readings.series[k] for k in (one, two)]
    states = [readings.states[s.source] for s in both]
    met = [_met(judged, k) for k in (one, two)]
    names = [*machine.sensor_names, "spindle_rpm", "load_kg", "force_n", "feed_mm_min"]
    names += [n for a in machine.axes for n in (a.channel, a.velocity_channel)]
    for name in names:
        if not all(name in s.channels for s in states):
            continue
        a, b = (np.abs(st.channels[name][s.row]) for st, s in zip(states, both, strict=True))
        change = UNLIKE * real(machine, name)
        low, high = ([float(f(v)) for v in (a, b)] for f in (np.nanmin, np.nanmax))
        if max(low) > change + min(high):
            return False
        if any(m and low[k] <= low[1 - k] + change and high[k] >= high[1 - k] - change for k, m in enumerate(met)):
            continue
        usual = abs(float(np.nanmedian(a) - np.nanmedian(b)))
        if usual > max(change, ELSEWHERE * max(float(np.ptp(a)), float(np.ptp(b)))):
            return False
    return True

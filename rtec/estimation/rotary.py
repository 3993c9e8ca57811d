"""Readings that depend on the angle of a rotary axis, which nothing reads: any other name would be wrong.

An angle is looked for by what it does: a pivot or an axis that is off turns with it, a rotary backlash has its
direction, a worm has so many waves a turn, and a table that is indexed between runs gives each run its own value.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.estimation import floor
from rtec.estimation.judge import Judgement
from rtec.estimation.readings import Series
from rtec.metrology.unread import is_rotary, joined, radians, ranged
from rtec.wording import ERROR_UNITS, listed, sizes

MOSTLY = 0.5
"""Share of the mean square that the angles must leave at most, and share of a position's variance below which it
follows the angles, as on a ball on a rotary table."""
ABOVE_NOISE = 1.5
"""A residual above this many times noise and slow drift together is no drift."""
READINGS_PER_NUMBER = 3
CHANCE = 1e-4
"""What angles explain, chance may explain as rarely as this."""
LEAST_A_WAVE = 2.5
"""Steps of the angle in a wave, at least."""
MOST_WAVES = 400
SAME_RAD = 1e-5
"""Angles within this are one."""
STEP = "Measure with each rotary axis at one angle, or leave these readings out."

FEWEST_WAVES = 2
WORK = 10**6
"""Readings times numbers of waves that are tried: a second of processor time. Of many readings only long waves are."""

View = Callable[["_Turned", Floats], Floats]
"""How the readings of a series are looked at: (n, k) to (l, k)."""
Columns = Callable[["_Turned"], list[Floats]]


def turned_with(judged: Judgement) -> str:
    """In words, where most of the residual depends on angles that nothing reads; empty where it does not.

    Where the angles are constant within each run, the means of runs are judged: readings of one run are one witness.
    Else a residual that may be a slow drift is judged by its steps from reading to reading.
    """
    readings = judged.readings
    angles = [{n: v for n, v in m.unread.items() if is_rotary(n)} for m in readings.measurements]
    if not any(angles):
        return ""
    parts = [_Turned(judged, s, angles[s.source]) for s in readings.series if angles[s.source]]
    drifts = judged.residual < ABOVE_NOISE * math.hypot(judged.noise_floor, judged.drift)
    alone = all(p.alone for p in parts)
    still = not alone and not any(p.turns_within_runs for p in parts)
    steps = _steps_of_means if alone else _steps
    found = _found(parts, (_means, _steps_of_means) if still else (steps,) if drifts else (_as_read,))
    if found is None:
        return ""
    how, explained = found
    after = judged.pooled(judged.left - floor.cleaned(readings, explained))
    if after**2 > MOSTLY * judged.residual**2:
        return ""
    each = joined(angles)
    named = " and ".join(ranged(n, v) for n, v in each.items())
    how = how.replace("the angle", "the angles") if len(each) > 1 else how
    there, here = sizes(judged.residual, after)
    files = [m.name for m, turned in zip(readings.measurements, angles, strict=True) if turned]
    of = f" of {listed(files)}" if len(readings.measurements) > 1 else ""
    return (
        f"The residual{of} depends on {named}, which rtec does not read: {how} lower it from {there} to {here} "
        f"{ERROR_UNITS[judged.unit]}. rtec has no rotary axes, so that any name of that would be wrong, and other "
        "effects may hide behind it."
    )


@dataclass(frozen=True)
class _Turned:
    """Readings of a series beside angles.

    Attributes:
        judged: the model.
        series: the readings.
        angles: in degrees or in rad, as their names say, of all readings of the file.
    """

    judged: Judgement
    series: Series
    angles: Mapping[str, Floats]

    def seen(self, view: View, columns: Columns) -> tuple[Floats, Floats]:
        """The residual and columns with a constant, looked at in one way, (l,) and (l, k)."""
        made = np.stack([*columns(self), *self.ones], axis=1)
        left = self.judged.left[self.series.part]
        return view(self, left[:, None])[:, 0], view(self, made)

    @property
    def ones(self) -> list[Floats]:
        """A constant."""
        return [np.ones(len(self.series))]

    @cached_property
    def turns(self) -> list[Floats]:
        """Each angle, rad, (n,)."""
        rows = self.series.row
        return [np.nan_to_num(radians(n, v[rows])) for n, v in self.angles.items()]

    @cached_property
    def circles(self) -> list[Floats]:
        """Cosine and sine of each angle."""
        return [f(t) for t in self.turns for f in (np.cos, np.sin)]

    @cached_property
    def places(self) -> dict[int, Floats]:
        """Each position that varies, by the number of its axis."""
        poses = self.judged.readings.poses_mm[self.series.source][self.series.row]
        return {i: p / np.ptp(p) for i, p in enumerate(poses.T) if np.ptp(p) > 0.0}

    @cached_property
    def following(self) -> dict[int, Floats]:
        """Positions that follow the angles."""
        circles = np.stack(self.circles, axis=1)
        return {i: p for i, p in self.places.items() if _rest(p, circles) <= MOSTLY * np.var(p)}

    @cached_property
    def known(self) -> list[Floats]:
        """Positions that do not follow the angles, and directions of the axes."""
        readings, part = self.judged.readings, self.series.part
        ways = [readings.channel(a.direction_channel)[part] for a in readings.machine.axes]
        own = [p for i, p in self.places.items() if i not in self.following]
        return own + [w for w in ways if np.isfinite(w).all() and np.ptp(w) > 0.0]

    @cached_property
    def of_angles(self) -> list[Floats]:
        """What is known, and cosine and sine of each angle; of two angles also their products."""
        pairs = itertools.combinations(range(0, len(self.circles), 2), 2)
        both = [f * g for i, k in pairs for f in self.circles[i : i + 2] for g in self.circles[k : k + 2]]
        return [*self.known, *self.circles, *both]

    @cached_property
    def turning(self) -> list[Floats]:
        """What turns with the angles, by itself and times each position."""
        places = list(self.places.values())
        return [*self.circles, *places, *(p * w for p in places for w in self.circles)]

    @property
    def turned(self) -> list[Floats]:
        """What is known, and what turns with the angles."""
        return [*self.known, *self.turning]

    @cached_property
    def backlash(self) -> list[Floats]:
        """The direction of each angle, by itself and turning with it."""
        ways = [_direction(t, self.series.run) for t in self.turns]
        return [w * f for w, t in zip(ways, self.turns, strict=True) for f in (np.ones(len(t)), np.cos(t), np.sin(t))]

    def waves(self, number: int) -> list[Floats]:
        """So many waves a turn, by themselves and turning with the angle."""
        return [
            f * w
            for t in self.turns
            for f in (np.ones(len(t)), np.cos(t), np.sin(t))
            for w in (np.cos(number * t), np.sin(number * t))
        ]

    def waves_along(self, axis: int, number: int) -> list[Floats]:
        """So many waves along a position that follows the angles, steady and growing; none where it does not."""
        if axis not in self.following:
            return []
        place = self.following[axis]
        phase = 2.0 * np.pi * number * place
        return [g * f(phase) for g in (1.0, place - place.mean()) for f in (np.cos, np.sin)]

    @property
    def alone(self) -> bool:
        """Whether every run has one reading."""
        return bool((np.diff(self.series.run) != 0).all())

    @cached_property
    def turns_within_runs(self) -> bool:
        """Whether an angle changes from one reading of a run to the next."""
        within = np.diff(self.series.run) == 0
        return any(bool((np.abs(np.diff(t))[within] > SAME_RAD).any()) for t in self.turns)

    @cached_property
    def most_waves(self) -> int:
        """Waves a turn that the steps of the angles resolve."""
        steps = np.concatenate([np.abs(np.diff(t)) for t in self.turns])
        steps = steps[steps > SAME_RAD]
        return min(int(2.0 * np.pi / (LEAST_A_WAVE * np.median(steps))), MOST_WAVES) if len(steps) else 0


@dataclass(frozen=True)
class _Fit:
    """What columns explain of readings that are looked at in one way.

    Attributes:
        left: sum of squares that they leave.
        free: readings less numbers.
        numbers: of independent columns.
        explained: of the residual itself, (m,).
    """

    left: float
    free: int
    numbers: int
    explained: Floats

    @property
    def mean(self) -> float:
        """Mean square that they leave."""
        return self.left / max(self.free, 1)

    def beats(self, other: "_Fit", tried: int = 1) -> bool:
        """Whether most of what fewer columns leave is explained, and not by chance in one of several trials."""
        from scipy.special import fdtrc

        more = self.numbers - other.numbers
        if more <= 0 or self.mean > MOSTLY * other.mean:
            return False
        ratio = (other.left - self.left) / more / max(self.mean, 1e-300)
        return tried * float(fdtrc(more, self.free, ratio)) < CHANCE


def _fit(parts: Sequence[_Turned], view: View, columns: Columns) -> _Fit:
    left, free, numbers = 0.0, 0, 0
    explained = np.zeros(len(parts[0].judged.readings))
    for p in parts:
        target, made = p.seen(view, columns)
        solved, _, rank, _ = np.linalg.lstsq(made, target, rcond=1e-6)
        count = int(rank)
        if len(target) < READINGS_PER_NUMBER * count:
            solved, count = 0.0 * solved, 0
        left += float(np.sum((target - made @ solved) ** 2))
        free, numbers = free + len(target) - count, numbers + count
        explained[p.series.part] = np.stack([*columns(p), *p.ones], axis=1) @ solved
    return _Fit(left, free, numbers, explained)


FORMS: tuple[tuple[str, Columns], ...] = (
    ("cosine and sine of the angle", lambda p: p.of_angles),
    ("cosine and sine of the angle", lambda p: p.turned),
    ("cosine, sine and direction of the angle", lambda p: [*p.turned, *p.backlash]),
)


def _found(parts: Sequence[_Turned], views: Sequence[View]) -> tuple[str, Floats] | None:
    """What of the angles explains most of the residual in every view, in words and as numbers; None where nothing does.

    From run to run there are too few angles for more than cosine and sine.
    """
    alone = len(views) == 1
    for how, form in FORMS if alone else FORMS[:2]:
        fits = [(_fit(parts, v, lambda p: p.known), _fit(parts, v, form)) for v in views]
        if all(its.beats(other) for other, its in fits):
            return how, fits[0][1].explained
    return _waves(parts, views[0]) if alone else None


def _waves(parts: Sequence[_Turned], view: View) -> tuple[str, Floats] | None:
    """Waves of the length that explains most, if no waves along a position that follows the angle do as well."""
    most = min(max(p.most_waves for p in parts), WORK // sum(len(p.series) for p in parts))
    if most < FEWEST_WAVES:
        return None

    def best(waves: Callable[[_Turned, int], list[Floats]], numbers: range) -> tuple[int, _Fit]:
        known = [p.seen(view, lambda p: p.turned) for p in parts]
        rests = [(q, t - q @ (q.T @ t)) for t, made in known for q in (_orthogonal(made),)]

        def explains(number: int) -> float:
            out = 0.0
            for p, (q, rest) in zip(parts, rests, strict=True):
                made = p.seen(view, lambda p: waves(p, number))[1]
                made = _orthogonal(made - q @ (q.T @ made))
                out += float(np.sum((made.T @ rest) ** 2))
            return out

        number = max(numbers, key=explains)
        return number, _fit(parts, view, lambda p: [*p.turned, *waves(p, number)])

    number, found = best(_Turned.waves, range(FEWEST_WAVES, most + 1))
    if not found.beats(_fit(parts, view, lambda p: p.turned), most):
        return None
    for axis in sorted({i for p in parts for i in p.following}):
        if found.mean > MOSTLY * best(partial(_along, axis), range(1, most + 1))[1].mean:
            return None
    return f"waves of about {360.0 / number:.2g}°", found.explained


def _along(axis: int, part: _Turned, number: int) -> list[Floats]:
    return part.waves_along(axis, number)


def _orthogonal(columns: Floats) -> Floats:
    """An orthonormal basis of columns, (n, rank)."""
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(u[:, s > 1e-6 * max(float(s.max(initial=0.0)), 1e-300)])


def _as_read(p: _Turned, values: Floats) -> Floats:
    """Readings, less what the instruments cannot know."""
    whole = np.zeros((len(p.judged.readings), values.shape[1]))
    whole[p.series.part] = values
    return floor.cleaned(p.judged.readings, whole)[p.series.part]


def _steps(p: _Turned, values: Floats) -> Floats:
    """Steps from each reading to the next of its run."""
    return np.asarray(np.diff(values, axis=0)[np.diff(p.series.run) == 0])


def _means(p: _Turned, values: Floats) -> Floats:
    """Means of runs."""
    run = np.unique(p.series.run, return_inverse=True)[1]
    total = np.zeros((run.max() + 1, values.shape[1]))
    np.add.at(total, run, values)
    return np.asarray(total / np.bincount(run)[:, None])


def _steps_of_means(p: _Turned, values: Floats) -> Floats:
    """Steps from the mean of each run to that of the next."""
    return np.asarray(np.diff(_means(p, values), axis=0))


def _direction(turn: Floats, run: Ints) -> Floats:
    """Direction of an angle from the reading before, +1 or -1, (n,).

    At the first reading of a run, and at one of the same angle, that to the next: a table overruns where it turns back.
    """
    step = np.diff(turn, prepend=turn[:1])
    moved = np.flatnonzero((np.abs(step) > SAME_RAD) & (np.diff(run, prepend=run[:1]) == 0))
    if not len(moved):
        return np.zeros(len(turn))
    following = np.minimum(np.searchsorted(moved, np.arange(len(turn))), len(moved) - 1)
    return np.asarray(np.sign(step[moved[following]]))


def _rest(values: Floats, columns: Floats) -> float:
    """Mean square that a constant and columns, (n, p), leave of values."""
    with_one = np.column_stack([np.ones(len(values)), columns])
    solved = np.linalg.lstsq(with_one, values, rcond=None)[0]
    return float(np.mean((values - with_one @ solved) ** 2))

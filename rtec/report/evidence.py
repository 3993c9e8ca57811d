"""Chooses the curves that show a finding: the residual over the variable that drives it, or a family of such curves.

A figure is clear if the explained part is a line in it, not a cloud. So the numbers decide the variable of the axis,
the simplest one first: one variable; a position with a second variable held at some levels; time, with the drivers of
the finding below; and if none of these shows a line, the explained part itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.diagnosis.result import Picture
from rtec.diagnosis.words import titled
from rtec.wording import ERROR_UNITS

PLACES, STRETCHES, MOST_TIMES = 120, 40, 300
"""Largest number of different values that are each a place of their own; number of intervals with equally many readings
where there are more; and that number over time, which must show fast changes."""
MOST_CAUSES, FEW_PLACES = 2, 2
LEVELS, GROUPS = 5, 12
"""Number of levels of the second variable, with a curve each; number of groups of readings, with an amplitude each."""
ENOUGH, ENOUGH_OF_TWO = 0.97, 0.8
"""Share of the explained part that a line over one variable, or one for each level of a second variable, must show."""
BETTER = 0.03
"""Gain of that share with which a later variable in the list is preferred, and curves for each direction are."""
ALIKE = 0.05
"""Largest share of the mean square by which curves differ and still count as one shape with several sizes."""
PLACED = ("mm", "deg")
FOLDED = 4.0
"""Number of periods above which a wave is drawn over one period."""
SECONDS_PER_H = 3600.0


@dataclass(frozen=True)
class Curve:
    """One curve: means of the readings by place.

    Attributes:
        direction: +1 or -1 where directions have separate curves; else 0.
        level: mean of the second variable; None where there is none.
        place: places, rising, (k,).
        residual, spread: mean and standard deviation of the residuals there, (k,).
        part: mean of the explained part there, (k,).
    """

    direction: int
    level: float | None
    place: Floats
    residual: Floats
    spread: Floats
    part: Floats


@dataclass(frozen=True)
class Amplitudes:
    """Size of one shape, group by group, against the variable that sets it.

    Attributes:
        below: title of the lower axis.
        value: mean of that variable, rising, (g,).
        measured, error: range of the shape in the residual, and its standard error, (g,).
        explained: range of the shape in the explained part, (g,).
    """

    below: str
    value: Floats
    measured: Floats
    error: Floats
    explained: Floats


@dataclass(frozen=True)
class Evidence:
    """Content of the figure for one reading column.

    Attributes:
        title: title of the panel.
        unit: unit of the readings, for people.
        below: title of the lower axis.
        curves: one, or one for each direction and level.
        dots: place and residual of every reading, (n,) each.
        second: title of the second variable; empty where there is none.
        amplitudes: sizes of the shape, where the curves are one shape with several sizes.
        causes: title and values, (n,), of the drivers of the finding, where it is drawn over time.
    """

    title: str
    unit: str
    below: str
    curves: tuple[Curve, ...]
    dots: tuple[Floats, Floats]
    second: str = ""
    amplitudes: Amplitudes | None = None
    causes: tuple[tuple[str, Floats], ...] = ()


@dataclass(frozen=True)
class _Variable:
    """A driver: title of its axis, value and place of each reading, (n,), and whether it is a position.

    A shape over positions may be rough. A rough shape over another variable is rejected: each run has a temperature of
    its own, which would then only identify the run.
    """

    title: str
    value: Floats
    code: Ints
    position: bool


def evidence(p: Picture) -> Evidence:
    """The evidence of a finding in one reading column."""
    moved = [_variable(*_within_one_period(p, *d), d[1] in PLACED) for d in p.drivers if np.ptp(d[2]) > 0.0]
    places_first = [d for d in moved if d.position]
    drivers = [*places_first, *_differences(p), *(d for d in moved if not d.position)]
    title = "time since the first reading, hours"
    hours = (p.time_s - p.time_s[0]) / SECONDS_PER_H
    time = _Variable(title, hours, places(hours, MOST_TIMES, MOST_TIMES), False)
    alone = _first_good(p, [(d,) for d in drivers], ENOUGH)
    if alone:
        return _over(p, *alone)
    pair = _first_good(p, [(a, b) for a in places_first for b in [*drivers, time] if a is not b], ENOUGH_OF_TWO)
    if pair:
        return replace(_over(p, *pair), second=pair[1].title, amplitudes=_amplitudes(p, *pair))
    if _shown(p, time) >= ENOUGH_OF_TWO:
        return replace(_over(p, time), causes=tuple((d.title, d.value) for d in drivers[:MOST_CAUSES]))
    itself = _variable(f"what the finding explains, {ERROR_UNITS[p.unit]}", p.part)
    return replace(_over(p, itself), curves=_curves(p, itself, apart=False))


def _over(p: Picture, over: _Variable, second: _Variable | None = None) -> Evidence:
    return Evidence(p.title, ERROR_UNITS[p.unit], over.title, _curves(p, over, second), (over.value, p.residual))


def _differences(p: Picture) -> list[_Variable]:
    """Differences of two temperatures, which bend a machine."""
    warm = [(name, value) for name, unit, value in p.drivers if unit == "degC"]
    return [_variable(f"{one} − {two}, K", a - b) for (one, a), (two, b) in combinations(warm, 2)]


def _within_one_period(p: Picture, channel: str, unit: str, value: Floats) -> tuple[str, Floats]:
    """Title and values of a driver; for a wave of many periods the position within one period."""
    title = titled(channel, unit)
    along = next((name for name, code, _ in p.drivers if code == "mm"), None)
    if channel == along and p.period_mm is not None and float(np.ptp(value)) > FOLDED * p.period_mm:
        return f"{title}, within one period of {p.period_mm:.4g} mm", value % p.period_mm
    return title, value


def _variable(title: str, value: Floats, position: bool = False) -> _Variable:
    return _Variable(title, value, places(value), position)


def places(value: Floats, most: int = PLACES, stretches: int = STRETCHES) -> Ints:
    """Index of each value's place, from 0 in rising order, (n,): one a value, or intervals where there are too many."""
    step = max(float(np.ptp(value)), 1e-12) / 2000.0
    levels, code = np.unique(np.round(value / step), return_inverse=True)
    if len(levels) <= most:
        return np.asarray(code, dtype=np.int64)
    # Equal values stay together: all get the place of the first one.
    before = np.concatenate([[0], np.cumsum(np.bincount(code))[:-1]])
    stretch = before[code] * min(stretches, len(value)) // len(value)
    return np.asarray(np.unique(stretch, return_inverse=True)[1], dtype=np.int64)


def _first_good(p: Picture, choices: Sequence[tuple[_Variable, ...]], enough: float) -> tuple[_Variable, ...] | None:
    """The first of the choices that shows enough, and nearly as much as the best one."""
    shown = [_shown(p, *c) for c in choices]
    best = max(shown, default=0.0)
    return next((c for c, s in zip(choices, shown, strict=True) if s >= max(enough, best - BETTER)), None)


def _shown(p: Picture, over: _Variable, second: _Variable | None = None) -> float:
    """Share of the explained part that curves over one variable show, at some levels of a second one."""
    code = over.code if second is None else over.code * LEVELS + places(second.value, LEVELS, LEVELS)
    side = _side_that_matters(p, code)
    rough = 0.0 if over.position or second else roughness(p.part, over.value, over.code, side)
    return explained(p.part, code, side) - rough


def roughness(part: Floats, value: Floats, code: Ints, side: Ints) -> float:
    """Deviation of the mean at a place from the interpolation of its neighbours: 0 for a straight line, 1 for noise.

    Args:
        part: the explained part, (n,).
        value, code: value of the variable, and place of each reading, (n,).
        side: direction of each reading, 0 or 1, (n,): neighbours are of one direction.
    """
    cell, at = np.unique(side * (int(code.max()) + 1) + code, return_inverse=True)
    count = np.bincount(at)
    x, y = (np.bincount(at, weights=v) / count for v in (value, part))
    way = cell // (int(code.max()) + 1)
    inner = np.flatnonzero((way[2:] == way[1:-1]) & (way[:-2] == way[1:-1])) + 1
    whole = float(np.var(y[inner])) if len(inner) else 0.0
    if whole <= 0.0:
        return 0.0
    near = (x[inner] - x[inner - 1]) / (x[inner + 1] - x[inner - 1])
    off = y[inner] - (1.0 - near) * y[inner - 1] - near * y[inner + 1]
    # For independent values the variance of such a difference is 1.5 times that of one value, on average.
    return float(np.mean(off**2)) / (1.5 * whole)


def _side(p: Picture) -> Ints:
    """0 or 1 by direction, (n,); all 0 where it is unknown."""
    if p.direction is None:
        return np.zeros(len(p.part), dtype=np.int64)
    return (p.direction > 0).astype(np.int64)


def _side_that_matters(p: Picture, code: Ints) -> Ints:
    """0 or 1 by direction, (n,), where the cells' means depend on it; else all 0."""
    side = _side(p)
    return side if explained(p.part, code, side) > explained(p.part, code) + BETTER else 0 * side


def explained(part: Floats, code: Ints, side: Ints | int = 0) -> float:
    """Share of a part's variance in the means of its cells, minus the share by noise alone in as many cells.

    Args:
        part: the explained part, (n,).
        code: cell of each reading, (n,).
        side: direction of each reading, 0 or 1, (n,), which has cells of its own.
    """
    _, cell = np.unique(2 * code + side, return_inverse=True)
    free = len(part) - 1 - int(cell.max())
    whole = float(np.var(part)) * len(part) / max(len(part) - 1, 1)
    if free <= 0 or whole <= 0.0:
        return 0.0
    mean = np.bincount(cell, weights=part) / np.bincount(cell)
    return 1.0 - float(np.sum((part - mean[cell]) ** 2)) / free / whole


def _curves(p: Picture, over: _Variable, second: _Variable | None = None, *, apart: bool = True) -> tuple[Curve, ...]:
    """A curve for each direction, where they differ, and each level of the second variable."""
    level = np.zeros(len(p.part), dtype=np.int64) if second is None else _levels(p, second)
    side = _side_that_matters(p, over.code * LEVELS + level) if apart else 0 * level
    out: list[Curve] = []
    for k in np.unique(level):
        for way in np.unique(side)[::-1]:
            rows = np.flatnonzero((level == k) & (side == way))
            if len(rows):
                mean = None if second is None else float(second.value[rows].mean())
                out.append(_curve(p, over, rows, (1 if way else -1) if side.any() else 0, mean))
    # A level with too few readings has no curve.
    return tuple(c for c in out if len(c.place) > FEW_PLACES) or tuple(out)


def _levels(p: Picture, second: _Variable) -> Ints:
    """Level of each reading, evenly spread over the second variable, (n,); a whole run has one level."""
    group = _groups(p, second)
    mean = np.bincount(group, weights=second.value) / np.bincount(group)
    level = np.round((mean - mean.min()) / max(float(np.ptp(mean)), 1e-12) * (LEVELS - 1))
    return np.asarray(level[group], dtype=np.int64)


def _curve(p: Picture, over: _Variable, rows: Ints, direction: int, level: float | None) -> Curve:
    _, cell = np.unique(over.code[rows], return_inverse=True)
    count = np.bincount(cell)

    def mean(value: Floats) -> Floats:
        return np.asarray(np.bincount(cell, weights=value[rows]) / count)

    residual = mean(p.residual)
    spread = np.sqrt(np.bincount(cell, weights=(p.residual[rows] - residual[cell]) ** 2) / count)
    return Curve(direction, level, mean(over.value), residual, spread, mean(p.part))


def _amplitudes(p: Picture, over: _Variable, second: _Variable) -> Amplitudes | None:
    """Size of the shape in each run, or in each interval of the second variable; None where shapes differ."""
    group = _groups(p, second)
    shape = _shape(p, over, group)
    if shape is None:
        return None
    rows = [np.flatnonzero(group == g) for g in np.unique(group)]
    rows = [r for r in rows if float(np.var(shape[r])) > 0.1 * float(np.var(shape))]
    fits = [(*_height(shape[r], p.residual[r]), _height(shape[r], p.part[r])[0]) for r in rows]
    off = sum(float(np.sum(_misfit(shape[r], p.part[r]) ** 2)) for r in rows)
    if len(rows) <= FEW_PLACES or off > ALIKE * float(np.var(p.part)) * len(p.part):
        return None
    value = np.array([float(second.value[r].mean()) for r in rows])
    order = np.argsort(value, kind="stable")
    if len(np.unique(places(value))) <= FEW_PLACES:
        return None
    measured, error, part = (np.array(v)[order] for v in zip(*fits, strict=True))
    return Amplitudes(second.title, value[order], measured, error, part)


def _groups(p: Picture, second: _Variable) -> Ints:
    """Group of each reading, (n,): its run, if the second variable hardly changes in one; else an interval of it."""
    runs = np.unique(p.run, return_inverse=True)[1]
    if int(runs.max()) + 1 >= LEVELS:
        mean = np.bincount(runs, weights=second.value) / np.bincount(runs)
        if float(np.var(second.value - mean[runs])) < ALIKE * float(np.var(second.value)):
            return np.asarray(runs, dtype=np.int64)
    return places(second.value, GROUPS, GROUPS)


def _shape(p: Picture, over: _Variable, group: Ints) -> Floats | None:
    """The shape at every reading, with a range of 1, (n,): that of the group in which it is largest."""
    cell = 2 * over.code + _side_that_matters(p, over.code * (int(group.max()) + 1) + group)
    sizes = [float(np.var(p.part[group == g])) for g in range(int(group.max()) + 1)]
    rows = np.flatnonzero(group == int(np.argmax(sizes)))
    seen, at = np.unique(cell[rows], return_inverse=True)
    mean = np.bincount(at, weights=p.part[rows]) / np.bincount(at)
    height = float(np.ptp(mean))
    if height <= 0.0 or not np.isin(cell, seen).all():
        return None
    return np.asarray(mean[np.searchsorted(seen, cell)] / height)


def _height(shape: Floats, value: Floats) -> tuple[float, float]:
    """Coefficient of the shape in some values, beside a constant, and its standard error."""
    about = shape - shape.mean()
    times = float(about @ value) / float(about @ about)
    left = _misfit(shape, value)
    return times, float(np.sqrt(left @ left / max(len(value) - 2, 1) / (about @ about)))


def _misfit(shape: Floats, value: Floats) -> Floats:
    about = shape - shape.mean()
    return np.asarray(value - value.mean() - about * (float(about @ value) / float(about @ about)))

"""End targets that stand out: readings at the first or last targets of an axis that the others do not predict.

A probe that touches a clamp or an end stop is wrong at the same targets in every run, so neither the neighbours in time
nor the other runs show it. A smooth law fitted to all targets bends towards them, and errs everywhere. So a curve is
fitted to the targets between and must predict the ends (`targets` does the same with a wave). One or two targets do not
decide between a true error of the machine there and a mistake of the measurement.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtec.arrays import Bools, Floats, Ints, robust_sigma
from rtec.estimation.readings import Readings, Series
from rtec.machine import Axis
from rtec.wording import ERROR_UNITS, significant

ENDS = 2
"""Most targets of an end that can stand out."""
FEWEST, MOST, PASSES = 6, 60, 3
"""Fewest and most targets of an axis; and runs in one direction that show whether an end deviates each time."""
DEGREES, FREE = 5, 2
"""Highest degree of the curves along the axis, and fewest targets beyond the numbers of a curve."""
FAR = 10.0
"""A target stands out at this many standard errors of its prediction; one of the curve does once in a hundred
(Student's t with two degrees of freedom)."""
HIGHER = 1
"""The curve that best predicts the targets between may be too low by this many degrees."""
SMOOTH = 4.0
"""The curve through all targets misses those outside its fit by this many times more than the curve between."""
MANY, LEAST = 10, 1e-3
"""The mean of a target is never taken as more accurate than that of this many runs, or this share of the readings."""
STEP, STILL_MM = 0.25, 0.05
"""Positions within this share of the usual step are one target; an axis that moves less is at rest."""

NEXT = (
    "look whether something touches there (a clamp, an end stop, the probe); read that end again at several targets "
    "close together: an error of the machine there would show at all of them"
)


@dataclass(frozen=True)
class EndTargets:
    """Targets at the ends of an axis that stand out in a series.

    Attributes:
        places_mm: positions of the targets along the axis, rising, (k,).
        off: deviation of the readings from the curve through the targets between, in their unit, (k,).
        readings: deviation of each reading there, (m,); NaN of all others.
        message: in words, without a full stop.
    """

    places_mm: Floats
    off: Floats
    readings: Floats
    message: str


def end_targets(readings: Readings) -> list[EndTargets]:
    """End targets that stand out, of each series that is read along one axis.

    Where the axis goes both ways, both must deviate alike: a reversal at an end shows in one direction only.
    """
    out = []
    for s in readings.series:
        axis = _moved(readings, s)
        if axis is None:
            continue
        state = readings.states[s.source]
        place, way = (state.value(c)[s.row] for c in (axis.channel, axis.direction_channel))
        target = _targets(place, s.run)
        at = np.bincount(target, place) / np.bincount(target)
        if not FEWEST <= len(at) <= MOST:
            continue
        tables = [_table(readings.values[s.part], s.run, target, np.sign(way) == w) for w in np.unique(np.sign(way))]
        off = _alike([_off(at, t) for t in tables if len(t) >= PASSES])
        if off.any():
            each = np.full(len(readings), np.nan)
            each[s.part] = np.where(off[target] != 0.0, off[target], np.nan)
            found = np.flatnonzero(off)
            message = _message(readings, s, axis, at[found], off[found])
            out.append(EndTargets(at[found], off[found], each, message))
    return out


def _message(readings: Readings, s: Series, axis: Axis, places: Floats, off: Floats) -> str:
    unit = ERROR_UNITS[s.unit]
    listed = [f"{p:.4g} mm ({significant(o, 2, sign=True)} {unit})" for p, o in zip(places, off, strict=True)]
    ends = listed[0] if len(listed) == 1 else f"{', '.join(listed[:-1])} and {listed[-1]}"
    return (
        f"{readings.measurements[s.source].name} {s.column}: at the end of {axis.name} the readings at {ends} are off "
        "the curve of the targets between, in most runs; so few targets decide no law, and none is fitted to them"
    )


def _moved(readings: Readings, s: Series) -> Axis | None:
    """The one axis that moves in a series; None where several do, or none."""
    travelled = np.ptp(readings.poses_mm[s.source][s.row], axis=0)
    moved = [a for a, by in zip(readings.machine.axes, travelled, strict=True) if by > STILL_MM]
    return moved[0] if len(moved) == 1 else None


def _targets(place: Floats, run: Ints) -> Ints:
    """Number of the target of each reading, rising along the axis, (n,)."""
    once = float(np.median(np.bincount(run)))
    order = np.argsort(place, kind="stable")
    apart = np.diff(place[order]) > STEP * np.ptp(place) / max(once, 1.0)
    out = np.empty(len(place), dtype=np.int64)
    out[order] = np.concatenate([[0], np.cumsum(apart)])
    return out


def _table(values: Floats, run: Ints, target: Ints, mine: Bools) -> Floats:
    """Means of each run in one direction at each target, (runs, targets).

    NaN where there is none; without runs that miss more than one target in four.
    """
    shape = int(run.max()) + 1, int(target.max()) + 1
    cell = run[mine] * shape[1] + target[mine]
    count = np.bincount(cell, minlength=shape[0] * shape[1]).reshape(shape)
    total = np.bincount(cell, values[mine], minlength=shape[0] * shape[1]).reshape(shape)
    with np.errstate(invalid="ignore"):
        return np.asarray((total / count)[(count > 0).mean(axis=1) > 0.75])


def _off(at: Floats, table: Floats) -> Floats:
    """Deviation of each target at an end from the curve through those between, (targets,).

    Zero where it fits the curve; NaN where too few runs read it, or too few targets were read.

    Args:
        at: positions of the targets, mm, rising, (targets,).
        table: readings of each run, (runs, targets).
    """
    out, read = np.full(len(at), np.nan), np.isnan(table).mean(axis=0) < 0.5
    if np.count_nonzero(read) >= FEWEST:
        low, high = at[read][[0, -1]]
        out[read] = _off_curve(2.0 * (at[read] - low) / (high - low) - 1.0, table[:, read])
    return out


def _off_curve(u: Floats, table: Floats) -> Floats:
    """The same for targets at u, -1 to +1, all read by most runs."""
    n, best = len(u), np.zeros(len(u))
    level = _levelled(u, table)
    mean = np.nanmedian(level, axis=0)
    scatter = robust_sigma(np.nanmedian(np.abs(level - mean), axis=0))
    least = max(scatter / np.sqrt(min(len(level), MANY)), LEAST * float(np.ptp(mean)), 1e-9)
    smooth = min(c.predicts for c in _curves(u, mean, np.arange(n), least))
    for low, high in itertools.product(range(ENDS + 1), repeat=2):
        between = np.arange(low, n - high)
        if len(between) == n or len(between) < 2 + FREE:
            continue
        off = _missed(u, mean, between, least, smooth)
        if np.count_nonzero(off) == low + high > np.count_nonzero(best):
            best = off
    return best


def _levelled(u: Floats, table: Floats) -> Floats:
    """Readings of each run less its line through the targets between: its zero, and the thermal change of scale."""
    side = ENDS if len(u) >= FEWEST + ENDS else 1
    there = np.isfinite(table) & (np.arange(len(u)) >= side) & (np.arange(len(u)) < len(u) - side)
    count, value = there.sum(axis=1), np.where(there, table, 0.0)
    along, across = there @ u / count, value.sum(axis=1) / count
    slope = (value @ u / count - along * across) / (there @ u**2 / count - along**2)
    return np.asarray(table - across[:, None] - slope[:, None] * (u - along[:, None]))


def _missed(u: Floats, mean: Floats, between: Ints, least: float, smooth: float) -> Floats:
    """Deviation of targets from the curves through those between, (targets,); zero of those that a curve may fit."""
    outside = np.setdiff1d(np.arange(len(u)), between)
    curves = _curves(u, mean, between, least)
    likeliest = int(np.argmin([c.predicts for c in curves]))
    far = np.min([np.abs(c.off / c.error) for c in curves[likeliest : likeliest + 1 + HIGHER]], axis=0) > FAR
    far &= smooth > SMOOTH * curves[likeliest].predicts
    out = np.zeros(len(u))
    out[outside] = np.where(far, curves[likeliest].off, 0.0)[outside]
    return out


@dataclass(frozen=True)
class _Curve:
    """A polynomial through some targets.

    Attributes:
        off, error: deviation of each target, and its standard error, (targets,).
        predicts: root mean square deviation of each fitted target from the curve through the others.
    """

    off: Floats
    error: Floats
    predicts: float


def _curves(u: Floats, mean: Floats, through: Ints, least: float) -> "list[_Curve]":
    """Curves of each degree that the targets determine."""
    return [_curve(u, mean, through, p, least) for p in range(1, min(DEGREES, len(through) - 1 - FREE) + 1)]


def _curve(u: Floats, mean: Floats, through: Ints, degree: int, least: float) -> _Curve:
    columns = np.polynomial.legendre.legvander(u, degree)
    q, r = np.linalg.qr(columns[through])
    whole = columns @ np.linalg.inv(r)
    off = mean - whole @ (q.T @ mean[through])
    leverage = np.sum(whole**2, axis=1)
    sigma = max(float(np.sqrt(np.sum(off[through] ** 2) / (len(through) - degree - 1))), least)
    without = off[through] / np.maximum(1.0 - leverage[through], 1e-9)
    return _Curve(off, sigma * np.sqrt(1.0 + leverage), max(float(np.sqrt(np.mean(without**2))), least))


def _alike(ways: Sequence[Floats]) -> Floats:
    """The smaller deviation of both directions, where both have the same sign; zero elsewhere, (targets,).

    A target that is read in one direction only, as an end may be, stands out by that one.
    """
    if not ways:
        return np.zeros(1)
    out = ways[0]
    for other in ways[1:]:
        smaller = np.where(np.abs(other) < np.abs(out), other, out)
        out = np.where(np.isnan(out), other, np.where(np.isnan(other), out, np.where(out * other > 0.0, smaller, 0.0)))
    return np.nan_to_num(out)

"""Non-linear parameters of a candidate, refined between the neighbours of the best grid value.

A grid finds the hill, not its top: a wave along a long axis whose phase is off by part of a turn at the ends explains
less than it could, and a standard error about a grid point claims too much. Values farther away were not searched, and
the evidence does not account for them.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rtec.arrays import Floats
from rtec.diagnosis.search.screen import UNMOVED, Projected
from rtec.effects import Effect, Parameter
from rtec.estimation.gls import solve
from rtec.estimation.readings import Readings
from rtec.estimation.visible import within_record
from rtec.model.fit import SearchScale

Theta = Mapping[str, float]

EVALUATIONS = 12
OPTIONS: dict[str, Any] = {"ftol": 1e-5, "xtol": 1e-6, "diff_step": 1e-4, "max_nfev": EVALUATIONS}
BETWEEN = (0.125, 0.375, 0.625, 0.875)
"""Places within a search of one parameter at which it may begin as well, as shares of it."""
EDGE, END, MOVES = 1e-6, 1e-3, 3
"""Distances from the ends of a search, as shares of it, from which it starts, and from which its result is at an end;
and how often it is then moved."""


def polished(
    effect: Effect, grid: Sequence[Theta], best: int, readings: Readings, projected: Callable[[], Projected]
) -> dict[str, float]:
    """Non-linear parameters refined by least squares from the best grid value; that value where nothing is better.

    Args:
        effect: the candidate.
        grid: values of its non-linear parameters.
        best: number of the best grid value.
        readings: the readings.
        projected: gives the whitened readings less the current model; called only where a parameter can be refined.
    """
    start = dict(grid[best])
    parameters = within_record(effect, readings.measurements)
    smooth = [p for p in parameters if _smooth(p)]
    free = [_between(p, grid, start) for p in smooth]
    instants = {p.name: _nearby(p.name, grid, start, readings) for p in parameters if at_instant(p)}
    if not free and not instants:
        return start
    search = _Search(effect, start, free, readings, projected())
    for name, times in instants.items():
        search.start = min(({**search.start, name: t} for t in times), key=search.squares, default=start)
    if not free:
        return search.start
    found = search.best()
    for _ in range(MOVES):
        # A bump between two places of the grid looked wider there than it is.
        moved = [
            _about(p, b, found[p.name]) if _at_end(p, b, found[p.name]) else b
            for p, b in zip(smooth, search.free, strict=True)
        ]
        if moved == search.free:
            break
        search = _Search(effect, found, moved, readings, search.projected)
        found = search.best()
    return found


def _at_end(p: Parameter, box: Parameter, value: float) -> bool:
    """Whether a place or a length is at an end of a search that is no bound of it; a delay is not followed farther."""
    place = SearchScale.of(box).place(value)
    return p.unit == "mm" and ((place < END and box.low > p.low) or (place > 1.0 - END and box.high < p.high))


def _about(p: Parameter, box: Parameter, value: float) -> Parameter:
    """A search of the same width about a value."""
    if p.low > 0.0:
        factor = math.sqrt(box.high / box.low)
        return replace(box, low=max(value / factor, p.low), high=min(value * factor, p.high))
    half = 0.5 * (box.high - box.low)
    return replace(box, low=max(value - half, p.low), high=min(value + half, p.high))


def _smooth(p: Parameter) -> bool:
    """Whether a parameter is bounded and changes the readings smoothly; an instant between readings does not."""
    return math.isfinite(p.low) and math.isfinite(p.high) and p.low < p.high and not at_instant(p)


def _between(p: Parameter, grid: Sequence[Theta], start: Theta) -> Parameter:
    """The parameter bounded by the neighbouring grid values; at an end of the grid, by the same distance again."""
    values = sorted({t[p.name] for t in grid})
    if len(values) < 2:
        return p
    at = values.index(start[p.name])
    here = values[at]
    even = p.low <= 0.0
    below = values[at - 1] if at else (2.0 * here - values[1] if even else here * here / values[1])
    last = at == len(values) - 1
    above = (2.0 * here - values[-2] if even else here * here / values[-2]) if last else values[at + 1]
    return replace(p, low=max(below, p.low), high=min(above, p.high))


def at_instant(p: Parameter) -> bool:
    """Whether a parameter is the instant of an event: readings change only where it passes one of them."""
    return p.unit == "s" and p.name.startswith("t0")


def live_columns(effect: Effect, theta: Theta, readings: Readings) -> Floats:
    """Columns of an effect, (m, k); zero where its usual size moves the readings by less than rounding."""
    columns = readings.columns(effect, theta)
    usual = np.array([p.typical for p in effect.coefficients(readings.machine)])
    return np.asarray(columns * (np.sqrt(np.mean(columns**2, axis=0)) * usual > UNMOVED))


def _nearby(name: str, grid: Sequence[Theta], start: Theta, readings: Readings) -> list[float]:
    """Instants between readings from the grid value below to the one above, the grid's first."""
    values = sorted({t[name] for t in grid})
    at = values.index(start[name])
    low, high = values[max(at - 1, 0)], values[min(at + 1, len(values) - 1)]
    times = np.unique(readings.time_s)
    between = 0.5 * (times[1:] + times[:-1])
    return [start[name], *between[(between > low) & (between < high)].tolist()]


class _Search:
    def __init__(
        self, effect: Effect, start: dict[str, float], free: list[Parameter], readings: Readings, projected: Projected
    ) -> None:
        self.effect, self.start, self.free = effect, start, free
        self.readings, self.projected = readings, projected
        self.scales = [SearchScale.of(p) for p in free]

    def best(self) -> dict[str, float]:
        """Variable projection from the start, within the bounds."""
        from scipy.optimize import least_squares

        start = np.array([s.place(self.start[p.name]) for p, s in zip(self.free, self.scales, strict=True)])
        start = np.clip(start, EDGE, 1.0 - EDGE)
        first = self._left(start)
        if len(start) == 1:  # a kink has hills of its own, each only as wide as the step between two readings
            others = [np.array([place]) for place in BETWEEN]
            start = min((start, *others), key=lambda x: float(np.sum((first if x is start else self._left(x)) ** 2)))
        found = least_squares(self._left, start, bounds=(0.0, 1.0), **OPTIONS)
        better = float(found.fun @ found.fun) < float(first @ first)
        return self._at(found.x) if better else self.start

    def _at(self, x: Floats) -> dict[str, float]:
        pairs = zip(self.free, self.scales, x, strict=True)
        return self.start | {p.name: s.value(float(v)) for p, s, v in pairs}

    def squares(self, theta: Theta) -> float:
        """Sum of squared residuals with the best linear coefficients."""
        left = self._left_at(theta)
        return float(left @ left)

    def _left(self, x: Floats) -> Floats:
        return self._left_at(self._at(x))

    def _left_at(self, theta: Theta) -> Floats:
        with np.errstate(all="ignore"):
            columns = live_columns(self.effect, theta, self.readings)
        if not np.isfinite(columns).all():
            return self.projected.left
        white = self.projected.take_out(self.projected.whitener(columns))
        return np.asarray(self.projected.left - white @ solve(white, self.projected.left))

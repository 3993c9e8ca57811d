"""Puts a candidate's non-linear parameters where they fit best between the values that were tried.

A grid finds the hill, not its top: a wave along a long axis that is off by a part of a turn at the ends loses some of
what it explains, and a standard error about a grid point promises what the number does not hold. It stays between the
neighbours of the value that was best: what lies farther off was not searched for, and nobody paid for the search.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis.search.screen import UNMOVED, Projected
from rtec.effects import Effect, Parameter
from rtec.estimation.gls import solve
from rtec.estimation.readings import Readings
from rtec.model.fit import SearchScale

Floats = NDArray[np.float64]
Theta = Mapping[str, float]

EVALUATIONS = 12
OPTIONS: dict[str, Any] = {"ftol": 1e-5, "xtol": 1e-6, "diff_step": 1e-4, "max_nfev": EVALUATIONS}
EDGE = 1e-6


def polished(
    effect: Effect, tried: Sequence[Theta], best: int, readings: Readings, projected: Callable[[], Projected]
) -> dict[str, float]:
    """Give the values that explain most, by least squares from the best tried; these where nothing is better.

    Args:
        effect: the candidate.
        tried: values of its non-linear parameters.
        best: which of these is the best.
        readings: the readings.
        projected: gives the noise, and the current model taken out; asked for only where there is something to find.
    """
    start = dict(tried[best])
    free = [_between(p, tried, start) for p in effect.nonlinear(readings.machine) if _smooth(p)]
    if not free:
        return start
    search = _Search(effect, start, free, readings, projected())
    return search.best()


def _smooth(p: Parameter) -> bool:
    """Whether a parameter is bounded and moves the readings smoothly: an instant does not, it lies between readings."""
    return math.isfinite(p.low) and math.isfinite(p.high) and p.low < p.high and not _instant(p)


def _between(p: Parameter, tried: Sequence[Theta], start: Theta) -> Parameter:
    """The same from the value below to the value above; at an end of what was tried as far again."""
    values = sorted({t[p.name] for t in tried})
    if len(values) < 2:
        return p
    at = values.index(start[p.name])
    here = values[at]
    even = p.low <= 0.0
    below = values[at - 1] if at else (2.0 * here - values[1] if even else here * here / values[1])
    last = at == len(values) - 1
    above = (2.0 * here - values[-2] if even else here * here / values[-2]) if last else values[at + 1]
    return replace(p, low=max(below, p.low), high=min(above, p.high))


def _instant(p: Parameter) -> bool:
    return p.unit == "s" and p.name.startswith("t0")


def live_columns(effect: Effect, theta: Theta, readings: Readings) -> Floats:
    """Columns of an effect, (m, k); one that hardly moves the readings at its usual size is rounding, and nothing."""
    columns = readings.columns(effect, theta)
    usual = np.array([p.typical for p in effect.coefficients(readings.machine)])
    return np.asarray(columns * (np.sqrt(np.mean(columns**2, axis=0)) * usual > UNMOVED))


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
        found = least_squares(self._left, start, bounds=(0.0, 1.0), **OPTIONS)
        better = float(found.fun @ found.fun) < float(first @ first)
        return self._at(found.x) if better else self.start

    def _at(self, x: Floats) -> dict[str, float]:
        pairs = zip(self.free, self.scales, x, strict=True)
        return self.start | {p.name: s.value(float(v)) for p, s, v in pairs}

    def _left(self, x: Floats) -> Floats:
        with np.errstate(all="ignore"):
            columns = live_columns(self.effect, self._at(x), self.readings)
        if not np.isfinite(columns).all():
            return self.projected.left
        white = self.projected.take_out(self.projected.whitener(columns))
        return np.asarray(self.projected.left - white @ solve(white, self.projected.left))

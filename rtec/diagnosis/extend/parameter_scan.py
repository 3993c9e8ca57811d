"""Scans the whole range of parameters that nobody searched before they are refined.

A period has many local minima: least squares from one start stops at the nearest. So the range is scanned point by
point, each by one linear least squares, and the best few are refined together with the given start.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rtec.arrays import Floats
from rtec.diagnosis.search.screen import orthonormal
from rtec.effects import Parameter
from rtec.estimation.gls import solve
from rtec.estimation.joint import Joint
from rtec.estimation.noise import Whitener, without_drift
from rtec.estimation.readings import Readings, looked_at
from rtec.model import FittedEffect

Theta = dict[str, float]

EVEN, LOGARITHMIC = 400, 120
MOST = 2000
"""Points of a range: even in 1/p at the least and at the most, and by equal factors."""
PER_TURN = 4.0
"""Points in 1/p for each additional turn of a wave over the span of the readings."""
KEPT = 6
"""Number of points that are refined."""
ALIKE = 1.01
"""Residuals (root mean square) within this factor are equal."""
AS_MUCH = 0.9
"""And they must remove this share of what the best one removes, so that small effects are distinguished too."""
WIDE = 1.2
"""A range up to this factor is refined from its start without a scan."""
SAME = 0.02
"""Values within this relative difference are one."""
EVALUATIONS = 30


@dataclass(frozen=True)
class _Place:
    """Values of the parameters and the sum of squared residuals."""

    theta: Theta
    left: float


class _Search:
    """One new effect fitted with the model under nearly no drift, so that drift does not absorb a slow wave."""

    def __init__(self, fitted: FittedEffect, before: Joint, readings: Readings) -> None:
        keep = looked_at(readings)
        self.readings = readings if keep.all() else readings.without(~keep)
        noise = before.whitener
        self.whitener = without_drift(Whitener(self.readings, noise.noises, noise.run_variances, noise.least))
        self.base = orthonormal(self.whitener(before.columns[keep]))
        self.target = self._apart(self.whitener(self.readings.values))
        self.fitted = fitted

    def _apart(self, white: Floats) -> Floats:
        return np.asarray(white - self.base @ (self.base.T @ white))

    def residual(self, theta: Theta) -> Floats | None:
        """Whitened readings less the best fit at these values, (m,); None where the effect is not finite."""
        with np.errstate(all="ignore"):
            columns = self.readings.columns(self.fitted.effect, theta)
        if not np.isfinite(columns).all():
            return None
        white = self._apart(self.whitener(columns))
        return np.asarray(self.target - white @ solve(white, self.target))

    def left(self, theta: Theta) -> float:
        """Sum of squared residuals; infinite where the effect is not finite."""
        residual = self.residual(theta)
        return math.inf if residual is None else float(residual @ residual)


def scan_ranges(fitted: FittedEffect, before: Joint, readings: Readings) -> tuple[FittedEffect, tuple[str, ...]]:
    """Put the parameters of an effect at the best fit within their whole ranges.

    Args:
        fitted: a new effect with its start; returned unchanged without bounded parameters, and unless it is an
            expression or all of them are where every search of that effect begins: others were searched already.
        before: the fit without it.
        readings: all readings of the fit.

    Returns:
        The effect at the best place (of several equal fits, at the one nearest to its start), and notes in words:
        distant values that fit equally well.
    """
    free = [p for p in fitted.effect.nonlinear(readings.machine) if np.isfinite([p.low, p.high]).all()]
    unsearched = all(fitted.theta[p.name] == p.start for p in free) and any(p.high > WIDE * p.low for p in free)
    if not free or not (fitted.effect.effect == "expression" or unsearched):
        return fitted, ()
    search = _Search(fitted, before, readings)
    places = _distinct([_refined(search, p.theta, free) for p in _looked_through(search, free)], free)
    finite = [p for p in places if math.isfinite(p.left)]
    if not finite:
        return fitted, ()
    alike = _alike(finite, float(search.target @ search.target))
    chosen = min(alike, key=lambda p: _far(p.theta, fitted.theta, free))
    return FittedEffect(fitted.effect, fitted.values, chosen.theta), _words(fitted, chosen, alike, free, readings)


def _looked_through(search: _Search, free: Sequence[Parameter]) -> list[_Place]:
    """The best few places, from a scan of one parameter after the other, and the start."""
    start = dict(search.fitted.theta)
    found = [_Place(start, search.left(start))]
    for p in free:
        more = [place for one in found[: max(1, KEPT // len(free))] for place in _valleys(search, one.theta, p)]
        found = sorted([*found, *more], key=lambda q: q.left)[:KEPT]
    return [*found, _Place(start, math.inf)]


def _valleys(search: _Search, at: Theta, p: Parameter) -> list[_Place]:
    """Local minima of the residual in one range."""
    grid = _grid(p, _span(search))
    left = np.array([search.left({**at, p.name: float(v)}) for v in grid])
    edge = np.concatenate([[math.inf], left, [math.inf]])
    low = np.flatnonzero((left <= edge[:-2]) & (left <= edge[2:]) & np.isfinite(left))
    best = low[np.argsort(left[low], kind="stable")][:KEPT]
    return [_Place({**at, p.name: float(grid[i])}, float(left[i])) for i in best]


def _grid(p: Parameter, span: float) -> Floats:
    """Points of a range: evenly, and of a positive one also even in 1/p (periods) and by equal factors."""
    if p.low <= 0.0:
        return np.linspace(p.low, p.high, EVEN)
    turns = span * (1.0 / p.low - 1.0 / p.high)
    count = int(np.clip(math.ceil(PER_TURN * turns), EVEN, MOST))
    by_turn = 1.0 / np.linspace(1.0 / p.high, 1.0 / p.low, count)
    whole = [by_turn, np.geomspace(p.low, p.high, LOGARITHMIC), np.linspace(p.low, p.high, LOGARITHMIC)]
    return np.clip(np.unique(np.concatenate(whole)), p.low, p.high)


def _span(search: _Search) -> float:
    """The longest span of the expression's channels, in their unit."""
    channels = search.fitted.effect.channels(search.readings.machine)
    ways = [float(np.ptp(v)) for c in channels if np.isfinite(v := search.readings.channel(c)).all()]
    return max(ways, default=0.0)


def _refined(search: _Search, theta: Theta, free: Sequence[Parameter]) -> _Place:
    """Least squares from one place, within the bounds."""
    from scipy.optimize import least_squares

    low, high = np.array([p.low for p in free]), np.array([p.high for p in free])
    start = np.array([theta[p.name] for p in free])
    if search.residual(theta) is None:
        return _Place(theta, math.inf)
    edge = 1e-9 * (high - low)
    wild = np.full(len(search.target), 1e3 * float(np.abs(search.target).max()))

    def at(x: Floats) -> Theta:
        return {**theta, **{p.name: float(v) for p, v in zip(free, x, strict=True)}}

    def residual(x: Floats) -> Floats:
        found = search.residual(at(x))
        return wild if found is None else found

    scale = np.maximum(np.abs(start), 1e-3 * (high - low))
    options: dict[str, Any] = {"x_scale": scale, "xtol": 1e-6, "ftol": 1e-8, "max_nfev": EVALUATIONS}
    run: Callable[..., Any] = least_squares
    found = run(residual, np.clip(start, low + edge, high - edge), bounds=(low, high), **options)
    return _Place(at(found.x), float(found.fun @ found.fun))


def _distinct(places: Sequence[_Place], free: Sequence[Parameter]) -> list[_Place]:
    """Best first, each place once."""
    out: list[_Place] = []
    for one in sorted(places, key=lambda p: p.left):
        if all(_far(one.theta, other.theta, free) > SAME for other in out):
            out.append(one)
    return out


def _alike(places: Sequence[_Place], whole: float) -> list[_Place]:
    best = min(p.left for p in places)
    return [p for p in places if p.left <= ALIKE**2 * best and whole - p.left >= AS_MUCH * (whole - best)]


def _far(one: Mapping[str, float], other: Mapping[str, float], free: Sequence[Parameter]) -> float:
    """Distance between two places: the largest difference of a parameter, relative to its size or its range."""
    out = 0.0
    for p in free:
        a, b = one[p.name], other[p.name]
        out = max(out, abs(math.log(a / b)) if p.low > 0.0 else abs(a - b) / (p.high - p.low))
    return out


def _words(
    fitted: FittedEffect, chosen: _Place, alike: Sequence[_Place], free: Sequence[Parameter], readings: Readings
) -> tuple[str, ...]:
    if len(alike) < 2:
        return ()
    out = []
    for p in free:
        values = sorted({float(f"{q.theta[p.name]:.4g}") for q in alike})
        if len(values) > 1:
            listed = f"{', '.join(f'{v:.4g}' for v in values[:-1])} and {values[-1]:.4g}"
            why = ", for the targets are at equal steps" if _even(fitted, readings) else ""
            out.append(
                f"these values of {p.name} fit alike within 1 %: {listed}{why}; taken was "
                f"{chosen.theta[p.name]:.4g}, the nearest to the start; measure at unequal steps to separate them"
            )
    return tuple(out)


def _even(fitted: FittedEffect, readings: Readings) -> bool:
    """Whether the readings are at equal steps of the expression's axis."""
    axes = {a.channel for a in readings.machine.axes} & set(fitted.effect.channels(readings.machine))
    for channel in axes:
        steps = np.diff(np.unique(np.round(readings.channel(channel), 3)))
        if len(steps) < 2 or float(np.ptp(steps)) > SAME * float(steps.mean()):
            return False
    return bool(axes)

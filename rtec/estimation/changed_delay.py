"""Delays of a model that are others in new readings: another flow of coolant, another load, a body that was changed.

A derivative by a delay describes small changes only. Where readings show another delay, what a refit of the model may
explain begins there; else an effect would be named for what the derivative leaves.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from rtec.arrays import Floats
from rtec.effects import Parameter
from rtec.estimation import floor
from rtec.estimation.candidates import simple_effects
from rtec.estimation.columns import Base, base_of
from rtec.estimation.gls import solve
from rtec.estimation.outliers import Clean
from rtec.estimation.readings import Readings
from rtec.estimation.visible import within_record
from rtec.model import FittedEffect, Model

Delays = Mapping[int, float]

MOVES, FAR = 0.1, 3.5
"""A delay is searched for where a linear refit moves it by this share of itself, and by so many standard errors."""
GRID = 16
"""Delays that are tried first, within the bounds."""
HELPS = 0.1
"""Least share of the squared residual that one changed delay takes away."""
TAKES = 0.5
"""Least share of the squared residual that all of them take away, of what a linear refit leaves."""
NEAR = 1.25
"""With them the residual is within this factor of the noise floor."""
AS_GOOD = 1.1
"""An explanation does as well as another if its residual is within this factor."""
FEWEST = 8
"""Readings for each number of the refit, at least."""


def with_changed_delays(model: Model, given: Clean) -> Clean:
    """The same readings with the delays that they show, where these are not the model's."""
    return replace(given, delays=changed_delays(model, given.readings))


def changed_delays(model: Model, readings: Readings) -> Delays:
    """Delays in s that have changed since the fit, by the number of their effect; empty where none has.

    Beside them the model's other numbers are refitted. What remains must be near the noise, and no effect with one new
    number may do as well beside the delays of the fit.
    """
    known = _Refits(model, readings)
    moved = {i: p for i, p in known.delays() if known.moves(i, p)}
    if not moved or len(readings) < FEWEST * known.base.columns.shape[1]:
        return {}
    found, now = dict[int, float](), known.squares({})
    before = now
    while len(found) < len(moved):
        tried = [(*known.best(i, p, found), i) for i, p in moved.items() if i not in found]
        least, delay_s, i = min(tried)
        if least > (1.0 - HELPS) * now:
            break
        found[i], now = delay_s, least
    if now > (1.0 - TAKES) * before:
        return {}
    found = {i: v for i, v in found.items() if abs(math.log(v / model.effects[i].theta["tau"])) > math.log1p(MOVES)}
    if not found or not known.near_noise(found, now) or known.simpler(now):
        return {}
    return found


class _Refits:
    """Ordinary refits of a model to readings, under several delays."""

    def __init__(self, model: Model, readings: Readings) -> None:
        self.model, self.readings = model, readings

    @cached_property
    def base(self) -> Base:
        """Columns under the delays of the model."""
        return base_of(self.model, self.readings)

    @cached_property
    def values(self) -> Floats:
        """The readings, less what the instruments cannot know, (m,)."""
        return floor.cleaned(self.readings, self.readings.values)

    @cached_property
    def flat(self) -> Floats:
        """The columns, less the same, (m, p)."""
        return floor.cleaned(self.readings, self.base.columns)

    @cached_property
    def step(self) -> Mapping[str, float]:
        """What a linear refit changes each number by."""
        left = floor.cleaned(self.readings, self.readings.values - self.base.predicted)
        return dict(zip(self.base.names, solve(self.flat, left).tolist(), strict=False))

    def delays(self) -> Iterator[tuple[int, Parameter]]:
        """Effects, by number, whose delay is known with an error and seen in these readings."""
        for i, f in enumerate(self.model.effects):
            if not f.errors.get("tau", 0.0) or not np.abs(self.readings.arms(f.effect.component)).any():
                continue
            for bounds in within_record(f.effect, self.readings.measurements):
                if bounds.name == "tau" and bounds.unit == "s" and 0.0 < bounds.low < bounds.high:
                    yield i, bounds

    def moves(self, i: int, bounds: Parameter) -> bool:
        """Whether a linear refit moves a delay far; one that it would move out of reach is no column of the base."""
        f = self.model.effects[i]
        step = self.step.get(f"{f.label} {bounds.name}")
        return step is None or abs(step) > max(MOVES * f.theta["tau"], FAR * f.errors["tau"])

    def squares(self, delays: Delays) -> float:
        """Sum of squares of a refit under some delays."""
        left = self.left_under(delays)
        return float(left @ left)

    def left_under(self, delays: Delays) -> Floats:
        """Residual of a refit under some delays, (m,)."""
        columns = self.flat if not delays else floor.cleaned(self.readings, self.under(delays))
        return np.asarray(self.values - columns @ solve(columns, self.values))

    def under(self, delays: Delays) -> Floats:
        """The model's columns under some delays, without the derivatives by these, (m, p)."""
        base, set_ = base_of(self.model, self.readings, delays), {f"{self.model.effects[i].label} tau" for i in delays}
        return base.columns[:, [name not in set_ for name in base.names]]

    def best(self, i: int, bounds: Parameter, beside: Delays) -> tuple[float, float]:
        """Least sum of squares by one delay beside others, and the delay in s."""
        from scipy.optimize import minimize_scalar

        tried = np.geomspace(bounds.low, bounds.high, GRID)

        def at(log_s: float) -> float:
            return self.squares({**beside, i: math.exp(log_s)})

        sums = [at(math.log(v)) for v in tried]
        k = int(np.argmin(sums))
        around = np.log(tried[[max(k - 1, 0), min(k + 1, GRID - 1)]])
        found = minimize_scalar(at, bounds=tuple(around), method="bounded", options={"xatol": 0.01})
        return (float(found.fun), math.exp(found.x)) if found.fun < sums[k] else (sums[k], float(tried[k]))

    def near_noise(self, delays: Delays, squares: float) -> bool:
        """Whether a refit under these delays leaves little but noise."""
        columns, left = self.under(delays), self.left_under(delays)
        floors = floor.noise_floors(self.readings, left, floor.flexible_noise(self.readings, columns))
        least = sum(f.value**2 * len(s) for f, s in zip(floors, self.readings.series, strict=True))
        return squares < NEAR**2 * least

    def simpler(self, squares: float) -> bool:
        """Whether one new number beside the delays of the fit does as well."""
        rest = self.left_under({})
        for effect in simple_effects(self.readings):
            new = floor.cleaned(self.readings, self.readings.columns(effect, {}))
            new = new - self.flat @ solve(self.flat, new)
            left = rest - new @ solve(new, rest)
            if float(left @ left) < AS_GOOD**2 * squares:
                return True
        return False


def with_delays(effects: Sequence[FittedEffect], delays: Delays) -> tuple[FittedEffect, ...]:
    """The effects with other delays."""
    return tuple(replace(f, theta={**f.theta, "tau": delays[i]}) if i in delays else f for i, f in enumerate(effects))

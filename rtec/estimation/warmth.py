"""How warm a machine was when its model was fitted, and how warm it is now.

Of a cold day and a warm one, a scale error that changed and a part that expands look the same.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rtec.effects import Effect
from rtec.effects.geometry import Scale
from rtec.effects.thermal import AxisExpansion
from rtec.estimation.readings import Readings
from rtec.machine.chain import component_unit
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.wording import significant

WARMER_K = 1.0
MISREADS_K, APART, DRIFTS_K = (1.0, 20.0), 0.5, 0.5
"""What a sensor may read too high or too low. Since the fit it has moved away from the other sensors; what it reads too
high explains that but for this share. By less than the last any sensor may read otherwise on another day."""
MATERIAL, FAR_K = (4.0, 14.0), 2.0
"""Expansion of the materials of screws and scales, glass to steel, µm/(m·K): what looks like one is likelier to be one
than to be another scale error, where the part is at least so many kelvin from all that it was in the fit."""
EXPANDS, SURE = 25.0, 2.0
"""Expansion that no material of a machine exceeds, µm/(m·K), and standard errors beyond it."""


def expands_much(effect: Effect, k: float, error: float) -> bool:
    """Whether a screw or scale would expand more than any material of a machine, beyond two standard errors.

    A number known to no better than such an expansion is none that a machine has, either: two that cancel each other
    on one day are large and uncertain. An angle that grows along an axis is no expansion of a material.
    """
    return _of_a_length(effect) and isinstance(effect, AxisExpansion) and abs(k) - SURE * min(error, EXPANDS) > EXPANDS


def _of_a_length(effect: Effect) -> bool:
    return component_unit(effect.component) == "um"


@dataclass(frozen=True)
class Warmer:
    """A sensor whose part is warmer or colder than in the fit.

    Attributes:
        sensor: its name.
        by_k: by how many kelvin, on average.
        growth: expansion that would look like the change of the scale error, µm/(m·K).
        effect: label of the expansion that explains the readings better than that change; empty where none does.
        leaves: residual with that effect, in the unit of the diagnosis; None without one.
        rivals: labels of expansions by other sensors that explain them better than that change as well.
        sure: whether that effect explains the readings better, and not only as well and as a material expands.
    """

    sensor: str
    by_k: float
    growth: float
    effect: str = ""
    leaves: float | None = None
    rivals: tuple[str, ...] = ()
    sure: bool = True


@dataclass(frozen=True)
class Misread:
    """A sensor that a model follows and that seems to read too high or too low.

    Attributes:
        sensor: its name.
        by_k: how many kelvin too high.
        shown: whether it stands apart from the other sensors by as much more than in the fit; else any sensor may read
            otherwise by so little.
    """

    sensor: str
    by_k: float
    shown: bool = True


def recorded_degc(measurements: Iterable[Measurement]) -> dict[str, dict[str, list[float]]]:
    """What an entry of a model's history keeps of how warm the machine was; empty where no temperature was recorded."""
    return {"recorded_degc": found} if (found := _recorded(measurements)) else {}


def _recorded(measurements: Iterable[Measurement]) -> dict[str, list[float]]:
    """Lowest and highest temperature of each recorded sensor, °C."""
    out: dict[str, list[float]] = {}
    for m in measurements:
        for name in m.machine.sensor_names:
            degc = m.channels.get(name)
            if degc is not None and np.isfinite(degc).any():
                low, high = out.get(name, (np.inf, -np.inf))
                out[name] = [min(low, float(np.nanmin(degc))), max(high, float(np.nanmax(degc)))]
    return out


def of_the_fit(model: Model) -> Mapping[str, tuple[float, float]]:
    """Lowest and highest temperature of each sensor that was recorded for a model, °C."""
    out: dict[str, tuple[float, float]] = {}
    for entry in model.history:
        for name, (low, high) in entry.get("recorded_degc", {}).items():
            a, b = out.get(name, (low, high))
            out[name] = (min(a, low), max(b, high))
    return out


def off_the_fit(model: Model, readings: Readings) -> dict[str, float]:
    """By how many kelvin, on average, sensors are above or below all that they were in the fit of a model.

    Args:
        model: of an earlier day.
        readings: of today.
    """
    now, out = _recorded(readings.measurements), {}
    for name, (low, high) in of_the_fit(model).items():
        least, most = now.get(name, (low, high))
        if least - high > WARMER_K or low - most > WARMER_K:
            out[name] = (least + most - low - high) / 2.0
    return out


def off_along(model: Model, readings: Readings, axis: str) -> dict[str, float]:
    """The same, of sensors by which an axis may expand, and does not in the model yet."""
    there = {f.effect.sensor for f in model.effects if isinstance(f.effect, AxisExpansion) and f.effect.axis == axis}
    found, machine = off_the_fit(model, readings), readings.machine
    return {n: k for n, k in found.items() if n not in there and not machine.of_another_axis(n, axis)}


def warmer(model: Model, readings: Readings, effect: Effect, change: float) -> Warmer | None:
    """The sensor whose expansion would look like a change of a scale error; None where there is none.

    Args:
        model: of an earlier day.
        readings: of today.
        effect: of the model.
        change: of its number, µm/m.
    """
    if not isinstance(effect, Scale) or not _of_a_length(effect):
        return None
    found = []
    for name, by_k in off_along(model, readings, effect.axis).items():
        if 0.0 < change / by_k <= EXPANDS:
            own = any(readings.machine.of_another_axis(name, a.name) for a in readings.machine.axes)
            found.append((own, abs(by_k), Warmer(name, by_k, change / by_k)))
    return max(found, key=lambda f: f[:2])[2] if found else None


def misread(model: Model, readings: Readings, effect: Effect, change: float) -> Misread | None:
    """The sensor of an expansion of the model that, reading too high or too low, looks like a change of a scale error.

    It must stand apart from all others by about as much more than in the fit, unless it is hardly anything. None where
    there is none.

    Args:
        model: of an earlier day.
        readings: of today.
        effect: of the model.
        change: of its number, µm/m.
    """
    if not isinstance(effect, Scale) or not _of_a_length(effect):
        return None
    then, now = ({n: sum(v) / 2.0 for n, v in r.items()} for r in (of_the_fit(model), _recorded(readings.measurements)))
    known, mine = then.keys() & now.keys(), (effect.component, effect.axis)
    for f in model.effects:
        if not isinstance(f.effect, AxisExpansion) or f.effect.stretched or (f.effect.component, f.effect.axis) != mine:
            continue
        name, k = f.effect.sensor, f.values["k"]
        others = [now[n] - then[n] for n in known if n != name]
        by_k = -change / k if k else math.inf
        if abs(by_k) < DRIFTS_K:
            return Misread(name, by_k, shown=False)
        if name not in known or not others or not MISREADS_K[0] <= abs(by_k) <= MISREADS_K[1]:
            continue
        apart = now[name] - then[name] - float(np.median(others))
        if abs(apart - by_k) < APART * abs(apart):
            return Misread(name, by_k)
    return None


SENSOR_S = 300.0
"""No sensor of a machine is later than its part by more, s."""
SHARED = 0.25
"""An expansion by several temperatures may differ from what the day of the fit showed by this share, or by `SURER`
standard errors. So may what each of them makes of it."""
SURER = 3.0


def differs_from_fit_day(model: Model, after: Model) -> tuple[str, ...]:
    """Axes that would have expanded otherwise than a model found it on the day of its fit, in words.

    A further temperature may share an expansion with those before. Where all of them warm as they did then, their sum
    is what that day showed. A temperature that hardly varied then showed nothing.

    Args:
        model: with its errors, and the ranges of the sensors on the day of its fit.
        after: the model with more effects.
    """
    span = {n: high - low for n, (low, high) in of_the_fit(model).items() if high - low >= WARMER_K}
    out, grown = [], _expansions(after)
    for part, was in _expansions(model).items():
        now = grown.get(part, [])
        if len(now) <= len(was) or not all(g.sensor in span for g in now) or not all(g.error for g in was):
            continue
        most, new = max(span[g.sensor] for g in was), {g.sensor for g in now[len(was) :]}
        before, then = (sum(g.k * span[g.sensor] / most for g in of) for of in (was, now))
        if abs(then - before) > max(SHARED * abs(before), SURER * min(g.error for g in was)):
            out.append(
                f"the expansion of {part[1]} would have been {significant(then, 2)} µm/(m·K) on the day of the fit, "
                f"which showed {significant(before, 2)}"
            )
        out += [
            f"the expansion of {part[1]} by {one.sensor} would grow from {significant(one.k, 2)} to "
            f"{significant(other.k, 2)} µm/(m·K), and another expansion would take it back"
            for one, other in zip(was, now, strict=False)
            if abs(other.k) - abs(one.k) > max(SHARED * abs(one.k), SURER * one.error) and one.sensor not in new
        ]
    return tuple(out)


class _Growth(NamedTuple):
    """An expansion: its sensor, its number in µm/(m·K), and the standard error; zero where that is unknown."""

    sensor: str
    k: float
    error: float


def _expansions(model: Model) -> dict[tuple[str, str], list[_Growth]]:
    """Expansions of a model that have no kink, by component and axis."""
    out: dict[tuple[str, str], list[_Growth]] = {}
    for f in model.effects:
        if isinstance(f.effect, AxisExpansion) and not f.effect.stretched:
            growth = _Growth(f.effect.sensor, f.values["k"], f.errors.get("k", 0.0))
            out.setdefault((f.effect.component, f.effect.axis), []).append(growth)
    return out

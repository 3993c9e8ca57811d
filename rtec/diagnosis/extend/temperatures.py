"""Further temperatures of an effect that the model has, and the fixed end of an expansion.

A body without a sensor is between bodies that have one: it follows several temperatures, each with its own delay. The
effect is already known, so a further temperature proves no cause: it must make the readings likelier and predict
held-out runs better. Effects along an axis get one, and those of the spindle, where heat also follows its speed. Other
shifts that are equal at all positions cannot be distinguished from a drift of the instrument: two temperatures fit any
slow drift. One by the temperature of an expansion is another: it says where the fixed end is, which is named at three
places of the travel only.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from rtec.arrays import Floats
from rtec.diagnosis.extend.add import is_there, new_effect
from rtec.effects import Effect
from rtec.effects.base import AxisEffect, Surroundings
from rtec.effects.spindle import SpindleGrowth
from rtec.effects.thermal import AxisExpansion, MountExpansion
from rtec.estimation.candidates import surroundings, visible
from rtec.estimation.gls import fit_columns, held_out
from rtec.estimation.judge import Judgement
from rtec.estimation.noise import Whitener, without_drift
from rtec.estimation.plain import weights
from rtec.estimation.readings import Readings, looked_at
from rtec.estimation.visible import within_record
from rtec.estimation.warmth import off_the_fit
from rtec.model import FittedEffect, Model

LIKELIER = 50.0
"""How many times likelier the readings must become, for each temperature, or for each fixed end, that is tried."""

ALIKE = 3.0
"""Gains in log likelihood within such a step are equally good: then the error on held-out runs decides."""

VARIED_DEGC, TRIMMED = 1.0, (0.01, 0.99)
"""Change of a temperature, between these quantiles, below which it is no further one: on another day it may differ by
many times as much, and its number is known from this change only."""


def further_temperatures(judged: Judgement) -> Iterator[FittedEffect]:
    """Temperatures, by other sensors or with other delays, that make the readings much likelier, the likeliest first.

    Of those that are about as likely, the one that predicts held-out runs best comes first. Each sensor comes once with
    and once without a delay: with the delay that best predicts held-out runs.

    Args:
        judged: the model, on its readings.

    Yields:
        A further copy of an effect of the model, to be added; it must predict held-out runs better, too.
    """
    keep = looked_at(judged.readings)
    few = judged.readings.without(~keep)
    base, noise = judged.base.columns[keep], replace(judged.noise, readings=few)
    by = weights(few, noise, judged.left[keep])
    best: dict[Effect, tuple[float, Mapping[str, float], Floats]] = {}
    for effect, theta in _offered(judged.model, few):
        columns = few.columns(effect, theta)
        squares = float(held_out(by, np.concatenate([base, columns], axis=1)).folds.sum())
        if effect not in best or squares < best[effect][0]:
            best[effect] = squares, theta, columns
    gains: dict[Effect, float] = {}
    ends = sum(isinstance(e, MountExpansion) for e in best)

    def enough(effect: Effect) -> float:
        return math.log(LIKELIER * max(ends if isinstance(effect, MountExpansion) else len(best) - ends, 1))

    for effect, (_, theta, columns) in best.items():
        # A temperature that hardly changed, far from the reference, would act like a shape that follows no temperature.
        sensor = getattr(effect, "sensor", None)
        still = few.at_constant(_grows(effect, judged.model), theta, sensor) if sensor is not None else base[:, :0]
        if _likelier(noise, base, still) < enough(effect):  # else that shape is missing, and would be named first
            gains[effect] = _likelier(noise, np.concatenate([base, still], axis=1), columns)
    most = max(gains.values(), default=0.0)
    for effect in sorted(gains, key=lambda e: ((most - gains[e]) // ALIKE, best[e][0])):
        if gains[effect] >= enough(effect):
            yield new_effect(effect, judged.model, best[effect][1])


def fixed_end(model: Model) -> str | None:
    """Where a shift by the same temperature puts the fixed end of an expansion, in words; None unless the last effect
    is one of these two.
    """
    for shift in (f for f in model.effects if isinstance(f.effect, MountExpansion)):
        grows = _grows(shift.effect, model)
        f = next(f for f in model.effects if f.effect == grows)
        if isinstance(grows, AxisExpansion) and model.effects[-1] in (shift, f):
            end_mm = grows.fixed_mm - 1000.0 * shift.values["k"] / f.values["k"]
            return f"with it the fixed end of {f.label} is at {end_mm:.0f} mm instead of {grows.fixed_mm:.0f} mm"
    return None


def _grows(effect: Effect, model: Model) -> Effect:
    """The expansion of the model whose fixed end a shift by its temperature moves; any other effect itself."""
    if not isinstance(effect, MountExpansion):
        return effect
    along = [f.effect for f in model.effects if isinstance(f.effect, AxisExpansion) and not f.effect.stretched]
    mine = (effect.component, effect.sensor, effect.lag)
    return next((e for e in along if (e.component, e.sensor, e.lag) == mine), effect)


def hardly_varied(model: Model, effect: Effect, readings: Readings) -> bool:
    """Whether an effect that the model has by other sensors follows one that varied by less than `VARIED_DEGC`.

    One that is far from all that it was in the model's fit has varied since.
    """
    sensor = getattr(effect, "sensor", None)
    same = [f.effect for f in model.effects if f.effect.effect == effect.effect]
    others = {getattr(e, "sensor", None) for e in same if e.component == effect.component}
    return (
        sensor is not None
        and bool(others)
        and sensor not in others
        and not (_varied(readings, sensor) or sensor in off_the_fit(model, readings))
    )


def _varied(readings: Readings, sensor: str) -> bool:
    return float(np.ptp(np.nanquantile(readings.channel(sensor), TRIMMED))) >= VARIED_DEGC


def _offered(model: Model, readings: Readings) -> Iterator[tuple[Effect, Mapping[str, float]]]:
    """Effects of heat along an axis and of the spindle, from every source and with every delay that the model lacks."""
    seen = {c.name: c for c in visible(readings)}
    offered: list[Effect] = []
    for fitted in model.effects:
        if fitted.effect.component not in seen:
            continue
        for other in _others(fitted.effect, surroundings(readings, seen[fitted.effect.component])):
            sensor = getattr(other, "sensor", None)
            if other in offered or (sensor is not None and not _varied(readings, sensor)):
                continue
            offered.append(other)
            for theta in _values(FittedEffect(other, {}, fitted.theta), readings):
                if not is_there(model, FittedEffect(other, {}, theta)):
                    yield other, theta


def _others(effect: Effect, around: Surroundings) -> Iterator[Effect]:
    """The same effect from each source of heat, immediate and delayed."""
    if isinstance(effect, SpindleGrowth):
        yield from effect.suggest(around)
    elif isinstance(effect, AxisEffect) and getattr(effect, "sensor", None) is not None:
        if isinstance(effect, AxisExpansion):
            effect = effect.model_copy(update={"stretched": False})
            yield MountExpansion(component=effect.component, sensor=effect.sensor, lag=effect.lag)
        for sensor in around.sensors:
            for late in _delays(effect):
                yield effect.model_copy(update={"sensor": sensor, **late})


def _delays(effect: Effect) -> Sequence[Mapping[str, bool]]:
    """Immediate and delayed, where an effect may be either."""
    kind = type(effect).model_fields.get("lag")
    return ({"lag": False}, {"lag": True}) if kind is not None and kind.annotation is bool else ({},)


def _values(fitted: FittedEffect, readings: Readings) -> Sequence[Mapping[str, float]]:
    """Grid of delays; other parameters stay as in the model, or at their start."""
    free = within_record(fitted.effect, readings.measurements)
    start = {p.name: float(fitted.theta.get(p.name, p.start)) for p in free}
    grids = [(p.name, v) for p in free for v in p.grid if p.unit == "s"]
    return [{**start, name: v} for name, v in grids] or [start]


def _likelier(by: Whitener, base: Floats, columns: Floats) -> float:
    """Gain in log likelihood by columns, (m, k), beside a base, (m, p)."""
    without, with_it = (
        max(fit_columns(w, c).log_likelihood for w in (by, without_drift(by)))
        for c in (base, np.concatenate([base, columns], axis=1))
    )
    return with_it - without

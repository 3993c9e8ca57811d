"""Further temperatures of an effect that the model has.

A body without a sensor is between bodies that have one: it follows several temperatures, each with its own delay. The
effect is already known, so a further temperature proves no cause: it must make the readings likelier and predict
held-out runs better. Only effects along an axis get one. A shift that is equal at all positions cannot be
distinguished from a drift of the instrument, and two temperatures fit any slow drift.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis.extend.add import is_there, new_effect
from rtec.effects import Effect
from rtec.effects.base import AxisEffect
from rtec.estimation.candidates import surroundings, visible
from rtec.estimation.gls import fit_columns, held_out
from rtec.estimation.judge import Judgement
from rtec.estimation.noise import Whitener, without_drift
from rtec.estimation.plain import weights
from rtec.estimation.readings import Readings, looked_at
from rtec.estimation.visible import within_record
from rtec.model import FittedEffect, Model

Floats = NDArray[np.float64]

LIKELIER = math.log(50.0)
"""Least gain in log likelihood. The best of some fifty further temperatures gained at most 3.3 in 24 records that
depend on only one temperature."""

VARIED_DEGC, TRIMMED = 1.0, (0.01, 0.99)
"""Change of a temperature, between these quantiles, below which it is no further one: on another day it may differ by
many times as much, and its number is known from this change only."""


def further_temperature(judged: Judgement) -> FittedEffect | None:
    """The temperature, by another sensor or with another delay, that best predicts held-out runs beside the model's.

    Args:
        judged: the model, on its readings.

    Returns:
        A further copy of the effect, to be added; None where the model has no effect of a temperature along an axis, or
        where a further one does not make the readings much likelier.
    """
    keep = looked_at(judged.readings)
    few = judged.readings.without(~keep)
    offered = list(_offered(judged.model, few))
    if not offered:
        return None
    base, noise = judged.base.columns[keep], replace(judged.noise, readings=few)
    by = weights(few, noise, judged.left[keep])
    columns = [few.columns(effect, theta) for effect, theta in offered]
    squares = [held_out(by, np.concatenate([base, c], axis=1)).folds.sum() for c in columns]
    best = int(np.argmin(squares))
    effect, theta = offered[best]
    # A temperature that hardly changed, far from the reference, would act like a shape that follows no temperature.
    base = np.concatenate([base, few.at_constant(effect, theta, str(getattr(effect, "sensor", "")))], axis=1)
    if _likelier(noise, base, columns[best]) < LIKELIER:
        return None
    return new_effect(effect, judged.model, theta)


def hardly_varied(model: Model, effect: Effect, readings: Readings) -> bool:
    """Whether an effect that the model has by other sensors follows one that varied by less than `VARIED_DEGC`."""
    sensor = getattr(effect, "sensor", None)
    same = [f.effect for f in model.effects if f.effect.effect == effect.effect]
    others = {getattr(e, "sensor", None) for e in same if e.component == effect.component}
    return sensor is not None and bool(others) and sensor not in others and not _varied(readings, sensor)


def _varied(readings: Readings, sensor: str) -> bool:
    return float(np.ptp(np.nanquantile(readings.channel(sensor), TRIMMED))) >= VARIED_DEGC


def _offered(model: Model, readings: Readings) -> Iterator[tuple[Effect, Mapping[str, float]]]:
    """Effects of a temperature along an axis, by every sensor and with every delay that the model lacks."""
    seen = {c.name: c for c in visible(readings)}
    offered: list[Effect] = []
    for fitted in model.effects:
        effect = fitted.effect
        along = isinstance(effect, AxisEffect) and getattr(effect, "sensor", None) is not None
        if not along or effect.component not in seen:
            continue
        for sensor in surroundings(readings, seen[effect.component]).sensors:
            if not _varied(readings, sensor):
                continue
            for late in _delays(effect):
                other = effect.model_copy(update={"sensor": sensor, **late})
                if other in offered:
                    continue
                offered.append(other)
                for theta in _values(other, readings):
                    if not is_there(model, FittedEffect(other, {}, theta)):
                        yield other, theta


def _delays(effect: Effect) -> Sequence[Mapping[str, bool]]:
    """Immediate and delayed, where an effect may be either."""
    kind = type(effect).model_fields.get("lag")
    return ({"lag": False}, {"lag": True}) if kind is not None and kind.annotation is bool else ({},)


def _values(effect: Effect, readings: Readings) -> Sequence[Mapping[str, float]]:
    """Grid of delays; other parameters stay at their start."""
    free = within_record(effect, readings.measurements)
    start = {p.name: p.start for p in free}
    grids = [(p.name, v) for p in free for v in p.grid if p.unit == "s"]
    return [{**start, name: v} for name, v in grids] or [start]


def _likelier(by: Whitener, base: Floats, columns: Floats) -> float:
    """Gain in log likelihood by columns, (m, k), beside a base, (m, p)."""
    without, with_it = (
        max(fit_columns(w, c).log_likelihood for w in (by, without_drift(by)))
        for c in (base, np.concatenate([base, columns], axis=1))
    )
    return with_it - without

"""What no machine can have recorded: asked about before anything is made of the readings."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from rtec.diagnosis.doubts.doubt import Doubt
from rtec.estimation import floor
from rtec.estimation.candidates import REAL
from rtec.estimation.changed_delay import AS_GOOD
from rtec.estimation.columns import base_of
from rtec.estimation.judge import Judgement
from rtec.estimation.warmth import of_the_fit
from rtec.machine import Axis
from rtec.metrology.contradicted import contradicted
from rtec.metrology.measurement import Measurement
from rtec.metrology.travel import BEYOND, outside_travel, travel_words
from rtec.wording import ERROR_UNITS, significant, sizes

FEWEST = 10
"""Moves, with fewer of which the clock is not asked about."""
FASTEST_MM_S, TOO_FAST = 5000.0, 0.1
"""No machine tool moves faster; share of the moves that are faster, where the clock is asked about."""
FAR_K, NEAR_K = 20.0, 10.0
"""Temperatures are far from those of a fit beyond the first, and near them within the second."""


def implausible(judged: Judgement) -> list[Doubt]:
    """Doubts about directions, the clock, temperatures and positions, fatal ones first."""
    found = []
    for m in judged.readings.measurements:
        for a in m.machine.axes:
            if a.channel in m.channels:
                found += [_direction(judged, m, a), _too_fast(m, a), _outside(judged, m, a)]
        found.append(_temperatures(judged, m))
    return sorted((d for d in found if d is not None), key=lambda d: not d.fatal)


def _direction(judged: Judgement, m: Measurement, axis: Axis) -> Doubt | None:
    """A direction with the wrong sign: the position rises where the direction is -1, and falls where it is +1."""
    ways = m.channels.get(axis.direction_channel)
    found = None if ways is None else contradicted(m.run, m.channels[axis.channel], ways)
    if found is None:
        return None
    now, other = judged.residual, _other_way(judged, m, axis)
    if other > AS_GOOD * now:
        return None  # the model knows these directions: the targets were approached from beyond
    here, there = sizes(other, now)
    name = f"dir_{axis.channel}"
    fits = f"; with the other sign the model leaves {here} instead of {there} {ERROR_UNITS[judged.unit]}"
    message = (
        f"{name} of {m.name} contradicts the order of the positions in {found[0]} of {found[1]} moves: {axis.channel} "
        f"rises where it is -1 and falls where it is +1{fits if AS_GOOD * other < now else ''}."
    )
    step = (
        f"Check the sign of {name} and of {axis.channel}_mm; without {name} the directions follow from the positions."
    )
    return Doubt("wrong_direction", message, step, fatal=True)


def _other_way(judged: Judgement, m: Measurement, axis: Axis) -> float:
    """Residual of the model if the directions of an axis in a file had the other sign."""
    readings, name = judged.readings, axis.direction_channel
    states = [
        replace(s, channels={**s.channels, name: -s.channels[name]}, _cache={}) if one is m else s
        for one, s in zip(readings.measurements, readings.states, strict=True)
    ]
    predicted = base_of(judged.model, readings.with_states(states)).predicted
    return judged.pooled(floor.cleaned(readings, readings.values - predicted))


def _too_fast(m: Measurement, axis: Axis) -> Doubt | None:
    """A clock by which an axis would have moved between readings as no machine does."""
    way, took = np.abs(np.diff(m.channels[axis.channel])), np.diff(m.time_s)
    moved = (way > REAL["mm"]) & (took > 0.0)
    if moved.sum() < FEWEST:
        return None
    speed = way[moved] / took[moved]
    if float(np.mean(speed > FASTEST_MM_S)) < TOO_FAST:
        return None
    usual = significant(float(np.median(speed[speed > FASTEST_MM_S])) / 1000.0, 2)
    message = (
        f"time_s of {m.name}: {axis.name} would have moved at {usual} m/s between readings, which no machine does."
    )
    return Doubt("wrong_rate", message, "Check the unit of time_s: is it in minutes or hours?", fatal=True)


def _outside(judged: Judgement, m: Measurement, axis: Axis) -> Doubt | None:
    """Positions outside the travel; where the fit did not have them either, they precede every answer."""
    at_mm = outside_travel(m, axis)
    if at_mm is None:
        return None
    fitted, (low, high) = judged.model.valid_range.get(axis.channel), axis.travel_mm
    beyond = BEYOND * (high - low)
    new = fitted is not None and (at_mm[0] < min(low, fitted[0]) - beyond or at_mm[1] > max(high, fitted[1]) + beyond)
    text, check = travel_words(m, axis, at_mm)
    return Doubt("outside_travel", f"{text}.", f"{check[0].upper()}{check[1:]}.", fatal=new)


def _temperatures(judged: Judgement, m: Measurement) -> Doubt | None:
    """A doubt where every temperature of a file is far from those of the model's fit: another unit."""
    known = _known_degc(judged)
    now = {n: (float(np.nanmin(m.channels[n])), float(np.nanmax(m.channels[n]))) for n in known if n in m.channels}
    if not now or not all(_apart(now[n], known[n]) > FAR_K for n in now):
        return None
    celsius = {n: ((low - 32.0) / 1.8, (high - 32.0) / 1.8) for n, (low, high) in now.items()}
    fahrenheit = all(_apart(celsius[n], known[n]) < NEAR_K for n in now)
    if not fahrenheit and len(now) == 1:
        return None
    (low, high), (least, most) = _span(now), _span({n: known[n] for n in now})
    named = " and ".join(now) if len(now) <= 2 else f"all {len(now)} known temperatures"
    message = (
        f"At the model's fit {named} went from {significant(least)} to {significant(most)} °C, in {m.name} from "
        f"{significant(low)} to {significant(high)} °C."
    )
    step = "They look like °F: convert them by (T - 32) / 1.8." if fahrenheit else "Check their unit."
    return Doubt("far_temperatures", message, step, fatal=True)


def _known_degc(judged: Judgement) -> Mapping[str, tuple[float, float]]:
    """Lowest and highest temperature of each sensor at the model's fit, °C, as far as they are known."""
    model = judged.model
    ranges = {n: v for n, v in model.valid_range.items() if n in model.machine.sensor_names}
    return {**ranges, **of_the_fit(model)}


def _apart(one: tuple[float, float], other: tuple[float, float]) -> float:
    """Distance of two ranges, zero where they overlap."""
    return max(one[0] - other[1], other[0] - one[1], 0.0)


def _span(ranges: Mapping[str, tuple[float, float]]) -> tuple[float, float]:
    return min(low for low, _ in ranges.values()), max(high for _, high in ranges.values())

"""Effects of the speed where these readings cannot separate it from the place: circles of one feed and radius.

On such a circle the speed of an axis is a function of its position. Any error of the place is then one of the speed,
too, and at another feed the two predict different errors. A servo lag is not meant here: it changes its sign with the
sense of rotation, which no error of the place does.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from rtec.diagnosis.result import Alike
from rtec.diagnosis.search.refit import Refitted
from rtec.effects import Effect
from rtec.effects.motion import ServoLag
from rtec.estimation.readings import Readings
from rtec.machine import Axis

PLACES = 40
"""Stretches of an axis in which its speed is compared."""
OF_PLACE = 0.02
"""The speed is a function of the place where it varies within the stretches by less than this share of its variance."""
VARIES = 0.05
"""A speed that varies by less than this share of its largest value is one speed."""
TEST = "the same circle at another feed"


def by_speed(effect: Effect) -> bool:
    """Whether an effect depends on the speed alike in both senses."""
    return "velocity" in effect.driven_by and not isinstance(effect, ServoLag)


def speed_of_place(readings: Readings, axis: Axis) -> bool:
    """Whether the speed of an axis is a function of its position in all these readings, and varies."""
    place, speed = readings.channel(axis.channel), np.abs(readings.channel(axis.velocity_channel))
    if not np.isfinite(speed).all() or np.ptp(speed) <= VARIES * speed.max():
        return False
    order = np.argsort(place, kind="stable")
    within = sum(float(np.sum((part - part.mean()) ** 2)) for part in np.array_split(speed[order], PLACES) if len(part))
    return within < OF_PLACE * float(np.sum((speed - speed.mean()) ** 2))


def not_separated(effect: Effect, readings: Readings) -> Axis | None:
    """The axis whose speed an effect follows and whose speed is a function of its place here; None for all others."""
    if not by_speed(effect):
        return None
    axis = next((a for a in readings.machine.axes if a.name == getattr(effect, "axis", None)), None)
    return axis if axis is not None and speed_of_place(readings, axis) else None


def of_places(effect: Effect, readings: Readings) -> bool:
    """Whether an effect depends on positions and directions only."""
    machine = readings.machine
    read = set(effect.channels(machine))
    return bool(read) and read <= {
        c for a in machine.axes for c in (a.channel, a.direction_channel, a.since_reversal_channel)
    }


def place_first(
    refitted: Sequence[Refitted],
    effect_of: Callable[[Refitted], Effect],
    readings: Readings,
    bar: float,
    as_good: float,
) -> list[Refitted]:
    """The same; an effect of the speed no likelier than one of the place that predicts held-out runs as well.

    How well the one curve of the speed fits is no evidence of a speed.

    Args:
        refitted: the best first.
        effect_of: the effect of each.
        readings: the readings.
        bar: evidence from which a candidate is significant.
        as_good: held-out mean squares within this factor are equally good.
    """
    if not refitted or not_separated(effect_of(refitted[0]), readings) is None:
        return list(refitted)
    first = refitted[0]
    places = [
        t
        for t in refitted[1:]
        if t.holds and t.log_evidence > bar and 1.0 - t.drop <= as_good * (1.0 - first.drop)
        and of_places(effect_of(t), readings)
    ]  # fmt: skip
    lead = max(places, key=lambda t: t.log_evidence, default=None)
    if lead is None:
        return list(refitted)
    same = [
        replace(t, log_evidence=min(t.log_evidence, lead.log_evidence)) if by_speed(effect_of(t)) else t
        for t in refitted
        if t is not lead
    ]
    return [lead, *same]


def as_place(effect: Effect, readings: Readings) -> Alike | None:
    """An error of the place, with or without a name, that an effect of the speed may be; None where it cannot be."""
    axis = not_separated(effect, readings)
    if axis is None:
        return None
    why = (
        f"at one feed and radius the speed of {axis.name} is a function of its place: any error of {axis.name} looks so"
    )
    return Alike("polynomial_position", effect.component, why, TEST, label=f"an error along {axis.name}")

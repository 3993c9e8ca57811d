"""Targets at equal steps show a wave of a period and of its aliases alike."""

from collections.abc import Mapping

import numpy as np

from rtec.diagnosis.result import Alike
from rtec.effects import Effect
from rtec.estimation.readings import Readings

PERIODS = ("pitch", "period")
EVEN = 1e-3
"""Steps that differ by less than this share of themselves are equal."""
LEAST_TARGETS = 5
PER_WAVE = 2.0
"""Steps in a period from which on it is not folded."""
ORDERS = (1, 2)
"""Multiples of the steps' own frequency whose aliases are told."""
RESOLVED_MM = 1e-3


def period_mm(effect: Effect, theta: Mapping[str, float]) -> float | None:
    """The period of a wave along an axis; None for anything else, and for what may be more than a wave."""
    if getattr(effect, "axis", None) is None:
        return None
    return next((theta[name] for name in PERIODS if name in theta), getattr(effect, "lambda_mm", None))


def step_mm(readings: Readings, channel: str, component: str) -> float | None:
    """The step between targets along an axis where all are equal; None where they are not, or are few.

    Args:
        readings: the readings.
        channel: position channel of the axis.
        component: whose readings count.
    """
    seen = readings.arms(component) != 0.0
    places = np.unique(np.round(readings.channel(channel)[seen] / RESOLVED_MM) * RESOLVED_MM)
    if len(places) < LEAST_TARGETS:
        return None
    steps = np.diff(places)
    step = float(np.median(steps))
    return step if float(np.ptp(steps)) <= max(EVEN * step, 2.0 * RESOLVED_MM) else None


def aliases_mm(period_mm: float, step: float) -> tuple[float, ...]:
    """Periods that look like this one at targets so far apart, the longest first."""
    own, comb = 1.0 / period_mm, 1.0 / step
    found = {abs(order * comb + sign * own) for order in (0, *ORDERS) for sign in (-1.0, 1.0)}
    others = sorted(f for f in found if f > 1e-9 and abs(f - own) > 1e-6 * own)
    return tuple(1.0 / f for f in others)


def fold(readings: Readings, effect: Effect, theta: Mapping[str, float]) -> Alike | None:
    """A wave of another period that these targets cannot tell from that of an effect; None where they can.

    Args:
        readings: the readings.
        effect: a wave along its axis, or anything else.
        theta: its period.
    """
    period, axis = period_mm(effect, theta), getattr(effect, "axis", None)
    if period is None or axis is None or not theta:
        return None
    channel = next(a.channel for a in readings.machine.axes if a.name == axis)
    step = step_mm(readings, channel, effect.component)
    if step is None or period >= PER_WAVE * step:
        return None
    others = ", ".join(f"{p:.4g}" for p in aliases_mm(period, step)[:3])
    why = (
        f"targets stand every {step:.4g} mm, and there a wave of {period:.4g} mm looks like one of {others} mm: "
        "the name rests on the period that the machine file gives"
    )
    test = f"unequal steps along {axis}, or steps below {period / PER_WAVE:.3g} mm"
    return Alike("cyclic_pole", effect.component, why, test, label=f"a wave of another period ({effect.component})")

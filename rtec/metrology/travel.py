"""Positions outside the travel of their axis: another unit, another origin, or diameters of a lathe."""

import numpy as np

from rtec.machine import Axis
from rtec.metrology.measurement import Measurement

BEYOND = 0.05
"""Share of the travel by which a position may exceed it."""
RADIAL = "X"
"""The axis of a lathe whose positions may be diameters (ISO 841)."""


def outside_travel(m: Measurement, axis: Axis) -> tuple[float, float] | None:
    """Lowest and highest position of an axis in mm, where these are outside its travel; else None."""
    if axis.channel not in m.channels:
        return None
    (low, high), places = axis.travel_mm, m.channels[axis.channel]
    first, last, beyond = float(np.nanmin(places)), float(np.nanmax(places)), BEYOND * (high - low)
    return None if first >= low - beyond and last <= high + beyond else (first, last)


def travel_words(m: Measurement, axis: Axis, at_mm: tuple[float, float]) -> tuple[str, str]:
    """What is outside, as a clause, and what to check."""
    (low, high), (first, last) = axis.travel_mm, at_mm
    text = f"{axis.name} of {m.name} was at {first:g} to {last:g} mm, outside its travel of {low:g} to {high:g} mm"
    check = f"check the unit and the origin of {axis.channel}_mm, or travel_mm in the machine file"
    if m.machine.turns_work and axis.name == RADIAL and half_fits(axis, at_mm):
        check = f"{axis.channel}_mm looks like a diameter: import it with --answer diameter=position; else {check}"
    return text, check


def half_fits(axis: Axis, at_mm: tuple[float, float]) -> bool:
    """Whether half of some positions is within the travel, and the positions are not."""
    low, high = axis.travel_mm
    return max(at_mm) > high and low <= 0.5 * min(at_mm) and 0.5 * max(at_mm) <= high

"""Motions of the tool that an effect brings along where no reading shows them.

An angle has an arm in two directions. A laser sees one of them. That the tool moves in the other one, too, follows from
the place of the pivot, which the machine file states and no reading confirms. A correction would move that axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtec.arrays import Floats
from rtec.estimation.readings import Readings
from rtec.model import FittedEffect
from rtec.wording import significant

DIRECTIONS = "XYZ"
ALONG = 0.3
"""An instrument reads a direction if its line has at least this cosine with it; the diagonal of a cube has 0.58."""
COUNTS = 0.25
"""A motion counts from this share of the largest one that the readings show."""
SHOWN = 0.5
"""Readings show a motion if it varies among them by this share of what it varies by at all of their places."""


@dataclass(frozen=True)
class UnmeasuredMotion:
    """A motion of the tool that an effect brings along and that no reading shows.

    Attributes:
        label: of the effect.
        direction: "X", "Y" or "Z"; an axis corrects it.
        um: range of the motion at the places of the readings, µm.
    """

    label: str
    direction: str
    um: float

    @property
    def words(self) -> str:
        """What the effect does there."""
        size = significant(self.um, 2)
        return f"{self.label} also moves the tool along {self.direction}, by up to {size} µm, and no reading shows that"

    @property
    def advice(self) -> str:
        """What to do about it."""
        return f"measure along {self.direction} at the same places before you let {self.direction} be corrected"


def unmeasured_motions(
    effects: Sequence[FittedEffect], readings: Readings, first: int = 0
) -> tuple[UnmeasuredMotion, ...]:
    """Motions that effects bring along where no reading shows them; an angle that is read as one is left out.

    Args:
        effects: all effects of a model.
        readings: what they were fitted to.
        first: number of the first effect that is looked at.
    """
    return tuple(motion for fitted in effects[first:] for motion in _of(fitted, readings))


def _of(fitted: FittedEffect, readings: Readings) -> list[UnmeasuredMotion]:
    component, machine = fitted.effect.component, readings.machine
    arms = readings.arms(component)
    if any(s.unit == "urad" and arms[s.part].any() for s in readings.series):
        return []
    parts = [_motion(fitted, readings, source) for source in range(len(readings.states))]
    whole = np.max([np.ptp(part, axis=0) for part in parts], axis=0)
    shown = np.zeros(3)
    for s in readings.series:
        seen = np.array([_sees(readings, s.part, d) for d in DIRECTIONS])
        shown = np.maximum(shown, np.where(seen, np.ptp(parts[s.source][s.row], axis=0), 0.0))
    corrected = {a.direction for a in machine.axes if a.compensate}
    return [
        UnmeasuredMotion(fitted.label, d, float(w))
        for d, w, s in zip(DIRECTIONS, whole, shown, strict=True)
        if d in corrected and w > COUNTS * shown.max() and s < SHOWN * w
    ]


def _motion(fitted: FittedEffect, readings: Readings, source: int) -> Floats:
    """Tool-tip error of an effect at every instant of a measurement, µm, (n, 3); zero where a channel is missing."""
    machine, state = readings.machine, readings.states[source]
    if not all(map(state.has, fitted.effect.channels(machine))):
        return np.zeros((len(state), 3))
    basis = fitted.effect.basis(machine, state, fitted.theta)
    values = [fitted.values[p.name] for p in fitted.effect.coefficients(machine)]
    size = sum((v * b for v, b in zip(values, basis, strict=True)), np.zeros(len(state)))
    column = machine.components.index(fitted.effect.component)
    return np.asarray(machine.chain.jacobian(readings.poses_mm[source])[:, :, column] * size[:, None])


def _sees(readings: Readings, part: slice, direction: str) -> bool:
    """Whether a series reads a direction: a shift of any axis along it changes the reading."""
    shifts = [c for c in readings.machine.components if c.startswith(f"E{direction}")]
    return any(float(np.abs(readings.arms(c)[part]).max()) > ALONG for c in shifts)

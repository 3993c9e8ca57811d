"""Three coordinates of the tool tip: laser tracker, probing of known points, a probe nest at the workpiece."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field, field_validator

from rtec.effects import State
from rtec.machine import Machine
from rtec.metrology.instruments.affine import ORIGIN, AffineInstrument, Letter, Scope, point, zero
from rtec.metrology.instruments.base import Floats, InstrumentSetup, Ints, Nuisance
from rtec.quantities import Vector


class ToolTipSetup(InstrumentSetup):
    """`[setup]` of tool-tip readings.

    Attributes:
        offset_mm: vector from the tool tip to the target (reflector, stylus ball).
        directions: coordinates that are read.
        zero: zero of each coordinate; once, or in every run.
        alignment: whether the fit estimates three small rotations of the instrument's frame relative to the machine's.
            A squareness that equals a rotation is then not determined.
    """

    offset_mm: Vector = ORIGIN
    directions: Annotated[tuple[Letter, ...], Field(min_length=1)] = ("X", "Y", "Z")
    zero: Scope = "setup"
    alignment: Scope = "none"

    @field_validator("directions")
    @classmethod
    def _distinct(cls, value: tuple[Letter, ...]) -> tuple[Letter, ...]:
        if len(set(value)) < len(value):
            raise ValueError("a direction is given twice")
        return value


@dataclass(frozen=True)
class ToolTip(AffineInstrument):
    """Displacement of the tool tip relative to the workpiece, µm, by coordinate."""

    name = "tool_tip"
    title = "Tool tip: tracker, probing points"
    setup_model = ToolTipSetup
    axis_use = "none"
    setup: ToolTipSetup

    def columns(self) -> tuple[str, ...]:
        """One reading a coordinate."""
        return tuple(f"reading_{d.lower()}_um" for d in self.setup.directions)

    def looks(self, machine: Machine) -> Floats:
        """The target's coordinates that are read."""
        return np.stack([point(machine, d, self.setup.offset_mm) for d in self.setup.directions])

    def nuisance(self, state: State, run: Ints) -> tuple[Nuisance, ...]:
        """Zero of each coordinate; rotations of the frame with `alignment`."""
        del run
        names = tuple(f"zero {d}" for d in self.setup.directions)
        out = list(zero(len(state), len(names), self.setup.zero, "um", names))
        if self.setup.alignment != "none":
            rows = ["XYZ".index(d) for d in self.setup.directions]
            arm_m = (self._target_mm(state) - self._target_mm(state).mean(axis=0)) * 1e-3
            for letter, unit in zip("ABC", np.eye(3), strict=True):
                values = np.cross(unit, arm_m).T[rows]
                if values.any():
                    out.append(Nuisance(f"alignment {letter}", "urad", values, self.setup.alignment))
        return tuple(out)

    def _target_mm(self, state: State) -> Floats:
        """Nominal position of the target relative to the workpiece, mm, (n, 3)."""
        machine = state.machine
        out = np.zeros((len(state), 3))
        for i, axis in enumerate(machine.axes):
            out[:, "XYZ".index(axis.direction)] += state.positions_mm()[:, i]
        return out

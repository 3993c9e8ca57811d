"""Three coordinates of the tool tip: laser tracker, probing of known points, a nest of probes, or a work piece.

Of a work piece measured after cutting, each row is a feature and the pose at which its last pass was cut.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator

from rtec.arrays import Floats, Ints
from rtec.effects import State
from rtec.machine import Machine
from rtec.metrology.instruments.base import (
    ORIGIN,
    AffineInstrument,
    InstrumentSetup,
    Letter,
    Nuisance,
    Scope,
    Sign,
    point,
    zero,
)
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


class WorkPieceSetup(InstrumentSetup):
    """`[setup]` of a work piece.

    Attributes:
        feature: "diameter" counts the error of the radius twice; "length" is from a datum on the same part.
        sign: +1: moving the tool in the axis' positive direction makes the feature larger; -1: smaller (a bore).
        zero: zero of the sizes. By default "setup" for diameters (the tool's own size), "run" for lengths (a run is a
            part, whose datum has an error of its own).
    """

    feature: Literal["diameter", "length"]
    sign: Sign = 1
    zero: Scope | None = None


@dataclass(frozen=True)
class WorkPiece(AffineInstrument):
    """Size of a feature minus its nominal size, µm; the axis is the one whose position determines the size."""

    name = "work_piece"
    title = "Work piece measured afterwards"
    at_rest = False
    in_order = False  # of features: each was cut in a direction of its own
    setup_model = WorkPieceSetup
    axis_use = "required"
    setup: WorkPieceSetup

    def columns(self) -> tuple[str, ...]:
        """One size."""
        return ("reading_um",)

    def looks(self, machine: Machine) -> Floats:
        """The tool tip along the axis, twice for a diameter."""
        factor = self.setup.sign * (2.0 if self.setup.feature == "diameter" else 1.0)
        return factor * point(machine, machine.axis(self.axis or "").direction)[None]

    def nuisance(self, state: State, run: Ints) -> tuple[Nuisance, ...]:
        """Zero."""
        del run
        usual: Scope = "setup" if self.setup.feature == "diameter" else "run"
        return zero(len(state), 1, self.setup.zero or usual, "um")

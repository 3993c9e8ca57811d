"""Grid encoder (2D digital scale, cross grid): two coordinates of the tool tip over a grid plate on the table [XT].

The plate is aligned to a machine plane only approximately: its offset in both directions and its rotation in the plane
are unknown. Both are nuisance parameters. Squareness is not affected: a rotation of the plate turns both axes alike.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

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
    point,
    zero,
)
from rtec.quantities import MicrometresNotNegative, Vector


class GridEncoderSetup(InstrumentSetup):
    """`[setup]` of a grid encoder.

    Attributes:
        plane: plane of the plate.
        origin_mm: machine coordinates of the plate's middle.
        offset_mm: vector from the tool tip to the reading point of the head.
        zero: zero of both readings; once, or in every run.
        alignment: rotation of the plate in its plane; once, or in every run.
        slope: whether the fit estimates the plate's own scale (its temperature); the machine's is then not determined.
        accuracy_um: the plate's own error, plus or minus, over its range; it is part of every stated uncertainty.
        plate: name or number of the plate. Between two set-ups with the same part of the same plate in the same
            orientation, its own error cancels. Empty: not known.
    """

    plane: Literal["XY", "YZ", "XZ"]
    origin_mm: Vector
    offset_mm: Vector = ORIGIN
    zero: Scope = "setup"
    alignment: Scope = "setup"
    slope: Scope = "none"
    accuracy_um: MicrometresNotNegative = 0.0
    plate: str = ""

    @property
    def letters(self) -> tuple[Letter, Letter]:
        """The two machine directions that are read."""
        letters: dict[str, tuple[Letter, Letter]] = {"XY": ("X", "Y"), "YZ": ("Y", "Z"), "XZ": ("X", "Z")}
        return letters[self.plane]

    @property
    def normal(self) -> str:
        """The third machine direction."""
        return next(d for d in "XYZ" if d not in self.plane)


@dataclass(frozen=True)
class GridEncoder(AffineInstrument):
    """Deviation of the tool tip from its commanded position, in the two directions of a plane, µm."""

    name = "grid_encoder"
    title = "Grid encoder, 2D digital scale"
    at_rest = False
    setup_model = GridEncoderSetup
    axis_use = "none"
    setup: GridEncoderSetup

    def columns(self) -> tuple[str, ...]:
        """One reading a direction of the plane."""
        return tuple(f"reading_{d.lower()}_um" for d in self.setup.letters)

    def looks(self, machine: Machine) -> Floats:
        """The head's point in both directions."""
        return np.stack([point(machine, d, self.setup.offset_mm) for d in self.setup.letters])

    def nuisance(self, state: State, run: Ints) -> tuple[Nuisance, ...]:
        """Zeros, and the plate's rotation: rotated by φ about the plane's normal it reads `-φ n × (p - origin)`."""
        del run
        names = tuple(f"zero {d}" for d in self.setup.letters)
        out = list(zero(len(state), 2, self.setup.zero, "um", names))
        if self.setup.alignment != "none":
            arm_m = (self._place_mm(state) - np.asarray(self.setup.origin_mm)) * 1e-3
            normal = np.eye(3)["XYZ".index(self.setup.normal)]
            rows = ["XYZ".index(d) for d in self.setup.letters]
            turned = -np.cross(normal, arm_m).T[rows]
            if turned.any():
                out.append(Nuisance("alignment", "urad", turned, self.setup.alignment))
        if self.setup.slope != "none":
            rows = ["XYZ".index(d) for d in self.setup.letters]
            longer = (self._place_mm(state) - np.asarray(self.setup.origin_mm)).T[rows] * 1e-3
            out.append(Nuisance("slope", "um_per_m", longer, self.setup.slope))
        return tuple(out)

    def faults(self, machine: Machine) -> list[str]:
        """A plane in which no axis moves."""
        moved = {a.direction for a in machine.axes}
        if moved.isdisjoint(self.setup.letters):
            return [f"[setup] plane {self.setup.plane!r}: no axis of machine {machine.name!r} moves in it"]
        return []

    def _place_mm(self, state: State) -> Floats:
        out = np.zeros((len(state), 3))
        for i, axis in enumerate(state.machine.axes):
            out[:, "XYZ".index(axis.direction)] += state.positions_mm()[:, i]
        return out

"""Electronic level: tilt against gravity."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.effects import State
from rtec.machine import Machine
from rtec.metrology.instruments.base import (
    AffineInstrument,
    InstrumentSetup,
    Letter,
    Nuisance,
    Scope,
    Sign,
    Turn,
    turn,
    zero,
)


class LevelSetup(InstrumentSetup):
    """`[setup]` of a level.

    Attributes:
        about: the rotation that it reads, A B C about X Y Z; needed unless a component is named.
        on: "both": a level at the tool minus a level at the workpiece, as ISO 230-1 requires; "tool" or "work": one
            level alone, which reads the links of its own side only.
        vertical: the machine's vertical direction; a level does not read a rotation about it.
        sign: -1 where the display counts against the right-hand rule.
        zero: unknown zero; once, or in every run.
    """

    about: Turn | None = None
    on: Literal["both", "tool", "work"] = "both"
    vertical: Letter = "Z"
    sign: Sign = 1
    zero: Scope = "setup"


@dataclass(frozen=True)
class Level(AffineInstrument):
    """Tilt, µrad, right-handed about the named direction; of the tool relative to the workpiece, or of one side."""

    name = "level"
    title = "Electronic level"
    setup_model = LevelSetup
    needs = ("about",)
    direct = "urad"
    setup: LevelSetup

    def columns(self) -> tuple[str, ...]:
        """One reading."""
        return ("reading_urad",)

    def affine(self, machine: Machine) -> Floats:
        """With the sign of the display, also for a component that is read directly."""
        return self.setup.sign * super().affine(machine)

    def looks(self, machine: Machine) -> Floats:
        """The rotation of the side that carries the level.

        A component of a work-side axis is defined as of the tool relative to the workpiece, so that a level on the
        table alone reads its negative.
        """
        out = turn(machine, self.setup.about or "A")
        if self.setup.on == "both":
            return out[None]
        chain = machine.tool_chain if self.setup.on == "tool" else machine.work_chain
        names = {f"E{k}{'' if link in machine.axis_names else '0'}{link}" for link in chain for k in "ABC"}
        here = np.array([c in names for c in machine.components])
        side = 1.0 if self.setup.on == "tool" else -1.0
        return np.asarray(out * here[:, None] * side)[None]

    def nuisance(self, state: State, run: Ints) -> tuple[Nuisance, ...]:
        """Zero."""
        del run
        return zero(len(state), 1, self.setup.zero, "urad")

    def faults(self, machine: Machine) -> list[str]:
        """No rotation named, or one about the vertical."""
        del machine
        if self.component is not None:
            return []
        if self.setup.about is None:
            return ["[setup] key 'about' is missing; it is the turn that is read: A, B or C"]
        if "ABC".index(self.setup.about) == "XYZ".index(self.setup.vertical):
            return [f"[setup] about {self.setup.about!r} is a turn about the vertical {self.setup.vertical}; no tilt"]
        return []

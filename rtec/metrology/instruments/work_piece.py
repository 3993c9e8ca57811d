"""A work piece measured after cutting: each row is a feature and the pose at which its last pass was cut."""

from dataclasses import dataclass
from typing import Literal

from rtec.effects import State
from rtec.machine import Machine
from rtec.metrology.instruments.affine import AffineInstrument, Scope, Sign, point, zero
from rtec.metrology.instruments.base import Floats, InstrumentSetup, Ints, Nuisance


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

"""Straightness: a probe (or laser straightness optics) that moves along an artefact.

The artefact (straightedge, arbor, prism) is on the workpiece side, the probe on the tool side; if they are exchanged,
the reading is the same. If the artefact is turned over between runs, its own form changes sign and the slide's does not
([G 3.1-3.3]), so that a fit separates them.
"""

from dataclasses import dataclass

from rtec.effects import State
from rtec.machine import Machine
from rtec.metrology.instruments.base import (
    ORIGIN,
    AffineInstrument,
    Degree,
    Floats,
    InstrumentSetup,
    Ints,
    Letter,
    Nuisance,
    Scope,
    Sign,
    flipped,
    from_middle_m,
    legendre,
    point,
    scaled,
    slope,
    zero,
)
from rtec.quantities import Vector, Whole


class StraightnessSetup(InstrumentSetup):
    """`[setup]` of a straightness measurement.

    Attributes:
        direction: direction of the reading, across the axis; needed unless a component is named.
        probe_offset_mm: vector from the tool tip to the probe's point of contact.
        sign: +1: reads positive as the tool moves in `direction` relative to the workpiece; -1: the other way.
        reversed_runs: runs with the artefact turned over. `sign` is the same in them: the readings of a probe that
            changes sides need the opposite sign first (import with sign = -1).
        artefact_degree: the fit estimates the artefact's form as a polynomial up to this degree; needs
            `reversed_runs`. Without it the artefact is taken as straight.
        zero: unknown zero; once, or in every run.
        slope: unknown direction of the artefact; once, or in every run.
    """

    direction: Letter | None = None
    probe_offset_mm: Vector = ORIGIN
    sign: Sign = 1
    reversed_runs: tuple[Whole, ...] = ()
    artefact_degree: Degree | None = None
    zero: Scope = "setup"
    slope: Scope = "setup"


@dataclass(frozen=True)
class StraightnessProbe(AffineInstrument):
    """Displacement across an axis, µm."""

    name = "straightness"
    title = "Straightness: probe on an artefact, or laser straightness optics"
    at_rest = False
    setup_model = StraightnessSetup
    needs = ("direction",)
    axis_use = "required"
    along = True
    direct = "um"
    setup: StraightnessSetup

    def columns(self) -> tuple[str, ...]:
        """One reading."""
        return ("reading_um",)

    def affine(self, machine: Machine) -> Floats:
        """With the probe's sign, also for a component that is read directly."""
        return self.setup.sign * super().affine(machine)

    def looks(self, machine: Machine) -> Floats:
        """The probe's point in its direction."""
        return point(machine, self.setup.direction or "X", self.setup.probe_offset_mm)[None]

    def nuisance(self, state: State, run: Ints) -> tuple[Nuisance, ...]:
        """Zero, slope, and the artefact's form where it was turned over."""
        out = list(zero(len(state), 1, self.setup.zero, "um"))
        if self.axis is None:
            return tuple(out)
        out += slope(from_middle_m(state.machine, state, self.axis), 1, self.setup.slope, "um_per_m")
        if self.setup.artefact_degree is not None:
            form = legendre(scaled(state.machine, state, self.axis), self.setup.artefact_degree)
            turned = flipped(run, self.setup.reversed_runs)
            for i, shape in enumerate(form):
                out += slope(shape * turned, 1, "setup", "um", f"artefact {i + 2}")
        return tuple(out)

    def faults(self, machine: Machine) -> list[str]:
        """No direction, one along the axis, or an artefact whose form is not separated from the slide's."""
        out = []
        if self.setup.artefact_degree is not None and not self.setup.reversed_runs:
            out.append(
                "[setup] artefact_degree needs reversed_runs (runs with the artefact turned over); without them "
                "nothing tells its form from the slide's"
            )
        if self.axis is None and self.component is not None:
            if self.setup.slope != "none" or self.setup.artefact_degree is not None:
                out.append("[measurement] key 'axis' is missing; slope and artefact_degree need it (or slope = 'none')")
            return out
        if self.component is not None or self.axis not in machine.axis_names:
            return out
        if self.setup.direction is None:
            out.append("[setup] key 'direction' is missing; it is the direction that is read: X, Y or Z")
        elif self.setup.direction == machine.axis(self.axis or "").direction:
            out.append(f"[setup] direction {self.setup.direction!r} is along axis {self.axis}; straightness is across")
        return out

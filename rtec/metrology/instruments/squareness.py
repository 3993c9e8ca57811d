"""Squareness of two axes against a square.

One arm of the square is read while one axis travels, the other arm while the other one does; in rows of one arm the
cell of the other reading stays empty. The orientation of the square on the table is unknown: the fit estimates a common
rotation of both arms. A square that is turned over lies otherwise. With the squareness s and the square's own error e,
both arms together show s + e, then s - e, whatever its rotation each time. A squareness that is known as one number
(from a report) is read directly: `component = "EC0Y"`.
"""

from dataclasses import dataclass

import numpy as np

from rtec.arrays import Bools, Floats, Ints
from rtec.effects import State
from rtec.machine import Machine
from rtec.metrology.instruments.base import (
    ORIGIN,
    AffineInstrument,
    InstrumentSetup,
    Nuisance,
    Scope,
    component_itself,
    each_laid,
    flipped,
    from_middle_m,
    laid_scope,
    point,
    zero,
)
from rtec.quantities import Vector, Whole
from rtec.tomlfile import nearest


class SquarenessSetup(InstrumentSetup):
    """`[setup]` of a squareness measurement.

    Attributes:
        reference_axis: the other axis, whose arm of the square is the reference.
        probe_offset_mm: vector from the tool tip to the probe's point of contact.
        reversed_runs: runs with the square turned over about its reference arm; the square's own angular error, then a
            nuisance parameter too, changes sign in them. Without any, the square is taken as exact (correct the
            readings by its certificate first). Each time the square is turned over, it lies otherwise on the table:
            read both arms each time.
        zero: zero of each arm; once for each time that the square was laid, or in every run.
    """

    reference_axis: str | None = None
    probe_offset_mm: Vector = ORIGIN
    reversed_runs: tuple[Whole, ...] = ()
    zero: Scope = "setup"


@dataclass(frozen=True)
class SquarenessProbe(AffineInstrument):
    """Displacement across each of two axes, µm, positive in the machine's directions; or a squareness, µrad."""

    name = "squareness"
    title = "Squareness: probe on both arms of a square"
    setup_model = SquarenessSetup
    needs = ("reference_axis",)
    axis_use = "required"
    direct = "urad"
    setup: SquarenessSetup

    def columns(self) -> tuple[str, ...]:
        """One reading for each of the two directions, in the order of X Y Z; one angle where a component is read."""
        if self.component is not None:
            return ("reading_urad",)
        return tuple(f"reading_{a.lower()}_um" for a in self.axes())

    def reads_while(self, axis: str | None) -> tuple[bool, ...]:
        """The reading along one axis is taken while the other axis travels."""
        if self.component is not None:
            return (True,)
        return tuple(axis is None or a != axis for a in self.axes())

    def looks(self, machine: Machine) -> Floats:
        """The probe's point along each of the two axes."""
        directions = [machine.axis(a).direction for a in self.axes()]
        return np.stack([point(machine, d, self.setup.probe_offset_mm) for d in directions])

    def turned(self, run: Ints) -> Bools:
        """As `reversed_runs` says."""
        return np.isin(run, self.setup.reversed_runs)

    def nuisance(self, state: State, run: Ints) -> tuple[Nuisance, ...]:
        """Zero of each arm, rotation of the square, and its own angular error where it was turned over."""
        if self.component is not None:
            return zero(len(state), 1, "none", "urad")
        machine, axes = state.machine, self.axes()
        names = tuple(f"zero {a}" for a in axes)
        out = list(zero(len(state), 2, laid_scope(self.setup.zero, self.turned(run), run), "um", names))
        lines = [np.eye(3)["XYZ".index(machine.axis(a).direction)] for a in axes]
        along_m = [from_middle_m(machine, state, a) for a in axes]
        # A rotation φ of the square about the normal moves its arms by φ × (along), the reading by the negative.
        normal = np.cross(lines[0], lines[1])
        turned = np.stack(
            [
                -lines[0] @ np.cross(normal, lines[1]) * along_m[1],
                -lines[1] @ np.cross(normal, lines[0]) * along_m[0],
            ]
        )
        out = each_laid([*out, Nuisance("alignment", "urad", turned, "setup")], self.turned(run))
        if self.setup.reversed_runs:
            own = np.zeros((2, len(state)))
            row = axes.index(self.setup.reference_axis or "")
            own[row] = turned[row] * flipped(self.turned(run))
            out.append(Nuisance("square", "urad", own, "setup"))
        return tuple(out)

    def faults(self, machine: Machine) -> list[str]:
        """No second axis, or one along the first."""
        if self.component is not None or self.axis not in machine.axis_names:
            return []
        other = self.setup.reference_axis
        if other is None:
            return ["[setup] key 'reference_axis' is missing; it is the axis along the square's other arm"]
        if other not in machine.axis_names:
            hint = nearest(other, machine.axis_names)
            return [f"[setup] reference_axis {other!r} is none of machine {machine.name!r}{hint}"]
        if machine.axis(other).direction == machine.axis(self.axis or "").direction:
            return [f"[setup] reference_axis {other} runs in the direction of axis {self.axis}; they cannot be square"]
        return []

    def affine(self, machine: Machine) -> Floats:
        """Both arms, or the component itself."""
        return self.looks(machine) if self.component is None else component_itself(machine, self.component)

    def axes(self) -> tuple[str, ...]:
        """Names of the two axes, in order."""
        return tuple(sorted((self.axis or "", self.setup.reference_axis or "")))

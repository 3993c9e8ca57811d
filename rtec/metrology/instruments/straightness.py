"""Straightness: a probe (or laser straightness optics) that moves along an artefact.

The artefact (straightedge, arbor, prism) is on the workpiece side, the probe on the tool side; if they are exchanged,
the reading is the same. If the artefact is turned over between runs, its own form changes sign and the slide's does not
([G 3.1-3.3]), so that a fit separates them. It also lies otherwise then: it has another zero and another slope.
"""

from dataclasses import dataclass

import numpy as np

from rtec.arrays import Bools, Floats, Ints
from rtec.effects import State
from rtec.machine import Machine
from rtec.metrology.instruments.base import (
    ORIGIN,
    AffineInstrument,
    Degree,
    InstrumentSetup,
    Letter,
    Nuisance,
    Scope,
    Sign,
    each_laid,
    flipped,
    from_middle_m,
    laid_scope,
    legendre,
    point,
    scaled,
    slope,
    zero,
)
from rtec.quantities import Vector, Whole

NEAR = 0.01
"""Places within this share of the visited range are one."""


class StraightnessSetup(InstrumentSetup):
    """`[setup]` of a straightness measurement.

    Attributes:
        direction: direction of the reading, across the axis; needed unless a component is named.
        probe_offset_mm: vector from the tool tip to the probe's point of contact.
        sign: +1: reads positive as the tool moves in `direction` relative to the workpiece; -1: the other way.
        reversed_runs: runs with the artefact turned over; the fit takes out the artefact's form, which changes sign in
            them. Without any, the artefact is taken as straight. `sign` is the same in them: the readings of a probe
            that changes sides need the opposite sign first (import with sign = -1).
        artefact_degree: the artefact's form is a polynomial up to this degree; needs `reversed_runs`. Without it the
            form has a value of its own at each target that was read both ways up, and is straight between them.
        zero: unknown zero; once for each time that the artefact was laid, or in every run.
        slope: unknown direction of the artefact; once for each time that it was laid, or in every run.
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

    def turned(self, run: Ints) -> Bools:
        """As `reversed_runs` says."""
        return np.isin(run, self.setup.reversed_runs)

    def nuisance(self, state: State, run: Ints) -> tuple[Nuisance, ...]:
        """Zero, slope, and the artefact's form where it was turned over."""
        turned = self.turned(run)
        out = list(zero(len(state), 1, laid_scope(self.setup.zero, turned, run), "um"))
        if self.axis is None:
            return tuple(each_laid(out, turned))
        along_m = from_middle_m(state.machine, state, self.axis)
        out = each_laid([*out, *slope(along_m, 1, laid_scope(self.setup.slope, turned, run), "um_per_m")], turned)
        if self.setup.artefact_degree is not None:
            shapes = legendre(scaled(state.machine, state, self.axis), self.setup.artefact_degree)
        else:
            shapes = polyline(along_m, turned)
        for i, shape in enumerate(shapes):
            out += slope(shape * flipped(turned), 1, "setup", "um", f"artefact {i + 2}")
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
            if self.setup.slope != "none" or self.setup.reversed_runs:
                out.append("[measurement] key 'axis' is missing; slope and reversed_runs need it (or slope = 'none')")
            return out
        if self.component is not None or self.axis not in machine.axis_names:
            return out
        if self.setup.direction is None:
            out.append("[setup] key 'direction' is missing; it is the direction that is read: X, Y or Z")
        elif self.setup.direction == machine.axis(self.axis or "").direction:
            out.append(f"[setup] direction {self.setup.direction!r} is along axis {self.axis}; straightness is across")
        return out


def polyline(along_m: Floats, turned: Bools) -> list[Floats]:
    """Shapes, (n,) each, of a form that is straight between the places that were read both ways up, zero at its ends.

    A value at a place that was read one way up would take the slide's straightness with it. So such places are joined
    to the next until both are there. The ends are the line through the artefact, which its zero and slope have.

    Args:
        along_m: position of each reading, m, (n,).
        turned: whether the artefact was turned over, (n,).
    """
    order = np.argsort(along_m, kind="stable")
    x, ways = along_m[order], [np.flatnonzero(turned[order] == way) for way in (False, True)]
    knots, start = [], 0
    while all(len(w) and w[-1] >= start for w in ways):
        both = max(int(w[np.searchsorted(w, start)]) for w in ways)
        end = int(np.searchsorted(x, x[both] + NEAR * (x[-1] - x[0]), "right"))
        knots.append(float(x[start:end].mean()))
        start = end
    return [np.interp(along_m, knots, unit) for unit in np.eye(len(knots))[1:-1]]

"""Spindle drift probes [G 3.5, ISO 230-3]: drift of the tool relative to the workpiece while the axes are at rest.

Each probe is a point beside the tool tip and a direction. Radial pair, axial probe and the five probes of ISO 230-3 are
therefore one instrument; tilt is the difference of two radial probes over their distance.
"""

import re
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

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
    slope,
    zero,
)
from rtec.quantities import Vector
from rtec.tomlfile import Strict

PROBE = re.compile(r"[a-z][a-z0-9]*")
FADES_S = (900.0, 2700.0, 8100.0)
"""Time constants with which what is remembered from before the record fades, s."""


class Probe(Strict):
    """One probe.

    Attributes:
        direction: direction of the reading.
        offset_mm: vector from the tool tip to the point of contact.
        sign: +1: reads positive as the tool moves in `direction` relative to the workpiece; -1: the other way.
    """

    direction: Letter
    offset_mm: Vector = ORIGIN
    sign: Sign = 1


class SpindleDriftSetup(InstrumentSetup):
    """`[setup]` of drift probes.

    Attributes:
        probe: probes by name; the column of probe `radial1` is `reading_radial1_um`.
        zero: zero of each probe; once, or in every run.
        start: "unknown" where the machine was warm when the record began: what its parts remember from before fades,
            and is estimated for each probe. "settled": they had rested.
    """

    probe: Annotated[dict[str, Probe], Field(min_length=1)]
    zero: Scope = "setup"
    start: Literal["settled", "unknown"] = "settled"

    @property
    def distance_mm(self) -> float | None:
        """Distance from probe `radial2` to `radial1`; None where one of them is missing."""
        if not {"radial1", "radial2"} <= set(self.probe):
            return None
        first, second = (np.array(self.probe[name].offset_mm) for name in ("radial1", "radial2"))
        return float(np.linalg.norm(first - second))


@dataclass(frozen=True)
class SpindleDrift(AffineInstrument):
    """Displacements at several probes, µm."""

    name = "spindle_drift"
    title = "Spindle drift probes"
    setup_model = SpindleDriftSetup
    axis_use = "optional"
    setup: SpindleDriftSetup

    def columns(self) -> tuple[str, ...]:
        """One reading a probe, in the order of the set-up."""
        return tuple(f"reading_{name}_um" for name in self.setup.probe)

    def looks(self, machine: Machine) -> Floats:
        """Each probe's point in its direction."""
        probes = self.setup.probe.values()
        return np.stack([p.sign * point(machine, p.direction, p.offset_mm) for p in probes])

    def nuisance(self, state: State, run: Ints) -> tuple[Nuisance, ...]:
        """Zero of each probe, and what fades from the first reading on where its start is unknown."""
        del run
        names = tuple(self.setup.probe)
        zeros = zero(len(state), len(names), self.setup.zero, "um", tuple(f"zero {name}" for name in names))
        if self.setup.start == "settled":
            return zeros
        fades = [np.exp(-(state.time_s - state.time_s[0]) / tau) for tau in FADES_S]
        starts = [
            one
            for row, name in enumerate(names)
            for k, fade in enumerate(fades, 1)
            for one in slope(fade, len(names), "setup", "um", f"start {k} of {name}", row)
        ]
        return (*zeros, *starts)

    def faults(self, machine: Machine) -> list[str]:
        """Names that give no column; two probes that do not determine a tilt."""
        del machine
        out = [
            f"[setup.probe.{name}] a probe's name is small letters and digits, and starts with a letter"
            for name in self.setup.probe
            if not PROBE.fullmatch(name)
        ]
        if self.setup.distance_mm == 0.0:
            out.append("[setup.probe.radial2] offset_mm is that of radial1; they must be apart to tell a tilt")
        return out

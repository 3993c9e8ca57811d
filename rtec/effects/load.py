"""Load, elasticity and coupling of axes (catalogue A5).

Symbols: `W` load in 100 kg; `F` force in kN; `u`, `w` positions scaled to -1 … +1 over the travels; `r` how far a ram
reaches out, 0 … 1 of its travel.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, field_validator

from rtec.effects.base import (
    About,
    AxisEffect,
    Confusion,
    Effect,
    Kind,
    Parameter,
    Surroundings,
    component_kind,
    other_axes,
)
from rtec.effects.geometry import legendre, scaled
from rtec.effects.state import Channels, Value
from rtec.errors import ModelError
from rtec.machine import Machine
from rtec.tomlfile import nearest

CROSS = ((1, 2), (2, 2))
"""Degrees of a displacement along the axis and in the other axis. A term that is linear in the other axis is missing:
it is an angle times its arm, which every rigid body has."""
CROSS_ANGLE = ((1, 1), (2, 1), (1, 2), (2, 2))
"""Degrees of an angle: no angle of a rigid body changes with another axis."""
RAMS = ("w", "ram", "quill")
_Power = Annotated[int, Field(ge=1, le=2)]


class RamSag(AxisEffect):
    """A ram bends as it reaches out: `e = c1 r² + c2 r³`."""

    about: ClassVar[About] = About(
        title="Sag of a ram or quill that reaches out",
        equation="e = c1·r² + c2·r³, r = 0..1 over the travel",
        typical="2-30 µm",
        seen_by=("straightness", "grid_encoder", "tool_tip"),
        source="catalogue A5",
        confusions=(
            Confusion("straightness", "a bent guide is the same curve", "a known mass at the tip"),
            Confusion("guide_curvature", "an angle that grows, times the arm", "a second offset"),
        ),
        reveal="straightness of the ram with and without a known mass at the tip",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("straightness",)
    driven_by: ClassVar[tuple[str, ...]] = ("position",)
    effect: Literal["ram_sag"] = "ram_sag"

    @classmethod
    def suggest(cls, around: Surroundings) -> Iterator[Effect]:
        """For axes that are named as rams, or that move along Z, as spindle heads and rams do."""
        axis = around.axis
        if axis is not None and (axis.name.lower() in RAMS or axis.direction == "Z"):
            yield from super().suggest(around)

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`c1`, `c2`."""
        del machine
        return (Parameter("c1", self.unit, typical=8.0), Parameter("c2", self.unit, typical=8.0))

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`r²`, `r³`."""
        del theta
        axis = self.the_axis(machine)
        low, high = axis.travel_mm
        r = (channels.value(axis.channel) - low) * (1.0 / (high - low))
        return [r * r, r * r * r]


class CrossTalk(AxisEffect):
    """A component that changes with another axis, unlike a rigid body's: `e = Σ c_ij P_i(u) P_j(w)`."""

    about: ClassVar[About] = About(
        title="Cross-talk: a component that changes with another axis",
        equation="e = Σ c_ij·P_i(u)·P_j(w); j = 2 for displacements, 1 and 2 for angles",
        typical="1-5 µm",
        seen_by=("grid_encoder", "laser_angular", "straightness", "tool_tip"),
        source="[XT 2, 4]",
        confusions=(
            Confusion("angular_motion", "an angle times its arm is straight in the other axis", "three places of it"),
            Confusion("mount_expansion", "the places were visited in order of time", "visit them in another order"),
        ),
        reveal="the same line at three places or more of the other axis",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("straightness", "tilt", "roll", "positioning")
    driven_by: ClassVar[tuple[str, ...]] = ("position", "other axis")
    effect: Literal["cross_talk"] = "cross_talk"
    other: str
    terms: tuple[tuple[_Power, _Power], ...] = ()
    """Degrees along the axis and in the other axis; if empty, all that the equation has."""

    @classmethod
    def arguments(cls, around: Surroundings) -> Iterator[dict[str, Any]]:
        """Every other axis that moved: all terms, and each term alone except the one that is linear in both axes.

        That term alone is an angle of the other axis times its arm.
        """
        angle = component_kind(around.component, around.machine) in ("tilt", "roll")
        for axis in other_axes(around):
            along = {"axis": around.moved.name, "other": axis.name}
            yield along
            for term in CROSS_ANGLE[1:] if angle else CROSS:
                yield {**along, "terms": (term,)}

    def check(self, machine: Machine, where: str) -> None:
        """Check component and both axes."""
        super().check(machine, where)
        if self.other not in machine.axis_names:
            hint = nearest(self.other, machine.axis_names)
            raise ModelError(f"{where}: other axis {self.other!r} is none of machine {machine.name!r}{hint}")
        if self.other == self.axis:
            raise ModelError(f"{where}: the other axis is the axis itself")

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`c12`, `c22` …."""
        del machine
        return tuple(Parameter(f"c{i}{j}", self.unit, typical=3.0) for i, j in self._degrees)

    @property
    def _degrees(self) -> tuple[tuple[int, int], ...]:
        return self.terms or (CROSS_ANGLE if self.unit == "urad" else CROSS)

    @field_validator("terms")
    @classmethod
    def _known(cls, value: tuple[tuple[int, int], ...]) -> tuple[tuple[int, int], ...]:
        if len(set(value)) < len(value) or not set(value) <= set(CROSS_ANGLE):
            raise ValueError(f"terms are some of {', '.join(f'[{i}, {j}]' for i, j in CROSS_ANGLE)}, each once")
        return value

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read both positions."""
        return (self.the_axis(machine).channel, machine.axis(self.other).channel)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """Products of Legendre polynomials."""
        del theta
        u = legendre(scaled(self.the_axis(machine), channels), (1, 2))
        w = legendre(scaled(machine.axis(self.other), channels), (1, 2))
        return [u[i - 1] * w[j - 1] for i, j in self._degrees]


class LoadDeformation(AxisEffect):
    """The work piece's weight bends the machine: `e = W (a + b u + c u²)`."""

    about: ClassVar[About] = About(
        title="Deformation by the weight of the work piece",
        equation="e = W·(a + b·u + c·u²), W in 100 kg",
        typical="1-20 µm at 500 kg",
        seen_by=("laser_linear", "level", "straightness", "tool_tip"),
        source="catalogue A5",
        confusions=(
            Confusion("mount_expansion", "the set-up shifted or warmed meanwhile", "load, unload, load again"),
            Confusion("bed_bending", "heat came with the load", "load at one temperature"),
        ),
        reveal="the same line loaded, unloaded, loaded again",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("positioning", "straightness", "tilt", "roll")
    driven_by: ClassVar[tuple[str, ...]] = ("position", "load_kg")
    effect: Literal["load_deformation"] = "load_deformation"
    terms: Annotated[tuple[Literal["a", "b", "c"], ...], Field(min_length=1)] = ("a", "b", "c")

    @field_validator("terms")
    @classmethod
    def _once(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(value)) < len(value):
            raise ValueError("a term is given twice")
        return value

    @classmethod
    def arguments(cls, around: Surroundings) -> Iterator[dict[str, Any]]:
        """All terms; shift, slope or bow alone; shift and bow."""
        for terms in (("a", "b", "c"), ("a",), ("b",), ("c",), ("a", "c")):
            yield {"axis": around.moved.name, "terms": terms}

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`a`, `b`, `c`, per 100 kg; those of `terms`."""
        del machine
        return tuple(Parameter(n, f"{self.unit}_per_100kg", typical=1.0) for n in self.terms)

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read position and load."""
        return (self.the_axis(machine).channel, "load_kg")

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`W`, `W u`, `W u²`; those of `terms`."""
        del theta
        load, u = channels.value("load_kg") * 0.01, scaled(self.the_axis(machine), channels)
        made = {"a": load, "b": load * u, "c": load * u * u}
        return [made[n] for n in self.terms]


class ForceDeflection(Effect):
    """A force bends the machine: `e = k F`."""

    about: ClassVar[About] = About(
        title="Deflection by a force (cutting, clamping, counterbalance)",
        equation="e = k·F, F in kN; 1/k is the stiffness",
        typical="stiffness 20-200 N/µm: 5-50 µm/kN",
        seen_by=("grid_encoder", "tool_tip", "spindle_drift"),
        source="catalogue A5",
        confusions=(
            Confusion("lost_motion", "friction holds part of it back", "sweep the force at rest, up and down"),
            Confusion("backlash", "the force turns over with the direction", "force without motion"),
        ),
        reveal="a force gauge between spindle and table, swept at rest",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("positioning", "link", "link_angle")
    driven_by: ClassVar[tuple[str, ...]] = ("force_n",)
    effect: Literal["force_deflection"] = "force_deflection"

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`k`, per kN."""
        del machine
        return (Parameter("k", f"{self.unit}_per_kn", typical=10.0),)

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read the force."""
        del machine
        return ("force_n",)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`F` in kN."""
        del machine, theta
        return [channels.value("force_n") * 1e-3]

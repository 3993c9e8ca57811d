"""Quasi-static geometry (catalogue A1): position errors along an axis, straightness, angles and squareness of its line.

Symbols: `q` axis position, mm; `u` position scaled to -1 … +1 over the travel; `e` the component error, µm or µrad.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, field_validator

from rtec.effects.base import About, AxisEffect, Confusion, Effect, Kind, Parameter, Surroundings
from rtec.effects.state import Channels, Value
from rtec.machine import Axis, Machine
from rtec.quantities import Millimetres

MM_TO_M = 1e-3


def scaled(axis: Axis, channels: Channels) -> Value:
    """Position of an axis scaled to -1 … +1 over its travel."""
    low, high = axis.travel_mm
    return (channels.value(axis.channel) - 0.5 * (low + high)) * (2.0 / (high - low))


def legendre(u: Value, degrees: Sequence[int]) -> list[Value]:
    """Legendre polynomials of some degrees at u, by Bonnet's recursion."""
    p = [u * 0.0 + 1.0, u]
    for k in range(1, max(degrees)):
        p.append(u * p[k] * ((2 * k + 1) / (k + 1)) - p[k - 1] * (k / (k + 1)))
    return [p[i] for i in degrees]


def distinct(degrees: tuple[int, ...]) -> tuple[int, ...]:
    """Give degrees back.

    Raises:
        ValueError: one is given twice.
    """
    if len(set(degrees)) < len(degrees):
        raise ValueError("a degree is given twice")
    return degrees


class Scale(AxisEffect):
    """Scale or mean pitch error: `e = k q`."""

    about: ClassVar[About] = About(
        title="Scale, mean pitch error",
        equation="e = k·q",
        typical="5-50 µm/m",
        seen_by=("laser_linear", "ball_bar", "tool_tip"),
        source="[XT Table 4]",
        confusions=(
            Confusion(
                "axis_expansion",
                "a warm screw or scale makes the same straight line",
                "repeat cold and hot, with the temperatures logged",
            ),
            Confusion(
                "instrument_drift",
                "air that is warmer than the laser believes stretches its scale",
                "log air temperature and pressure, or compare with an artefact",
            ),
            Confusion(
                "guide_curvature",
                "a pitch that grows along the axis does the same at one height",
                "repeat the line at a second height",
            ),
        ),
        reveal="laser along the axis, over its whole travel",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("positioning",)
    driven_by: ClassVar[tuple[str, ...]] = ("position",)
    effect: Literal["scale"] = "scale"

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`k`, per metre of travel."""
        del machine
        return (Parameter("k", f"{self.unit}_per_m", typical=20.0),)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`q` in m."""
        del theta
        return [channels.value(self.the_axis(machine).channel) * MM_TO_M]


class PolynomialPosition(AxisEffect):
    """Polynomial in position: `e = Σ c_i P_i(u)`, Legendre polynomials over the travel."""

    about: ClassVar[About] = About(
        title="Polynomial in position",
        equation="e = Σ c_i·P_i(u), u = position scaled to -1..+1 over the travel",
        typical="1-15 µm; quadratics are typically enough",
        seen_by=("laser_linear", "straightness", "laser_angular", "tool_tip"),
        source="[G 3.6]",
        confusions=(
            Confusion(
                "piecewise_position",
                "both follow a bent line; few targets do not separate them",
                "more targets, and compare by evidence",
            ),
            Confusion(
                "cyclic_screw",
                "targets in steps near the pitch fold a wave into a slow curve",
                "steps that are no multiple of the pitch",
            ),
        ),
        reveal="laser along the axis with 20 targets or more",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("positioning",)
    driven_by: ClassVar[tuple[str, ...]] = ("position",)
    effect: Literal["polynomial_position"] = "polynomial_position"
    degrees: Annotated[tuple[Annotated[int, Field(ge=0, le=12)], ...], Field(min_length=1)] = (1, 2)

    @field_validator("degrees")
    @classmethod
    def _distinct(cls, value: tuple[int, ...]) -> tuple[int, ...]:
        return distinct(value)

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`c0` … by degree, in the component's unit."""
        del machine
        return tuple(Parameter(f"c{i}", self.unit, typical=5.0) for i in self.degrees)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """Legendre polynomials by Bonnet's recursion."""
        del theta
        return legendre(scaled(self.the_axis(machine), channels), self.degrees)

    @classmethod
    def arguments(cls, around: Surroundings) -> Iterator[dict[str, Any]]:
        """Degrees 2 to 5, as a straight line is `scale`; and degree 2 alone, which is enough for most machines."""
        for degrees in ((2,), (2, 3), (2, 3, 4, 5)):
            yield {"axis": around.moved.name, "degrees": degrees}


class PiecewisePosition(AxisEffect):
    """Piecewise linear in position: the error at each knot, linear between knots, constant beyond the ends."""

    about: ClassVar[About] = About(
        title="Piecewise linear in position",
        equation="e = straight lines through (knot, value)",
        typical="1-10 µm",
        seen_by=("laser_linear", "tool_tip"),
        source="[G 3.6] advises segments in position",
        confusions=(
            Confusion("polynomial_position", "both follow a bent line", "dense targets about the bend"),
            Confusion(
                "backlash_position", "local wear shows in both directions differently", "dense targets, both directions"
            ),
        ),
        reveal="laser along the axis with dense targets, both directions",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("positioning",)
    driven_by: ClassVar[tuple[str, ...]] = ("position",)
    effect: Literal["piecewise_position"] = "piecewise_position"
    knots_mm: Annotated[tuple[Millimetres, ...], Field(min_length=2, max_length=1000)]

    @classmethod
    def arguments(cls, around: Surroundings) -> Iterator[dict[str, Any]]:
        """Seven and eleven knots over the visited range."""
        low, high = around.channels[around.moved.channel]
        for knots in (7, 11):
            step = (high - low) / (knots - 1)
            yield {"axis": around.moved.name, "knots_mm": tuple(round(low + i * step, 3) for i in range(knots))}

    @field_validator("knots_mm")
    @classmethod
    def _rising(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if any(b <= a for a, b in itertools.pairwise(value)):
            raise ValueError("knots must rise")
        return value

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`at0` … the error at each knot."""
        del machine
        return tuple(Parameter(f"at{i}", self.unit, typical=5.0) for i in range(len(self.knots_mm)))

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """One hat function per knot; they sum to one everywhere."""
        del theta
        q = channels.value(self.the_axis(machine).channel)
        # Share of each segment that lies behind, 0 … 1; a knot's hat is that of the segment before it minus the next's.
        steps = [
            np.minimum(np.maximum((q - a) * (1.0 / (b - a)), 0.0), 1.0)
            for a, b in zip(self.knots_mm, self.knots_mm[1:], strict=False)
        ]
        inner = [before - after for before, after in itertools.pairwise(steps)]
        return [1.0 - steps[0], *inner, steps[-1]]


class Squareness(Effect):
    """Squareness of an axis to another axis: a constant angle of its line of travel."""

    about: ClassVar[About] = About(
        title="Squareness of an axis to another",
        equation="e = α",
        typical="5-50 µrad",
        seen_by=("ball_bar", "grid_encoder", "laser_diagonal", "squareness", "tool_tip"),
        source="[XT 1], ISO 230-1",
        confusions=(
            Confusion(
                "servo_phase",
                "in a ball bar of one sense a phase mismatch draws the same oval",
                "circles in both senses",
            ),
            Confusion("guide_twist", "at one height a twist looks like it", "a second height"),
            Confusion("straightness", "the slope of a fixture is taken for it", "turn the square round"),
        ),
        reveal="square, or ball bar in both senses",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("axis_angle",)
    driven_by: ClassVar[tuple[str, ...]] = ()
    effect: Literal["squareness"] = "squareness"

    @classmethod
    def suggest(cls, around: Surroundings) -> Iterator[Effect]:
        """For angles of the lines of X and Y; the angle of Z, which runs along the spindle, is its parallelism."""
        axis = around.machine.axis(around.component[3:]) if around.component[3:] in around.machine.axis_names else None
        if axis is not None and (axis.direction == "Z") is cls._along_spindle:
            yield from super().suggest(around)

    _along_spindle: ClassVar[bool] = False

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`alpha`."""
        del machine
        return (Parameter("alpha", self.unit, typical=20.0),)

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read nothing."""
        del machine
        return ()

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """One."""
        del machine, channels, theta
        return [1.0]


class Parallelism(Squareness):
    """Parallelism of an axis to the spindle's axis: a constant angle of its line of travel."""

    about: ClassVar[About] = About(
        title="Parallelism of an axis to the spindle",
        equation="e = α",
        typical="5-20 µrad",
        seen_by=("tool_tip", "straightness"),
        source="[G 2.16, 3.5]",
        confusions=(
            Confusion(
                "spindle_tilt",
                "an arbor that is not in line with the spindle",
                "best-fit circles at two stations along the arbor",
            ),
            Confusion("squareness", "another name for the angle of another axis", "measure against the other axes"),
        ),
        reveal="two probes 180 degrees apart on an arbor, two stations",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("axis_angle",)
    driven_by: ClassVar[tuple[str, ...]] = ()
    effect: Literal["parallelism"] = "parallelism"  # type: ignore[assignment]
    _along_spindle: ClassVar[bool] = True


class Straightness(AxisEffect):
    """Straightness of a line of travel, without its slope: `e = Σ c_i P_i(u)`, degrees 2 and 3 if none are given."""

    about: ClassVar[About] = About(
        title="Straightness of a line of travel",
        equation="e = c2·P2(u) + c3·P3(u), u = position scaled to -1..+1 over the travel",
        typical="1-10 µm",
        seen_by=("straightness", "grid_encoder", "ball_bar", "tool_tip"),
        source="[XT Table 4], ISO 230-1",
        confusions=(
            Confusion("guide_curvature", "an angle that grows, times the arm", "a second offset"),
            Confusion("ram_sag", "a ram that bends as it reaches out", "a known mass at the tip"),
            Confusion("bed_bending", "the part of it that goes with heat", "repeat hot and cold"),
            Confusion("instrument_drift", "the form of the arbor or straight edge", "reversal of the artefact"),
        ),
        reveal="straightness with reversal of the artefact",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("straightness",)
    driven_by: ClassVar[tuple[str, ...]] = ("position",)
    forms: ClassVar[tuple[tuple[int, ...], ...]] = ((2, 3), (2,))
    """Degrees that a search tries."""
    typical_size: ClassVar[float] = 3.0
    effect: Literal["straightness"] = "straightness"
    degrees: Annotated[tuple[Annotated[int, Field(ge=1, le=12)], ...], Field(min_length=1)] = (2, 3)

    @field_validator("degrees")
    @classmethod
    def _distinct(cls, value: tuple[int, ...]) -> tuple[int, ...]:
        return distinct(value)

    @classmethod
    def arguments(cls, around: Surroundings) -> Iterator[dict[str, Any]]:
        """The default degrees, and subsets of them."""
        for degrees in cls.forms:
            yield {"axis": around.moved.name, "degrees": degrees}

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`c2`, `c3`, by degree."""
        del machine
        return tuple(Parameter(f"c{i}", self.unit, typical=self.typical_size) for i in self.degrees)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """Legendre polynomials."""
        del theta
        return legendre(scaled(self.the_axis(machine), channels), self.degrees)


class AngularMotion(Straightness):
    """Angular error motion: `E = Σ c_i P_i(u)`, degrees 2 and 3 if none are given; the chain has the lever arm."""

    about: ClassVar[About] = About(
        title="Angular error motion (Abbe error with its arm)",
        equation="e = Σ c_i·P_i(u), an angle; degrees 2 and 3, or 2, or 1 and 2; times the arm at the tip",
        typical="2-50 µrad, arms 0.1-1 m",
        seen_by=("laser_angular", "level", "grid_encoder", "tool_tip"),
        source="ISO 230-1, [XT Table 4]",
        confusions=(
            Confusion("polynomial_position", "seen at one arm only, it is a positioning error", "a second offset"),
            Confusion("straightness", "seen at one arm only, it is a straightness error", "a second offset"),
            Confusion("cross_talk", "an angle that changes with another axis", "three positions of the other axis"),
        ),
        reveal="angular laser or level along the axis",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("tilt", "roll")
    forms: ClassVar[tuple[tuple[int, ...], ...]] = ((2, 3), (2,), (1, 2))
    """One that grows evenly is a guide's curvature or twist."""
    typical_size: ClassVar[float] = 10.0
    effect: Literal["angular_motion"] = "angular_motion"  # type: ignore[assignment]


class GuideCurvature(Scale):
    """A guide bent to a circle: pitch or yaw grows along the axis, `E = k q`, k = 1/ρ."""

    about: ClassVar[About] = About(
        title="Guide curvature (pitch or yaw grows along the axis)",
        equation="e = k·q, k = 1/ρ",
        typical="ρ 10³-10⁵ m: 10-1000 µrad/m",
        seen_by=("laser_angular", "ball_bar", "level", "tool_tip"),
        source="[BB 14-17]",
        confusions=(
            Confusion("scale", "pitch at a fixed height is a scale error", "two heights"),
            Confusion("angular_motion", "an angle that does not grow evenly", "more targets"),
            Confusion("straightness", "the bow that comes with it", "angular laser beside a straightness laser"),
        ),
        reveal="angular laser or level; ball bar: third harmonic at two heights",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("tilt",)
    effect: Literal["guide_curvature"] = "guide_curvature"  # type: ignore[assignment]


class GuideTwist(Scale):
    """A twisted guide: roll grows along the axis, `E = κ q`."""

    about: ClassVar[About] = About(
        title="Guide twist (roll grows along the axis)",
        equation="e = k·q",
        typical="1-200 µrad/m",
        seen_by=("level", "ball_bar", "tool_tip"),
        source="[BB 18]",
        confusions=(
            Confusion("squareness", "in a ball bar both draw sin 2ζ", "a second height"),
            Confusion("servo_phase", "in a ball bar both draw sin 2ζ", "both senses and a second height"),
            Confusion("angular_motion", "a roll that does not grow evenly", "more targets"),
        ),
        reveal="level along the axis",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("roll",)
    effect: Literal["guide_twist"] = "guide_twist"  # type: ignore[assignment]

"""Lines of travel: straightness, angles, squareness; quasi-static geometry (catalogue A1).

Symbols: `q` axis position, mm; `u` position scaled to -1 … +1 over the travel; `e` the component error, µm or µrad.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar, Literal

from rtec.effects.base import About, AxisEffect, Confusion, Effect, Kind, Parameter, Surroundings
from rtec.effects.geometry import Scale, legendre, scaled
from rtec.effects.state import Channels, Value
from rtec.machine import Machine


class Squareness(Effect):
    """Squareness of an axis to another: a constant angle of its line of travel."""

    about: ClassVar[About] = About(
        title="Squareness of an axis to another",
        equation="e = α",
        typical="5-50 µrad",
        seen_by=("ball_bar", "grid_encoder", "squareness", "tool_tip"),
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
        """For angles of the lines of X and Y; that of Z, which runs along the spindle, is its parallelism."""
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
    """Straightness of a line of travel, its slope taken out: `e = c2 P2(u) + c3 P3(u)`."""

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
    effect: Literal["straightness"] = "straightness"

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`c2`, `c3`."""
        del machine
        return tuple(Parameter(f"c{i}", self.unit, typical=3.0) for i in (2, 3))

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """Legendre polynomials of degree 2 and 3."""
        del theta
        return legendre(scaled(self.the_axis(machine), channels), (2, 3))


class AngularMotion(Straightness):
    """Angular error motion beyond a straight line: `E = c2 P2(u) + c3 P3(u)`; the arm to the tip comes by the chain."""

    about: ClassVar[About] = About(
        title="Angular error motion (Abbe error with its arm)",
        equation="e = c2·P2(u) + c3·P3(u), an angle; times the arm at the tip",
        typical="2-50 µrad, arms 0.1-1 m",
        seen_by=("laser_angular", "level", "grid_encoder", "tool_tip"),
        source="ISO 230-1, [XT Table 4]",
        confusions=(
            Confusion("polynomial_position", "seen at one arm only, it is a positioning error", "a second offset"),
            Confusion("straightness", "seen at one arm only, it is a straightness error", "a second offset"),
            Confusion("cross_talk", "an angle that changes with another axis", "three positions of that axis"),
        ),
        reveal="angular laser or level along the axis",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("tilt", "roll")
    effect: Literal["angular_motion"] = "angular_motion"  # type: ignore[assignment]

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`c2`, `c3`."""
        del machine
        return tuple(Parameter(f"c{i}", self.unit, typical=10.0) for i in (2, 3))


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
            Confusion("straightness", "the bow that goes with it", "angular laser beside a straightness laser"),
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

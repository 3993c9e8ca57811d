"""Effects of speed and acceleration (catalogue A3, and the servo's of A2).

Symbols: `v` velocity of the axis, mm/s, with its sign; `a` its acceleration, mm/s².
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Literal

import numpy as np

from rtec.effects.base import About, AxisEffect, Confusion, Effect, Kind, Parameter, Surroundings
from rtec.effects.state import Channels, Value
from rtec.errors import ModelError
from rtec.machine import Machine
from rtec.tomlfile import nearest

REFERENCE_MM_S = 100.0
SETTLES = Parameter("T", "s", 0.05, 0.002, 2.0, 0.05, (0.01, 0.03, 0.1, 0.3))
STILL_MM_S = 1e-6
SWITCH_S_PER_MM = 1e6
"""Steepness of the change-over: it is complete at a difference in speed of 1 nm/s."""


class ServoLag(AxisEffect):
    """Following error: `e = τ v`; |τ| = 1/K_v minus the share of feed-forward, negative where the slide lags.

    With `builds_up` the slide starts from rest at the reversal, and its lag builds up as that of a first-order loop:
    `e = τ v (1 - exp(-t/T))`, `t = s/|v|` the time since the reversal.
    """

    about: ClassVar[About] = About(
        title="Servo lag (following error)",
        equation="e = tau·v, v with its sign; builds_up: times 1 - exp(-s/(|v|·T)), s = distance since the reversal",
        typical="0.1-20 µm per 100 mm/s; mismatch of two axes 0.1-5 %",
        seen_by=("ball_bar", "grid_encoder", "laser_linear"),
        source="[BB 19]",
        confusions=(
            Confusion("backlash", "at one feed both shift the directions apart", "measure at two feeds"),
            Confusion("scale", "a mismatch of scale does not depend on the feed", "sweep the feed"),
            Confusion("stribeck", "fades with the feed instead of growing", "four feeds or more"),
            Confusion("inertia", "goes with the acceleration", "circles of several radii at one speed"),
        ),
        reveal="both directions at two feeds or more",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("positioning",)
    driven_by: ClassVar[tuple[str, ...]] = ("velocity",)
    effect: Literal["servo_lag"] = "servo_lag"
    builds_up: bool = False

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`tau`: µm per mm/s is ms."""
        del machine
        return (Parameter("tau", f"{self.unit}_s_per_mm", typical=0.05),)

    def nonlinear(self, machine: Machine) -> tuple[Parameter, ...]:
        """`T` where the lag builds up."""
        del machine
        return (SETTLES,) if self.builds_up else ()

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read the velocity, and the distance since the reversal where the lag builds up."""
        axis = self.the_axis(machine)
        return (axis.velocity_channel, *([axis.since_reversal_channel] if self.builds_up else []))

    @classmethod
    def arguments(cls, around: Surroundings) -> Iterator[dict[str, Any]]:
        """With a settled lag, and with one that builds up after each reversal."""
        yield {"axis": around.moved.name}
        if around.moved.since_reversal_channel in around.channels:
            yield {"axis": around.moved.name, "builds_up": True}

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`v` times the share of its final value that the lag has reached."""
        axis = self.the_axis(machine)
        v = channels.value(axis.velocity_channel)
        if not self.builds_up:
            return [v]
        settled_mm = np.maximum(np.abs(v), STILL_MM_S) * theta["T"]
        return [v * (1.0 - np.exp(-(channels.value(axis.since_reversal_channel) / settled_mm)))]


class ServoPhase(ServoLag):
    """Phase mismatch of two axes on a circle: one lags by half of it, the other leads by half of it.

    In the axis that lags it is `½ τ v`. A pair with opposite signs gives `sin 2ζ` in a ball bar, with a sign that
    changes with the sense of rotation. In one axis alone it cannot be distinguished from servo lag.
    """

    about: ClassVar[About] = About(
        title="Phase mismatch of two axes on a circle",
        equation="e = ½·tau·v in one axis, its opposite in the other",
        typical="0.01-1 mrad on a circle",
        seen_by=("ball_bar", "grid_encoder"),
        source="[BB 19]",
        confusions=(
            Confusion("squareness", "in one sense both draw the same oval", "circles in both senses"),
            Confusion("guide_twist", "at one height both draw sin 2ζ", "both senses and a second height"),
            Confusion("servo_lag", "in one axis it is a lag", "a circle in which both axes move"),
        ),
        reveal="ball bar in both senses",
    )
    effect: Literal["servo_phase"] = "servo_phase"  # type: ignore[assignment]

    @classmethod
    def suggest(cls, around: Surroundings) -> Iterator[Effect]:
        """None: in one axis alone it is servo lag; the diagnosis of a ball bar fits the pair."""
        del around
        return iter(())

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`½ v`."""
        (follows,) = super().basis(machine, channels, theta)
        return [follows * 0.5]


class ChangeOver(ServoLag):
    """Master-slave change-over: the slower axis follows the faster one with a delay, `e = τ v` while it is slower.

    On a circle the axes change roles at 45°, 135° …; there the path steps from one side to the other.
    """

    about: ClassVar[About] = About(
        title="Master-slave change-over of two axes",
        equation="e = tau·v while |v| < |v of the other axis|, else 0; v with its sign",
        typical="0.05-1 ms; steps of 1-20 µm at 45°, 135°, 225°, 315°",
        seen_by=("ball_bar", "grid_encoder"),
        source="catalogue A2",
        confusions=(
            Confusion("servo_lag", "a lag that is always there does not step", "a circle read every degree or finer"),
            Confusion("squareness", "in one sense the steps lean the circle over a little", "circles in both senses"),
        ),
        reveal="ball bar in both senses",
    )
    effect: Literal["change_over"] = "change_over"  # type: ignore[assignment]
    other: str

    @classmethod
    def suggest(cls, around: Surroundings) -> Iterator[Effect]:
        """None: both axes have it; the diagnosis of a ball bar fits the pair."""
        del around
        return iter(())

    def check(self, machine: Machine, where: str) -> None:
        """Check that the other axis belongs to this machine and is not this one."""
        super().check(machine, where)
        if self.other not in machine.axis_names:
            hint = nearest(self.other, machine.axis_names)
            raise ModelError(f"{where}: other = {self.other!r} is no axis of machine {machine.name!r}{hint}")
        if self.other == self.axis:
            raise ModelError(f"{where}: other = {self.other!r} must be another axis than the one that lags")

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read both velocities."""
        return (*super().channels(machine), machine.axis(self.other).velocity_channel)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`v` where this axis is the slower one, else zero."""
        own, other = (
            channels.value(self.the_axis(machine).velocity_channel),
            channels.value(machine.axis(self.other).velocity_channel),
        )
        slower = np.minimum(np.maximum((np.abs(other) - np.abs(own)) * SWITCH_S_PER_MM, 0.0), 1.0)
        (follows,) = super().basis(machine, channels, theta)
        return [follows * slower]


class GuideLift(AxisEffect):
    """The oil film lifts a slide with speed: `e = A (|v| / 100 mm/s)^q`."""

    about: ClassVar[About] = About(
        title="Hydrodynamic lift of a guide",
        equation="e = A·(|v|/100 mm/s)^q, the same both ways",
        typical="1-7 µm between 0.5 and 10 m/min, q 0.5-1",
        seen_by=("grid_encoder", "straightness", "laser_angular"),
        source="[XT Table 9]",
        confusions=(
            Confusion("mount_expansion", "rubbing heat lags by minutes", "fast and slow passes in turn"),
            Confusion("servo_lag", "turns over with the direction", "both directions"),
        ),
        reveal="straightness or level at four feeds, fast and slow in turn",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("straightness", "tilt")
    driven_by: ClassVar[tuple[str, ...]] = ("velocity",)
    effect: Literal["guide_lift"] = "guide_lift"

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`A`: at 100 mm/s."""
        del machine
        return (Parameter("A", self.unit, typical=4.0),)

    def nonlinear(self, machine: Machine) -> tuple[Parameter, ...]:
        """`q`."""
        del machine
        return (Parameter("q", "1", 0.7, 0.2, 2.0, 0.7, (0.5, 0.75, 1.0)),)

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read the velocity."""
        return (self.the_axis(machine).velocity_channel,)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`(|v| / 100)^q`."""
        speed = np.abs(channels.value(self.the_axis(machine).velocity_channel)) * (1.0 / REFERENCE_MM_S)
        return [speed ** theta["q"]]


class Inertia(AxisEffect):
    """A part bends under its own inertia: `e = k a`, k negative for a mass that lags behind."""

    about: ClassVar[About] = About(
        title="Deflection by acceleration",
        equation="e = k·a, a with its sign, m/s²",
        typical="1-20 µm at 5 m/s²",
        seen_by=("grid_encoder", "ball_bar"),
        source="catalogue A3",
        confusions=(
            Confusion("servo_lag", "goes with the velocity", "circles of several radii at one speed"),
            Confusion("reversal_spike", "comes only at reversals", "accelerate without turning round"),
        ),
        reveal="corners on a grid, or circles of several radii at one speed",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("positioning", "straightness", "tilt")
    driven_by: ClassVar[tuple[str, ...]] = ("acceleration",)
    effect: Literal["inertia"] = "inertia"

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`k`, per m/s²."""
        del machine
        return (Parameter("k", f"{self.unit}_s2_per_m", typical=2.0),)

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read the acceleration."""
        return (self.the_axis(machine).acceleration_channel,)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`a` in m/s²."""
        del theta
        return [channels.value(self.the_axis(machine).acceleration_channel) * 1e-3]

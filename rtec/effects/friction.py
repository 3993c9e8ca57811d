"""Reversal errors beyond play: tipping, and what fades with distance or feed (catalogue A2).

Symbols: `d` last non-zero direction of motion, -1 or +1, 0 before the first motion; `u` position scaled to -1 … +1.
"""

from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np

from rtec.effects.base import About, Confusion, Kind, Parameter
from rtec.effects.reversal import Reversal
from rtec.effects.state import Channels, Value
from rtec.machine import Machine


class AngularReversal(Reversal):
    """An angle that turns over with the direction: `E = ½ θ d`."""

    about: ClassVar[About] = About(
        title="Angular reversal (the slide tips over when it turns round)",
        equation="e = ½·theta·d, an angle; times the arm at the tip",
        typical="1-20 µrad",
        seen_by=("grid_encoder", "laser_angular", "level", "tool_tip"),
        source="[XT 5]",
        confusions=(
            Confusion("backlash", "at one height it is a reversal value", "two offsets of the instrument"),
            Confusion("servo_lag", "at one feed a lag shifts both directions apart", "measure at two feeds"),
        ),
        reveal="angular laser in both directions; L-shaped paths on both sides of a grid",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("tilt", "roll")
    driven_by: ClassVar[tuple[str, ...]] = ("direction",)
    effect: Literal["angular_reversal"] = "angular_reversal"

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`theta`: angle moving positive minus angle moving negative."""
        del machine
        return (Parameter("theta", self.unit, typical=8.0),)


TRAVELS_MM = (0.05, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)


class LostMotion(Reversal):
    """Pre-sliding lost motion (Dahl): a reversal error that fades on the way, `e = ½ A d exp(-s/s0)`."""

    about: ClassVar[About] = About(
        title="Lost motion after a reversal, fading on the way",
        equation="e = ½·A·d·exp(-s/s0), s = distance since the reversal",
        typical="0.5-5 µm, s0 5 µm - 20 mm",
        seen_by=("laser_linear", "grid_encoder", "ball_bar"),
        source="Dahl's friction model",
        confusions=(
            Confusion("backlash", "play does not fade", "steps of growing size after a reversal"),
            Confusion("reversal_spike", "a spike begins at nothing", "a recording of 1 kHz or more"),
        ),
        reveal="fine steps after each reversal",
    )
    driven_by: ClassVar[tuple[str, ...]] = ("direction", "since_reversal")
    effect: Literal["lost_motion"] = "lost_motion"

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`A`: at the reversal."""
        del machine
        return (Parameter("A", self.unit, typical=4.0),)

    def nonlinear(self, machine: Machine) -> tuple[Parameter, ...]:
        """`s0`."""
        del machine
        return (Parameter("s0", "mm", 2.0, 0.005, 100.0, 2.0, TRAVELS_MM),)

    def more_channels(self, machine: Machine) -> tuple[str, ...]:
        """The distance since the reversal."""
        return (self.the_axis(machine).since_reversal_channel,)

    def grows(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Value:
        """What is left of it."""
        s = channels.value(self.the_axis(machine).since_reversal_channel)
        return np.exp(-(s / theta["s0"]))


class ReversalSpike(LostMotion):
    """A spike after a reversal (stick-slip): `e = ½ A d (s/s0) exp(1 - s/s0)`."""

    about: ClassVar[About] = About(
        title="Reversal spike (quadrant glitch, stick-slip)",
        equation="e = ½·A·d·(s/s0)·exp(1 - s/s0)",
        typical="1-15 µm over 5-50 ms",
        seen_by=("ball_bar", "grid_encoder"),
        source="[BB 4]",
        confusions=(
            Confusion("lost_motion", "lost motion is largest at once", "a recording of 1 kHz or more"),
            Confusion("outliers", "sampled too slowly it is one wrong reading", "a recording of 1 kHz or more"),
        ),
        reveal="ball bar recorded at 1 kHz or more, quadrants kept",
    )
    effect: Literal["reversal_spike"] = "reversal_spike"  # type: ignore[assignment]

    def nonlinear(self, machine: Machine) -> tuple[Parameter, ...]:
        """`s0`: shorter than that of lost motion; 5-50 ms at usual feeds."""
        del machine
        return (Parameter("s0", "mm", 0.3, 0.005, 100.0, 0.3, TRAVELS_MM),)

    def grows(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Value:
        """Rises to one at `s0`, then fades."""
        part = channels.value(self.the_axis(machine).since_reversal_channel) / theta["s0"]
        return part * np.exp(1.0 - part)


class Stribeck(Reversal):
    """A reversal value that fades with speed: `e = ½ A d exp(-|v|/v_s)`."""

    about: ClassVar[About] = About(
        title="Reversal that fades with the feed (Stribeck)",
        equation="e = ½·A·d·exp(-|v|/v_s)",
        typical="v_s 50-2000 mm/min",
        seen_by=("laser_linear", "ball_bar"),
        source="Stribeck's friction curve",
        confusions=(
            Confusion("servo_lag", "a lag grows with the feed", "four feeds or more"),
            Confusion("backlash", "at one feed it is a reversal value", "four feeds or more"),
        ),
        reveal="both directions at four feeds or more",
    )
    driven_by: ClassVar[tuple[str, ...]] = ("direction", "velocity")
    effect: Literal["stribeck"] = "stribeck"

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`A`: at a creeping feed."""
        del machine
        return (Parameter("A", self.unit, typical=4.0),)

    def nonlinear(self, machine: Machine) -> tuple[Parameter, ...]:
        """`v_s`."""
        del machine
        return (Parameter("v_s", "mm_per_s", 8.0, 0.3, 200.0, 8.0, (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)),)

    def more_channels(self, machine: Machine) -> tuple[str, ...]:
        """The velocity."""
        return (self.the_axis(machine).velocity_channel,)

    def grows(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Value:
        """What is left at this speed."""
        speed = np.abs(channels.value(self.the_axis(machine).velocity_channel))
        return np.exp(-(speed / theta["v_s"]))

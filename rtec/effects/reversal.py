"""Effects of the direction of motion (catalogue A2): play, tipping, and errors that fade after a reversal.

Symbols: `d` last non-zero direction of motion, -1 or +1, 0 before the first motion; `u` position scaled to -1 … +1.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from rtec.effects.base import About, AxisEffect, Confusion, Kind, Parameter, Surroundings
from rtec.effects.geometry import scaled
from rtec.effects.state import Channels, Value
from rtec.effects.thermal import OneSensor
from rtec.machine import Machine


class Backlash(AxisEffect):
    """Reversal value B of ISO 230-2: `e = ½ B d`."""

    about: ClassVar[About] = About(
        title="Backlash, reversal value",
        equation="e = ½·B·d",
        typical="0.5-20 µm; negative where the controller's own table takes away too much",
        seen_by=("laser_linear", "ball_bar", "tool_tip"),
        source="[BB 20], ISO 230-2",
        confusions=(
            Confusion("servo_lag", "at one feed a lag shifts both directions apart", "measure at two feeds"),
            Confusion(
                "angular_reversal",
                "an angle that turns over with the direction, times the arm",
                "repeat at a second offset",
            ),
            Confusion(
                "lost_motion",
                "lost motion fades with the distance after a reversal",
                "steps of growing size after a reversal",
            ),
        ),
        reveal="laser in both directions",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("positioning", "straightness")
    driven_by: ClassVar[tuple[str, ...]] = ("direction",)
    effect: Literal["backlash"] = "backlash"

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`B`: error moving positive minus error moving negative."""
        del machine
        return (Parameter("B", self.unit, typical=4.0),)

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read the direction."""
        return (self.the_axis(machine).direction_channel,)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`½ d`."""
        del theta
        return [channels.value(self.the_axis(machine).direction_channel) * 0.5]


class BacklashPosition(AxisEffect):
    """Reversal that changes along the axis: `e = d (b0 + b1 u + b2 u² …)`."""

    about: ClassVar[About] = About(
        title="Position-dependent backlash (wind-up, wear)",
        equation="e = d·(b0 + b1·u + b2·u²)",
        typical="20-100 % of the backlash",
        seen_by=("laser_linear", "tool_tip"),
        source="[G 3.6]",
        confusions=(
            Confusion(
                "backlash_wear",
                "play that grows with time, when runs go along the axis in order",
                "change the order of the targets",
            ),
            Confusion(
                "backlash_temperature",
                "play that grows with heat, when runs go along the axis in order",
                "change the order of the targets",
            ),
            Confusion("backlash", "the same everywhere", "targets over the whole travel, both directions"),
            Confusion("backlash_zone", "one length of the axis is worn", "targets close to its ends"),
        ),
        reveal="laser in both directions over the whole travel",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("positioning", "straightness")
    driven_by: ClassVar[tuple[str, ...]] = ("direction", "position")
    effect: Literal["backlash_position"] = "backlash_position"
    degree: Annotated[int, Field(ge=0, le=6)] = 2

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`b0` … `b{degree}`."""
        del machine
        return tuple(Parameter(f"b{i}", self.unit, typical=2.0) for i in range(self.degree + 1))

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read position and direction."""
        axis = self.the_axis(machine)
        return (axis.channel, axis.direction_channel)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`d u^i`."""
        del theta
        axis = self.the_axis(machine)
        u = scaled(axis, channels)
        out = [channels.value(axis.direction_channel)]
        for _ in range(self.degree):
            out.append(out[-1] * u)
        return out

    @classmethod
    def arguments(cls, around: Surroundings) -> Iterator[dict[str, Any]]:
        """Degrees for a linear change, a bent one, and one with more bends."""
        for degree in (1, 2, 4):
            yield {"axis": around.moved.name, "degree": degree}


class Reversal(AxisEffect):
    """An effect whose sign changes with the direction: `e = ½ k d · g`, g from `grows`."""

    feeds: ClassVar[tuple[Kind, ...]] = ("positioning",)

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """The direction, and the channels of the factor."""
        return (self.the_axis(machine).direction_channel, *self.more_channels(machine))

    def more_channels(self, machine: Machine) -> tuple[str, ...]:
        """Channels of the factor, without the direction."""
        del machine
        return ()

    def grows(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Value:
        """The factor g of half the direction."""
        del machine, channels, theta
        return 1.0

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`½ d g`."""
        direction = channels.value(self.the_axis(machine).direction_channel)
        return [direction * 0.5 * self.grows(machine, channels, theta)]


ZONES, HALF_WIDTHS, INSIDE, WIDEST = 12, (0.05, 0.1, 0.2), 0.1, 0.25
"""Number of places of a worn length that a search tries, and half of its length, as shares of the travel. Least
distance of its middle from the ends, and its largest half: wider, or at an end, it would be a curve along the axis."""


class BacklashZone(Reversal):
    """Play of a worn length of a screw, a rack or a guide: `e = ½ B d exp(-|(q - q0)/w|^p)`, nothing beside it."""

    about: ClassVar[About] = About(
        title="Backlash of a worn length",
        equation="e = ½·B·d·exp(-|(q - q0)/w|^p), q0 its middle, w half of its length, p how steep its ends are",
        typical="1-10 µm over 50-300 mm, where most work is done",
        seen_by=("laser_linear", "tool_tip"),
        source="worn screws",
        confusions=(
            Confusion("backlash_position", "play that changes smoothly along the axis", "targets close to its ends"),
            Confusion("piecewise_position", "the same in both directions", "dense targets, both directions"),
        ),
        reveal="laser in both directions, with targets close together where the machine works most",
    )
    driven_by: ClassVar[tuple[str, ...]] = ("direction", "position")
    effect: Literal["backlash_zone"] = "backlash_zone"

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`B`: in the middle."""
        del machine
        return (Parameter("B", self.unit, typical=4.0),)

    def nonlinear(self, machine: Machine) -> tuple[Parameter, ...]:
        """`q0` and `w`: middle and half of the length; `p`: 2 for a bell, more for steeper ends."""
        low, high = self.the_axis(machine).travel_mm
        span = high - low
        first, last = low + INSIDE * span, high - INSIDE * span
        middles = tuple(np.linspace(first, last, ZONES).tolist())
        halves = tuple(share * span for share in HALF_WIDTHS)
        return (
            Parameter("q0", "mm", 0.5 * (low + high), first, last, 0.5 * span, middles),
            Parameter("w", "mm", halves[1], 0.8 * halves[0], WIDEST * span, halves[1], halves),
            Parameter("p", "1", 3.0, 2.0, 8.0, 3.0, (3.0,)),
        )

    def more_channels(self, machine: Machine) -> tuple[str, ...]:
        """The position."""
        return (self.the_axis(machine).channel,)

    def grows(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Value:
        """`exp(-|(q - q0)/w|^p)`."""
        off = (channels.value(self.the_axis(machine).channel) - theta["q0"]) / theta["w"]
        return np.exp(-(np.abs(off) ** theta["p"]))


class BacklashWear(Reversal):
    """Play that grows with time: `e = ½ w d t`."""

    about: ClassVar[About] = About(
        title="Backlash that grows with time (wear)",
        equation="e = ½·w·d·t, t in hours",
        typical="0.1-5 µm",
        seen_by=("laser_linear", "tool_tip"),
        source="catalogue A2",
        confusions=(
            Confusion("backlash_temperature", "both grow through a warm-up", "start again cold after a rest"),
            Confusion("backlash_load", "the load was changed in order of time", "vary the load at one temperature"),
            Confusion("backlash_position", "runs went along the axis in order", "another order of the targets"),
        ),
        reveal="laser in both directions, repeated over the hours, cold again at the end",
    )
    driven_by: ClassVar[tuple[str, ...]] = ("direction", "time_s")
    effect: Literal["backlash_wear"] = "backlash_wear"

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`w`, per hour."""
        del machine
        return (Parameter("w", f"{self.unit}_per_h", typical=0.3),)

    def more_channels(self, machine: Machine) -> tuple[str, ...]:
        """The time."""
        del machine
        return ("time_s",)

    def grows(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Value:
        """Hours."""
        del machine, theta
        return channels.value("time_s") * (1.0 / 3600.0)


class BacklashLoad(Reversal):
    """Play that grows with the work piece's weight: `e = ½ k d W`."""

    about: ClassVar[About] = About(
        title="Backlash that grows with the load",
        equation="e = ½·k·d·W, W in 100 kg",
        typical="0.1-5 µm",
        seen_by=("laser_linear", "tool_tip"),
        source="catalogue A2",
        confusions=(
            Confusion("backlash_temperature", "load and heat changed together", "vary the load at one temperature"),
            Confusion("backlash_wear", "the load was changed in order of time", "load, unload, load again"),
        ),
        reveal="laser in both directions with and without load",
    )
    driven_by: ClassVar[tuple[str, ...]] = ("direction", "load_kg")
    effect: Literal["backlash_load"] = "backlash_load"

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`k`, per 100 kg."""
        del machine
        return (Parameter("k", f"{self.unit}_per_100kg", typical=1.0),)

    def more_channels(self, machine: Machine) -> tuple[str, ...]:
        """The load."""
        del machine
        return ("load_kg",)

    def grows(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Value:
        """Load in 100 kg."""
        del machine, theta
        return channels.value("load_kg") * 0.01


class BacklashTemperature(OneSensor, Reversal):
    """Play that grows with heat: `e = ½ k d ΔT`."""

    about: ClassVar[About] = About(
        title="Backlash that changes with temperature",
        equation="e = ½·k·d·ΔT",
        typical="0.1-5 µm over a warm-up",
        seen_by=("laser_linear", "tool_tip"),
        source="catalogue A2",
        confusions=(
            Confusion("backlash_wear", "both grow through a warm-up", "start again cold after a rest"),
            Confusion("backlash_load", "load and heat changed together", "vary the load at one temperature"),
        ),
        reveal="laser in both directions through a warm-up and after a rest",
    )
    driven_by: ClassVar[tuple[str, ...]] = ("direction", "temperature")
    effect: Literal["backlash_temperature"] = "backlash_temperature"

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read the direction and the sensor."""
        return Reversal.channels(self, machine)

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`k`, per kelvin."""
        del machine
        return (Parameter("k", f"{self.unit}_per_degc", typical=0.3),)

    def more_channels(self, machine: Machine) -> tuple[str, ...]:
        """The sensor."""
        del machine
        return (self.sensor,)

    def grows(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Value:
        """Temperature rise, lagged where `lag` is set."""
        del machine
        return self.rise(channels, theta)


class AngularReversal(Reversal):
    """An angle whose sign changes with the direction: `E = ½ θ d`."""

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
    """Pre-sliding lost motion (Dahl): a reversal error that fades with distance, `e = ½ A d exp(-s/s0)`."""

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
        """`exp(-s/s0)`."""
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
        """`exp(-|v|/v_s)`."""
        speed = np.abs(channels.value(self.the_axis(machine).velocity_channel))
        return np.exp(-(speed / theta["v_s"]))

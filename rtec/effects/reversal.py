"""Effects of the direction of motion (catalogue A2).

Symbols: `d` last non-zero direction of motion, -1 or +1, 0 before the first motion; `u` position scaled to -1 … +1.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from rtec.effects.base import About, AxisEffect, Parameter
from rtec.effects.state import Channels, Value
from rtec.machine import Machine


class Backlash(AxisEffect):
    """Reversal value B of ISO 230-2: `e = ½ B d`."""

    about: ClassVar[About] = About(
        title="Backlash, reversal value",
        equation="e = ½·B·d",
        typical="0.5-20 µm",
        seen_by="laser in both directions, ball bar (steps)",
        confused_with="servo lag when measured at one feed (measure at two)",
        source="[BB 20], ISO 230-2",
    )
    effect: Literal["backlash"] = "backlash"

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`B`: error moving positive minus error moving negative."""
        del machine
        return (Parameter("B", self.unit),)

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
        title="Position-dependent backlash (wear zone, wind-up)",
        equation="e = d·(b0 + b1·u + b2·u²)",
        typical="20-100 % of the backlash",
        seen_by="laser in both directions",
        confused_with="wear or load that grows with time, when runs go along the axis in order (change the order)",
        source="[G 3.6]",
    )
    effect: Literal["backlash_position"] = "backlash_position"
    degree: Annotated[int, Field(ge=0, le=6)] = 2

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`b0` … `b{degree}`."""
        del machine
        return tuple(Parameter(f"b{i}", self.unit) for i in range(self.degree + 1))

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read position and direction."""
        axis = self.the_axis(machine)
        return (axis.channel, axis.direction_channel)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`d u^i`."""
        del theta
        axis = self.the_axis(machine)
        low, high = axis.travel_mm
        u = (channels.value(axis.channel) - 0.5 * (low + high)) * (2.0 / (high - low))
        out = [channels.value(axis.direction_channel)]
        for _ in range(self.degree):
            out.append(out[-1] * u)
        return out

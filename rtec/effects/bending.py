"""Parts that bend or tilt by a temperature difference (catalogue A4).

Symbols: `ΔT` temperature above the model's reference, K; `q` position, mm; `L[·]` first-order lag with time
constant τ, `τ L' + L = u`; `n` spindle speed, 1/min. Coefficients are in the component's unit, µm or µrad.
"""

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

from rtec.effects.base import About, AxisEffect, Confusion, Effect, Kind, Parameter, check_sensor
from rtec.effects.geometry import scaled
from rtec.effects.state import Channels, Value
from rtec.machine import Machine


class ColumnTilt(Effect):
    """A temperature difference bends or tilts a part: `e = k (T_front - T_back)`."""

    about: ClassVar[About] = About(
        title="Temperature difference bends a part",
        equation="e = k·(T_front - T_back)",
        typical="5-20 µrad/K",
        seen_by=("spindle_drift", "level", "tool_tip"),
        source="[G 3.6]: temperature differences",
        confusions=(
            Confusion("mount_expansion", "a shift with heat", "two heights"),
            Confusion("axis_expansion", "growth along the axis", "heat one side only"),
            Confusion("bed_bending", "the bed bends by the same heat", "levels on bed and column"),
        ),
        reveal="drift probes at two heights, or a level, while one side is heated",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("axis_angle", "link_angle", "tilt")
    driven_by: ClassVar[tuple[str, ...]] = ("two temperatures",)
    effect: Literal["column_tilt"] = "column_tilt"
    front: str
    back: str

    def check(self, machine: Machine, where: str) -> None:
        """Check component and both sensors."""
        super().check(machine, where)
        check_sensor(machine, self.front, where)
        check_sensor(machine, self.back, where)

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`k`, per kelvin of difference."""
        del machine
        return (Parameter("k", f"{self.unit}_per_degc", typical=2.0),)

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read both sensors."""
        del machine
        return (self.front, self.back)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`T_front - T_back`."""
        del machine, theta
        return [channels.rise(self.front) - channels.rise(self.back)]


class BedBending(ColumnTilt, AxisEffect):
    """A bed that is warmer on one side bends: `e = k (T_front - T_back) u²`."""

    about: ClassVar[About] = About(
        title="Bed bends by a temperature difference",
        equation="e = k·(T_front - T_back)·u², u = position scaled to -1..+1 over the travel",
        typical="1-10 µm/K",
        seen_by=("straightness", "level", "tool_tip"),
        source="catalogue A4",
        confusions=(
            Confusion("straightness", "the part of it that stands still", "repeat hot and cold"),
            Confusion("column_tilt", "an even tilt", "levels along the bed"),
            Confusion("load_deformation", "the load was changed with the heat", "load at one temperature"),
        ),
        reveal="straightness repeated hot and cold",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("straightness",)
    driven_by: ClassVar[tuple[str, ...]] = ("position", "two temperatures")
    effect: Literal["bed_bending"] = "bed_bending"  # type: ignore[assignment]

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read the position and both sensors."""
        return (self.the_axis(machine).channel, self.front, self.back)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`(T_front - T_back) u²`."""
        del theta
        u = scaled(self.the_axis(machine), channels)
        return [(channels.rise(self.front) - channels.rise(self.back)) * u * u]

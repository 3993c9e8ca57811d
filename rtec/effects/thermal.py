"""Thermal effects along an axis, and what effects of one temperature share (catalogue A4).

Symbols: `ΔT` temperature above the model's reference, K; `q` position, mm; `L[·]` first-order lag with time
constant τ, `τ L' + L = u`; `n` spindle speed, 1/min. Coefficients are in the component's unit, µm or µrad.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Literal

from rtec.effects.base import About, AxisEffect, Confusion, Effect, Kind, Parameter, Surroundings, check_sensor
from rtec.effects.geometry import scaled
from rtec.effects.state import Channels, Value
from rtec.machine import Machine

LAGS_S = (300.0, 600.0, 1200.0, 2400.0, 4800.0, 9600.0)
TAU = Parameter("tau", "s", 1800.0, 10.0, 40000.0, 1800.0, LAGS_S)
SLOW = Parameter("tau", "s", 7200.0, 10.0, 40000.0, 7200.0, (1200.0, 2400.0, 4800.0, 9600.0, 19200.0))


def named(sensors: Sequence[str], *words: str) -> list[str]:
    """Sensors with one of the words in their names; all where none has."""
    found = [s for s in sensors if any(w in s.lower() for w in words)]
    return found or list(sensors)


class OneSensor(Effect):
    """An effect of one temperature, as read or (`lag = true`) through a first-order lag."""

    sensor: str
    lag: bool = False

    def check(self, machine: Machine, where: str) -> None:
        """Check component and sensor."""
        super().check(machine, where)
        check_sensor(machine, self.sensor, where)

    def nonlinear(self, machine: Machine) -> tuple[Parameter, ...]:
        """`tau` where the temperature is lagged."""
        del machine
        return (TAU,) if self.lag else ()

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read the sensor."""
        del machine
        return (self.sensor,)

    def rise(self, channels: Channels, theta: Mapping[str, Value]) -> Value:
        """Temperature rise, lagged where asked for."""
        rise = channels.rise(self.sensor)
        return channels.lagged(rise, theta["tau"]) if self.lag else rise


class AxisExpansion(OneSensor, AxisEffect):
    """Expansion of a screw or scale: `e = k (q - q_fix) ΔT`."""

    about: ClassVar[About] = About(
        title="Expansion of screw or scale",
        equation="e = k·(q - q_fix)·ΔT",
        typical="11-12 µm/m/K for screws, 8 for glass scales; 5-60 µm",
        seen_by=("laser_linear", "tool_tip"),
        source="[G 3.6]",
        confusions=(
            Confusion(
                "mount_expansion",
                "the shift at the fixed end",
                "heat the screw only: jog the axis with the spindle off",
            ),
            Confusion("scale", "the part of it that stands still", "repeat cold and hot"),
            Confusion("column_tilt", "an angle that grows with heat, times the arm", "repeat at a second offset"),
            Confusion(
                "axis_expansion_nonuniform", "the screw is not equally warm all along", "two centres of a short stroke"
            ),
        ),
        reveal="laser repeated during a warm-up; for screw or scale once jogging, once at rest while the room swings",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("positioning",)
    driven_by: ClassVar[tuple[str, ...]] = ("position", "temperature")
    effect: Literal["axis_expansion"] = "axis_expansion"
    fixed_mm: float = 0.0

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read position and sensor."""
        return (self.the_axis(machine).channel, self.sensor)

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`k`, per metre and kelvin."""
        del machine
        return (Parameter("k", f"{self.unit}_per_m_degc", typical=10.0),)

    @classmethod
    def arguments(cls, around: Surroundings) -> Iterator[dict[str, Any]]:
        """Every sensor; fixed at zero, and at the ends and the middle of the travel where those are others."""
        low, high = around.moved.travel_mm
        for sensor, fixed in itertools.product(around.sensors, dict.fromkeys((0.0, low, 0.5 * (low + high), high))):
            yield {"axis": around.moved.name, "sensor": sensor, "fixed_mm": fixed}

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`(q - q_fix)` in m times `ΔT`."""
        arm = (channels.value(self.the_axis(machine).channel) - self.fixed_mm) * 1e-3
        return [arm * self.rise(channels, theta)]


class AxisExpansionNonuniform(OneSensor, AxisEffect):
    """Uneven heating along an axis: `e = k u² ΔT`, `u` position scaled to -1 … +1 over the travel."""

    about: ClassVar[About] = About(
        title="Non-uniform heating along an axis",
        equation="e = k·u²·ΔT",
        typical="1-10 µm",
        seen_by=("laser_linear", "tool_tip"),
        source="[G 3.6]: temperature × position products",
        confusions=(
            Confusion("polynomial_position", "the part of it that stands still", "repeat cold and hot"),
            Confusion("axis_expansion", "even heating", "jog a short stroke about two centres"),
        ),
        reveal="laser after jogging a short stroke",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("positioning",)
    driven_by: ClassVar[tuple[str, ...]] = ("position", "temperature")
    effect: Literal["axis_expansion_nonuniform"] = "axis_expansion_nonuniform"

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read position and sensor."""
        return (self.the_axis(machine).channel, self.sensor)

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`k`, per kelvin at the ends of the travel."""
        del machine
        return (Parameter("k", f"{self.unit}_per_degc", typical=2.0),)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`u² ΔT`."""
        u = scaled(self.the_axis(machine), channels)
        return [u * u * self.rise(channels, theta)]

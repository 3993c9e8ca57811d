"""Thermal effects (catalogue A4).

Symbols: `ΔT` temperature above the model's reference, K; `q` position, mm; `L[·]` first-order lag with time
constant τ, `τ L' + L = u`; `n` spindle speed, 1/min. Coefficients are in the component's unit, µm or µrad.
"""

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

import numpy as np

from rtec.effects.base import About, AxisEffect, Effect, Parameter, check_sensor
from rtec.effects.state import Channels, Value
from rtec.errors import ModelError
from rtec.machine import Machine

TAU = Parameter("tau", "s", 1800.0, 10.0, 40000.0)


class _OneSensor(Effect):
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


class AxisExpansion(_OneSensor, AxisEffect):
    """Expansion of a screw or scale: `e = k (q - q_fix) ΔT`."""

    about: ClassVar[About] = About(
        title="Expansion of screw or scale",
        equation="e = k·(q - q_fix)·ΔT",
        typical="11-12 µm/m/K for screws, 8 for glass scales; 5-60 µm",
        seen_by="laser repeated during warm-up",
        confused_with="other sensors that warm together (jog the axis with the spindle off)",
        source="[G 3.6]",
    )
    effect: Literal["axis_expansion"] = "axis_expansion"
    fixed_mm: float = 0.0

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read position and sensor."""
        return (self.the_axis(machine).channel, self.sensor)

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`k`, per metre and kelvin."""
        del machine
        return (Parameter("k", f"{self.unit}_per_m_degc"),)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`(q - q_fix)` in m times `ΔT`."""
        arm = (channels.value(self.the_axis(machine).channel) - self.fixed_mm) * 1e-3
        return [arm * self.rise(channels, theta)]


class AxisExpansionNonuniform(_OneSensor, AxisEffect):
    """Uneven heating along an axis: `e = k u² ΔT`, `u` position scaled to -1 … +1 over the travel."""

    about: ClassVar[About] = About(
        title="Non-uniform heating along an axis",
        equation="e = k·u²·ΔT",
        typical="1-10 µm",
        seen_by="laser after short-stroke jogging",
        confused_with="polynomial in position (two stroke centres)",
        source="[G 3.6]: temperature × position products",
    )
    effect: Literal["axis_expansion_nonuniform"] = "axis_expansion_nonuniform"

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read position and sensor."""
        return (self.the_axis(machine).channel, self.sensor)

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`k`, per kelvin at the ends of the travel."""
        del machine
        return (Parameter("k", f"{self.unit}_per_degc"),)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`u² ΔT`."""
        axis = self.the_axis(machine)
        low, high = axis.travel_mm
        u = (channels.value(axis.channel) - 0.5 * (low + high)) * (2.0 / (high - low))
        return [u * u * self.rise(channels, theta)]


class MountExpansion(_OneSensor):
    """A part between mounting and measuring point grows: `e = k ΔT`."""

    about: ClassVar[About] = About(
        title="Temperature term: expansion of a mounting",
        equation="e = k·ΔT",
        typical="1-20 µm",
        seen_by="spindle drift probes, zero drift of the laser",
        confused_with="spindle growth, column tilt (re-zero at the reference point; heat one part)",
        source="[G 3.6]",
    )
    effect: Literal["mount_expansion"] = "mount_expansion"

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`k`, per kelvin."""
        del machine
        return (Parameter("k", f"{self.unit}_per_degc"),)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`ΔT`."""
        del machine
        return [self.rise(channels, theta)]


class AmbientDrift(MountExpansion):
    """Drift with the environment through the machine's own slowness: `e = k L[ΔT_amb]`."""

    about: ClassVar[About] = About(
        title="Drift with the environment",
        equation="e = k·L[ΔT], τ L' + L = ΔT",
        typical="1-10 µm/K, τ 0.5-8 h",
        seen_by="drift probes, spindle off, 24 h",
        confused_with="time of day (open a door, pulse a heater)",
        source="ISO 230-3 (ETVE)",
    )
    effect: Literal["ambient_drift"] = "ambient_drift"  # type: ignore[assignment]
    lag: Literal[True] = True


class ColumnTilt(Effect):
    """A temperature difference bends or tilts a part: `e = k (T_front - T_back)`."""

    about: ClassVar[About] = About(
        title="Temperature difference bends a part",
        equation="e = k·(T_front - T_back)",
        typical="5-20 µrad/K",
        seen_by="drift probes (radial), electronic level",
        confused_with="mount expansion, scale expansion (heat one side; measure at two heights)",
        source="[G 3.6]: temperature differences",
    )
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
        return (Parameter("k", f"{self.unit}_per_degc"),)

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read both sensors."""
        del machine
        return (self.front, self.back)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`T_front - T_back`."""
        del machine, theta
        return [channels.rise(self.front) - channels.rise(self.back)]


class SpindleGrowth(Effect):
    """Spindle growth: with a sensor `e = k ΔT` (lagged if asked), without one `e = k L[(n/1000)^p]`."""

    about: ClassVar[About] = About(
        title="Spindle growth",
        equation="e = k·ΔT, or from the speed τ g' + g = k·(n/1000)^p",
        typical="10-60 µm, τ 5-60 min, 8-10 h to settle",
        seen_by="axial drift probe, a reading every 10 min",
        confused_with="temperature and speed forms follow each other (speed steps up and down with rests)",
        source="[G 3.5], ISO 230-3",
    )
    effect: Literal["spindle_growth"] = "spindle_growth"
    sensor: str | None = None
    lag: bool = False

    def check(self, machine: Machine, where: str) -> None:
        """Check component and sensor."""
        super().check(machine, where)
        if self.sensor is not None:
            check_sensor(machine, self.sensor, where)
        elif self.lag:
            raise ModelError(f"{where}: lag is for the form with a sensor; the form from the speed always lags")

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`k`, per kelvin or per (1000/min)^p."""
        del machine
        return (Parameter("k", f"{self.unit}_per_degc" if self.sensor else f"{self.unit}_per_krpm_to_p"),)

    def nonlinear(self, machine: Machine) -> tuple[Parameter, ...]:
        """`tau` where lagged; `p` for the form from the speed."""
        del machine
        if self.sensor is not None:
            return (TAU,) if self.lag else ()
        return (TAU, Parameter("p", "1", 1.0, 0.3, 3.0))

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read the sensor, or the speed."""
        del machine
        return (self.sensor,) if self.sensor is not None else ("spindle_rpm",)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`ΔT`, its lag, or the lag of the heat that the speed makes."""
        del machine
        if self.sensor is None:
            heat = (np.abs(channels.value("spindle_rpm")) * 1e-3) ** theta["p"]
            return [channels.lagged(heat, theta["tau"])]
        rise = channels.rise(self.sensor)
        return [channels.lagged(rise, theta["tau"]) if self.lag else rise]


class SpindleTilt(SpindleGrowth):
    """Spindle or head tilts with its temperature: as spindle growth, for an angle."""

    about: ClassVar[About] = About(
        title="Spindle or head tilt",
        equation="e = k·ΔT, or from the speed; an angle, times the tool's length at the tip",
        typical="to 50 µrad",
        seen_by="two radial drift probes",
        confused_with="spindle growth, tool length (two arbor lengths)",
        source="[G 3.5], ISO 230-3",
    )
    effect: Literal["spindle_tilt"] = "spindle_tilt"  # type: ignore[assignment]

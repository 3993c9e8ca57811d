"""Thermal effects (catalogue A4).

Symbols: `ΔT` temperature above the model's reference, K; `q` position, mm; `L[·]` first-order lag with time
constant τ, `τ L' + L = u`; `n` spindle speed, 1/min. Coefficients are in the component's unit, µm or µrad.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Literal

import numpy as np

from rtec.effects.base import (
    About,
    AxisEffect,
    Confusion,
    Effect,
    Kind,
    Parameter,
    Surroundings,
    check_sensor,
    component_kind,
)
from rtec.effects.state import Channels, Value
from rtec.errors import ModelError
from rtec.machine import Machine

LAGS_S = (300.0, 600.0, 1200.0, 2400.0, 4800.0, 9600.0)
TAU = Parameter("tau", "s", 1800.0, 10.0, 40000.0, 1800.0, LAGS_S)
SLOW = Parameter("tau", "s", 7200.0, 10.0, 40000.0, 7200.0, (1200.0, 2400.0, 4800.0, 9600.0, 19200.0))


def named(sensors: Sequence[str], *words: str) -> list[str]:
    """Sensors with one of the words in their names; all where none has."""
    found = [s for s in sensors if any(w in s.lower() for w in words)]
    return found or list(sensors)


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
        reveal="laser repeated during a warm-up",
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


class AxisExpansionNonuniform(_OneSensor, AxisEffect):
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
        seen_by=("spindle_drift", "tool_tip"),
        source="[G 3.6]",
        confusions=(
            Confusion(
                "spindle_growth", "the spindle grows with the same heat", "touch a reference point again; heat one part"
            ),
            Confusion("column_tilt", "a tilt, times the arm", "two heights"),
            Confusion("ambient_drift", "the room warms everything", "change the room with the machine at rest"),
        ),
        reveal="drift probes, or the zero of a laser left in place",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("positioning", "straightness", "link")
    driven_by: ClassVar[tuple[str, ...]] = ("temperature",)
    effect: Literal["mount_expansion"] = "mount_expansion"

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`k`, per kelvin."""
        del machine
        return (Parameter("k", f"{self.unit}_per_degc", typical=2.0),)

    @classmethod
    def arguments(cls, around: Surroundings) -> Iterator[dict[str, Any]]:
        """Every sensor but those whose growth has its own name: the coolant's, and along the spindle the spindle's."""
        kind = component_kind(around.component, around.machine)
        taken = set(_in_coolant(around)) if kind in CoolantExpansion.feeds else set()
        if kind == "link" and around.component[1] == "Z":
            own = set(named(around.sensors, "spindle"))
            taken |= own if len(own) < len(around.sensors) else set()
        for sensor in around.sensors:
            if sensor not in taken:
                yield {"sensor": sensor}

    @classmethod
    def missing(cls, around: Surroundings) -> str:
        """Needs a temperature that has no effect of its own name."""
        reason = super().missing(around)
        if reason or component_kind(around.component, around.machine) not in cls.feeds:
            return reason
        return "" if any(cls.arguments(around)) else "no temperature varies but the spindle's or the coolant's"

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
        seen_by=("spindle_drift", "level", "tool_tip"),
        source="ISO 230-3 (ETVE)",
        confusions=(
            Confusion("daily_drift", "the sun and the hour of the day", "open a door or pulse a heater"),
            Confusion("mount_expansion", "a part that follows the air at once", "a step of the room temperature"),
            Confusion("instrument_drift", "the probe itself warms", "cap the probe"),
        ),
        reveal="drift probes with the spindle off, 24 hours",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("positioning", "link", "link_angle", "tilt")
    driven_by: ClassVar[tuple[str, ...]] = ("temperature",)
    effect: Literal["ambient_drift"] = "ambient_drift"  # type: ignore[assignment]
    lag: Literal[True] = True

    def nonlinear(self, machine: Machine) -> tuple[Parameter, ...]:
        """`tau`."""
        del machine
        return (SLOW,)

    @classmethod
    def arguments(cls, around: Surroundings) -> Iterator[dict[str, Any]]:
        """Sensors of the air; all where none is named so."""
        for sensor in named(around.sensors, "air", "amb", "room"):
            yield {"sensor": sensor}


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


class SpindleGrowth(Effect):
    """Spindle growth: with a sensor `e = k ΔT` (lagged if asked), without one `e = k L[(n/1000)^p]`."""

    about: ClassVar[About] = About(
        title="Spindle growth",
        equation="e = k·ΔT, or from the speed τ g' + g = k·(n/1000)^p",
        typical="10-60 µm, τ 5-60 min, 8-10 h to settle",
        seen_by=("spindle_drift", "tool_tip"),
        source="[G 3.5], ISO 230-3",
        confusions=(
            Confusion(
                "spindle_speed_shift",
                "what comes at once with the speed",
                "the first ten seconds after a step of the speed",
            ),
            Confusion("mount_expansion", "the headstock warms with the spindle", "speed steps up and down with rests"),
            Confusion("ambient_drift", "the room warms over the same hours", "leave the spindle off for a day"),
        ),
        reveal="axial drift probe, speed steps up and down with rests",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("link",)
    driven_by: ClassVar[tuple[str, ...]] = ()
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
        unit = f"{self.unit}_per_degc" if self.sensor else f"{self.unit}_per_krpm_to_p"
        return (Parameter("k", unit, typical=3.0),)

    def nonlinear(self, machine: Machine) -> tuple[Parameter, ...]:
        """`tau` where lagged; `p` for the form from the speed."""
        del machine
        if self.sensor is not None:
            return (TAU,) if self.lag else ()
        return (TAU, Parameter("p", "1", 1.0, 0.3, 3.0, 1.0, (0.7, 1.0, 1.5, 2.0)))

    @classmethod
    def missing(cls, around: Surroundings) -> str:
        """Needs either the speed or a temperature; across the spindle the speed."""
        fed = component_kind(around.component, around.machine) in cls.feeds
        if not fed or "spindle_rpm" in around.channels or (around.sensors and cls._by_sensor(around)):
            return ""
        return (
            "neither the spindle speed nor a temperature varies"
            if cls._by_sensor(around)
            else ("the spindle speed never changes, or was not recorded")
        )

    @classmethod
    def _by_sensor(cls, around: Surroundings) -> bool:
        """Whether a temperature of the spindle's is its growth: along its axis, and for angles."""
        return around.component[1] == "Z" or cls.feeds != ("link",)

    @classmethod
    def arguments(cls, around: Surroundings) -> Iterator[dict[str, Any]]:
        """From the speed, and from the spindle's own sensors (all where none is named so)."""
        if "spindle_rpm" in around.channels:
            yield {}
        own = named(around.sensors, "spindle") if cls._by_sensor(around) else []
        for sensor in own:
            yield {"sensor": sensor}
            yield {"sensor": sensor, "lag": True}

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
        seen_by=("spindle_drift", "level"),
        source="[G 3.5], ISO 230-3",
        confusions=(
            Confusion("spindle_growth", "seen by one radial probe only", "two radial probes apart along the arbor"),
            Confusion("mount_expansion", "a shift with the same heat", "two arbor lengths"),
            Confusion("column_tilt", "the column tilts, not the spindle", "a level on the column"),
        ),
        reveal="two radial drift probes apart along the arbor",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("link_angle",)
    driven_by: ClassVar[tuple[str, ...]] = ()
    effect: Literal["spindle_tilt"] = "spindle_tilt"  # type: ignore[assignment]


class SpindleSpeedShift(Effect):
    """What comes at once with the speed: centrifugal growth, preload of the bearings; `e = c (n/1000)²`."""

    about: ClassVar[About] = About(
        title="Shift at once with the spindle speed",
        equation="e = c·(n/1000)²",
        typical="1-15 µm",
        seen_by=("spindle_drift",),
        source="ISO 230-3",
        confusions=(
            Confusion("spindle_growth", "growth follows the speed slowly", "the first ten seconds after a step"),
            Confusion("mount_expansion", "heat follows the speed", "short bursts of speed with the machine warm"),
        ),
        reveal="axial drift probe read every second after a step of the speed",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("link", "link_angle")
    driven_by: ClassVar[tuple[str, ...]] = ("spindle_rpm",)
    effect: Literal["spindle_speed_shift"] = "spindle_speed_shift"

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`c`, at 1000 1/min."""
        del machine
        return (Parameter("c", f"{self.unit}_per_krpm2", typical=0.5),)

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read the speed."""
        del machine
        return ("spindle_rpm",)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`(n/1000)²`."""
        del machine, theta
        krpm = channels.value("spindle_rpm") * 1e-3
        return [krpm * krpm]


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
        axis = self.the_axis(machine)
        low, high = axis.travel_mm
        u = (channels.value(axis.channel) - 0.5 * (low + high)) * (2.0 / (high - low))
        return [(channels.rise(self.front) - channels.rise(self.back)) * u * u]


class CoolantExpansion(MountExpansion):
    """Coolant warms work piece, tool and fixture: `e = k ΔT_coolant`."""

    about: ClassVar[About] = About(
        title="Expansion by the coolant (work piece, tool)",
        equation="e = k·ΔT_coolant",
        typical="1-30 µm",
        seen_by=("tool_tip", "work_piece", "spindle_drift"),
        source="catalogue A4",
        confusions=(
            Confusion("mount_expansion", "the machine warms with the coolant", "coolant on and off in a steady room"),
            Confusion("ambient_drift", "the room warms with the coolant", "coolant on and off in a steady room"),
        ),
        reveal="probe a part with the coolant on and off",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("link", "positioning")
    effect: Literal["coolant_expansion"] = "coolant_expansion"  # type: ignore[assignment]

    @classmethod
    def missing(cls, around: Surroundings) -> str:
        """Needs a sensor in the coolant."""
        if component_kind(around.component, around.machine) not in cls.feeds or _in_coolant(around):
            return ""
        return "no sensor of the coolant varies (one with 'cool' in its name)"

    @classmethod
    def arguments(cls, around: Surroundings) -> Iterator[dict[str, Any]]:
        """Sensors in the coolant."""
        for sensor in _in_coolant(around):
            yield {"sensor": sensor}


def _in_coolant(around: Surroundings) -> list[str]:
    return [s for s in around.sensors if "cool" in s.lower()]

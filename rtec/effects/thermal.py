"""Thermal effects (catalogue A4): along an axis, bending by a difference, shifts of the structure.

Symbols: `ΔT` temperature above the model's reference, K; `q` position, mm; `L[·]` first-order lag with time constant
τ, `τ L' + L = u`; `n` spindle speed, 1/min. Coefficients are in the component's unit, µm or µrad.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import SerializerFunctionWrapHandler, model_serializer

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
    of_one_part,
)
from rtec.effects.geometry import scaled
from rtec.effects.state import Channels, Value
from rtec.machine import Machine
from rtec.quantities import Millimetres

LAGS_S = (300.0, 600.0, 1200.0, 2400.0, 4800.0, 9600.0)
TAU = Parameter("tau", "s", 1800.0, 10.0, 40000.0, 1800.0, LAGS_S)
SLACK = Parameter("T0", "degC", 24.0, -20.0, 80.0, 24.0)
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
        """Temperature rise, K; lagged where `lag` is set."""
        rise = channels.rise(self.sensor)
        return channels.lagged(rise, theta["tau"]) if self.lag else rise


STRETCHED_K = 2.0
"""A sensor that changes by less shows no temperature at which a screw gets slack."""
PART_OF_RANGE = 0.15
"""That temperature lies at least this share of the range away from either end: near an end nobody sees it."""


class AxisExpansion(OneSensor, AxisEffect):
    """Expansion of a screw or scale: `e = k (q - q_fix) ΔT`; of an angle a guideway that bends as it warms up.

    A guideway of two materials, or bolted to another, bends by its own temperature: its slide tilts along the travel.
    A screw that was stretched at assembly takes up its expansion until it is slack, at `T0` °C, and grows from there on
    (`stretched = true`).
    """

    about: ClassVar[About] = About(
        title="Expansion of screw or scale",
        equation="e = k·(q - q_fix)·ΔT; with stretched = true k·(q - q_fix)·max(0, T - T0)",
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
    feeds: ClassVar[tuple[Kind, ...]] = ("positioning", "tilt")
    driven_by: ClassVar[tuple[str, ...]] = ("position", "temperature")
    effect: Literal["axis_expansion"] = "axis_expansion"
    fixed_mm: Millimetres = 0.0
    stretched: bool = False

    @model_serializer(mode="wrap")
    def _as_before(self, serialized: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without `stretched` where it is false: models from before it keep their hash."""
        return {k: v for k, v in serialized(self).items() if k != "stretched" or v}

    def nonlinear(self, machine: Machine) -> tuple[Parameter, ...]:
        """`tau` where the temperature is lagged; `T0` where the screw is stretched."""
        return (*super().nonlinear(machine), *((SLACK,) if self.stretched else ()))

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read position and sensor."""
        return (self.the_axis(machine).channel, self.sensor)

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`k`, per metre and kelvin."""
        del machine
        return (Parameter("k", f"{self.unit}_per_m_degc", typical=10.0),)

    @classmethod
    def suggest(cls, around: Surroundings) -> Iterator[Effect]:
        """Of an angle only as read, from zero."""
        if component_kind(around.component, around.machine) == "positioning":
            yield from super().suggest(around)
        else:
            for effect in super().suggest(around):
                if isinstance(effect, cls) and effect.fixed_mm == 0.0 and not effect.lag and not effect.stretched:
                    yield effect

    @classmethod
    def arguments(cls, around: Surroundings) -> Iterator[dict[str, Any]]:
        """Every sensor, as read and lagged, with the fixed point at zero and at the ends and the middle of the travel.

        A sensor on the nut or in the coolant warms up before the screw does. A stretched screw grows from a bearing.
        """
        low, high = around.moved.travel_mm
        feet = dict.fromkeys((0.0, low, 0.5 * (low + high), high))
        for lag, sensor, fixed in itertools.product((False, True), around.sensors, feet):
            yield {"axis": around.moved.name, "sensor": sensor, "fixed_mm": fixed, "lag": lag}
        for sensor in around.sensors:
            low_degc, high_degc = around.channels[sensor]
            for fixed in dict.fromkeys((0.0, low, high)) if high_degc - low_degc >= STRETCHED_K else ():
                yield {"axis": around.moved.name, "sensor": sensor, "fixed_mm": fixed, "stretched": True}

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`(q - q_fix)` in m times `ΔT`, or times the rise above `T0`."""
        arm = (channels.value(self.the_axis(machine).channel) - self.fixed_mm) * 1e-3
        if not self.stretched:
            return [arm * self.rise(channels, theta)]
        degc = channels.value(self.sensor)
        return [arm * np.maximum(0.0, (channels.lagged(degc, theta["tau"]) if self.lag else degc) - theta["T0"])]


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


class ColumnTilt(Effect):
    """A temperature difference bends or tilts a part: `e = k (T_front - T_back)`, as read or lagged."""

    about: ClassVar[About] = About(
        title="Temperature difference bends a part",
        equation="e = k·(T_front - T_back), or k·L[T_front - T_back] with lag = true",
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
    lag: bool = False

    @model_serializer(mode="wrap")
    def _as_before(self, serialized: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without `lag` where it is false: models from before it keep their hash."""
        return {k: v for k, v in serialized(self).items() if k != "lag" or v}

    @classmethod
    def arguments(cls, around: Surroundings) -> Iterator[dict[str, Any]]:
        """Every pair of sensors that vary, and pairs on one part, by their names, of which one side stays as it is.

        Also lagged where both are on one part, or where no names are so: the middle of a thick wall warms up after both
        of its sides.
        """
        pairs = list(super().arguments(around))
        yield from pairs
        same = [p for p in pairs if of_one_part(p["front"], p["back"])]
        yield from ({**pair, "lag": True} for pair in same or pairs)

    @classmethod
    def suggest(cls, around: Surroundings) -> Iterator[Effect]:
        """Also the roll of an axis at rest: a column that travels along X and leans back turns about X."""
        rolls = around.axis is None and component_kind(around.component, around.machine) == "roll"
        if not rolls or "axis" in cls.model_fields:
            yield from super().suggest(around)
            return
        for sensors in cls.arguments(around):
            yield cls.model_validate({"effect": "column_tilt", "component": around.component, **sensors})

    def check(self, machine: Machine, where: str) -> None:
        """Check component and both sensors."""
        super().check(machine, where)
        check_sensor(machine, self.front, where)
        check_sensor(machine, self.back, where)

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`k`, per kelvin of difference."""
        del machine
        return (Parameter("k", f"{self.unit}_per_degc", typical=2.0),)

    def nonlinear(self, machine: Machine) -> tuple[Parameter, ...]:
        """`tau` where the difference is lagged."""
        del machine
        return (TAU,) if self.lag else ()

    def difference(self, channels: Channels, theta: Mapping[str, Value]) -> Value:
        """Temperature difference, K; lagged where `lag` is set."""
        difference = channels.rise(self.front) - channels.rise(self.back)
        return channels.lagged(difference, theta["tau"]) if self.lag else difference

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read both sensors."""
        del machine
        return (self.front, self.back)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`T_front - T_back`."""
        del machine
        return [self.difference(channels, theta)]


class BedBending(ColumnTilt, AxisEffect):
    """A bed that is warmer on one side bends: `e = k (T_front - T_back) u²`, and its slope along the bed.

    A slide on the bent bed shifts by the bow and turns by its slope: an angle is `e = k_a (T_front - T_back) u`. One
    bend has `k_a = ± 2000 k / h`, with `k` in µm/K, `h` half the travel in mm, and `k_a` in µrad/K at its ends. Of a
    slide that carries the tool the sign is + for the pairs `EYX, ECX`, `EZY, EAY` and `EXZ, EBZ`, and - for `EZX, EBX`,
    `EXY, ECY` and `EYZ, EAZ`. Of one that carries the work piece it is the opposite, for it moves the other way.
    """

    about: ClassVar[About] = About(
        title="Bed bends by a temperature difference",
        equation="e = k·(T_front - T_back)·u², an angle e = k·(T_front - T_back)·u, u = position scaled to -1..+1 over "
        "the travel",
        typical="1-10 µm/K; 2-20 µrad/K at the ends of the travel",
        seen_by=("straightness", "laser_angular", "level", "tool_tip"),
        source="catalogue A4; an angle: the slope of the bow",
        confusions=(
            Confusion("straightness", "the part of it that stands still", "repeat hot and cold"),
            Confusion("angular_motion", "the angle that stands still", "repeat hot and cold"),
            Confusion("column_tilt", "an even tilt", "levels along the bed"),
            Confusion("load_deformation", "the load was changed with the heat", "load at one temperature"),
        ),
        reveal="straightness, or a level along the bed, repeated hot and cold",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("straightness", "tilt")
    driven_by: ClassVar[tuple[str, ...]] = ("position", "two temperatures")
    effect: Literal["bed_bending"] = "bed_bending"  # type: ignore[assignment]

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read the position and both sensors."""
        return (self.the_axis(machine).channel, self.front, self.back)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`(T_front - T_back) u²`; of an angle `(T_front - T_back) u`."""
        u = scaled(self.the_axis(machine), channels)
        return [self.difference(channels, theta) * u * (1.0 if self.unit == "urad" else u)]


class MountExpansion(OneSensor):
    """A part between mounting and measuring point grows, or turns: `e = k ΔT`."""

    about: ClassVar[About] = About(
        title="Temperature term: expansion or tilt of a mounting",
        equation="e = k·ΔT",
        typical="1-20 µm, 1-10 µrad/K",
        seen_by=("spindle_drift", "level", "tool_tip"),
        source="[G 3.6]",
        confusions=(
            Confusion(
                "spindle_growth", "the spindle grows with the same heat", "touch a reference point again; heat one part"
            ),
            Confusion("column_tilt", "a tilt, times the arm", "two heights"),
            Confusion("ambient_drift", "the room warms everything", "change the room with the machine at rest"),
        ),
        reveal="drift probes, or the zero of a laser left in place; for a tilt a level, or probes at two heights",
    )
    feeds: ClassVar[tuple[Kind, ...]] = (
        "positioning",
        "straightness",
        "link",
        "tilt",
        "roll",
        "axis_angle",
        "link_angle",
    )
    driven_by: ClassVar[tuple[str, ...]] = ("temperature",)
    effect: Literal["mount_expansion"] = "mount_expansion"

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`k`, per kelvin."""
        del machine
        return (Parameter("k", f"{self.unit}_per_degc", typical=2.0),)

    @classmethod
    def arguments(cls, around: Surroundings) -> Iterator[dict[str, Any]]:
        """Every sensor without an effect of its own: not the coolant's, nor the spindle's along it and for its tilt.

        Each also delayed, for a body that warms up after its sensor; of the air, `ambient_drift` is that.
        """
        kind = component_kind(around.component, around.machine)
        taken = set(_in_coolant(around)) if kind in CoolantExpansion.feeds else set()
        if kind == "link_angle" or (kind == "link" and around.component[1] == "Z"):
            own = set(named(around.sensors, "spindle"))
            taken |= own if len(own) < len(around.sensors) else set()
        left = [s for s in around.sensors if s not in taken]
        yield from ({"sensor": sensor} for sensor in left)
        if kind != "straightness":
            air = named(around.sensors, "air", "amb", "room")
            yield from ({"sensor": sensor, "lag": True} for sensor in left if sensor not in air)

    @classmethod
    def missing(cls, around: Surroundings) -> str:
        """Needs a temperature without an effect of its own."""
        reason = super().missing(around)
        if reason or component_kind(around.component, around.machine) not in cls.feeds:
            return reason
        return "" if any(cls.arguments(around)) else "no temperature varies but the spindle's or the coolant's"

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`ΔT`."""
        del machine
        return [self.rise(channels, theta)]


class AmbientDrift(MountExpansion):
    """Drift that follows the temperature of the air with the machine's time constant: `e = k L[ΔT_amb]`."""

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
        """Sensors that are named after the air; all where there is none."""
        for sensor in named(around.sensors, "air", "amb", "room"):
            yield {"sensor": sensor}


class CoolantExpansion(MountExpansion):
    """Coolant heats work piece, tool and fixture: `e = k ΔT_coolant`."""

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
        """Sensors in the coolant; each also delayed, for a body that warms up after it."""
        for lag, sensor in itertools.product((False, True), _in_coolant(around)):
            yield {"sensor": sensor, "lag": lag}


def _in_coolant(around: Surroundings) -> list[str]:
    return [s for s in around.sensors if "cool" in s.lower()]

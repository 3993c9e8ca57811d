"""Thermal shifts of whatever carries tool and work piece (catalogue A4).

Symbols: `ΔT` temperature above the model's reference, K; `q` position, mm; `L[·]` first-order lag with time
constant τ, `τ L' + L = u`; `n` spindle speed, 1/min. Coefficients are in the component's unit, µm or µrad.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Literal

from rtec.effects.base import About, Confusion, Kind, Parameter, Surroundings, component_kind
from rtec.effects.state import Channels, Value
from rtec.effects.thermal import SLOW, OneSensor, named
from rtec.machine import Machine


class MountExpansion(OneSensor):
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

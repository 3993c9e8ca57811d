"""Effects of the spindle: heat and speed (catalogue A4).

Symbols: `ΔT` temperature above the model's reference, K; `q` position, mm; `L[·]` first-order lag with time
constant τ, `τ L' + L = u`; `n` spindle speed, 1/min. Coefficients are in the component's unit, µm or µrad.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Literal

import numpy as np

from rtec.effects.base import About, Confusion, Effect, Kind, Parameter, Surroundings, check_sensor, component_kind
from rtec.effects.state import Channels, Value
from rtec.effects.thermal import TAU, named
from rtec.errors import ModelError
from rtec.machine import Machine

NO_SPINDLE = "it is no part of the spindle"
OTHER_BODIES = ("table", "bed", "base", "column", "granite", "frame", "pallet", "fixture")
"""Words in the names of links that are no spindle."""


def of_spindle(machine: Machine, component: str, runs: bool) -> bool:
    """Whether a component is of the link that is named after the spindle; where none is, of no other body's.

    Args:
        machine: its machine.
        component: of a fixed link, such as `EZ0spindle`.
        runs: whether the spindle's speed varies in the readings.
    """
    links, link = (*machine.tool_chain, *machine.work_chain), component[3:]
    own = [name for name in links if "spindle" in name.lower() or name.lower() == "s"]
    if own:
        return link in own
    return runs and not any(word in link.lower() for word in OTHER_BODIES)


def _is_spindle(around: Surroundings) -> bool:
    return of_spindle(around.machine, around.component, "spindle_rpm" in around.channels)


class SpindleGrowth(Effect):
    """Spindle growth: with a sensor `e = k ΔT` (lagged with `lag`), without one `e = k L[(n/1000)^p]`."""

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
        """Needs the spindle's link, and the speed or a temperature; across the spindle the speed."""
        fed = component_kind(around.component, around.machine) in cls.feeds
        if fed and not _is_spindle(around):
            return NO_SPINDLE
        if not fed or "spindle_rpm" in around.channels or (around.sensors and cls._by_sensor(around)):
            return ""
        return (
            "neither the spindle speed nor a temperature varies"
            if cls._by_sensor(around)
            else ("the spindle speed never changes, or was not recorded")
        )

    @classmethod
    def _by_sensor(cls, around: Surroundings) -> bool:
        """Whether a spindle temperature may drive this component: along the spindle's axis, and for angles."""
        return around.component[1] == "Z" or cls.feeds != ("link",)

    @classmethod
    def arguments(cls, around: Surroundings) -> Iterator[dict[str, Any]]:
        """From the speed, and from the sensors named after the spindle (from all where there is none)."""
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
        """`ΔT`, its lag, or the lag of `(n/1000)^p`."""
        del machine
        if self.sensor is None:
            heat = (np.abs(channels.value("spindle_rpm")) * 1e-3) ** theta["p"]
            return [channels.lagged(heat, theta["tau"])]
        rise = channels.rise(self.sensor)
        return [channels.lagged(rise, theta["tau"]) if self.lag else rise]


class SpindleTilt(SpindleGrowth):
    """Tilt of the spindle or head with its temperature: as spindle growth, for an angle."""

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
    """Immediate shift with the speed (centrifugal growth, preload of the bearings): `e = c (n/1000)²`."""

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

    @classmethod
    def missing(cls, around: Surroundings) -> str:
        """Needs the spindle's link, and its speed."""
        fed = component_kind(around.component, around.machine) in cls.feeds
        return super().missing(around) or (NO_SPINDLE if fed and not _is_spindle(around) else "")

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

"""Effects of time, and artefacts that look like an effect of the machine (catalogue A6).

A diagnosis can name a time effect, so that people remove its cause. The loop refuses it: its clock is not the
measurement's.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Literal

import numpy as np

from rtec.effects.base import About, AxisEffect, Confusion, Effect, Kind, Parameter, Surroundings
from rtec.effects.state import Channels, Value
from rtec.machine import Machine
from rtec.quantities import DAY_S

LONG_ENOUGH_S = 0.9 * DAY_S


class _OfTime(Effect):
    """An effect of the time alone."""

    feeds: ClassVar[tuple[Kind, ...]] = ("positioning", "link", "link_angle")
    driven_by: ClassVar[tuple[str, ...]] = ("time_s",)

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read the time."""
        del machine
        return ("time_s",)


class DailyDrift(_OfTime):
    """Daily cycle (sun, foundation, working shift): `e = s sin(2πt/24 h) + c cos(2πt/24 h)`."""

    about: ClassVar[About] = About(
        title="Daily drift (sun, foundation, tide)",
        equation="e = s·sin(2π·t/24h) + c·cos(2π·t/24h)",
        typical="1-10 µm, 5 µrad",
        seen_by=("level", "spindle_drift"),
        source="catalogue A6",
        confusions=(
            Confusion("ambient_drift", "the room has its day too", "change the room with a heater, out of step"),
            Confusion("wear_drift", "less than a day does not separate a swing from a trend", "two days or more"),
        ),
        reveal="levels or probes left in place for two days",
    )
    effect: Literal["daily_drift"] = "daily_drift"

    @classmethod
    def missing(cls, around: Surroundings) -> str:
        """Needs about a day."""
        reason = super().missing(around)
        if reason or around.span_s >= LONG_ENOUGH_S:
            return reason
        return f"the record is {around.span_s / 3600.0:.1f} h long; a day's swing cannot be told from any drift"

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`s`, `c`."""
        del machine
        return tuple(Parameter(n, self.unit, typical=3.0) for n in "sc")

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """Sine and cosine of the day."""
        del machine, theta
        angle = channels.value("time_s") * (2.0 * math.pi / DAY_S)
        return [np.sin(angle), np.cos(angle)]


class WearDrift(_OfTime):
    """Wear at a steady rate: `e = w t`."""

    about: ClassVar[About] = About(
        title="Drift by wear (tool, guide)",
        equation="e = w·t, t in hours",
        typical="0.1-5 µm/h for a tool, per month for a guide",
        seen_by=("work_piece", "tool_tip"),
        source="catalogue A6",
        confusions=(
            Confusion("spindle_growth", "heat drifts too", "measure again after a rest: wear stays"),
            Confusion("ambient_drift", "the room drifts too", "measure again after a rest: wear stays"),
        ),
        reveal="probe an artefact before and after a rest",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("positioning", "link")
    effect: Literal["wear_drift"] = "wear_drift"

    @classmethod
    def missing(cls, around: Surroundings) -> str:
        """Needs about a day: over hours, machine and instrument drift too. A cutting tool wears within hours."""
        reason = super().missing(around)
        if reason or around.cut or around.span_s >= LONG_ENOUGH_S:
            return reason
        return f"the record is {around.span_s / 3600.0:.1f} h long; an even trend cannot be told from any drift"

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`w`, per hour."""
        del machine
        return (Parameter("w", f"{self.unit}_per_h", typical=1.0),)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """Hours."""
        del machine, theta
        return [channels.value("time_s") * (1.0 / 3600.0)]


class MissedCounts(AxisEffect):
    """Lost counts, or a slip, at one instant: `e = q · 1[t > t0]`."""

    about: ClassVar[About] = About(
        title="Missed counts, slip or a knock",
        equation="e = q for t > t0",
        typical="1-40 µm; q a whole number of counts",
        seen_by=("laser_linear", "tool_tip"),
        source="[G 4]: one cycle of the signals is four counts",
        confusions=(
            Confusion("instrument_drift", "the set-up was knocked or clamped again", "is q a whole number of counts?"),
            Confusion("spindle_growth", "a quick warm-up", "move to the index pulse again"),
        ),
        reveal="check of the index pulse; move home again",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("positioning", "roll", "tilt")
    driven_by: ClassVar[tuple[str, ...]] = ("time_s",)
    effect: Literal["missed_counts"] = "missed_counts"

    @classmethod
    def arguments(cls, around: Surroundings) -> Iterator[dict[str, Any]]:
        """Along the component's own axis."""
        if around.axis is not None:
            yield {"axis": around.axis.name}

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`q`: the lost distance or angle."""
        del machine
        return (Parameter("q", self.unit, typical=5.0),)

    def nonlinear(self, machine: Machine) -> tuple[Parameter, ...]:
        """`t0`: the instant, s."""
        del machine
        return (Parameter("t0", "s", 3600.0, 0.0, 1e7),)

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read the time."""
        del machine
        return ("time_s",)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """A step that takes a second: a search needs its derivative."""
        del machine
        return [np.minimum(np.maximum((channels.value("time_s") - theta["t0"]) + 0.5, 0.0), 1.0)]


NOT_EFFECTS: dict[str, About] = {
    "centre_offset": About(
        title="Centre offset of a ball bar (nuisance)",
        equation="reading = e_x·cos ζ + e_y·sin ζ",
        typical="1-20 µm",
        seen_by=("ball_bar",),
        source="[BB]",
        confusions=(Confusion("parallelism", "h·cos ζ is the same at one height", "two heights"),),
        reveal="the instrument finds it by itself, in every set-up",
    ),
    "instrument_drift": About(
        title="Drift of probe or laser, air, cosine (nuisance)",
        equation="reading = g(t), about 1 µm/m/K for the wavelength",
        typical="0.2-5 µm",
        seen_by=(),
        source="catalogue A6",
        confusions=(Confusion("ambient_drift", "the machine drifts with the room too", "cap the probe"),),
        reveal="cap the probe and record for the same time",
    ),
    "outliers": About(
        title="Single wrong readings, beam breaks, quantisation (data check)",
        equation="sparse; q/√12 for steps of q",
        typical="-",
        seen_by=(),
        source="catalogue A6",
        confusions=(Confusion("reversal_spike", "a spike sampled once", "a recording of 1 kHz or more"),),
        reveal="reported with every fit and diagnosis; only isolated readings are excluded",
    ),
}
"""Artefacts that look like an effect: `rtec effects` shows them, a model cannot hold them."""

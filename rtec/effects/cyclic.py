"""Periodic effects of position (catalogue A1, 4-7)."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer

from rtec.arrays import Floats
from rtec.effects.base import About, AxisEffect, Confusion, Kind, Parameter, Surroundings, check_sensor
from rtec.effects.state import Channels, Value
from rtec.errors import ModelError
from rtec.machine import Machine

MOST_HARMONICS = (1, 2, 4, 8, 16)
PER_PERIOD = 4.0
"""A harmonic is tried only if its period is at least this many times the widest gap between phases of readings."""


PITCH_MM, TURNS = 40.0, 3.0
"""Longest pitch of teeth or poles; a longer period is of what turns, at least so often along the travel: a curve along
the axis explains fewer turns as well."""
ROUNDING = 1e-6


def widest_phase_gap(places_mm: Floats, pitch_mm: float | None) -> float:
    """Widest part of a screw's turn without a reading, 0 … 1; 1 where all readings have one phase or no pitch is known.

    Readings that are more than a turn apart still cover the turn if their phases differ.
    """
    if pitch_mm is None or not len(places_mm):
        return 1.0
    phases = np.unique(places_mm / pitch_mm % 1.0)
    return float(np.max(np.diff(np.append(phases, phases[0] + 1.0))))


GROWTHS = {"load_kg": (0.01, "100kg"), "spindle_rpm": (0.001, "krpm")}
"""Channels besides the temperatures with which a wave may grow: factor, and its unit in a parameter's unit."""


class Cyclic(AxisEffect):
    """A periodic error along an axis; its size is constant, or proportional to a channel that `grows_with` names.

    An error of which one part is constant and another grows is the same effect twice, without `grows_with` and with it.
    """

    feeds: ClassVar[tuple[Kind, ...]] = ("positioning",)
    driven_by: ClassVar[tuple[str, ...]] = ("position",)
    grows_with: str | None = None

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """The position, and what the size grows with."""
        return (*super().channels(machine), *([self.grows_with] if self.grows_with is not None else []))

    def check(self, machine: Machine, where: str) -> None:
        """Check component, axis, and the channel that the size grows with."""
        super().check(machine, where)
        if self.grows_with is not None and self.grows_with not in GROWTHS:
            check_sensor(machine, self.grows_with, f"{where}: grows_with (a temperature, {' or '.join(GROWTHS)})")

    @model_serializer(mode="wrap")
    def _as_before(self, serialized: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without `grows_with` where it is not given: models from before it keep their hash."""
        return {k: v for k, v in serialized(self).items() if k != "grows_with" or v is not None}

    @property
    def steady(self) -> Self:
        """The same wave of constant size."""
        return self.model_copy(update={"grows_with": None})

    def grown(self, waves: Sequence[Value], channels: Channels) -> Sequence[Value]:
        """Waves of size one at the size of this state."""
        if self.grows_with is None:
            return waves
        if self.grows_with in GROWTHS:
            size = channels.value(self.grows_with) * GROWTHS[self.grows_with][0]
        else:
            size = channels.rise(self.grows_with)
        return [wave * size for wave in waves]

    @property
    def label(self) -> str:
        """Short name, with what the size grows with."""
        return super().label if self.grows_with is None else f"{super().label[:-1]}, grows with {self.grows_with})"

    @property
    def wave_unit(self) -> str:
        """Unit of the amplitudes."""
        if self.grows_with is None:
            return self.unit
        return f"{self.unit}_per_{GROWTHS[self.grows_with][1] if self.grows_with in GROWTHS else 'degc'}"


class _Wave(Cyclic):
    """A sine and a cosine over position."""

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`s`, `c`."""
        del machine
        return tuple(Parameter(k, self.wave_unit, typical=1.0) for k in "sc")

    def angle(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Value:
        """Phase of the wave, rad."""
        return channels.value(self.the_axis(machine).channel) * (2.0 * math.pi / theta["period"])

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """Sine and cosine."""
        angle = self.angle(machine, channels, theta)
        return self.grown([np.sin(angle), np.cos(angle)], channels)


class CyclicScrew(Cyclic):
    """Cyclic error at the screw's pitch and its harmonics: `e = Σ s_k sin(2πk q/p) + c_k cos(2πk q/p)`."""

    about: ClassVar[About] = About(
        title="Cyclic screw error, once per revolution and harmonics",
        equation="e = Σ s_k·sin(2πk·q/p) + c_k·cos(2πk·q/p)",
        typical="0.5-5 µm, p 5-20 mm",
        seen_by=("laser_linear", "ball_bar"),
        source="[G 3.2]",
        confusions=(
            Confusion("coupling_misalignment", "its second harmonic", "ratio of the two; realign the coupling"),
            Confusion(
                "cyclic_pole",
                "a period near the pitch",
                "a longer travel: travel times the difference of the frequencies must exceed one",
            ),
            Confusion(
                "instrument_drift",
                "eccentric encoder, bearing and screw make one and the same wave",
                "compare motor encoder and linear scale; re-clock the coupling",
            ),
        ),
        reveal="laser in steps that are no multiple of the pitch, or fine over two pitches",
    )
    driven_by: ClassVar[tuple[str, ...]] = ("position", "pitch")
    effect: Literal["cyclic_screw"] = "cyclic_screw"
    harmonics: Annotated[int, Field(ge=1, le=16)] = 1

    @classmethod
    def arguments(cls, around: Surroundings) -> Iterator[dict[str, Any]]:
        """The first harmonic; then sets of 2, 4, … harmonics, as far as the phases of the readings cover them."""
        axis = around.moved
        gap = widest_phase_gap(around.places_mm.get(axis.channel, np.zeros(0)), axis.pitch_mm)
        for most in MOST_HARMONICS:
            if most == 1 or PER_PERIOD * most * gap <= 1.0 + ROUNDING:
                yield {"axis": axis.name, "harmonics": most}

    def check(self, machine: Machine, where: str) -> None:
        """Check that the axis has a pitch."""
        super().check(machine, where)
        if self.the_axis(machine).pitch_mm is None:
            raise ModelError(f"{where}: axis {self.axis!r} has no pitch_mm in the machine file, cyclic_screw needs it")

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`s1 c1 s2 c2` …."""
        del machine
        return tuple(
            Parameter(f"{k}{i}", self.wave_unit, typical=2.0) for i in range(1, self.harmonics + 1) for k in "sc"
        )

    def nonlinear(self, machine: Machine) -> tuple[Parameter, ...]:
        """`pitch`, from the machine, within 2 %."""
        pitch = self.the_axis(machine).pitch_mm or math.nan
        return (Parameter("pitch", "mm", pitch, 0.98 * pitch, 1.02 * pitch, pitch, (pitch,)),)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """Sine and cosine once; the harmonics by the addition theorem."""
        angle = channels.value(self.the_axis(machine).channel) * (2.0 * math.pi / theta["pitch"])
        s1, c1 = np.sin(angle), np.cos(angle)
        out, s, c = [s1, c1], s1, c1
        for _ in range(1, self.harmonics):
            s, c = s * c1 + c * s1, c * c1 - s * s1
            out += [s, c]
        return self.grown(out, channels)


class CouplingMisalignment(_Wave):
    """A wave with two periods per revolution of the screw (universal joint, misaligned coupling)."""

    about: ClassVar[About] = About(
        title="Misaligned coupling, twice per revolution",
        equation="e = s·sin(4π·q/p) + c·cos(4π·q/p)",
        typical="below 1 µm at 3° and 5 mm pitch",
        seen_by=("laser_linear",),
        source="[BB 21-22]",
        confusions=(
            Confusion("cyclic_screw", "its second harmonic", "ratio of the two; realign the coupling"),
            Confusion("interpolation_error", "a fold of a finer wave", "other steps between the targets"),
        ),
        reveal="laser in fine steps over two pitches",
    )
    driven_by: ClassVar[tuple[str, ...]] = ("position", "pitch")
    effect: Literal["coupling_misalignment"] = "coupling_misalignment"

    def check(self, machine: Machine, where: str) -> None:
        """Check that the axis has a pitch."""
        super().check(machine, where)
        if self.the_axis(machine).pitch_mm is None:
            raise ModelError(
                f"{where}: axis {self.axis!r} has no pitch_mm in the machine file, coupling_misalignment needs it"
            )

    def nonlinear(self, machine: Machine) -> tuple[Parameter, ...]:
        """`period`: half of the pitch, within 2 %."""
        half = 0.5 * (self.the_axis(machine).pitch_mm or math.nan)
        return (Parameter("period", "mm", half, 0.98 * half, 1.02 * half, half, (half,)),)


class InterpolationError(_Wave):
    """Error within one signal period of a scale: `e = s sin(2π q/λ) + c cos(2π q/λ)`, λ known."""

    about: ClassVar[About] = About(
        title="Interpolation error within a signal period of the scale",
        equation="e = s·sin(2π·q/λ) + c·cos(2π·q/λ)",
        typical="to 1 % of λ; λ 2-200 µm",
        seen_by=("laser_linear",),
        source="makers of encoders",
        confusions=(
            Confusion("cyclic_screw", "steps near a multiple of λ fold it into a slow wave", "targets at random"),
            Confusion("outliers", "recorded too coarsely it looks like noise", "record positions to λ/20"),
        ),
        reveal="laser in steps of λ/8 or less over a few periods",
    )
    effect: Literal["interpolation_error"] = "interpolation_error"
    lambda_mm: Annotated[float, Field(ge=1e-6, le=5.0)]

    @classmethod
    def arguments(cls, around: Surroundings) -> Iterator[dict[str, Any]]:
        """Usual signal periods of scales."""
        for period_mm in (0.02, 0.04, 0.1, 0.2, 1.0):
            yield {"axis": around.moved.name, "lambda_mm": period_mm}

    def angle(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Value:
        """Phase of the wave, rad."""
        del theta
        return channels.value(self.the_axis(machine).channel) * (2.0 * math.pi / self.lambda_mm)


class CyclicPole(_Wave):
    """A wave whose period is not the screw's: teeth of a rack, turns of a gear or pinion, poles of a linear motor."""

    about: ClassVar[About] = About(
        title="Cyclic error of a gear, rack or linear motor",
        equation="e = s·sin(2π·q/p) + c·cos(2π·q/p), p to be found",
        typical="0.2-5 µm, p 3-300 mm",
        seen_by=("laser_linear", "grid_encoder"),
        source="catalogue A1",
        confusions=(
            Confusion("cyclic_screw", "a period near the pitch", "travel times the difference of 1/p above one"),
            Confusion("polynomial_position", "a period near the travel", "a longer travel"),
        ),
        reveal="laser in fine steps over the whole travel",
    )
    effect: Literal["cyclic_pole"] = "cyclic_pole"

    def nonlinear(self, machine: Machine) -> tuple[Parameter, ...]:
        """`period`: pitch of teeth or poles; or circumference of what turns, three of which fit into the travel."""
        low, high = self.the_axis(machine).travel_mm
        longest = min(max(PITCH_MM, (high - low) / TURNS), 0.4 * (high - low))
        start = min(16.0, 0.8 * longest)
        return (Parameter("period", "mm", start, min(2.5, 0.2 * longest), longest, start),)

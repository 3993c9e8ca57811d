"""Periodic effects of position (catalogue A1, 4-7)."""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from rtec.effects.base import About, AxisEffect, Parameter
from rtec.effects.state import Channels, Value
from rtec.errors import ModelError
from rtec.machine import Machine


class CyclicScrew(AxisEffect):
    """Cyclic error at the screw's pitch and its harmonics: `e = Σ s_k sin(2πk q/p) + c_k cos(2πk q/p)`."""

    about: ClassVar[About] = About(
        title="Cyclic screw error, once per revolution and harmonics",
        equation="e = Σ s_k·sin(2πk·q/p) + c_k·cos(2πk·q/p)",
        typical="0.5-5 µm, p 5-20 mm",
        seen_by="laser in fine steps, ball bar",
        confused_with="encoder eccentricity, bearing run-out (compare with a linear scale, re-clock the coupling); "
        "steps at a multiple of p hide it",
        source="[G 3.2]",
    )
    effect: Literal["cyclic_screw"] = "cyclic_screw"
    harmonics: Annotated[int, Field(ge=1, le=16)] = 1

    def check(self, machine: Machine, where: str) -> None:
        """Check that the axis has a pitch."""
        super().check(machine, where)
        if self.the_axis(machine).pitch_mm is None:
            raise ModelError(f"{where}: axis {self.axis!r} has no pitch_mm in the machine file, cyclic_screw needs it")

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`s1 c1 s2 c2` …."""
        del machine
        return tuple(Parameter(f"{k}{i}", self.unit) for i in range(1, self.harmonics + 1) for k in "sc")

    def nonlinear(self, machine: Machine) -> tuple[Parameter, ...]:
        """`pitch`, from the machine, within 2 %."""
        pitch = self.the_axis(machine).pitch_mm or math.nan
        return (Parameter("pitch", "mm", pitch, 0.98 * pitch, 1.02 * pitch),)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """Sine and cosine once; the harmonics by the addition theorem."""
        angle = channels.value(self.the_axis(machine).channel) * (2.0 * math.pi / theta["pitch"])
        s1, c1 = np.sin(angle), np.cos(angle)
        out, s, c = [s1, c1], s1, c1
        for _ in range(1, self.harmonics):
            s, c = s * c1 + c * s1, c * c1 - s * s1
            out += [s, c]
        return out

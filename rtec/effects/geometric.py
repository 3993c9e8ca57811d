"""Effects of position alone: quasi-static geometry (catalogue A1).

Symbols: `q` axis position, mm; `u` position scaled to -1 … +1 over the travel; `e` the component error, µm or µrad.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, field_validator

from rtec.effects.base import About, AxisEffect, Effect, Parameter
from rtec.effects.state import Channels, Value
from rtec.machine import Machine

MM_TO_M = 1e-3


class Scale(AxisEffect):
    """Scale or mean pitch error: `e = k q`."""

    about: ClassVar[About] = About(
        title="Scale, mean pitch error",
        equation="e = k·q",
        typical="5-50 µm/m",
        seen_by="laser, ball bar",
        confused_with="screw heating (repeat cold and hot); air index of the laser (log air temperature and pressure)",
        source="[XT Table 4]",
    )
    effect: Literal["scale"] = "scale"

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`k`, per metre of travel."""
        del machine
        return (Parameter("k", f"{self.unit}_per_m"),)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """`q` in m."""
        del theta
        return [channels.value(self.the_axis(machine).channel) * MM_TO_M]


class PolynomialPosition(AxisEffect):
    """Polynomial in position: `e = Σ c_i P_i(u)`, Legendre polynomials over the travel."""

    about: ClassVar[About] = About(
        title="Polynomial in position",
        equation="e = Σ c_i·P_i(u), u = position scaled to -1..+1 over the travel",
        typical="1-15 µm; quadratics are typically enough",
        seen_by="laser, straightness, angular laser",
        confused_with="piecewise error (more targets); scale for degree 1",
        source="[G 3.6]",
    )
    effect: Literal["polynomial_position"] = "polynomial_position"
    degrees: Annotated[tuple[Annotated[int, Field(ge=0, le=12)], ...], Field(min_length=1)] = (1, 2)

    @field_validator("degrees")
    @classmethod
    def _distinct(cls, value: tuple[int, ...]) -> tuple[int, ...]:
        if len(set(value)) < len(value):
            raise ValueError("a degree stands twice")
        return value

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`c0` … by degree, in the component's unit."""
        del machine
        return tuple(Parameter(f"c{i}", self.unit) for i in self.degrees)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """Legendre polynomials by Bonnet's recursion."""
        del theta
        axis = self.the_axis(machine)
        low, high = axis.travel_mm
        u = (channels.value(axis.channel) - 0.5 * (low + high)) * (2.0 / (high - low))
        p = [u * 0.0 + 1.0, u]
        for k in range(1, max(self.degrees)):
            p.append(u * p[k] * ((2 * k + 1) / (k + 1)) - p[k - 1] * (k / (k + 1)))
        return [p[i] for i in self.degrees]


class PiecewisePosition(AxisEffect):
    """Piecewise linear in position: the error at each knot, straight between, constant beyond the ends."""

    about: ClassVar[About] = About(
        title="Piecewise linear in position",
        equation="e = straight lines through (knot, value)",
        typical="1-10 µm",
        seen_by="laser with dense targets",
        confused_with="polynomial; local wear (dense targets, reverse pass)",
        source="[G 3.6] advises segments in position",
    )
    effect: Literal["piecewise_position"] = "piecewise_position"
    knots_mm: Annotated[tuple[float, ...], Field(min_length=2, max_length=1000)]

    @field_validator("knots_mm")
    @classmethod
    def _rising(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if any(b <= a for a, b in itertools.pairwise(value)):
            raise ValueError("knots must rise")
        return value

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`at0` … the error at each knot."""
        del machine
        return tuple(Parameter(f"at{i}", self.unit) for i in range(len(self.knots_mm)))

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """One hat per knot; they sum to one everywhere."""
        del theta
        q = channels.value(self.the_axis(machine).channel)
        # How far along each segment, 0 … 1; the hat of a knot is what has come minus what has gone on.
        steps = [
            np.minimum(np.maximum((q - a) * (1.0 / (b - a)), 0.0), 1.0)
            for a, b in zip(self.knots_mm, self.knots_mm[1:], strict=False)
        ]
        inner = [before - after for before, after in itertools.pairwise(steps)]
        return [1.0 - steps[0], *inner, steps[-1]]


class Squareness(Effect):
    """Squareness of an axis to another: a constant angle of its line of travel."""

    about: ClassVar[About] = About(
        title="Squareness of an axis to another",
        equation="e = α",
        typical="5-50 µrad",
        seen_by="ball bar, grid encoder, square",
        confused_with="servo phase mismatch in a ball bar of one sense (measure both senses); slope of the fixture",
        source="[XT 1], ISO 230-1",
    )
    effect: Literal["squareness"] = "squareness"

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`alpha`."""
        del machine
        return (Parameter("alpha", self.unit),)

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Read nothing."""
        del machine
        return ()

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """One."""
        del machine, channels, theta
        return [1.0]


class Parallelism(Squareness):
    """Parallelism of an axis to the spindle's axis: a constant angle of its line of travel."""

    about: ClassVar[About] = About(
        title="Parallelism of an axis to the spindle",
        equation="e = α",
        typical="5-20 µrad",
        seen_by="two probes 180° apart on an arbor",
        confused_with="misaligned arbor (best-fit circle radii at two stations)",
        source="[G 2.16, 3.5]",
    )
    effect: Literal["parallelism"] = "parallelism"  # type: ignore[assignment]

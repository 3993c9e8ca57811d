"""Position errors along an axis: quasi-static geometry (catalogue A1).

Symbols: `q` axis position, mm; `u` position scaled to -1 … +1 over the travel; `e` the component error, µm or µrad.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, field_validator

from rtec.effects.base import About, AxisEffect, Confusion, Kind, Parameter, Surroundings
from rtec.effects.state import Channels, Value
from rtec.machine import Axis, Machine

MM_TO_M = 1e-3


def scaled(axis: Axis, channels: Channels) -> Value:
    """Position of an axis scaled to -1 … +1 over its travel."""
    low, high = axis.travel_mm
    return (channels.value(axis.channel) - 0.5 * (low + high)) * (2.0 / (high - low))


def legendre(u: Value, degrees: Sequence[int]) -> list[Value]:
    """Legendre polynomials of some degrees at u, by Bonnet's recursion."""
    p = [u * 0.0 + 1.0, u]
    for k in range(1, max(degrees)):
        p.append(u * p[k] * ((2 * k + 1) / (k + 1)) - p[k - 1] * (k / (k + 1)))
    return [p[i] for i in degrees]


class Scale(AxisEffect):
    """Scale or mean pitch error: `e = k q`."""

    about: ClassVar[About] = About(
        title="Scale, mean pitch error",
        equation="e = k·q",
        typical="5-50 µm/m",
        seen_by=("laser_linear", "ball_bar", "tool_tip"),
        source="[XT Table 4]",
        confusions=(
            Confusion(
                "axis_expansion",
                "a warm screw or scale makes the same straight line",
                "repeat cold and hot, with the temperatures logged",
            ),
            Confusion(
                "instrument_drift",
                "air that is warmer than the laser believes stretches its scale",
                "log air temperature and pressure, or compare with an artefact",
            ),
            Confusion(
                "guide_curvature",
                "a pitch that grows along the axis does the same at one height",
                "repeat the line at a second height",
            ),
        ),
        reveal="laser along the axis, over its whole travel",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("positioning",)
    driven_by: ClassVar[tuple[str, ...]] = ("position",)
    effect: Literal["scale"] = "scale"

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`k`, per metre of travel."""
        del machine
        return (Parameter("k", f"{self.unit}_per_m", typical=20.0),)

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
        seen_by=("laser_linear", "straightness", "laser_angular", "tool_tip"),
        source="[G 3.6]",
        confusions=(
            Confusion(
                "piecewise_position",
                "both follow a bent line; few targets cannot tell them apart",
                "more targets, and compare by evidence",
            ),
            Confusion(
                "cyclic_screw",
                "targets in steps near the pitch fold a wave into a slow curve",
                "steps that are no multiple of the pitch",
            ),
        ),
        reveal="laser along the axis with 20 targets or more",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("positioning",)
    driven_by: ClassVar[tuple[str, ...]] = ("position",)
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
        return tuple(Parameter(f"c{i}", self.unit, typical=5.0) for i in self.degrees)

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """Legendre polynomials by Bonnet's recursion."""
        del theta
        return legendre(scaled(self.the_axis(machine), channels), self.degrees)

    @classmethod
    def arguments(cls, around: Surroundings) -> Iterator[dict[str, Any]]:
        """Degrees 2 to 5: a straight line is `scale`; and the bow alone, which is all that most machines have."""
        for degrees in ((2,), (2, 3), (2, 3, 4, 5)):
            yield {"axis": around.moved.name, "degrees": degrees}


class PiecewisePosition(AxisEffect):
    """Piecewise linear in position: the error at each knot, straight between, constant beyond the ends."""

    about: ClassVar[About] = About(
        title="Piecewise linear in position",
        equation="e = straight lines through (knot, value)",
        typical="1-10 µm",
        seen_by=("laser_linear", "tool_tip"),
        source="[G 3.6] advises segments in position",
        confusions=(
            Confusion("polynomial_position", "both follow a bent line", "dense targets about the bend"),
            Confusion(
                "backlash_position", "local wear shows in both directions differently", "dense targets, both directions"
            ),
        ),
        reveal="laser along the axis with dense targets, both directions",
    )
    feeds: ClassVar[tuple[Kind, ...]] = ("positioning",)
    driven_by: ClassVar[tuple[str, ...]] = ("position",)
    effect: Literal["piecewise_position"] = "piecewise_position"
    knots_mm: Annotated[tuple[float, ...], Field(min_length=2, max_length=1000)]

    @classmethod
    def arguments(cls, around: Surroundings) -> Iterator[dict[str, Any]]:
        """Seven and eleven knots over what was visited."""
        low, high = around.channels[around.moved.channel]
        for knots in (7, 11):
            step = (high - low) / (knots - 1)
            yield {"axis": around.moved.name, "knots_mm": tuple(round(low + i * step, 3) for i in range(knots))}

    @field_validator("knots_mm")
    @classmethod
    def _rising(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if any(b <= a for a, b in itertools.pairwise(value)):
            raise ValueError("knots must rise")
        return value

    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """`at0` … the error at each knot."""
        del machine
        return tuple(Parameter(f"at{i}", self.unit, typical=5.0) for i in range(len(self.knots_mm)))

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

"""Instruments whose lever arms are affine in the axis positions, and their building blocks.

The chain's arms are affine, `J(q) = J0 + Σ_a J_a q_a`. They stay affine for an instrument that measures, in a fixed
direction, a point that moves with the tool, or a rotation. Its arms are one small array (readings, components, 1 +
axes), computed once; a million poses cost one product.

There are two measurands, both of the tool relative to the workpiece, in machine coordinates:

- `point`: displacement of a point beside the tool tip, µm: `e(tip) + ε × offset`, the Abbe arm.
- `turn`: rotation of the tool about a machine direction, µrad, right-handed.
"""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from rtec.effects import State
from rtec.machine import Machine
from rtec.machine.chain import MM_URAD_TO_UM
from rtec.metrology.instruments.base import Floats, Instrument, Ints, Nuisance, component_index
from rtec.quantities import Vector

Letter = Literal["X", "Y", "Z"]
Turn = Literal["A", "B", "C"]
Scope = Literal["run", "setup", "none"]
Sign = Literal[-1, 1]
Degree = Annotated[int, Field(ge=2, le=12)]
ORIGIN: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class AffineInstrument(Instrument):
    """An instrument with a fixed measuring direction."""

    @abstractmethod
    def looks(self, machine: Machine) -> Floats:
        """Arms as an affine function of the pose, (readings, components, 1 + axes); first the constant part."""

    def affine(self, machine: Machine) -> Floats:
        """As `looks`; for a component that is read directly the arm is 1, all others are 0."""
        return self.looks(machine) if self.component is None else component_itself(machine, self.component)

    def arms(self, machine: Machine, pose_mm: Floats) -> Floats:
        """Lever arms, (readings, n, components)."""
        affine = self.affine(machine)
        out = np.tensordot(affine[:, :, 1:], pose_mm, axes=(2, 1)).transpose(0, 2, 1)
        return np.asarray(out + affine[:, None, :, 0], dtype=np.float64)

    def arms_of(self, machine: Machine, pose_mm: Floats, component: str) -> Floats:
        """Lever arms of one component, (readings, n)."""
        affine = self.affine(machine)[:, component_index(machine, component, self.name)]
        return np.asarray(affine[:, 1:] @ pose_mm.T + affine[:, :1], dtype=np.float64)


def point(machine: Machine, direction: Letter, offset_mm: Vector = ORIGIN) -> Floats:
    """Arms of a point beside the tool tip along a machine direction, (components, 1 + axes); µm per µm or µrad."""
    row = "XYZ".index(direction)
    out: Floats = machine.chain.terms[row].copy()
    out[:, 0] += np.cross(machine.chain.turns.T, np.asarray(offset_mm, dtype=np.float64))[:, row] * MM_URAD_TO_UM
    return out


def turn(machine: Machine, about: Turn) -> Floats:
    """Arms of the rotation of the tool relative to the workpiece, (components, 1 + axes); µrad per µrad."""
    out = np.zeros(machine.chain.terms.shape[1:])
    out[:, 0] = machine.chain.turns["ABC".index(about)]
    return out


def component_itself(machine: Machine, component: str) -> Floats:
    """Arms of a component that is read directly, (1, components, 1 + axes)."""
    out = np.zeros((1, *machine.chain.terms.shape[1:]))
    out[0, component_index(machine, component, "component"), 0] = 1.0
    return out


def zero(n: int, readings: int, scope: Scope, unit: str, names: tuple[str, ...] = ("zero",)) -> tuple[Nuisance, ...]:
    """Zero of each reading: an unknown constant; `names` has one name a reading."""
    if scope == "none":
        return ()
    return tuple(Nuisance(name, unit, _only(i, readings, np.ones(n)), scope) for i, name in enumerate(names))


def slope(values: Floats, readings: int, scope: Scope, unit: str, name: str = "slope", row: int = 0) -> list[Nuisance]:
    """An unknown factor of `values` (n,) in one of the readings."""
    return [] if scope == "none" else [Nuisance(name, unit, _only(row, readings, values), scope)]


def from_middle_m(machine: Machine, state: State, axis: str) -> Floats:
    """Position along an axis from the middle of its travel, m, (n,)."""
    known = machine.axis(axis)
    return (state.value(known.channel) - 0.5 * sum(known.travel_mm)) * 1e-3


def scaled(machine: Machine, state: State, axis: str) -> Floats:
    """Position along an axis scaled to -1 … +1 over its travel, (n,)."""
    low, high = machine.axis(axis).travel_mm
    return from_middle_m(machine, state, axis) * (2000.0 / (high - low))


def flipped(run: Ints, reversed_runs: tuple[int, ...]) -> Floats:
    """-1 in the runs taken with the artefact reversed, else +1, (n,)."""
    return np.where(np.isin(run, reversed_runs), -1.0, 1.0)


def legendre(u: Floats, degree: int) -> list[Floats]:
    """Legendre polynomials of degree 2 … `degree`, each (n,)."""
    p = [np.ones_like(u), u]
    for k in range(1, degree):
        p.append(((2 * k + 1) * u * p[k] - k * p[k - 1]) / (k + 1))
    return p[2 : degree + 1]


def _only(row: int, readings: int, values: Floats) -> Floats:
    out = np.zeros((readings, len(values)))
    out[row] = values
    return out

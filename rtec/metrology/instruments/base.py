"""An instrument: a linear functional of the model, with nuisance parameters (seam 5 of the architecture).

    reading = H(instrument, pose) · component errors + nuisance

`arms` gives `H · J`: the change of each reading, µm or µrad, for one unit of each component error, µm or µrad;
`arms_of` gives the same for one component, which needs less memory. All errors are of the tool relative to the
workpiece; a reading is actual minus nominal.

The chain's arms are affine, `J(q) = J0 + Σ_a J_a q_a`. They stay affine for an instrument that measures, in a fixed
direction, a point that moves with the tool, or a rotation. The arms of an `AffineInstrument` are one small array
(readings, components, 1 + axes), computed once; a million poses cost one product.

There are two measurands, both of the tool relative to the workpiece, in machine coordinates:

- `point`: displacement of a point beside the tool tip, µm: `e(tip) + ε × offset`, the Abbe arm.
- `turn`: rotation of the tool about a machine direction, µrad, right-handed.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from rtec.arrays import Bools, Floats, Ints
from rtec.effects import State
from rtec.errors import MeasurementError
from rtec.machine import Machine
from rtec.machine.chain import MM_URAD_TO_UM, component_unit
from rtec.quantities import Vector
from rtec.tomlfile import Strict, nearest

BLOCK = 16384
"""Number of poses in a block of `Instrument.arms_of`."""


class InstrumentSetup(Strict):
    """The `[setup]` table of an instrument; each instrument has its own keys."""


@dataclass(frozen=True)
class Nuisance:
    """A nuisance parameter: a part of the readings that is no machine error and that the fit must estimate.

    Attributes:
        name: in the field's terms: "zero", "slope", "cosine".
        unit: unit of its coefficient.
        values: contribution of one unit to each reading, (readings, n).
        per: "run": one coefficient for each run; "setup": one for the whole measurement.
    """

    name: str
    unit: str
    values: Floats
    per: Literal["run", "setup"]


@dataclass(frozen=True)
class Instrument(ABC):
    """An instrument with its set-up on one machine.

    Attributes:
        name, title: in files, and for people.
        setup_model: model of the `[setup]` table.
        axis_use: whether an axis is required, allowed, or not allowed.
        needs: keys of `[setup]` that are needed unless a component is named, beside those without a default.
        direct: unit of a component that it may read directly; None where it cannot.
        at_rest: it reads while the axes are at rest, unless their velocities are recorded.
        in_order: its readings follow one another as the axes moved, so that positions tell directions.
        along: its axis is the one that moves from reading to reading.
        setup: the `[setup]` table.
        axis: axis that it follows, if any.
        component: component that it reads directly, if any.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    setup_model: ClassVar[type[InstrumentSetup]]
    axis_use: ClassVar[Literal["required", "optional", "none"]] = "optional"
    needs: ClassVar[tuple[str, ...]] = ()
    direct: ClassVar[Literal["um", "urad"] | None] = None
    at_rest: ClassVar[bool] = True
    in_order: ClassVar[bool] = True
    along: ClassVar[bool] = False

    setup: InstrumentSetup
    axis: str | None = None
    component: str | None = None

    @abstractmethod
    def columns(self) -> tuple[str, ...]:
        """Names of the reading columns, with their unit: `reading_um`, `reading_x_um` and so on."""

    @abstractmethod
    def arms(self, machine: Machine, pose_mm: Floats) -> Floats:
        """Change of each reading for one unit of each component error, (readings, n, components).

        Args:
            machine: its chain is used.
            pose_mm: axis positions, (n, axes).
        """

    def arms_of(self, machine: Machine, pose_mm: Floats, component: str) -> Floats:
        """Change of each reading for one unit of a component error, (readings, n): that column of `arms`, in blocks.

        Args:
            machine: its chain is used.
            pose_mm: axis positions, (n, axes).
            component: its name, for example "EXX".

        Raises:
            MeasurementError: the machine has no such component.
        """
        index = component_index(machine, component, self.name)
        out = np.empty((len(self.columns()), len(pose_mm)))
        for start in range(0, len(pose_mm), BLOCK):
            part = slice(start, start + BLOCK)
            out[:, part] = self.arms(machine, pose_mm[part])[:, :, index]
        return out

    @abstractmethod
    def nuisance(self, state: State, run: Ints) -> tuple[Nuisance, ...]:
        """Nuisance parameters of the readings; `run` is the run number of each row, (n,)."""

    def reads_while(self, axis: str | None) -> tuple[bool, ...]:
        """Whether each reading is taken while an axis travels (None: at standstill); the others stay empty."""
        del axis
        return (True,) * len(self.columns())

    def turned(self, run: Ints) -> Bools:
        """Whether each row was read with the artefact turned over, (n,); `run` is its run number."""
        return np.zeros(len(run), dtype=np.bool_)

    def check(self, machine: Machine, where: str) -> None:
        """Raise MeasurementError where axis, component or set-up do not fit the machine; all faults, one a line."""
        faults = [f"{where}: {fault}" for fault in (*self._head_faults(machine), *self.faults(machine))]
        if faults:
            raise MeasurementError("\n".join(faults))

    def faults(self, machine: Machine) -> list[str]:
        """Faults of the set-up on the machine, in words."""
        del machine
        return []

    def _head_faults(self, machine: Machine) -> list[str]:
        out = []
        if self.axis is not None and self.axis_use == "none":
            out.append(f"[measurement] axis: {self.name} follows no axis; leave the key out")
        elif self.axis is not None and self.axis not in machine.axis_names:
            hint = nearest(self.axis, machine.axis_names)
            out.append(f"[measurement] axis {self.axis!r} is none of machine {machine.name!r}{hint}")
        elif self.axis is None and self.axis_use == "required" and self.component is None:
            axes = ", ".join(machine.axis_names)
            out.append(f"[measurement] key 'axis' is missing; {self.name} follows one of: {axes}")
        return out + self._component_faults(machine)

    def _component_faults(self, machine: Machine) -> list[str]:
        if self.component is None:
            return []
        if self.direct is None:
            return [f"[measurement] component: {self.name} reads no component directly; leave the key out"]
        fitting = [c for c in machine.components if component_unit(c) == self.direct]
        if self.component in fitting:
            return []
        what = "in µm" if self.direct == "um" else "in µrad"
        hint = nearest(self.component, fitting)
        return [f"[measurement] component {self.component!r} is none that {self.name} reads {what}{hint}"]


def component_index(machine: Machine, component: str, where: str) -> int:
    """Column of a component in `Instrument.arms`.

    Raises:
        MeasurementError: the machine has no such component.
    """
    if component not in machine.components:
        hint = nearest(component, machine.components)
        raise MeasurementError(f"{where}: component {component!r} is none of machine {machine.name!r}{hint}")
    return machine.components.index(component)


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
        affine = self._affine_once(machine)
        out = np.tensordot(affine[:, :, 1:], pose_mm, axes=(2, 1)).transpose(0, 2, 1)
        return np.asarray(out + affine[:, None, :, 0], dtype=np.float64)

    def arms_of(self, machine: Machine, pose_mm: Floats, component: str) -> Floats:
        """Lever arms of one component, (readings, n)."""
        affine = self._affine_once(machine)[:, component_index(machine, component, self.name)]
        return np.asarray(affine[:, 1:] @ pose_mm.T + affine[:, :1], dtype=np.float64)

    @cached_property
    def _affine_by_machine(self) -> dict[int, tuple[Machine, Floats]]:
        return {}

    def _affine_once(self, machine: Machine) -> Floats:
        """As `affine`, computed once for a machine: a search asks thousands of times."""
        known = self._affine_by_machine
        if id(machine) not in known:
            known[id(machine)] = machine, self.affine(machine)
        return known[id(machine)][1]


def point(machine: Machine, direction: Letter, offset_mm: Vector = ORIGIN) -> Floats:
    """Arms of a point beside the tool tip along a machine direction, (components, 1 + axes); µm per µm or µrad."""
    row = "XYZ".index(direction)
    second, third = (row + 1) % 3, (row + 2) % 3
    out: Floats = machine.chain.terms[row].copy()
    turns = machine.chain.turns
    # One row of the cross product of each turn with the offset.
    out[:, 0] += (turns[second] * offset_mm[third] - turns[third] * offset_mm[second]) * MM_URAD_TO_UM
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


def flipped(turned: Bools) -> Floats:
    """-1 where the artefact was turned over, else +1, (n,)."""
    return np.where(turned, -1.0, 1.0)


def laid(turned: Bools) -> Ints:
    """How often the artefact had been turned over before each row, (n,)."""
    return np.cumsum(np.diff(turned, prepend=turned[:1]))


def each_laid(nuisances: Sequence[Nuisance], turned: Bools) -> list[Nuisance]:
    """What a set-up shares, once for each time that the artefact was laid: turned over, it lies otherwise.

    Names are numbered from the second time on.
    """
    times = laid(turned)
    numbers = [(f" {k + 1}" if k else "", times == k) for k in np.unique(times).tolist()]
    return [
        replace(n, name=n.name + number, values=n.values * there)
        for n in nuisances
        for number, there in (numbers if n.per == "setup" else [("", True)])
    ]


def laid_scope(scope: Scope, turned: Bools, run: Ints) -> Scope:
    """Scope of what starts again each time that the artefact was laid: "run" where some of these are single runs."""
    times = laid(turned)
    single = any(len(np.unique(run[times == k])) == 1 for k in np.unique(times).tolist())
    return "run" if scope == "setup" and single and times.any() else scope


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

"""Laser interferometer: linear and along a diagonal (retroreflector), and angular (two retroreflectors on an arm).

The moving optics are on the tool side, the others on the workpiece side. If they are exchanged, the reading is the
same, as only their relative motion counts. A retroreflector reads the position of its centre along the beam, whatever
its own rotation.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.effects import State
from rtec.machine import Machine
from rtec.metrology.instruments.base import (
    ORIGIN,
    AffineInstrument,
    InstrumentSetup,
    Letter,
    Nuisance,
    Scope,
    Sign,
    Turn,
    from_middle_m,
    point,
    slope,
    turn,
    zero,
)
from rtec.quantities import Millimetres, Vector
from rtec.tomlfile import nearest

DIRECTIONS: Final[tuple[Letter, ...]] = ("X", "Y", "Z")
LEAST_PART: Final = 1e-3
"""Least part of a diagonal along an axis that takes part, of a length of one."""


class LaserLinearSetup(InstrumentSetup):
    """`[setup]` of a linear laser.

    Attributes:
        beam_offset_mm: vector from the tool tip to the retroreflector; across the beam this is the Abbe arm.
        zero: when the display is zeroed: once, or at the start of every run.
        slope: whether the fit estimates an unknown slope (cosine error, air index). The machine's own scale error is
            then not determined.
        air_sensor: temperature sensor in the air of the beam, where the air's index was not corrected.
        interferometer_mm: position of the axis at which the beam would have no length; needed with `air_sensor`. It
            is outside the range of the targets by the dead path.
    """

    beam_offset_mm: Vector = ORIGIN
    zero: Scope = "setup"
    slope: Scope = "none"
    air_sensor: str | None = None
    interferometer_mm: Millimetres | None = None


@dataclass(frozen=True)
class LaserLinear(AffineInstrument):
    """Distance along an axis, µm; positive in the axis' programmed positive direction."""

    name = "laser_linear"
    title = "Laser interferometer, linear"
    setup_model = LaserLinearSetup
    axis_use = "required"
    along = True
    direct = "um"
    setup: LaserLinearSetup

    def columns(self) -> tuple[str, ...]:
        """One reading."""
        return ("reading_um",)

    def looks(self, machine: Machine) -> Floats:
        """The reflector along the axis."""
        return point(machine, machine.axis(self.axis or "").direction, self.setup.beam_offset_mm)[None]

    def nuisance(self, state: State, run: Ints) -> tuple[Nuisance, ...]:
        """Zero; slope and air where the set-up says so."""
        del run
        out = list(zero(len(state), 1, self.setup.zero, "um"))
        if self.axis is None:
            return tuple(out)
        out += slope(from_middle_m(state.machine, state, self.axis), 1, self.setup.slope, "um_per_m")
        if self.setup.air_sensor is not None and self.setup.interferometer_mm is not None:
            path_m = (state.value(state.machine.axis(self.axis).channel) - self.setup.interferometer_mm) * 1e-3
            out += slope(path_m * state.rise(self.setup.air_sensor), 1, "setup", "um_per_m_degc", "air")
        return tuple(out)

    def faults(self, machine: Machine) -> list[str]:
        """A missing sensor; air without the beam's length; slope or air without an axis."""
        out = []
        sensor = self.setup.air_sensor
        if sensor is not None and sensor not in machine.sensor_names:
            hint = nearest(sensor, machine.sensor_names)
            out.append(f"[setup] air_sensor {sensor!r} is none of machine {machine.name!r}{hint}")
        if (sensor is None) != (self.setup.interferometer_mm is None):
            out.append("[setup] air_sensor and interferometer_mm belong together; give both or neither")
        if self.axis is None and (sensor is not None or self.setup.slope != "none"):
            out.append("[measurement] key 'axis' is missing; slope and air_sensor need it")
        return out


class LaserDiagonalSetup(InstrumentSetup):
    """`[setup]` of a laser along a diagonal of the machine.

    Attributes:
        direction: of the beam in the machine's directions X, Y and Z, of any length, such as [500, 400, 300]; the
            reading counts positive along it.
        beam_offset_mm: vector from the tool tip to the retroreflector.
        zero: when the display is zeroed: once, or at the start of every run.
        slope: whether the fit estimates an unknown slope (cosine error, air index). The sum of the scale errors is then
            not determined; differences between diagonals still are.
    """

    direction: Vector
    beam_offset_mm: Vector = ORIGIN
    zero: Scope = "setup"
    slope: Scope = "none"


@dataclass(frozen=True)
class LaserDiagonal(AffineInstrument):
    """Distance along a line on which several axes move together, µm [ISO 230-6]; positive along the direction."""

    name = "laser_diagonal"
    title = "Laser interferometer, along a diagonal"
    setup_model = LaserDiagonalSetup
    axis_use = "none"
    setup: LaserDiagonalSetup

    @property
    def line(self) -> Floats:
        """The direction of the beam, (3,), with length one."""
        given = np.array(self.setup.direction)
        return np.asarray(given / (np.linalg.norm(given) or 1.0))

    def columns(self) -> tuple[str, ...]:
        """One reading."""
        return ("reading_um",)

    def looks(self, machine: Machine) -> Floats:
        """The reflector along the beam."""
        parts = zip(self.line, DIRECTIONS, strict=True)
        return np.asarray(sum(share * point(machine, d, self.setup.beam_offset_mm) for share, d in parts))[None]

    def nuisance(self, state: State, run: Ints) -> tuple[Nuisance, ...]:
        """Zero; slope where the set-up says so."""
        del run
        machine, parts = state.machine, dict(zip(DIRECTIONS, self.line, strict=True))
        along_m = sum(parts[a.direction] * from_middle_m(machine, state, a.name) for a in machine.axes)
        steep = slope(np.asarray(along_m), 1, self.setup.slope, "um_per_m")
        return (*zero(len(state), 1, self.setup.zero, "um"), *steep)

    def faults(self, machine: Machine) -> list[str]:
        """A direction along one axis alone, or with a part along which no axis moves."""
        parts = {d for d, part in zip(DIRECTIONS, self.setup.direction, strict=True) if part}
        if still := sorted(parts - {a.direction for a in machine.axes}):
            return [f"[setup] direction has a part along {still[0]}, and no axis of {machine.name} moves there"]
        if min(abs(self.line[["XYZ".index(d) for d in parts]]), default=1.0) < LEAST_PART:
            return [f"[setup] direction {list(self.setup.direction)}: a part is far smaller than the others; write 0"]
        if len(parts) > 1:
            return []
        return ["[setup] direction needs two parts or more, such as [500, 400, 300]; laser_linear reads along one axis"]


class LaserAngularSetup(InstrumentSetup):
    """`[setup]` of an angular laser.

    Attributes:
        about: the rotation that it reads, A B C about X Y Z; needed unless a component is named.
        sign: -1 where the display counts against the right-hand rule.
        zero: when the display is zeroed: once, or at the start of every run.
    """

    about: Turn | None = None
    sign: Sign = 1
    zero: Scope = "setup"


@dataclass(frozen=True)
class LaserAngular(AffineInstrument):
    """Rotation of the tool relative to the workpiece about a direction across the beam, µrad, right-handed."""

    name = "laser_angular"
    title = "Laser interferometer, angular"
    setup_model = LaserAngularSetup
    needs = ("about",)
    axis_use = "required"
    along = True
    direct = "urad"
    setup: LaserAngularSetup

    def columns(self) -> tuple[str, ...]:
        """One reading."""
        return ("reading_urad",)

    def affine(self, machine: Machine) -> Floats:
        """With the sign of the display, also for a component that is read directly."""
        return self.setup.sign * super().affine(machine)

    def looks(self, machine: Machine) -> Floats:
        """The rotation."""
        return turn(machine, self.setup.about or "A")[None]

    def nuisance(self, state: State, run: Ints) -> tuple[Nuisance, ...]:
        """Zero."""
        del run
        return zero(len(state), 1, self.setup.zero, "urad")

    def faults(self, machine: Machine) -> list[str]:
        """No rotation named, or roll, which an angular laser cannot read."""
        if self.component is not None or self.axis not in machine.axis_names:
            return []
        if self.setup.about is None:
            return ["[setup] key 'about' is missing; it is the turn that is read: A, B or C"]
        if "ABC".index(self.setup.about) == "XYZ".index(machine.axis(self.axis or "").direction):
            return [f"[setup] about {self.setup.about!r} is the roll of axis {self.axis}; a level reads that"]
        return []

"""Errors that the second machine of the demo has and its first model lacks.

Each is a typical fault of a turning centre, written as physics and independent of the catalogue of effects on purpose:
the diagnosis must not find its own formulas. A seed draws sizes and places.

Symbols: `q` position, mm; `way` position of the slide in its play, -1 to +1: its last direction; `T` true temperature
of a body, °C.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from rtec.arrays import Floats
from rtec.errors import ConfigError
from rtec.machine import Machine
from rtec.sim.geometry import Geometry
from rtec.sim.machine import SimulatedMachine
from rtec.sim.truth import Truth
from rtec.tomlfile import nearest


@dataclass(frozen=True)
class Here:
    """State on which a fault depends.

    Attributes:
        q: positions by axis, mm, (n,).
        way: direction by axis, (n,).
        degc: true temperatures by body ("air", too).
    """

    q: Mapping[str, Floats]
    way: Mapping[str, Floats]
    degc: Mapping[str, float]


Error = Callable[[Here], Floats]
"""Error of one component, µm, (n,)."""


@dataclass(frozen=True)
class Fault:
    """A fault of a machine with drawn numbers.

    Attributes:
        name: name for `--hidden`.
        words: description for people.
        component: component error that it feeds, a displacement.
        right: effects of the catalogue that describe it.
        error: error of the component.
    """

    name: str
    words: str
    component: str
    right: tuple[str, ...]
    error: Error
    play_um: Mapping[str, float] = field(default_factory=dict)


def _gear(rng: np.random.Generator) -> Fault:
    period, size, phase = rng.uniform(14.0, 40.0), rng.uniform(2.5, 4.0), rng.uniform(0.0, 2.0 * np.pi)

    def error(here: Here) -> Floats:
        turn = 2.0 * np.pi * here.q["X"] / period + phase
        return np.asarray(size * (np.sin(turn) + 0.15 * np.sin(2.0 * turn + 1.0)))

    words = f"a worn gear in the drive of X: a wave of {size:.1f} µm every {period:.1f} mm"
    return Fault("gear", words, "EXX", ("cyclic_pole",), error)


def _worn_screw(rng: np.random.Generator) -> Fault:
    size, middle, width = rng.uniform(6.0, 10.0), rng.uniform(85.0, 125.0), rng.uniform(25.0, 40.0)

    def error(here: Here) -> Floats:
        worn = np.exp(-0.5 * ((here.q["X"] - middle) / width) ** 2)
        return np.asarray(-0.5 * size * worn * here.way["X"])

    words = f"a screw of X worn around {middle:.0f} mm: {size:.1f} µm more play there"
    return Fault("worn-screw", words, "EXX", ("backlash_zone", "backlash_position"), error, {"X": 0.6 * size})


def _hot_nut(rng: np.random.Generator) -> Fault:
    size = rng.uniform(0.9, 1.4)

    def error(here: Here) -> Floats:
        return np.asarray(-0.5 * size * (here.degc["z_nut"] - 20.0) * here.way["Z"])

    words = f"a nut of Z that opens as it warms: {size:.2f} µm more play per °C"
    return Fault("hot-nut", words, "EZZ", ("backlash_temperature",), error, {"Z": 4.0 * size})


def _loose_gib(rng: np.random.Generator) -> Fault:
    size = rng.uniform(3.5, 6.0) * rng.choice([-1.0, 1.0])

    def error(here: Here) -> Floats:
        return np.asarray(0.5 * size * here.way["X"])

    words = f"a loose gib: the cross slide shifts by {abs(size):.1f} µm along Z each time X turns round"
    return Fault("loose-gib", words, "EZX", ("backlash",), error)


def _bed(rng: np.random.Generator) -> Fault:
    size, middle = rng.uniform(0.9, 1.5) * rng.choice([-1.0, 1.0]), 200.0

    def error(here: Here) -> Floats:
        difference = here.degc["headstock"] - here.degc["bed"]
        return np.asarray(size * difference * (1.0 - np.cos(0.9 * (here.q["Z"] - middle) / middle)) / 0.378)

    words = f"a bed that bends as the headstock warms: {abs(size):.1f} µm at its ends per °C of difference"
    return Fault("bed", words, "EXZ", ("bed_bending",), error)


def _rack(rng: np.random.Generator) -> Fault:
    period, size, phase = rng.uniform(16.0, 45.0), rng.uniform(2.5, 4.0), rng.uniform(0.0, 2.0 * np.pi)

    def error(here: Here) -> Floats:
        turn = 2.0 * np.pi * here.q["Z"] / period + phase
        return np.asarray(size * (np.sin(turn) - 0.12 * np.sin(3.0 * turn)))

    words = f"a coupling of Z that slips out of true: a wave of {size:.1f} µm every {period:.1f} mm"
    return Fault("coupling", words, "EZZ", ("cyclic_pole",), error)


FAULTS: Mapping[str, Callable[[np.random.Generator], Fault]] = {
    "gear": _gear,
    "worn-screw": _worn_screw,
    "hot-nut": _hot_nut,
    "loose-gib": _loose_gib,
    "bed": _bed,
    "coupling": _rack,
}


def draw(seed: int, name: str | None = None) -> Fault:
    """Draw a fault and its numbers; with a name, draw its numbers only.

    Raises:
        ConfigError: no fault has that name.
    """
    rng = np.random.default_rng([seed, 50])
    chosen = list(FAULTS)[int(rng.integers(len(FAULTS)))]
    if name is not None and name not in FAULTS:
        raise ConfigError(f"--hidden {name!r}: no such fault{nearest(name, FAULTS)}")
    return FAULTS[name or chosen](rng)


def with_play(truth: Truth, fault: Fault) -> Truth:
    """The truth with the play of a fault, so that the slide really moves in it."""
    axes = {
        name: axis.model_copy(update={"backlash_um": axis.backlash_um + fault.play_um.get(name, 0.0)})
        for name, axis in truth.axis.items()
    }
    return truth.model_copy(update={"axis": axes})


class FaultyGeometry(Geometry):
    """The true errors of a machine with an additional fault."""

    def __init__(self, machine: Machine, truth: Truth, bodies: tuple[str, ...], seed: int, fault: Fault) -> None:
        super().__init__(machine, truth, bodies, seed)
        self._fault, self._names, self._bodies = fault, machine.axis_names, (*bodies, "air")
        self._degc = dict.fromkeys(self._bodies, truth.reference_degc)
        self._moves_mm = np.array([1e-3 if fault.component[1] == letter else 0.0 for letter in "XYZ"])

    def set_temperatures(self, body_degc: Floats, time_s: float) -> None:
        """As `Geometry`; stores the temperatures for the fault."""
        super().set_temperatures(body_degc, time_s)
        self._degc = dict(zip(self._bodies, map(float, body_degc), strict=True))

    def tip_mm(self, reading_mm: Floats, slide_mm: Floats) -> Floats:
        """As `Geometry`, plus the shift by the fault."""
        way = {n: self._way(a, reading_mm[:, a], slide_mm[:, a]) for a, n in enumerate(self._names)}
        here = Here({n: reading_mm[:, a] for a, n in enumerate(self._names)}, way, self._degc)
        moved = self._fault.error(here)[:, None] * self._moves_mm
        return np.asarray(super().tip_mm(reading_mm, slide_mm) + moved)

    def _way(self, number: int, reading_mm: Floats, slide_mm: Floats) -> Floats:
        """Position of a slide in its play, -1 to +1, from slide and encoder positions."""
        axis = self.axes[number]
        if axis.on_scale or axis.half_play_mm <= 0.0:
            return np.zeros(len(reading_mm))
        motor = axis.motor_at(reading_mm)
        after = slide_mm - 1e-3 * axis.position_error_um(motor)
        return np.clip((motor - after) / axis.half_play_mm, -1.0, 1.0)


def with_fault(sim: SimulatedMachine, fault: Fault | None, seed: int) -> SimulatedMachine:
    """Add a fault to a simulated machine; None adds nothing."""
    if fault is not None:
        sim.geometry = FaultyGeometry(sim.machine, sim.truth, sim.thermal.bodies, seed, fault)
        sim.geometry.set_temperatures(sim.thermal.body_degc, float(sim.thermal.time_s))
    return sim

"""The simulated machine as the far sides use it; the track of its tool tip, and its accuracy."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rtec.arrays import Bools, Floats, Ints
from rtec.hil import Accuracy
from rtec.machine import Machine
from rtec.sim.controller import COMMAND, MOTOR, READING, SLIDE
from rtec.sim.machine import SimulatedMachine, recording_of


@dataclass(frozen=True)
class TipTrack:
    """Track; one row an instant.

    Attributes:
        time_s: time since the machine's start, (n,).
        commanded_mm: (n, axes).
        tip_um: tool relative to workpiece, actual minus commanded, (n, 3).
        inserted: inserted counts at the machine's controller, (n, axes).
    """

    time_s: Floats
    commanded_mm: Floats
    tip_um: Floats
    inserted: Ints

    def save(self, path: Path) -> None:
        """Write it as plain arrays."""
        np.savez(path, **vars(self))

    @classmethod
    def load(cls, path: Path) -> "TipTrack":
        """Read what `save` wrote."""
        with np.load(path, allow_pickle=False) as arrays:
            return cls(**{name: arrays[name] for name in cls.__dataclass_fields__})


def directions(machine: Machine) -> tuple[str, ...]:
    """Directions of the axes that are compensated, in the order X, Y, Z."""
    return tuple(d for d in "XYZ" if any(a.direction == d and a.compensate for a in machine.axes))


def errors_um(track: TipTrack, names: Sequence[str]) -> Floats:
    """Tip errors in some directions, (n, directions)."""
    return track.tip_um[:, ["XYZ".index(d) for d in names]]


def inside(time_s: Floats, spans: Sequence[tuple[float, float]]) -> Bools:
    """Which instants are in any of the spans, (n,)."""
    out = np.zeros(len(time_s), np.bool_)
    for low, high in spans:
        out |= (time_s >= low) & (time_s <= high)
    return out


def accuracy(track: TipTrack, names: Sequence[str], spans: Sequence[tuple[float, float]]) -> Accuracy:
    """Accuracy of the tip in these spans of time."""
    error = errors_um(track, names)[inside(track.time_s, spans)]
    if not len(error):
        return Accuracy(float("nan"), float("nan"), dict.fromkeys(names, float("nan")))
    rms = np.sqrt(np.mean(error**2, axis=0))
    return Accuracy(
        float(np.sqrt(np.mean(np.sum(error**2, axis=1)))),
        float(np.linalg.norm(error, axis=1).max()),
        dict(zip(names, rms.tolist(), strict=True)),
    )


TRACED = [COMMAND, MOTOR, SLIDE, READING]


class Recorder:
    """Records the machine's state at growing instants; the tip errors are computed at the end, outside real time.

    Args:
        machine: machine to record.
        every_ns: shortest time between two records.
    """

    def __init__(self, machine: SimulatedMachine, every_ns: int) -> None:
        self._machine, self._every_ns = machine, every_ns
        self._start_ns = self._next_ns = machine.time_ns
        self._times: list[int] = []
        self._axes: list[Floats] = []
        self._inserted: list[Ints] = []
        self._seconds: list[int] = []
        self._bodies: dict[int, Floats] = {}

    def look(self) -> None:
        """Record the present state, if that is due."""
        machine = self._machine
        if machine.time_ns < self._next_ns:
            return
        self._next_ns = machine.time_ns + self._every_ns
        second = machine.thermal.time_s
        if second not in self._bodies:
            self._bodies[second] = machine.thermal.body_degc.copy()
        self._times.append(machine.time_ns)
        self._axes.append(np.asarray(machine.save()["axes"], np.float64)[:, TRACED])
        self._inserted.append(machine.inserted_counts)
        self._seconds.append(second)

    def track(self) -> TipTrack:
        """The tip's track. Leaves the machine's geometry at the last instant's temperatures."""
        geometry, axes = self._machine.geometry, self._machine.machine.axes
        per_mm = np.array([a.counts_per_mm for a in axes], np.float64)
        states, times = np.stack(self._axes), np.array(self._times)
        seconds = np.array(self._seconds)
        tip_um = np.empty((len(times), 3))
        for second, body_degc in self._bodies.items():
            mine = seconds == second
            geometry.set_temperatures(body_degc, float(second))
            tip_um[mine] = recording_of(geometry, per_mm, states[mine], times[mine]).tip_error_um
        return TipTrack((times - self._start_ns) * 1e-9, states[:, :, 0].copy(), tip_um, np.stack(self._inserted))


class Sensed:
    """Temperatures of the sensors and the spindle speed, in a file that two processes map.

    Every number is one aligned word, so it is never torn; as on a real machine, numbers need not belong to the same
    instant.

    Args:
        path: the file; created where it does not exist.
        sensors: number of sensors.
    """

    def __init__(self, path: Path, sensors: int) -> None:
        if not path.exists():
            path.write_bytes(bytes(8 * (sensors + 1)))
        self._words = np.memmap(path, np.float64, "r+", shape=(sensors + 1,))

    def write(self, degc: Floats) -> None:
        """Set the sensors' temperatures, °C."""
        self._words[:-1] = degc

    def degc(self, sensor: int) -> float:
        """A sensor's temperature, °C."""
        return float(self._words[sensor])

    @property
    def rpm(self) -> float:
        """Spindle speed, 1/min, signed."""
        return float(self._words[-1])

    @rpm.setter
    def rpm(self, value: float) -> None:
        self._words[-1] = value


class MachinePlant:
    """The simulated machine at an encoder box: its time stands still until `start`, then follows the clock.

    Attributes:
        jump_counts: error of the box's counts.
    """

    def __init__(self, machine: SimulatedMachine, sensed: Sensed, every_ns: int) -> None:
        self.machine, self.jump_counts = machine, 0
        self.recorder = Recorder(machine, every_ns)
        self._sensed, self._lead_ns = sensed, machine.time_ns
        self._start_ns: int | None = None
        self._second = -1
        self._sense()

    def start(self, now_ns: int) -> None:
        """Start the machine's time now."""
        self._start_ns = now_ns

    def follow(self, now_ns: int) -> None:
        """Advance it to now."""
        if self._start_ns is None:
            return
        self.machine.advance_to(self._lead_ns + now_ns - self._start_ns)
        self.recorder.look()
        self._sense()

    def counts(self, now_ns: int) -> list[int]:
        """Raw counts of every axis, x4, as the box has them."""
        self.follow(now_ns)
        return [int(n) + self.jump_counts for n in self.machine.raw_counts]

    def insert(self, ledger: list[int]) -> None:
        """Add this many counts to those that the controller sees."""
        self.machine.apply(np.array(ledger, np.int64))

    def _sense(self) -> None:
        self._sensed.rpm = self.machine.spindle_rpm
        second = self.machine.thermal.time_s
        if second != self._second:
            self._second = second
            self._sensed.write(self.machine.temperatures()[0])


class InBoxOrder:
    """A plant with its axes in the order of the box's inputs.

    Args:
        plant: plant in the machine's order.
        order: for every input of the box, the index of its axis.
    """

    def __init__(self, plant: MachinePlant, order: tuple[int, ...]) -> None:
        self._plant, self._order = plant, order

    def counts(self, now_ns: int) -> list[int]:
        """Raw counts, input by input."""
        counts = self._plant.counts(now_ns)
        return [counts[axis] for axis in self._order]

    def insert(self, ledger: list[int]) -> None:
        """Pass the ledger on, in the machine's order."""
        own = [0] * len(ledger)
        for value, axis in zip(ledger, self._order, strict=True):
            own[axis] = value
        self._plant.insert(own)

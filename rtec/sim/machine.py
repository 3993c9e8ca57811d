"""The simulated machine: program, controller, drives, slides, heat, sensors and the true tip error, in one object.

The caller passes the time, so that real and virtual clocks both work. Temperatures change at every whole second and are
constant in between; no error changes by more than about 0.02 µm in a second.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtec.arrays import Floats, Ints
from rtec.machine import Machine
from rtec.sim import controller as c
from rtec.sim.controller import (
    T_COMMAND,
    T_MOTOR,
    T_READING,
    T_SLIDE,
    at_rest,
    program_table,
    servo_parameters,
    table_nodes_mm,
)
from rtec.sim.geometry import Geometry
from rtec.sim.program import END, POSITIONS, ProgramReader
from rtec.sim.thermal import ThermalNetwork
from rtec.sim.truth import Truth, check_truth


@dataclass(frozen=True)
class MotionRecording:
    """A recording, one row an instant; tip errors as in `SimulatedMachine`.

    Attributes:
        time_ns: (n,).
        commanded_mm, actual_mm: (n, axes); actual is the true position of the slides.
        raw_counts: (n, axes).
        reading_counts: the encoder's position as a real number of counts; `raw_counts` is its floor.
        tip_error_um, geometric_error_um: (n, 3).
    """

    time_ns: Ints
    commanded_mm: Floats
    actual_mm: Floats
    raw_counts: Ints
    reading_counts: Floats
    tip_error_um: Floats
    geometric_error_um: Floats


def recording_of(geometry: Geometry, counts_per_mm: Floats, trace: Floats, time_ns: Ints) -> MotionRecording:
    """A recording from the controller's trace, (n, axes, 4), all of it within one second of constant temperatures."""
    command, reading = trace[:, :, T_COMMAND], trace[:, :, T_READING]
    slides = geometry.slides_mm(trace[:, :, T_MOTOR], trace[:, :, T_SLIDE])
    tip = geometry.tip_mm(reading, slides)
    nominal = geometry.chain.nominal_mm
    in_counts = reading * counts_per_mm + 0.5
    return MotionRecording(
        time_ns=time_ns,
        commanded_mm=command.copy(),
        actual_mm=slides,
        raw_counts=np.floor(in_counts).astype(np.int64),
        reading_counts=in_counts,
        tip_error_um=(tip - nominal(command)) * 1e3,
        geometric_error_um=(tip - nominal(reading)) * 1e3,
    )


NS = 1_000_000_000


class SimulatedMachine:
    """A machine tool with its controller.

    Args:
        machine: the machine as rtec knows it.
        truth: the true errors.
        seed: seed of the day; another seed is another day of the same machine.
        start_mm: start position (axes,), within the travel; default zero.

    Raises:
        ConfigError: truth and machine do not fit.
    """

    def __init__(self, machine: Machine, truth: Truth, seed: int = 0, start_mm: ArrayLike | None = None) -> None:
        check_truth(truth, machine)
        self.machine, self.truth = machine, truth
        self.thermal = ThermalNetwork(truth, machine.axis_names, machine.sensor_names, seed)
        self.geometry = Geometry(machine, truth, self.thermal.bodies, seed)
        self._period_ns = truth.servo.period_us * 1000
        self._ticks_per_s = NS // self._period_ns
        self._per_mm = np.array([a.counts_per_mm for a in machine.axes], dtype=np.float64)
        self._nodes_mm = table_nodes_mm(machine)
        self._parameters = servo_parameters(machine, truth, self.geometry, self._nodes_mm)
        self._tables = np.zeros(self._nodes_mm.shape)
        self._warm()
        n = len(machine.axes)
        self._axes, self._counts = at_rest(machine, self.geometry, np.zeros(n) if start_mm is None else start_mm)
        self._clock: Ints = np.zeros(c.CLOCK_STATES, np.int64)
        self._spindle = np.array([0.0, truth.servo.spindle_rpm_per_s / self._ticks_per_s, 0.0])
        self._blocks = np.zeros((0, POSITIONS + 2 * n))
        self._paid = np.zeros(1 + n)  # turns and path whose heat the network already has
        self._no_trace = np.zeros((0, n, c.TRACE_COLUMNS))
        self._read: tuple[int, Floats] = (-1, np.zeros(0))

    @property
    def time_ns(self) -> int:
        """Simulated time, ns since the start, in whole servo ticks."""
        return int(self._clock[c.TICK]) * self._period_ns

    def advance_to(self, time_ns: int) -> None:
        """Run program, controller and heat up to an instant; an instant in the past has no effect."""
        while (ticks := self._ticks_to(time_ns)) > 0:
            self._run(ticks, self._no_trace, 1)
            self._heat_up()

    def work(self, duration_s: float, spindle_rpm: float = 0.0, feed_duty: float = 0.0) -> None:
        """Simulate a long time in one step, in whole seconds: heat only, the slides end at their present positions.

        Args:
            duration_s: duration; the program, if any, waits meanwhile.
            spindle_rpm: speed throughout, and afterwards until the program sets another.
            feed_duty: share of the time, 0 to 1, in which every axis moves at its production feed.
        """
        seconds = round(duration_s)
        feeds = np.array([self.truth.axis[a.name].drive.production_feed_mm_s for a in self.machine.axes])
        self.thermal.advance(seconds, self.thermal.heat_w(spindle_rpm, feed_duty * feeds))
        self._clock[[c.TICK, c.PROGRAM_TICK]] += seconds * self._ticks_per_s
        self._spindle[c.SPINDLE_RPM] = spindle_rpm
        self._warm()

    def record_to(self, time_ns: int, every_ns: int) -> MotionRecording:
        """As `advance_to`, with a recording at every multiple of `every_ns`."""
        stride = max(1, every_ns // self._period_ns)
        pieces = [self._run_recorded(ticks, stride) for ticks in iter(lambda: self._ticks_to(time_ns), 0)]
        names = MotionRecording.__dataclass_fields__
        empty = self._recording(self._no_trace, np.zeros(0, np.int64))
        return MotionRecording(**{k: np.concatenate([getattr(p, k) for p in (empty, *pieces)]) for k in names})

    def load_program(self, text: str, repeat: bool = False) -> None:
        """Start a part program (`rtec.sim.program`) at the present time and position.

        A program that repeats ends with a rapid move back to its start.

        Raises:
            ConfigError: a line is wrong; the message has its number, its text and what is allowed.
        """
        start = tuple(float(v) for v in self.commanded_mm)
        travel = tuple(a.travel_mm for a in self.machine.axes)
        reader = ProgramReader(self.machine.axis_names, travel, start, self.truth.servo.rapid_mm_s, self.spindle_rpm)
        self._blocks = program_table(reader, self.truth, text, repeat)
        self._clock[c.PROGRAM_TICK :] = self._clock[c.TICK], 0, int(repeat)

    @property
    def program_s(self) -> float:
        """Duration of one pass of the program, s."""
        return float(self._blocks[-1][END]) * self._period_ns * 1e-9 if len(self._blocks) else 0.0

    @property
    def raw_counts(self) -> Ints:
        """Encoder counts before insertion, (axes,)."""
        return self._counts[:, c.COUNTS].copy()

    @property
    def inserted_counts(self) -> Ints:
        """Counts inserted, (axes,)."""
        return self._counts[:, c.INSERTED].copy()

    def apply(self, inserted: Ints) -> None:
        """Insert counts, (axes,), absolute: the controller reads raw + inserted, so +k stops the slide k sooner."""
        self._counts[:, c.INSERTED] = inserted

    def set_offset_um(self, offset_um: ArrayLike, kind: str = "following_error") -> None:
        """Shift the slides by a controller register instead: positive moves them further; rounded to counts.

        Args:
            offset_um: (axes,), absolute.
            kind: "following_error" acts at the next servo tick; "origin" at the next block, or at once at rest.
        """
        column = {"following_error": c.FOLLOWING, "origin": c.NEXT_ORIGIN}[kind]
        self._counts[:, column] = np.rint(np.asarray(offset_um) * 1e-3 * self._per_mm).astype(np.int64)

    def temperatures(self) -> tuple[Floats, int]:
        """Readings of the sensors, °C (sensors,), and their time, ns (the last whole second)."""
        second = self.thermal.time_s
        if self._read[0] != second:
            self._read = (second, self.thermal.readings_degc())
        return self._read[1].copy(), second * NS

    @property
    def spindle_rpm(self) -> float:
        """Spindle speed, 1/min, signed."""
        return float(self._spindle[c.SPINDLE_RPM])

    @property
    def commanded_mm(self) -> Floats:
        """Commanded positions of the axes, (axes,)."""
        return self._axes[:, c.COMMAND].copy()

    @property
    def actual_mm(self) -> Floats:
        """True positions of the slides along their axes, (axes,)."""
        return _only(self._now().actual_mm)

    def tip_error_um(self) -> Floats:
        """Tool relative to workpiece, actual minus *commanded*, (3,): with servo error, counts and correction."""
        return _only(self._now().tip_error_um)

    def geometric_error_um(self) -> Floats:
        """Tool relative to workpiece, actual minus *encoder readings*, (3,): the error that a model predicts."""
        return _only(self._now().geometric_error_um)

    def geometric_error_at_um(self, position_mm: ArrayLike, direction: ArrayLike = 0.0) -> Floats:
        """The same at encoder readings (n, axes), approached in direction ±1 (0: mid-play), (n, 3)."""
        q = np.atleast_2d(np.asarray(position_mm, dtype=np.float64))
        slides = self.geometry.at_readings(q, np.broadcast_to(np.asarray(direction, dtype=np.float64), q.shape))
        return (self.geometry.tip_mm(q, slides) - self.geometry.chain.nominal_mm(q)) * 1e3

    def save(self) -> dict[str, NDArray[np.generic]]:
        """The whole state as plain arrays."""
        kept = {"axes": self._axes, "counts": self._counts, "clock": self._clock, "spindle": self._spindle}
        kept |= {"blocks": self._blocks, "paid": self._paid, "thermal": self.thermal.state}
        return {name: array.copy() for name, array in kept.items()}

    def restore(self, kept: dict[str, NDArray[np.generic]]) -> None:
        """Restore a state from `save`; machine, truth and seed must be the same."""
        own = {name: np.array(array) for name, array in kept.items()}
        self._axes, self._counts, self._clock = own["axes"], own["counts"], own["clock"]
        self._spindle, self._blocks, self._paid = own["spindle"], own["blocks"], own["paid"]
        self.thermal.state = own["thermal"]
        self.thermal.time_s = int(self._clock[c.TICK]) // self._ticks_per_s
        self._warm()

    def _ticks_to(self, time_ns: int) -> int:
        """Servo ticks to an instant, at most to the next whole second."""
        tick = int(self._clock[c.TICK])
        return max(0, min(time_ns // self._period_ns - tick, self._ticks_per_s - tick % self._ticks_per_s))

    def _run(self, ticks: int, trace: Floats, stride: int) -> None:
        setup = (self._period_ns * 1e-9, self._parameters, self._tables, self._blocks)
        c.run_ticks(ticks, setup, (self._axes, self._counts, self._clock, self._spindle), trace, stride)

    def _run_recorded(self, ticks: int, stride: int) -> MotionRecording:
        first = int(self._clock[c.TICK])
        marks = np.arange((first // stride + 1) * stride, first + ticks + 1, stride)
        trace = np.zeros((len(marks), len(self._axes), c.TRACE_COLUMNS))
        self._run(ticks, trace, stride)
        done = self._recording(trace, marks * self._period_ns)  # with the temperatures of this second
        self._heat_up()
        return done

    def _heat_up(self) -> None:
        """At a whole second, advance the thermal network with the heat of the past second."""
        if self._clock[c.TICK] % self._ticks_per_s:
            return
        done = np.concatenate([self._spindle[c.TURNS :], self._axes[:, c.TRAVELLED]])
        mean = done - self._paid
        self._paid = done
        self.thermal.advance(1, self.thermal.heat_w(mean[0] * 60.0, mean[1:]))
        self._warm()

    def _warm(self) -> None:
        """Set geometry, and the encoder tables of linear scales, to the temperatures of this second."""
        self.geometry.set_temperatures(self.thermal.body_degc, float(self.thermal.time_s))
        for a, axis in enumerate(self.geometry.axes):
            if axis.on_scale:
                self._tables[a] = 1e-3 * axis.encoder_table_um(self._nodes_mm[a])

    def _now(self) -> MotionRecording:
        columns = self._axes[None, :, [c.COMMAND, c.MOTOR, c.SLIDE, c.READING]]
        return self._recording(columns, np.array([self.time_ns]))

    def _recording(self, trace: Floats, time_ns: Ints) -> MotionRecording:
        return recording_of(self.geometry, self._per_mm, trace, time_ns)


def _only(rows: Floats) -> Floats:
    """The row of a recording of one instant."""
    row: Floats = rows[0]
    return row

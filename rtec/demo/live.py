"""Simulates a day: uncorrected by the machine alone, corrected through the loop of `rtec run`."""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.correction.flags import HOLD_REASONS, MODE_ON, GuardSettings, Limits
from rtec.demo.day import EVERY_NS, NS, OTHER, WAIT_S, Cut, Plan, Track, Work, surface_of
from rtec.demo.hidden import Fault, with_fault
from rtec.loop.devices import Ports, driver_class
from rtec.loop.loop import Loop, Row, bind_rows
from rtec.loop.records import Commands, Samples
from rtec.loop.step import Step, StepSettings
from rtec.machine import Machine
from rtec.model import Model
from rtec.sim.controller import COMMAND, MOTOR, READING, SLIDE
from rtec.sim.machine import MotionRecording, SimulatedMachine, recording_of
from rtec.sim.truth import Truth

Progress = Callable[[int, int], None]

RATE_HZ = 250
LIMITS = Limits(warning_um=120.0, stop_um=150.0, slew_um_s=200.0, acceleration_um_s2=10000.0)
GUARD = GuardSettings()


class Book:
    """Collects a track."""

    def __init__(self, machine: SimulatedMachine) -> None:
        self._machine = machine
        self._per_mm = np.array([a.counts_per_mm for a in machine.machine.axes])
        self._pieces: list[dict[str, Any]] = []
        self.part = -1

    def write(self, seen: MotionRecording, cutting: bool, inserted: Any) -> None:
        """Append a recording, with the present temperatures."""
        n = len(seen.time_ns)
        surface = surface_of(seen.commanded_mm) if cutting else np.full(n, OTHER, np.int64)
        self._pieces.append({
            "time_ns": seen.time_ns, "part": np.full(n, self.part if cutting else -1, np.int64), "surface": surface,
            "commanded_mm": seen.commanded_mm, "reading_mm": (seen.reading_counts - 0.5) / self._per_mm,
            "raw_counts": seen.raw_counts, "inserted_counts": np.broadcast_to(inserted, seen.raw_counts.shape),
            "tip_um": seen.tip_error_um, "geometric_um": seen.geometric_error_um,
            "degc": np.tile(self._machine.temperatures()[0], (n, 1)),
            "body_degc": np.tile(self._machine.thermal.body_degc, (n, 1)),
        })  # fmt: skip

    def stand(self) -> None:
        """Append an instant between parts, without the tip."""
        sim, none = self._machine, np.full((1, 3), np.nan)
        counts, here = sim.raw_counts[None], sim.commanded_mm[None]
        reading = counts.astype(np.float64) + 0.5
        standing = MotionRecording(np.array([sim.time_ns]), here, here, counts, reading, none, none)
        self.write(standing, False, sim.inserted_counts)

    def track(self) -> Track:
        """The track so far."""
        names = Track.__dataclass_fields__
        return Track(**{k: np.concatenate([p[k] for p in self._pieces]) for k in names})


class MachineClock:
    """A clock that advances the simulated machine when it sleeps, and records it at every multiple of `EVERY_NS`.

    Attributes:
        work: work of the machine while the clock sleeps; None: it runs its program.
        looked: whether the present instant is recorded.
    """

    def __init__(self) -> None:
        self.work: Work | None = None
        self.looked = False
        self._machine: SimulatedMachine | None = None
        self._kept: list[tuple[int, Floats, Ints]] = []

    def drive(self, machine: SimulatedMachine, book: Book) -> None:
        """Drive this machine from now on."""
        self._machine, self._book = machine, book
        self._per_mm = np.array([a.counts_per_mm for a in machine.machine.axes])

    def now_ns(self) -> int:
        """Time of the machine."""
        return self._machine.time_ns if self._machine else 0

    def sleep_until_ns(self, instant_ns: int) -> None:
        """Advance the machine to an instant."""
        machine = self._machine
        if machine is None:
            return
        self.looked = self.work is not None or instant_ns % EVERY_NS == 0
        if self.work is not None:
            machine.work((instant_ns - machine.time_ns) / NS, self.work.rpm, self.work.feed_duty)
            self._book.stand()
        elif instant_ns % NS == 0:
            # Temperatures change at a whole second: first compute the past second with its own ones.
            self._look_back(machine)
            recording = machine.record_to(instant_ns, EVERY_NS)
            self._book.write(recording, True, machine.inserted_counts)
        else:
            machine.advance_to(instant_ns)
            if self.looked:
                self._kept.append((instant_ns, machine.save()["axes"], machine.inserted_counts))  # type: ignore[arg-type]

    def _look_back(self, machine: SimulatedMachine) -> None:
        """Compute the tip errors of a second together, which is faster than one by one."""
        if not self._kept:
            return
        trace = np.stack([axes for _, axes, _ in self._kept])[:, :, [COMMAND, MOTOR, SLIDE, READING]]
        times = np.array([at for at, _, _ in self._kept])
        recording = recording_of(machine.geometry, self._per_mm, trace, times)
        self._book.write(recording, True, np.stack([inserted for _, _, inserted in self._kept]))
        self._kept = []


@dataclass(frozen=True)
class LoopSide:
    """Samples and commands of the loop at the instants of a track, and the play that only the simulation knows.

    Attributes:
        samples, commands: n rows.
        seen_counts: position that the controller reads after the cycle, (n, axes).
        direction: direction of every axis in the step, (n, axes).
        play_um: position of the slide in its play: slide minus motor, (n, axes).
    """

    samples: Samples
    commands: Commands
    seen_counts: Ints
    direction: Floats
    play_um: Floats

    @property
    def held(self) -> Any:
        """Whether the guard held the correction, (n,)."""
        return (self.commands.flags & HOLD_REASONS) != 0


def uncorrected(machine: Machine, truth: Truth, seed: int, plan: Plan) -> Track:
    """The day without correction, and without the loop."""
    sim = SimulatedMachine(machine, truth, seed)
    book = Book(sim)
    none = np.zeros(len(machine.axes), np.int64)
    for step in plan.steps(seed):
        if isinstance(step, Work):
            for _ in range(step.seconds // WAIT_S):
                sim.work(WAIT_S, step.rpm, step.feed_duty)
                book.stand()
            continue
        book.part += 1
        end_ns = _start_cut(sim, step)
        while sim.time_ns < end_ns:
            second_ns = (sim.time_ns // NS + 1) * NS
            for until_ns in (second_ns - EVERY_NS, second_ns):
                book.write(sim.record_to(until_ns, EVERY_NS), True, none)
    return book.track()


def step_settings(model: Model) -> StepSettings:
    """Settings of the demo's step: those of `rtec run` at the demo's rate."""
    return StepSettings(model, dict.fromkeys(model.machine.axis_names, LIMITS), {}, GUARD, 10.0 / RATE_HZ)


def corrected(
    model: Model,
    truth_file: Path,
    seed: int,
    plan: Plan,
    mode: int = MODE_ON,
    progress: Progress | None = None,
    fault: Fault | None = None,
) -> tuple[Track, LoopSide]:
    """The day through the loop, with the simulated machine's driver for input and output."""
    machine, clock = model.machine, MachineClock()
    kind = driver_class("sim", "demo")
    device = kind(kind.options_model(truth=truth_file, seed=seed), machine, clock)
    sim = with_fault(device.machine, fault, seed)
    step = Step(step_settings(model))
    pair = Samples.empty(step.layout, 1), Commands.empty(step.layout, 1)
    rows = bind_rows(step, [pair])
    book, sides = Book(sim), _Sides(sim, step)
    clock.drive(sim, book)
    with ExitStack() as stack:
        ports = Ports(stack.enter_context(device), (device,), device, device)
        waiting = Loop(step, ports, clock, WAIT_S * NS, rows, mode)
        cutting = Loop(step, ports, clock, NS // RATE_HZ, rows, mode)

        def after(row: Row) -> bool:
            if clock.looked:
                sides.write(row)
            return True

        for what in plan.steps(seed):
            if isinstance(what, Work):
                clock.work = what
                waiting.run(what.seconds // WAIT_S, after)
                clock.work = None
                continue
            book.part += 1
            end_ns = _start_cut(sim, what)
            cutting.run((end_ns - sim.time_ns) * RATE_HZ // NS, after)
            if progress:
                progress(book.part + 1, plan.cuts)
    return book.track(), sides.together()


class _Sides:
    """Collects a `LoopSide`."""

    def __init__(self, sim: SimulatedMachine, step: Step) -> None:
        self._sim, self._step, self._at = sim, step, step.source.floats.at["d"]
        self._rows: list[tuple[dict[str, Any], dict[str, Any], Ints, Floats, Floats]] = []

    def write(self, row: Row) -> None:
        axes = self._sim.save()["axes"]
        play_um = 1e3 * (np.asarray(axes[:, SLIDE], np.float64) - np.asarray(axes[:, MOTOR], np.float64))
        direction = self._step.state.floats[self._at].copy()
        seen = self._sim.raw_counts + self._sim.inserted_counts
        self._rows.append((row.samples.copy().arrays(), row.commands.copy().arrays(), seen, direction, play_um))

    def together(self) -> LoopSide:
        samples, commands, seen, direction, play_um = zip(*self._rows, strict=True)
        return LoopSide(
            Samples(**{k: np.concatenate([s[k] for s in samples]) for k in samples[0]}),
            Commands(**{k: np.concatenate([c[k] for c in commands]) for k in commands[0]}),
            np.stack(seen),
            np.stack(direction),
            np.stack(play_um),
        )


def _start_cut(sim: SimulatedMachine, cut: Cut) -> int:
    """Load the program; give the whole second at which it ends, ns."""
    sim.load_program(cut.program)
    return -(-(sim.time_ns + round(sim.program_s * NS)) // NS) * NS

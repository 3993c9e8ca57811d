"""The fast path: the loop in a process of its own, which writes into the supervisor's ring.

It owns the count source, the actuator and the kept state. It ends when its cycles are done, when the supervisor
requests it through the ring, or in the next cycle after the supervisor has ended. In each case the devices hold, then
close.

Between two cycles (`AfterCycle`) it publishes the row, reads the orders, and takes over a reload or another zero. A
reload with the same structure (other limits, other coefficients) only copies numbers. Another structure is another
compiled step: a thread of lower priority compiles it while the loop goes on.
"""

import os
import signal
import sys
import threading
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtec.arrays import Ints
from rtec.correction.flags import MODE_HOLD, OUTPUT_TROUBLE
from rtec.daemon.process import prepare_process, starter
from rtec.daemon.published import Published
from rtec.daemon.recover import AtStart, Start, allowed, recover, why_waits
from rtec.daemon.ring import Ring
from rtec.daemon.sign_check import load_stepped
from rtec.daemon.supervision import fault
from rtec.daemon.workers import worker_ports
from rtec.errors import DriverError, RtecError
from rtec.loop.clock import Clock, RealClock
from rtec.loop.devices import Ports, make_devices, open_ports
from rtec.loop.loop import Loop, Row, bind_rows
from rtec.loop.output import beyond
from rtec.loop.ports import OneWay, Resumable
from rtec.loop.records import MODES_BY_NAME, Commands, Samples
from rtec.loop.run_file import Setup
from rtec.loop.state import Saved, StateWriter, is_damaged, newest, state_text, structure_of, units_of
from rtec.loop.state_files import StatePlaces, disk_is_damaged, read_disk, state_memory
from rtec.loop.step import Step, StepSettings
from rtec.loop.zero import Home, Zero

NOTES_PER_S: Final = 10


class AfterCycle:
    """Called with each row after its command; returns whether the loop goes on.

    Args:
        loop: the running loop; its keeper is set.
        ring: shared with the supervisor.
        pipe: brings the content of a reload, before the ring has its order.
        image: memory of the kept state.
        rate_hz: cycles per second.
    """

    def __init__(self, loop: Loop, ring: Ring, pipe: Connection, image: NDArray[np.uint8], rate_hz: float) -> None:
        self._loop, self._ring, self._pipe, self._image = loop, ring, pipe, image
        self._parent = starter()
        self._note_cycles = max(1, round(rate_hz / NOTES_PER_S))
        self._resumes, self._reloads = ring.orders.resumes, ring.orders.reloads
        self._making: _Making | None = None
        self._row: Row | None = None

    def __call__(self, row: Row) -> bool:
        """Publish the row and carry out orders; False: the loop ends."""
        loop, ring, orders, stats = self._loop, self._ring, self._ring.orders, self._loop.stats
        self._row = row
        if orders.reloads != self._reloads:
            self._reload(row, orders.reloads)
        if self._making is not None:
            self._take_made(row, self._making)
        ring.publish()
        ring.deadline_misses = stats.misses
        loop.mode = orders.mode
        if orders.resumes != self._resumes:
            self._resumes = orders.resumes
            loop.order_resume()
        if stats.cycles % self._note_cycles == 0:
            self._tell()
        return os.getppid() == self._parent and not ring.stop_requested

    def finish(self, in_order: bool) -> None:
        """Keep the last state as that of a run that ended in order; else it stays as after a kill."""
        loop, row = self._loop, self._row
        if row is not None and loop.keeper is not None and in_order and not loop.waits:
            loop.keeper.finish(row.samples, row.output, loop.stats.cycles - 1)

    def _tell(self) -> None:
        loop, ring = self._loop, self._ring
        reasons = loop.stats.reasons()
        if loop.keeper is not None:
            loop.keeper.waits = loop.waits
            loop.keeper.tell_why(why_waits(reasons) if loop.waits else "")
        if ring.note is not None:
            ring.note.write(reasons)
        ring.takeovers = loop.stats.takeovers  # whoever sees it sees what is wrong since

    def _reload(self, row: Row, generation: int) -> None:
        self._reloads = generation
        content = self._pipe.recv()  # the supervisor sent it before the order, so this does not wait
        if isinstance(content, Home):
            if self._loop.home(content):
                self._taken(row, generation)
            else:
                self._ring.reloads = -generation
        elif isinstance(content, StepSettings):
            self._making = _Making(content, self._ring, generation)
        else:
            self._loop.step.take_numbers(*content)
            self._taken(row, generation)

    def _take_made(self, row: Row, making: "_Making") -> None:
        if making.thread.is_alive():
            return
        self._making = None
        keeper, old = self._loop.keeper, self._loop.step
        if not making.rows:
            self._ring.reloads = -making.generation
        elif making.step is not None and keeper is not None:
            making.step.adopt(old, row.samples)
            _let_go(self._loop.go_on_with(making.step, making.rows))
            writer = StateWriter(self._image, making.step, keeper.start_mode, keeper.sequence, keeper.zero)
            writer.order, writer.waits = keeper.order, keeper.waits
            writer.tell_why(why_waits(self._loop.stats.reasons()) if writer.waits else "")
            self._loop.keeper = writer
            self._taken(row, making.generation)

    def _taken(self, row: Row, generation: int) -> None:
        if self._loop.keeper is not None:
            self._loop.keeper.snapshot(row.samples, row.output, self._loop.stats.cycles - 1)
        self._ring.reloads = generation


def _below_the_loop() -> None:
    """Set a priority just below the loop's: the loop waits for the thread that has the interpreter's lock."""
    with suppress(OSError):
        priority = os.sched_getparam(0).sched_priority
        if priority > 1:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority - 1))


def _let_go(rows: list[Row]) -> None:
    """Free thousands of rows one by one in a thread: all at once would hold the interpreter's lock for milliseconds."""

    def work() -> None:
        _below_the_loop()
        while rows:
            rows.pop()

    threading.Thread(target=work, name="rtec-let-go", daemon=True).start()


class _Making:
    """A new step that a thread of its own compiles."""

    def __init__(self, settings: StepSettings, ring: Ring, generation: int) -> None:
        self.generation = generation
        self.step: Step | None = None
        self.rows: list[Row] = []
        self.thread = threading.Thread(target=self._make, args=(settings, ring), name="rtec-reload", daemon=True)
        self.thread.start()

    def _make(self, settings: StepSettings, ring: Ring) -> None:
        _below_the_loop()
        with suppress(RtecError):  # the supervisor has compiled the same step before it sent it
            self.step = Step(settings)
            self.step.warm_up()
            self.rows = bind_rows(self.step, ring.slots)


REHEARSAL_CYCLES = 100
LONGEST_REHEARSED_NS = 10_000_000
"""Limit of the rehearsal's period, ns, so that a slow loop begins within a second or so."""
FIRST_COUNTS_S, TRY_S = 1.0, 0.01
"""Longest wait, s, for the counts of a device that sends them by itself, and between two tries. Without them nobody
knows whether an axis has moved since the run before, and its direction is lost."""
DISK_SLACK_S = 1.0
"""Largest age of the copy on disk, s (the limit of `[run] flush_s`)."""
SWITCH_INTERVAL_S = 5e-5
"""Interval, s, after which another thread of this process (a port that reopens, a new step) yields to the loop."""


@dataclass(frozen=True)
class LoopTask:
    """The supervisor's instructions to its loop at the start.

    Attributes:
        config: the run file.
        ring: name of the ring.
        cycles: number of cycles; None: until it is stopped.
        places: files of the kept state.
        workers: shared memory of the devices that a worker reads, by device.
        step_um: step of a sign check by axis, in place of the model.
    """

    config: Path
    ring: str
    cycles: int | None
    places: StatePlaces
    workers: Mapping[str, Published] = field(default_factory=dict)
    step_um: Mapping[str, float] = field(default_factory=dict)


def fast_path(task: LoopTask, pipe: Connection) -> None:
    """Run the loop; report to the supervisor through the pipe: ("ready", …), then ("done", …), ("error", text)
    or ("died", text).
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    signal.signal(signal.SIGUSR1, signal.SIG_IGN)  # the supervisor takes the order to resume; it comes through the ring
    try:
        _tell(pipe, "done", _run(task, pipe))
    except RtecError as e:
        _tell(pipe, "error", str(e))
    except Exception as e:  # noqa: BLE001 - any fault is reported with its place, devices are closed, the process ends
        _tell(pipe, "died", fault(e))
    finally:
        pipe.close()


def _tell(pipe: Connection, kind: str, content: Any) -> None:
    with suppress(BrokenPipeError, ConnectionResetError):  # the supervisor has ended: the loop notices that by itself
        pipe.send((kind, content))


def _run(task: LoopTask, pipe: Connection) -> dict[str, Any]:
    setup = load_stepped(task.config, task.step_um)
    clock = RealClock()
    step = Step(setup.step_settings())
    step.warm_up()
    with ExitStack() as stack:
        ring = stack.enter_context(Ring.attach(task.ring))
        ring.take_name()
        image = stack.enter_context(state_memory(task.places.memory, clock))
        rows = bind_rows(step, ring.slots)
        here = make_devices(setup, clock)  # all of them, so that all faults of the run file are reported together
        ports = open_ports(setup, {**here, **worker_ports(task.workers, setup.machine, clock)}, stack)
        zero = Zero(ports.counts, step.layout.axes, by_order=setup.file.run.zero == "ordered")
        at_start = _at_start(task.places, image, setup, ports, step, clock, zero)
        start = recover(step, at_start)
        loop = Loop(step, ports, clock, setup.period_ns, rows, start.mode, zero)
        if start.waits:
            loop.wait_for_order(start.waits)
        if at_start.output is None or beyond(step, at_start.output):
            loop.take_over(start.expected, allowed(step, DISK_SLACK_S), start.or_zero)
        warnings = _rehearse(setup, ports, at_start.output)
        ring.orders.mode = start.mode
        loop.keeper = StateWriter(image, step, MODES_BY_NAME[setup.file.run.mode], start.sequence, zero)
        after_cycle = AfterCycle(loop, ring, pipe, image, setup.file.run.rate_hz)
        told_all = {**_ready(step, start, warnings), "forgets": at_start.one_way or at_start.inserts or zero.by_order}
        _tell(pipe, "ready", told_all)
        try:
            loop.run(task.cycles, after_cycle)
        finally:
            ports.actuator.hold()
        after_cycle.finish(in_order=bool(ring.stop_requested) or loop.stats.cycles == task.cycles)
        return summary(loop)


def _at_start(
    places: StatePlaces, image: NDArray[np.uint8], setup: Setup, ports: Ports, step: Step, clock: Clock, zero: Zero
) -> AtStart:
    """Kept state, ledger and counts at the start; the zero goes on."""
    in_memory = image.tobytes()
    saved: Saved | None = newest(in_memory)
    new_boot, slack_s, damaged = False, 2.0 / setup.file.run.rate_hz, [places.memory] if is_damaged(in_memory) else []
    if saved is None and places.disk is not None:
        (saved, new_boot), slack_s = read_disk(places.disk), DISK_SLACK_S
        damaged += [places.disk] if saved is None and disk_is_damaged(places.disk) else []
    axes = len(step.layout.axes)
    output, counts = np.zeros(axes, np.int64), np.zeros(axes, np.int64)
    if saved is not None and saved.units == units_of(step):
        zero.go_on(saved.zero, saved.supply, saved.homed)
        if isinstance(ports.actuator, OneWay):
            ports.actuator.was_told(saved.output)
    there = first_counts(ports, counts, clock, FIRST_COUNTS_S if saved is not None else 0.0)
    return AtStart(
        saved=saved,
        new_boot=new_boot,
        slack_s=slack_s,
        output=output if _reports_output(ports, output) else None,
        counts=counts + zero.offset if there else None,
        start_mode=MODES_BY_NAME[setup.file.run.mode],
        damaged=_damaged(damaged),
        one_way=isinstance(ports.actuator, OneWay),
        inserts=isinstance(ports.actuator, Resumable) and setup.inserts,
    )


def _damaged(damaged: list[Path]) -> str:
    if not damaged:
        return ""
    places = " and ".join(str(path) for path in damaged)
    return f"the state that the run before kept in {places} is damaged, or of another version of rtec"


def _reports_output(ports: Ports, output: Ints) -> bool:
    try:
        ports.actuator.read_output(output)
    except DriverError:
        return False
    return True


def first_counts(ports: Ports, counts: Ints, clock: Clock, wait_s: float = FIRST_COUNTS_S) -> bool:
    """Read the counts, and wait for a device that sends them by itself; were there any?"""
    end_ns = clock.now_ns() + round(wait_s * 1e9)
    while True:
        try:
            ports.counts.read_counts(counts)
        except DriverError:
            if clock.now_ns() >= end_ns:
                return False
            clock.sleep_until_ns(clock.now_ns() + round(TRY_S * 1e9))
        else:
            return True


def _ready(step: Step, start: Start, warnings: list[str]) -> dict[str, Any]:
    return {
        "output": start.output.tolist(),
        "state": {"structure": structure_of(step).hex(), **state_text(step.state)},
        "warnings": [*warnings, *start.notes, *([start.waits] if start.waits else [])],
    }


def _rehearse(setup: Setup, ports: Ports, output: Ints | None) -> list[str]:
    """Run the whole cycle a few times with a held step, so that the first real cycle is not the slow one.

    The step is a second one that keeps the actuator's output, even beyond a limit: nothing moves, nothing is
    recorded. An actuator that has not reported its output gets no command before it does.
    """
    step = Step(setup.step_settings())
    if output is not None:
        step.resume(output)
    rows = bind_rows(step, [(Samples.empty(step.layout, 1), Commands.empty(step.layout, 1))])
    warnings = prepare_process(setup.file.realtime)
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    clock, parent = RealClock(), starter()
    loop = Loop(step, ports, clock, min(setup.period_ns, LONGEST_REHEARSED_NS), rows, MODE_HOLD | OUTPUT_TROUBLE)
    if output is None:
        loop.take_over(None)
    loop.run(REHEARSAL_CYCLES, lambda _: os.getppid() == parent)
    return warnings


def summary(loop: Loop) -> dict[str, Any]:
    """Times and failures of the loop, as plain data."""
    stats, step = loop.stats, loop.step
    return {
        "cycles": stats.cycles,
        "deadline_misses": stats.misses,
        "wake_up": stats.wake_up.summary(),
        "compute": stats.compute.summary(),
        "driver_errors": stats.driver_errors,
        "last_error": stats.last_error,
        "devices": stats.failures(),
        "takeovers": stats.takeovers,
        "output": dict(zip(step.layout.axes, step.output_of(step.state).tolist(), strict=True)),
    }

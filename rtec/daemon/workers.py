"""Slow devices in processes of their own.

A device that gives temperatures or the spindle speed and nothing else is opened, polled and closed by a worker
(`work`). It publishes its readings in shared memory (`rtec.daemon.published`). In the loop's process a small port
(`WorkerPort`) reads that memory. The supervisor starts the workers (`Workers`); `KeptWorker` restarts one that died,
with growing waits, and ends one that hangs.

The supervisor starts the workers, never the loop's process: a child should not begin with its locked memory, threads
and real-time priority.
"""

import ctypes
import os
import signal
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.daemon.process import SIGNALS, child_context, signals_wait, starter
from rtec.daemon.published import FAILED, NEVER, OPEN, STARTING, Published, PublishedReader
from rtec.daemon.supervision import DaemonPart, DaemonParts, fault
from rtec.errors import DriverError, DriverFault, DriverTimeout, DriverUnavailable, RtecError
from rtec.loop.clock import Clock, RealClock
from rtec.loop.devices import driver_class, make_device
from rtec.loop.ports import Resumable
from rtec.machine import Machine

if TYPE_CHECKING:
    from rtec.loop.run_file import Setup

POLL_NS: Final = 10_000_000
"""Period, ns, at which a worker polls its driver; the instants of the readings are the driver's own."""
PR_SET_PDEATHSIG: Final = 1
LOOK_NS: Final = 10_000_000
"""Period, ns, of checks while the worker opens its device."""
OPENS_NS: Final = 20_000_000_000
"""Longest time, ns, to open a device, from the worker's start with it."""
BEGINS_NS: Final = 120_000_000_000
"""Longest time, ns, until a new process begins: a busy or slow computer reads its programs from the disk."""
SILENT_NS: Final = 1_000_000_000
"""A worker without a sign of life for this time, ns, is reported as silent."""
ERRORS: Final = {kind.__name__: kind for kind in (DriverError, DriverUnavailable, DriverTimeout, DriverFault)}
STOP_TIMEOUT_S: Final = 3.0


@dataclass(frozen=True)
class WorkerTask:
    """A worker's task, as it is sent to its process.

    Attributes:
        name: name of the device.
        table: the device's table in the run file.
        machine: machine that has the sensors.
        path: path of the run file.
        temperatures, spindle: what the worker reads.
        memory: memory in which it publishes.
    """

    name: str
    table: Mapping[str, Any]
    machine: Machine
    path: Path
    temperatures: bool
    spindle: bool
    memory: Published


def work(task: WorkerTask) -> None:
    """Be the worker, until the supervisor ends it or has ended itself.

    A device that cannot be opened, and an unforeseen fault, are reported in the memory and end the process.
    """
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    # A worker that is stopped or hangs cannot check for its parent; the kernel can.
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    clock, memory = RealClock(), task.memory
    memory.heartbeat_ns = clock.now_ns()
    with ExitStack() as stack:
        try:
            device: Any = make_device(task.name, task.table, task.machine, clock, task.path)
            stack.enter_context(device)
            _Polling(task, device, clock).serve()
        except RtecError as e:
            _last_words(memory, str(e))
        except Exception as e:  # noqa: BLE001 - reported with its place, cleaned, and the process ends
            _last_words(memory, fault(e))


def _last_words(memory: Published, text: str) -> None:
    memory.device_note.write({"open": [text]})
    memory.state = FAILED


class _Polling:
    """Polls one device and publishes its readings."""

    def __init__(self, task: WorkerTask, device: Any, clock: Clock) -> None:
        self._task, self._device, self._clock = task, device, clock
        sensors = len(task.machine.sensor_names)
        self._degc, self._time_ns, self._rpm = np.full(sensors, np.nan), np.full(sensors, NEVER), float("nan")
        self._resumes = task.memory.resumes

    def serve(self) -> None:
        """Poll until the supervisor ends it."""
        memory, parent = self._task.memory, starter()
        while not memory.stop_requested and os.getppid() == parent:
            now_ns = self._clock.now_ns()
            self._once()
            memory.heartbeat_ns, memory.state = now_ns, OPEN
            self._clock.sleep_until_ns(now_ns + POLL_NS)

    def _once(self) -> None:
        memory, device, wrong = self._task.memory, self._device, dict[str, list[str]]()
        if isinstance(device, Resumable):
            if memory.resumes != self._resumes:
                self._resumes = memory.resumes
                device.resume()
            if device.must_resume:
                wrong["resume"] = [device.must_resume]
        if self._task.temperatures:
            try:
                device.read_temperatures(self._degc, self._time_ns)
            except DriverError as e:  # the good values are in the arrays all the same
                wrong["temperatures"] = [type(e).__name__, str(e)]
        if self._task.spindle:
            try:
                self._rpm = device.read_spindle()
            except DriverError as e:
                self._rpm = float("nan")
                wrong["spindle"] = [type(e).__name__, str(e)]
        memory.publish(self._degc, self._time_ns, self._rpm)
        memory.device_note.write(wrong)


class WorkerPort:
    """The loop's side of a worker: a device like any other; it reads memory only and never waits.

    Args:
        name: name of the device.
        memory: memory in which its worker publishes.
        sensors: number of sensors of the machine.
        clock: the monotonic one; all processes share it.
    """

    def __init__(self, name: str, memory: Published, sensors: int, clock: Clock) -> None:
        self._name, self._memory, self._clock = name, memory, clock
        self._reader = PublishedReader(memory, sensors)

    def __enter__(self) -> Self:
        """Wait until the worker has opened its device.

        Raises:
            DriverUnavailable: the worker could not open it, or does not answer.
        """
        memory, begun_ns = self._memory, self._clock.now_ns()
        while memory.state == STARTING and not memory.worker_note.read() and not late(memory, begun_ns, self._clock):
            self._clock.sleep_until_ns(self._clock.now_ns() + LOOK_NS)
        if memory.state != OPEN:
            why = memory.device_note.read().get("open") or memory.worker_note.read().get("worker")
            raise DriverUnavailable(why[0] if why else "its worker does not say whether it is open")
        return self

    def __exit__(self, *error: object) -> None:
        """Do nothing; the supervisor ends the worker."""

    @property
    def must_resume(self) -> str:
        """Why the device waits for an order to resume; "" where it does not."""
        return "".join(self._memory.device_note.read().get("resume", ()))

    def resume(self) -> None:
        """Pass the order on to the worker."""
        self._memory.resumes += 1

    def read_temperatures(self, degc: Floats, time_ns: Ints) -> None:
        """Fill in the worker's newest readings, °C and instants, ns; then raise its fault.

        Raises:
            DriverError: the driver's own error; or the worker is dead or silent.
        """
        reader = self._reader
        reader.look()
        np.copyto(degc, reader.degc, where=reader.read)
        np.copyto(time_ns, reader.time_ns, where=reader.read)
        self._check("temperatures")

    def read_spindle(self) -> float:
        """The worker's newest spindle speed, 1/min.

        Raises:
            DriverError: the driver's own error; or the worker is dead or silent.
        """
        self._check("spindle")
        self._reader.look()
        return float(self._reader.rpm[0])

    def _check(self, does: str) -> None:
        memory = self._memory
        note = memory.worker_note.read()
        if note:
            raise DriverUnavailable(note["worker"][0])
        silent_ns = self._clock.now_ns() - memory.heartbeat_ns
        if silent_ns > SILENT_NS:
            raise DriverTimeout(f"its worker has shown no life for {silent_ns // 1_000_000_000} s")
        wrong = memory.device_note.read().get(does)
        if wrong:
            raise ERRORS.get(wrong[0], DriverFault)(wrong[1])


def worker_ports(memories: Mapping[str, Published], machine: Machine, clock: Clock) -> dict[str, WorkerPort]:
    """The loop's ports, by device."""
    return {name: WorkerPort(name, m, len(machine.sensor_names), clock) for name, m in memories.items()}


def late(memory: Published, begun_ns: int, clock: Clock) -> bool:
    """Has a worker been without a sign of life for too long? It was started, or awaited, at `begun_ns`."""
    if not memory.heartbeat_ns:
        return clock.now_ns() - begun_ns > BEGINS_NS
    return clock.now_ns() - memory.heartbeat_ns > OPENS_NS


class KeptWorker:
    """One worker and its restarts."""

    def __init__(self, task: WorkerTask, clock: Clock, part: DaemonPart, forks: bool = False) -> None:
        self._task, self._clock, self._part, self._forks = task, clock, part, forks
        self._process: Any = None
        self._begun_ns = 0

    def start(self) -> None:
        """Start it, with cleared memory."""
        context = child_context(self._forks)
        self._task.memory.forget()
        self._process = context.Process(
            target=work, args=(self._task,), name=f"rtec-worker-{self._task.name}", daemon=True
        )
        self._begun_ns = self._clock.now_ns()
        with signals_wait():
            self._process.start()

    def look(self, again: bool) -> None:
        """Check it; restart it when that is due, if `again`."""
        memory = self._task.memory
        if self._process is None:
            if again and self._part.due:
                self.start()
        elif not self._process.is_alive():
            self._ended(again)
        elif late(memory, self._begun_ns, self._clock):
            self._process.kill()
        elif memory.state == OPEN and memory.worker_note.read():
            memory.worker_note.write({})
            self._part.report("its new worker has opened it")

    def ask_to_end(self) -> None:
        """Ask it to end; `end` waits."""
        self._task.memory.stop_requested = 1

    def end(self, clean_up: Callable[[], None]) -> None:
        """Wait for its end; kill it after a while."""
        process, self._process = self._process, None
        if process is not None:
            process.join(STOP_TIMEOUT_S)
            if process.is_alive():
                process.kill()
                process.join()
        clean_up()

    def _ended(self, again: bool) -> None:
        self._process.join()
        memory, process = self._task.memory, self._process
        why = memory.device_note.read().get("open") if memory.state == FAILED else None
        text = why[0] if why else f"its worker, process {process.pid}, ended ({_how(process.exitcode)})"
        self._process = None
        if again:
            text = self._part.failed(text, "a new one is started")
        memory.worker_note.write({"worker": [text]})


def _how(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"


def names_for_workers(setup: "Setup") -> list[str]:
    """Devices of a run file that have a worker: those that only give temperatures or spindle speed.

    A driver whose class says `IN_LOOP = True` stays in the loop's process.
    """
    role = setup.file.role
    slow = dict.fromkeys((*role.temperatures, *([role.spindle] if role.spindle else [])))
    names = [n for n in slow if n not in (role.counts, role.actuator) and n in setup.file.device]
    return [n for n in names if not _in_loop(setup.file.device[n].get("driver"), f"{setup.path}: [device.{n}]")]


def _in_loop(driver: object, where: str) -> bool:
    """Also where there is no such driver: the loop, which makes all devices once, reports that best."""
    try:
        return bool(getattr(driver_class(str(driver), where), "IN_LOOP", False))
    except RtecError:
        return True


class Workers:
    """All workers of a run: starts them on entry, ends them on exit.

    Args:
        setup: the setup to run.
        clock: the monotonic one.
        parts: gets a part for each worker.
        forks: see `rtec.daemon.process.child_context`.

    Attributes:
        memories: by device, for the loop's process.
    """

    def __init__(self, setup: "Setup", clock: Clock, parts: DaemonParts, forks: bool = False) -> None:
        role, machine = setup.file.role, setup.machine
        self.memories: dict[str, Published] = {}
        self._kept: Sequence[KeptWorker] = []
        kept = []
        for name in names_for_workers(setup):
            memory = self.memories[name] = Published.create(len(machine.sensor_names))
            does = (name in role.temperatures, name == role.spindle)
            part = parts.add(f"device {name}", device=True)
            task = WorkerTask(name, setup.file.device[name], machine, setup.path, *does, memory)
            kept.append(KeptWorker(task, clock, part, forks))
        self._kept = kept

    def __enter__(self) -> Self:
        for kept in self._kept:
            kept.start()
        return self

    def __exit__(self, *error: object) -> None:
        for kept in self._kept:
            kept.ask_to_end()
        for kept, memory in zip(self._kept, self.memories.values(), strict=True):
            kept.end(memory.close)

    def look(self, again: bool = True) -> None:
        """Check them; called some 50 times a second, never waits.

        Args:
            again: restart those that ended. At the start of a run they are not restarted: the run does not begin
                without them.
        """
        for kept in self._kept:
            kept.look(again)

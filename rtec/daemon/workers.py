"""Slow devices in processes of their own.

A device that gives temperatures or the spindle speed and nothing else is opened, polled and closed by a worker
(`work`). It publishes what it reads in shared memory (`rtec.daemon.published`). In the loop's process a small port
(`WorkerPort`) looks at that memory. The supervisor starts the workers (`Workers`); `KeptWorker` starts one again that
died, with growing waits, and ends one that hangs.

Workers are started by the supervisor, never by the loop's process: that one has locked memory, threads and real-time
priority, none of which a child should begin with.
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

from rtec.daemon.process import SIGNALS, child_context, signals_wait, starter
from rtec.daemon.published import FAILED, NEVER, OPEN, STARTING, Published, PublishedReader
from rtec.daemon.supervision import DaemonPart, DaemonParts, fault
from rtec.errors import DriverError, DriverFault, DriverTimeout, DriverUnavailable, RtecError
from rtec.loop.clock import Clock, RealClock
from rtec.loop.devices import driver_class, make_device
from rtec.loop.ports import FloatArray, IntArray, Resumable
from rtec.machine import Machine

if TYPE_CHECKING:
    from rtec.loop.run_file import Setup

POLL_NS: Final = 10_000_000
"""A driver in a worker is asked so often; the instants of its readings are its own."""
PR_SET_PDEATHSIG: Final = 1
LOOK_NS: Final = 10_000_000
"""While the worker opens its device, it is looked at so often."""
OPENS_NS: Final = 20_000_000_000
"""Opening may take so long, counted from when the worker begins with it."""
BEGINS_NS: Final = 120_000_000_000
"""So long may a new process take until it begins: a busy or slow computer reads its programs from the disk."""
SILENT_NS: Final = 1_000_000_000
"""A worker that shows no life for so long is told as silent."""
ERRORS: Final = {kind.__name__: kind for kind in (DriverError, DriverUnavailable, DriverTimeout, DriverFault)}
STOP_TIMEOUT_S: Final = 3.0


@dataclass(frozen=True)
class WorkerTask:
    """What a worker does; goes to its process as it stands.

    Attributes:
        name: of the device.
        table: the device's table in the run file.
        machine: whose sensors the readings follow.
        path: of the run file.
        temperatures, spindle: what is read from it.
        memory: where it publishes.
    """

    name: str
    table: Mapping[str, Any]
    machine: Machine
    path: Path
    temperatures: bool
    spindle: bool
    memory: Published


def work(task: WorkerTask) -> None:
    """Be the worker, until the supervisor asks to end or is gone.

    What cannot be opened, and what nobody foresaw, is told in the memory and ends the process.
    """
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    # A worker that is stopped or hangs cannot look for its parent; the kernel can.
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
    memory.told.write({"open": [text]})
    memory.state = FAILED


class _Polling:
    """Asks one device and publishes."""

    def __init__(self, task: WorkerTask, device: Any, clock: Clock) -> None:
        self._task, self._device, self._clock = task, device, clock
        sensors = len(task.machine.sensor_names)
        self._degc, self._time_ns, self._rpm = np.full(sensors, np.nan), np.full(sensors, NEVER), float("nan")
        self._resumes = task.memory.resumes

    def serve(self) -> None:
        """Do it until told otherwise."""
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
            except DriverError as e:  # what is good is in the arrays all the same
                wrong["temperatures"] = [type(e).__name__, str(e)]
        if self._task.spindle:
            try:
                self._rpm = device.read_spindle()
            except DriverError as e:
                self._rpm = float("nan")
                wrong["spindle"] = [type(e).__name__, str(e)]
        memory.publish(self._degc, self._time_ns, self._rpm)
        memory.told.write(wrong)


class WorkerPort:
    """The loop's side of a worker: a device like any other, that looks at memory and waits for nothing.

    Args:
        name: of the device.
        memory: where its worker publishes.
        sensors: of the machine.
        clock: the monotonic one; all processes share it.
    """

    def __init__(self, name: str, memory: Published, sensors: int, clock: Clock) -> None:
        self._name, self._memory, self._clock = name, memory, clock
        self._reader = PublishedReader(memory, sensors)

    def __enter__(self) -> Self:
        """Wait until the worker has opened its device.

        Raises:
            DriverUnavailable: it could not, or does not say.
        """
        memory, begun_ns = self._memory, self._clock.now_ns()
        while memory.state == STARTING and not memory.said.read() and not late(memory, begun_ns, self._clock):
            self._clock.sleep_until_ns(self._clock.now_ns() + LOOK_NS)
        if memory.state != OPEN:
            why = memory.told.read().get("open") or memory.said.read().get("worker")
            raise DriverUnavailable(why[0] if why else "its worker does not say whether it is open")
        return self

    def __exit__(self, *error: object) -> None:
        """Let go; the supervisor ends the worker."""

    @property
    def must_resume(self) -> str:
        """Why the device waits for an order to resume; "" where it does not."""
        return "".join(self._memory.told.read().get("resume", ()))

    def resume(self) -> None:
        """Hand the order on to the worker."""
        self._memory.resumes += 1

    def read_temperatures(self, degc: FloatArray, time_ns: IntArray) -> None:
        """Fill in what the worker published last, °C and instants, ns; then tell what is wrong.

        Raises:
            DriverError: as the driver itself; or the worker is dead or silent.
        """
        reader = self._reader
        reader.look()
        np.copyto(degc, reader.degc, where=reader.read)
        np.copyto(time_ns, reader.time_ns, where=reader.read)
        self._check("temperatures")

    def read_spindle(self) -> float:
        """Give the spindle speed that the worker published last, 1/min.

        Raises:
            DriverError: as the driver itself; or the worker is dead or silent.
        """
        self._check("spindle")
        self._reader.look()
        return float(self._reader.rpm[0])

    def _check(self, does: str) -> None:
        memory = self._memory
        said = memory.said.read()
        if said:
            raise DriverUnavailable(said["worker"][0])
        silent_ns = self._clock.now_ns() - memory.heartbeat_ns
        if silent_ns > SILENT_NS:
            raise DriverTimeout(f"its worker has shown no life for {silent_ns // 1_000_000_000} s")
        wrong = memory.told.read().get(does)
        if wrong:
            raise ERRORS.get(wrong[0], DriverFault)(wrong[1])


def worker_ports(memories: Mapping[str, Published], machine: Machine, clock: Clock) -> dict[str, WorkerPort]:
    """The loop's ports, by device."""
    return {name: WorkerPort(name, m, len(machine.sensor_names), clock) for name, m in memories.items()}


def late(memory: Published, begun_ns: int, clock: Clock) -> bool:
    """Has a worker shown no life for longer than it may? It was started, or waited for, at `begun_ns`."""
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
        """Start it; what an earlier one left in the memory is forgotten."""
        context = child_context(self._forks)
        self._task.memory.forget()
        self._process = context.Process(
            target=work, args=(self._task,), name=f"rtec-worker-{self._task.name}", daemon=True
        )
        self._begun_ns = self._clock.now_ns()
        with signals_wait():
            self._process.start()

    def look(self, again: bool) -> None:
        """See how it does; start it again when its time has come, where that is asked for."""
        memory = self._task.memory
        if self._process is None:
            if again and self._part.due:
                self.start()
        elif not self._process.is_alive():
            self._ended(again)
        elif late(memory, self._begun_ns, self._clock):
            self._process.kill()
        elif memory.state == OPEN and memory.said.read():
            memory.said.write({})
            self._part.report("its new worker has opened it")

    def ask_to_end(self) -> None:
        """Ask; `end` waits."""
        self._task.memory.stop_requested = 1

    def end(self, clean_up: Callable[[], None]) -> None:
        """See it gone."""
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
        why = memory.told.read().get("open") if memory.state == FAILED else None
        text = why[0] if why else f"its worker, process {process.pid}, ended ({_how(process.exitcode)})"
        self._process = None
        if again:
            text = self._part.failed(text, "a new one is started")
        memory.said.write({"worker": [text]})


def _how(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"


def names_for_workers(setup: "Setup") -> list[str]:
    """Devices of a run file that have a worker: read for temperatures or spindle speed, and nothing else.

    A driver whose class says `IN_LOOP = True` stays in the loop's process.
    """
    role = setup.file.role
    slow = dict.fromkeys((*role.temperatures, *([role.spindle] if role.spindle else [])))
    names = [n for n in slow if n not in (role.counts, role.actuator) and n in setup.file.device]
    return [n for n in names if not _in_loop(setup.file.device[n].get("driver"), f"{setup.path}: [device.{n}]")]


def _in_loop(driver: object, where: str) -> bool:
    """Also where there is no such driver: the loop, which makes all devices once, says so best."""
    try:
        return bool(getattr(driver_class(str(driver), where), "IN_LOOP", False))
    except RtecError:
        return True


class Workers:
    """All workers of a run: starts them on entry, ends them on exit.

    Args:
        setup: what runs.
        clock: the monotonic one.
        parts: each worker is one of them.
        forks: as `rtec.daemon.process.child_context` has it.

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
        """See how they do; called some 50 times a second, waits for nothing.

        Args:
            again: start those that ended anew. At the start of a run they are not: it does not begin without them.
        """
        for kept in self._kept:
            kept.look(again)

"""The worker: a process that opens one slow device, polls it, publishes what it reads, and closes it."""

import ctypes
import os
import signal
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtec.daemon.published import FAILED, NEVER, OPEN, Published
from rtec.daemon.signals import SIGNALS, starter
from rtec.errors import DriverError, RtecError, unforeseen
from rtec.loop.clock import Clock, RealClock
from rtec.loop.devices import make_device
from rtec.loop.ports import Resumable
from rtec.machine import Machine

POLL_NS: Final = 10_000_000
"""A driver in a worker is asked so often; the instants of its readings are its own."""
PR_SET_PDEATHSIG: Final = 1


@dataclass(frozen=True)
class Task:
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


def work(task: Task) -> None:
    """Be the worker, until the supervisor asks to end or is gone.

    What cannot be opened, and what nobody foresaw, is told in the memory and ends the process.
    """
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    # A worker that is stopped or hangs cannot look for its parent; the kernel can.
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    clock, memory = RealClock(), task.memory
    with ExitStack() as stack:
        try:
            device: Any = make_device(task.name, task.table, task.machine, clock, task.path)
            stack.enter_context(device)
            _Desk(task, device, clock).serve()
        except RtecError as e:
            _last_words(memory, str(e))
        except Exception as e:
            _last_words(memory, unforeseen(e))
            raise


def _last_words(memory: Published, text: str) -> None:
    memory.told.write({"open": [text]})
    memory.state = FAILED


class _Desk:
    """Asks one device and publishes."""

    def __init__(self, task: Task, device: Any, clock: Clock) -> None:
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

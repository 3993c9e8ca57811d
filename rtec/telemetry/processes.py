"""The processes of `rtec telemetry`: one a protocol, started, watched, restarted.

Their parent is no child of the daemon, and the daemon knows them only as readers of its local socket. So a process that
hangs, dies, fills its memory or is broken into from the network costs the loop nothing.
"""

import asyncio
import ctypes
import importlib
import logging
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Coroutine
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

from rtec.daemon.process import SIGNALS, signals, signals_wait, starter
from rtec.daemon.supervision import DaemonPart, DaemonParts, fault
from rtec.errors import ConfigError
from rtec.loop.clock import Clock
from rtec.loop.telemetry_tables import TelemetryTable
from rtec.telemetry.values import Follower
from rtec.text import clean
from rtec.tomlfile import Strict

if TYPE_CHECKING:
    from rtec.loop.run_file import Setup

PR_SET_PDEATHSIG: Final = 1
NICE: Final = 10
"""Nice value, below everything of the daemon."""
ALIVE_S: Final = 0.5
SILENT_NS: Final = 30_000_000_000
"""A process without a sign of life for this time, ns, hangs; it is ended and restarted."""
LOOK_NS: Final = 50_000_000
END_S: Final = 3.0


@dataclass(frozen=True)
class Task:
    """A process' task, as it is sent to the process.

    Attributes:
        protocol: module of this package with the protocol; also the name of its table.
        table: table of the run file.
        config: path of the run file.
        machine: name of the machine.
    """

    protocol: str
    table: Strict
    config: Path
    machine: str


def tasks(setup: "Setup") -> list[Task]:
    """The tasks of the run file, checked as far as possible without the network.

    Raises:
        ConfigError: it has none, a file cannot be used, or a package is not installed.
    """
    table = setup.file.telemetry
    chosen = {name: getattr(table, name) for name in TelemetryTable.model_fields if getattr(table, name) is not None}
    if not chosen:
        known = ", ".join(f"[telemetry.{name}]" for name in TelemetryTable.model_fields)
        raise ConfigError(f"{setup.path}: asks for no telemetry: it has none of {known}; see docs/telemetry.md")
    tasks = [Task(name, one, setup.path, setup.machine.name) for name, one in chosen.items()]
    for task in tasks:
        try:
            _module(task).prepare(task.table, setup.base)
        except ConfigError as error:
            raise ConfigError(f"{setup.path}: {error}") from error
    return tasks


def _module(task: Task) -> Any:
    return importlib.import_module(f"rtec.telemetry.{task.protocol}")


def say(protocol: str, text: str) -> None:
    """Print one line on standard error."""
    with suppress(OSError, ValueError):
        sys.stderr.write(f"{protocol}: {clean(text)}\n")
        sys.stderr.flush()


def work(task: Task, alive: Any) -> None:
    """Be the process, until the parent ends it or has ended itself."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != starter():
        return
    os.nice(NICE)
    logging.getLogger().addHandler(logging.NullHandler())  # silences libraries; `say` reports
    try:
        asyncio.run(_serve(task, alive))
    except Exception as error:  # noqa: BLE001 (the parent reports the end, and restarts it)
        say(task.protocol, fault(error))
        sys.exit(1)


async def _serve(task: Task, alive: Any) -> None:
    ended = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, ended.set)
    await serve(task, lambda text: say(task.protocol, text), ended.wait(), _live(alive))


async def serve(task: Task, say: Callable[[str], None], *others: Coroutine[Any, Any, Any]) -> None:
    """Follow the daemon, serve the protocol, run the others; the first that ends ends all."""
    follower = Follower(task.config, task.protocol)
    speaker = _module(task).server(task, say)
    jobs = [asyncio.create_task(job) for job in (follower.follow(), speaker.serve(follower), *others)]
    done, unfinished = await asyncio.wait(jobs, return_when=asyncio.FIRST_COMPLETED)
    for job in unfinished:
        job.cancel()
    await asyncio.wait(unfinished, timeout=END_S / 2)
    for job in done:
        job.result()


async def _live(alive: Any) -> None:
    while True:
        alive.value += 1
        await asyncio.sleep(ALIVE_S)


class KeptProcess:
    """One process and its restarts."""

    def __init__(self, task: Task, clock: Clock, part: DaemonPart) -> None:
        self._task, self._clock, self._part = task, clock, part
        self._context = multiprocessing.get_context("spawn")
        self._alive: Any = self._context.Value("q", 0, lock=False)
        self._last_value, self._last_change_ns = 0, 0
        self.process: Any = None

    def start(self) -> None:
        """Start the process."""
        name = f"rtec-{self._task.protocol}"
        self.process = self._context.Process(target=work, args=(self._task, self._alive), name=name, daemon=True)
        self._last_change_ns = self._clock.now_ns()
        with signals_wait():
            self.process.start()

    def look(self) -> None:
        """Check it; restart it when that is due."""
        now_ns = self._clock.now_ns()
        if self._alive.value != self._last_value:
            self._last_value, self._last_change_ns = self._alive.value, now_ns
        if self.process is None:
            if self._part.due:
                self.start()
        elif not self.process.is_alive():
            self.process.join()
            self._part.failed(f"its process ended (exit code {self.process.exitcode})", "a new one is started")
            self.process = None
        elif now_ns - self._last_change_ns > SILENT_NS:
            self.process.kill()

    def end(self) -> None:
        """End it in order, or kill it where it does not end."""
        process, self.process = self.process, None
        if process is not None:
            process.join(END_S)
            if process.is_alive():
                process.kill()
                process.join()


class Processes:
    """All processes: starts them on entry, ends them on exit.

    Args:
        tasks: the task of each.
        clock: monotonic.
    """

    def __init__(self, tasks: list[Task], clock: Clock) -> None:
        self._clock = clock
        parts = DaemonParts(clock, lambda _what, text: say("telemetry", text))
        self.kept = [KeptProcess(task, clock, parts.add(task.protocol)) for task in tasks]
        self._ended = False

    def __enter__(self) -> Self:
        for kept in self.kept:
            kept.start()
        return self

    def __exit__(self, *error: object) -> None:
        for kept in self.kept:
            if kept.process is not None:
                kept.process.terminate()
        for kept in self.kept:
            kept.end()

    def run(self) -> None:
        """Check and restart them until a signal."""
        with signals(self._on_signal):
            while not self._ended:
                for kept in self.kept:
                    kept.look()
                self._clock.sleep_until_ns(self._clock.now_ns() + LOOK_NS)

    def _on_signal(self, number: int, _frame: object) -> None:
        self._ended |= number in (signal.SIGINT, signal.SIGTERM)

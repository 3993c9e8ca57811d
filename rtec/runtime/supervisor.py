"""The supervisor: starts the fast path, drains its ring into the log, shows what goes on, ends it in order."""

import json
import multiprocessing
import platform
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from rtec.correction.guard import REASONS, Flag
from rtec.errors import DriverFault, LogError, RtecError
from rtec.runtime.clock import RealClock, wall_clock_iso
from rtec.runtime.config import Setup
from rtec.runtime.fastpath import fast_path
from rtec.runtime.log import LogWriter
from rtec.runtime.records import MODES_BY_NAME, Commands, Layout, Samples
from rtec.runtime.ring import Ring

DRAIN_PERIOD_NS = 20_000_000
STOP_TIMEOUT_S = 5.0
RING_SECONDS = 4.0


@dataclass
class Status:
    """The newest row in words.

    Attributes:
        time_s: since the first row.
        cycles, misses: of the loop.
        requested_um, applied_um, output: by axis name.
        flags: bits of `Flag`.
        degc: by sensor name.
    """

    time_s: float = 0.0
    cycles: int = 0
    misses: int = 0
    requested_um: dict[str, float] = field(default_factory=dict)
    applied_um: dict[str, float] = field(default_factory=dict)
    output: dict[str, int] = field(default_factory=dict)
    flags: Flag = field(default_factory=lambda: Flag(0))
    degc: dict[str, float] = field(default_factory=dict)

    @property
    def reasons(self) -> list[str]:
        """Why the correction is not simply the requested one."""
        return [text for flag, text in REASONS.items() if flag in self.flags]


@dataclass
class Report:
    """What a run came to.

    Attributes:
        summary: the fast path's own figures.
        warnings: what the system did not grant, and what went wrong with the log.
        log: where the log is.
        overruns: rows that did not reach the log.
        interrupted: ended by a signal.
        status: the last row.
        flags_seen: share of cycles that carried each flag, by the flag's name.
        largest_um: largest applied correction by axis.
    """

    summary: dict[str, Any]
    warnings: list[str]
    log: Path | None
    overruns: int
    interrupted: bool
    status: Status
    flags_seen: dict[str, float]
    largest_um: dict[str, float]


class Supervisor:
    """Runs a setup on the real clock."""

    def __init__(
        self,
        setup: Setup,
        log_path: Path | None,
        on_status: Callable[[Status], None] | None = None,
        on_start: Callable[[], None] | None = None,
    ) -> None:
        self.setup = setup
        self.layout = Layout(setup.machine.axis_names, setup.machine.sensor_names)
        self.log_path = log_path
        self.status = Status()
        self.warnings: list[str] = []
        self._on_status = on_status or (lambda _: None)
        self._on_start = on_start or (lambda: None)
        self._clock = RealClock()
        self._first_ns: int | None = None
        self._flag_counts = np.zeros(len(Flag), dtype=np.int64)
        self._rows = 0
        self._largest = np.zeros(len(self.layout.axes))
        self._interrupted = False

    def run(self, duration_s: float | None) -> Report:
        """Run for so long, or until a signal.

        Raises:
            RtecError: the fast path could not start, or died.
        """
        cycles = None if duration_s is None else max(1, round(duration_s * self.setup.file.run.rate_hz))
        capacity = max(64, round(RING_SECONDS * self.setup.file.run.rate_hz))
        context = multiprocessing.get_context("spawn")
        with Ring.create(self.layout, capacity) as ring, _signals(self._on_signal):
            ring.ordered_mode = MODES_BY_NAME[self.setup.file.run.mode]
            here, there = context.Pipe(duplex=False)
            process = context.Process(
                target=fast_path, args=(self.setup.path, ring.name, there, cycles), name="rtec-loop", daemon=True
            )
            with _signals_wait():
                process.start()
            there.close()
            try:
                return self._supervise(ring, here, process)
            finally:
                ring.stop_requested = 1
                process.join(STOP_TIMEOUT_S)
                if process.is_alive():
                    process.kill()
                    process.join()

    def _supervise(self, ring: Ring, pipe: Connection, process: Any) -> Report:
        ready = self._receive(pipe, process)
        ring.unlink()  # both sides have it: now it goes with the last of them, however that ends
        self.warnings += ready["warnings"]
        with self._log(ready["output"]) as log:
            self._on_start()
            self._drain_until_done(ring, pipe, process, log)
            summary = self._receive(pipe, process)
            while self._drain(ring, log):
                pass
        return Report(
            summary=summary,
            warnings=self.warnings,
            log=self.log_path,
            overruns=ring.overruns,
            interrupted=self._interrupted,
            status=self.status,
            flags_seen={
                flag.name or str(flag): count / self._rows
                for flag, count in zip(Flag, self._flag_counts.tolist(), strict=True)
                if count
            },
            largest_um=dict(zip(self.layout.axes, self._largest.tolist(), strict=True)),
        )

    def _drain_until_done(self, ring: Ring, pipe: Connection, process: Any, log: "_SafeLog") -> None:
        flush_ns = round(self.setup.file.run.flush_s * 1e9)
        next_flush = self._clock.now_ns() + flush_ns
        while not pipe.poll() and process.is_alive():
            now = self._clock.now_ns()
            ring.consumer_heartbeat_ns = now
            if self._interrupted:
                ring.stop_requested = 1
            self._drain(ring, log)
            if now >= next_flush:
                log.flush()
                next_flush = now + flush_ns
            self._on_status(self.status)
            self._clock.sleep_until_ns(now + DRAIN_PERIOD_NS)

    def _drain(self, ring: Ring, log: "_SafeLog") -> int:
        samples, commands = ring.drain()
        if len(samples):
            log.write(samples, commands)
            self._look(ring, samples, commands)
        return len(samples)

    def _look(self, ring: Ring, samples: Samples, commands: Commands) -> None:
        if self._first_ns is None:
            self._first_ns = int(samples.time_ns[0])
        self._rows += len(samples)
        self._flag_counts += [np.count_nonzero(commands.flags & int(flag)) for flag in Flag]
        self._largest = np.maximum(self._largest, np.abs(commands.applied_um).max(axis=0))
        axes = self.layout.axes
        self.status = Status(
            time_s=(int(samples.time_ns[-1]) - self._first_ns) * 1e-9,
            cycles=self._rows + ring.overruns,
            misses=ring.deadline_misses,
            requested_um=dict(zip(axes, commands.requested_um[-1].tolist(), strict=True)),
            applied_um=dict(zip(axes, commands.applied_um[-1].tolist(), strict=True)),
            output=dict(zip(axes, commands.output[-1].tolist(), strict=True)),
            flags=Flag(int(commands.flags[-1])),
            degc=dict(zip(self.layout.sensors, samples.degc[-1].tolist(), strict=True)),
        )

    @contextmanager
    def _log(self, output: list[int]) -> Iterator["_SafeLog"]:
        if self.log_path is None:
            yield _SafeLog(None, self.warnings)
            return
        header = {
            **self.setup.log_header(),
            "host": platform.node(),
            "python": platform.python_version(),
            "started": wall_clock_iso(),
            "initial_output": json.dumps(output),
        }
        with LogWriter(self.log_path, self.layout, header) as writer:
            yield _SafeLog(writer, self.warnings)

    def _receive(self, pipe: Connection, process: Any) -> Any:
        try:
            kind, content = pipe.recv()
        except EOFError:
            process.join(STOP_TIMEOUT_S)
            raise DriverFault(f"the loop's process ended without a word (exit code {process.exitcode})") from None
        if kind == "error":
            raise RtecError(content)
        return content

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        self._interrupted = True


class _SafeLog:
    """A log whose failure is a warning: the correction goes on without it."""

    def __init__(self, writer: LogWriter | None, warnings: list[str]) -> None:
        self._writer, self._warnings = writer, warnings

    def write(self, samples: Samples, commands: Commands) -> None:
        """Hand rows on."""
        self._try(lambda w: w.write(samples, commands))

    def flush(self) -> None:
        """Bring them to the disk."""
        self._try(lambda w: w.flush())

    def _try(self, action: Callable[[LogWriter], None]) -> None:
        if self._writer is None:
            return
        try:
            action(self._writer)
        except LogError as e:
            self._warnings.append(f"logging stopped, the correction went on: {e}")
            self._writer = None


@contextmanager
def _signals(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Ctrl-C and a polite kill ask for an end in order; the previous handlers come back afterwards."""
    previous = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, old in previous.items():
            signal.signal(number, old)


@contextmanager
def _signals_wait() -> Iterator[None]:
    """A child started meanwhile is deaf to Ctrl-C from its first instruction, until it says itself what to do with it.

    Here a signal that comes meanwhile is handled afterwards.
    """
    resource_tracker.ensure_running()  # started by `Process.start` it would let the signals through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def new_log_path(setup: Setup) -> Path | None:
    """Name of the log of a run that starts now: by date and time, in the run file's log folder.

    Raises:
        LogError: the folder cannot be made.
    """
    if setup.file.run.log_folder is None:
        return None
    folder = (setup.base / setup.file.run.log_folder).resolve()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise LogError(f"{folder}: cannot be made: {e.strerror}") from e
    stem = f"{setup.path.stem}-{wall_clock_iso().replace(':', '').replace('-', '')}"
    path, k = folder / f"{stem}.arrows", 1
    while path.exists():
        k += 1
        path = folder / f"{stem}-{k}.arrows"
    return path

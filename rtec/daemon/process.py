"""The daemon as a process of this computer: real-time scheduling, signals, its service manager, lines for people.

- `prepare_process` asks the system for real-time scheduling; one sentence reports what the system refused.
- `signals`, `signals_wait` and `starter`: the meaning of signals while the daemon runs, the start of a child that
  ignores them, and the process that started this one.
- `Notifier` reports to the service manager: the protocol of `sd_notify(3)`, a datagram to a socket. READY follows the
  first good cycle: its counts and every temperature that the model reads were fresh. WATCHDOG is sent only while the
  number of rows grows, so the service manager detects a loop that is stuck, or a supervisor that gets no more rows, and
  restarts the daemon. Where an essential part of the daemon is lost, `Notifier` requests the restart at once.
- `LinePrinter` prints lines and never waits for a stopped terminal or a full journal.
"""

import ctypes
import gc
import multiprocessing
import os
import queue
import signal
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from multiprocessing import parent_process, resource_tracker
from multiprocessing.context import ForkContext, SpawnContext
from types import FrameType
from typing import TYPE_CHECKING, Final, Self

from rtec.correction.flags import Flag
from rtec.daemon.status import Status
from rtec.loop.clock import Clock
from rtec.text import joined

if TYPE_CHECKING:
    from rtec.loop.run_file import Realtime

MCL_CURRENT_AND_FUTURE = 3
PR_SET_TIMERSLACK = 29
HOW = "see docs/real-time.md"
WORKER_PRIORITY = 1
"""Priority of drivers' threads: below every loop, above everything that is not real time."""


def prepare_process(realtime: "Realtime") -> list[str]:
    """Raise this process to SCHED_FIFO, lock its memory, pin it, switch the garbage collector off.

    Returns:
        one plain warning for everything that the system refused; empty where it granted all.
    """
    refused = []
    if realtime.priority and not _fifo(realtime.priority):
        refused.append(f"SCHED_FIFO priority {realtime.priority}")
    if realtime.lock_memory and not _lock_memory():
        refused.append("locking memory")
    if not _pin(realtime.cpu):
        refused.append(f"processor {realtime.cpu}")
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0)
    gc.collect()
    gc.freeze()
    gc.disable()
    if not refused:
        return []
    return [f"no real-time treatment for: {', '.join(refused)}; the loop runs, with later wake-ups ({HOW})"]


def _fifo(priority: int) -> bool:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, AttributeError):
        return False
    return True


def _lock_memory() -> bool:
    libc = ctypes.CDLL(None, use_errno=True)
    return bool(libc.mlockall(MCL_CURRENT_AND_FUTURE) == 0)


def _pin(cpu: int | None) -> bool:
    """Stay on one processor: the given one, else the last one where there are several."""
    try:
        allowed = sorted(os.sched_getaffinity(0))
        if cpu is None and len(allowed) < 2:
            return True
        os.sched_setaffinity(0, {allowed[-1] if cpu is None else cpu})
    except (OSError, AttributeError):
        return False
    return True


def prepare_worker() -> None:
    """Give the calling thread the lowest real-time priority, where the system grants it.

    A driver's thread in the loop's process is not urgent. But while it holds the interpreter's lock, the loop waits for
    it; if an ordinary program could keep it off the processor meanwhile, the loop would wait for that program.
    """
    _fifo(WORKER_PRIORITY)


SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)


@contextmanager
def signals(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Pass all signals to the handler; restore the previous handlers afterwards.

    The end of the terminal stays ignored where it was, as under `nohup`.
    """
    nohup = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    previous = {n: signal.signal(n, handler) for n in SIGNALS if not (nohup and n == signal.SIGHUP)}
    try:
        yield
    finally:
        for number, old in previous.items():
            signal.signal(number, old)


@contextmanager
def signals_wait() -> Iterator[None]:
    """Start a child inside this, and it ignores Ctrl-C from its first instruction until it sets its own handler.

    In this process a signal that comes meanwhile is handled afterwards.
    """
    resource_tracker.ensure_running()  # if `Process.start` started it, it would unblock the signals
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def child_context(forks: bool) -> ForkContext | SpawnContext:
    """How a child is started: as a copy of this process, which has loaded everything, or by a new interpreter.

    A copy lacks the other threads, and their unfinished work stays unfinished in it. So a process with several threads
    starts a new interpreter.

    Args:
        forks: this process is rtec's own, and has nothing open that a child must not have.
    """
    alone = forks and threading.active_count() == 1
    return multiprocessing.get_context("fork") if alone else multiprocessing.get_context("spawn")


def starter() -> int:
    """Number of the process that started this one; `os.getppid` changes as soon as that process has ended.

    It was stored when this process started; a parent that is killed at that very moment is missed all the same.
    """
    parent = parent_process()
    return os.getppid() if parent is None or parent.pid is None else parent.pid


NOT_GOOD: Final = Flag.STALE_COUNTS | Flag.STALE_TEMPERATURE
STATUS_NS: Final = 1_000_000_000
_PARTS: Final = 4
"""Signs of life within the service manager's time limit."""


class Notifier:
    """Reports to the service manager; does nothing without one.

    Args:
        address: path of the socket, or its abstract name after an `@`; "": no service manager.
        watchdog_ns: longest time between two signs of life; 0: none are needed.
        clock: monotonic.

    Attributes:
        listens: is there a service manager that listens?
    """

    def __init__(self, address: str, watchdog_ns: int, clock: Clock) -> None:
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self.listens = bool(address)
        self._clock, self._period_ns = clock, watchdog_ns // _PARTS
        self._ready = self._lost = False
        self._cycles, self._text = -1, ""
        self._next_life_ns = self._next_text_ns = 0

    @classmethod
    def from_environment(cls, environment: Mapping[str, str], clock: Clock) -> "Notifier":
        """The notifier for NOTIFY_SOCKET, and for WATCHDOG_USEC where WATCHDOG_PID is this process or not set."""
        usec, pid = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
        mine = pid in ("", str(os.getpid())) and usec.isdecimal()
        return cls(environment.get("NOTIFY_SOCKET", ""), int(usec) * 1000 if mine else 0, clock)

    def look(self, status: Status) -> None:
        """Send the messages that the newest status requires; called many times a second."""
        if not self._address:
            return
        now = self._clock.now_ns()
        if not self._ready and status.cycles and not status.flags & NOT_GOOD:
            self._ready = self._send(f"READY=1\nSTATUS={_words(status)}")
        lives, self._cycles = status.cycles != self._cycles and not self._lost, status.cycles
        if self._period_ns and lives and now >= self._next_life_ns and self._send("WATCHDOG=1"):
            self._next_life_ns = now + self._period_ns
        if now >= self._next_text_ns:
            self._next_text_ns = now + STATUS_NS
            self._tell(_words(status))

    def lost(self) -> None:
        """Request a restart, because an essential part of the daemon is lost; send no more signs of life."""
        if self._period_ns and not self._lost:
            self._lost = self._send("WATCHDOG=trigger")

    def stopping(self) -> None:
        """Report that the run is ending."""
        self._send("STOPPING=1")

    def _tell(self, text: str) -> None:
        if text != self._text and self._send(f"STATUS={text}"):
            self._text = text

    def _send(self, text: str) -> bool:
        """Send without waiting; a message that cannot be sent now is sent again at the next look."""
        if not self._address:
            return False
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK) as s:
                s.sendto(text.encode(), socket.MSG_NOSIGNAL, self._address)
        except (OSError, ValueError):
            return False
        return True


def _words(status: Status) -> str:
    """One line for `systemctl status`."""
    if not status.cycles:
        return "starting"
    wrong = [f"{name}: {joined(texts)}" for name, texts in status.devices.items()]
    wrong += [f"{name}: {text}" for name, text in status.parts.items()]
    parts = [f"correction {status.mode}", *status.reasons, *wrong, status.log]
    return "; ".join(part.replace("\n", " ") for part in parts if part)


WAITING: Final = 200
"""Lines that may wait; further lines are not printed. The events have them all the same."""
END_S: Final = 1.0


class LinePrinter:
    """Prints lines in a thread. Entering starts it; leaving lets it finish, for a moment.

    Args:
        say: prints a line; may block. A line that it cannot print is skipped.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._lines: queue.Queue[str | None] = queue.Queue(WAITING)
        self._thread = threading.Thread(target=self._work, name="rtec-aloud", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._put(None)
        self._thread.join(END_S)

    def line(self, text: str) -> None:
        """Queue a line; from any thread."""
        self._put(text)

    def _put(self, text: str | None) -> None:
        try:
            self._lines.put_nowait(text)
        except queue.Full:
            return

    def _work(self) -> None:
        with suppress(OSError):  # a pipe without a reader: nobody reads the lines
            while (text := self._lines.get()) is not None:
                with suppress(ValueError, TypeError, LookupError):  # this terminal cannot show it; the events have it
                    self._say(text)

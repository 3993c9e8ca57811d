"""The daemon as a process of this computer: real-time treatment, signals, its service manager, lines for people.

- `prepare_process` asks the system for real-time treatment; what is not granted is reported in one sentence.
- `signals`, `signals_wait` and `starter`: what signals mean while the daemon runs, how a child is started deaf to
  them, and who started it.
- `Notifier` reports to the service manager: the protocol of `sd_notify(3)`, a datagram to a socket. READY follows the
  first good cycle: one whose counts were fresh, and every temperature that the model reads. WATCHDOG is sent only
  while the loop does cycles. Its rows are counted, so the service manager finds a loop that stands still, or a
  supervisor that no longer gets any, and restarts the daemon. Where a part of the daemon is lost that it must not
  correct without, it asks for that at once.
- `LinePrinter` prints lines and never waits for a terminal that stands or a journal that is full.
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

if TYPE_CHECKING:
    from rtec.loop.run_file import Realtime

MCL_CURRENT_AND_FUTURE = 3
PR_SET_TIMERSLACK = 29
HOW = "see docs/real-time.md"
WORKER_PRIORITY = 1
"""Of drivers' threads: below every loop, above all that is not real time."""


def prepare_process(wanted: "Realtime") -> list[str]:
    """Raise this process to SCHED_FIFO, lock its memory, pin it, switch the garbage collector off.

    Returns:
        one plain warning for everything that was refused; empty when all was granted.
    """
    refused = []
    if wanted.priority and not _fifo(wanted.priority):
        refused.append(f"SCHED_FIFO priority {wanted.priority}")
    if wanted.lock_memory and not _lock_memory():
        refused.append("locking memory")
    if not _pin(wanted.cpu):
        refused.append(f"processor {wanted.cpu}")
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
    """Stay on one processor: the one asked for, else the last where there are several."""
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

    A driver's thread in the loop's process is not urgent. But while it holds the interpreter the loop waits for it, and
    if any ordinary program may keep it off the processor meanwhile, the loop waits for that program.
    """
    _fifo(WORKER_PRIORITY)


SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)


@contextmanager
def signals(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Hand them all to the handler; the previous handlers come back afterwards."""
    previous = {number: signal.signal(number, handler) for number in SIGNALS}
    try:
        yield
    finally:
        for number, old in previous.items():
            signal.signal(number, old)


@contextmanager
def signals_wait() -> Iterator[None]:
    """A child started meanwhile is deaf to Ctrl-C from its first instruction, until it says itself what to do with it.

    Here a signal that comes meanwhile is handled afterwards.
    """
    resource_tracker.ensure_running()  # started by `Process.start` it would let the signals through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def child_context(forks: bool) -> ForkContext | SpawnContext:
    """How a child is started: as a copy of this process, which has loaded everything, or by a new interpreter.

    A copy lacks the other threads, and what they were doing stays half done in it. So a process with several threads
    starts a new interpreter.

    Args:
        forks: this process is rtec's own, and holds nothing open that a child must not have.
    """
    alone = forks and threading.active_count() == 1
    return multiprocessing.get_context("fork") if alone else multiprocessing.get_context("spawn")


def starter() -> int:
    """Process number of whoever started this process; `os.getppid` says another as soon as that one is gone.

    It was told when this process was started: one that is killed in that very moment is missed all the same.
    """
    parent = parent_process()
    return os.getppid() if parent is None or parent.pid is None else parent.pid


NOT_GOOD: Final = Flag.STALE_COUNTS | Flag.STALE_TEMPERATURE
STATUS_NS: Final = 1_000_000_000
_PARTS: Final = 4
"""So often within the time that the service manager allows."""


class Notifier:
    """Does nothing where no service manager asks for it.

    Args:
        address: path of the socket, or its abstract name behind an `@`; "": nobody asks.
        watchdog_ns: longest time between two signs of life; 0: nobody asks for them.
        clock: monotonic.

    Attributes:
        asked: whether a service manager listens.
    """

    def __init__(self, address: str, watchdog_ns: int, clock: Clock) -> None:
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self.asked = bool(address)
        self._clock, self._period_ns = clock, watchdog_ns // _PARTS
        self._ready = self._lost = False
        self._cycles, self._text = -1, ""
        self._next_life_ns = self._next_text_ns = 0

    @classmethod
    def from_environment(cls, environment: Mapping[str, str], clock: Clock) -> "Notifier":
        """Give what the service manager asked for: NOTIFY_SOCKET, WATCHDOG_USEC for the process WATCHDOG_PID."""
        usec, pid = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
        mine = pid in ("", str(os.getpid())) and usec.isdecimal()
        return cls(environment.get("NOTIFY_SOCKET", ""), int(usec) * 1000 if mine else 0, clock)

    def look(self, status: Status) -> None:
        """Tell what the newest status gives reason to; called many times a second."""
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
        """Ask for a restart: an essential part of the daemon cannot be counted on. No further sign of life is told."""
        if self._period_ns and not self._lost:
            self._lost = self._send("WATCHDOG=trigger")

    def stopping(self) -> None:
        """Tell that the run comes to its end."""
        self._send("STOPPING=1")

    def _tell(self, text: str) -> None:
        if text != self._text and self._send(f"STATUS={text}"):
            self._text = text

    def _send(self, text: str) -> bool:
        """Send, and never wait for it: what does not go now is sent again at the next look."""
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
    wrong = [f"{name}: {'; '.join(texts)}" for name, texts in status.devices.items()]
    wrong += [f"{name}: {text}" for name, text in status.parts.items()]
    parts = [f"correction {status.mode}", *status.reasons, *wrong, status.log]
    return "; ".join(part.replace("\n", " ") for part in parts if part)


WAITING: Final = 200
"""Lines; what comes then is not said. It stands in the events all the same."""
END_S: Final = 1.0


class LinePrinter:
    """Entering starts a thread that says what it is given; leaving lets it finish, for a moment.

    Args:
        say: prints a line; may take as long as it likes. A line that it cannot print is left out.
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
        """Have it said; from any thread."""
        self._put(text)

    def _put(self, text: str | None) -> None:
        try:
            self._lines.put_nowait(text)
        except queue.Full:
            return

    def _work(self) -> None:
        with suppress(OSError):  # a pipe whose reader is gone: there is nobody to tell
            while (text := self._lines.get()) is not None:
                with suppress(ValueError, TypeError, LookupError):  # no text for this terminal; the events have it
                    self._say(text)

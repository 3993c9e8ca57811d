"""Reopens a lost device or link in a thread of its own; the loop never waits for it.

A `Reopener` opens a device that the loop reads. A `Worker` opens a link and serves it until it breaks, for the drivers
of buses. The worker does not poll: between attempts, and while serving, it waits in the kernel, and `stop` wakes it.
"""

import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Annotated, Generic, Protocol, TypeVar

from pydantic import Field

from rtec.daemon.process import prepare_worker
from rtec.errors import DriverError, DriverUnavailable, unforeseen
from rtec.loop.clock import Clock

T = TypeVar("T")
NS = 1_000_000_000
STOP_TIMEOUT_S = 15.0

FirstRetry = Annotated[float, Field(ge=1e-6, le=60)]
LongestRetry = Annotated[float, Field(ge=1e-6, le=600)]


class Backoff:
    """Waiting times that double from the first to the longest, and restart with the first after a success."""

    def __init__(self, first_s: float, longest_s: float) -> None:
        self._first_ns, self._longest_ns = round(first_s * NS), round(longest_s * NS)
        self._next_ns = self._first_ns

    def next_ns(self) -> int:
        """The next wait, ns."""
        now_ns = self._next_ns
        self._next_ns = min(2 * now_ns, self._longest_ns)
        return now_ns

    def reset(self) -> None:
        """Restart with the shortest."""
        self._next_ns = self._first_ns

    def another(self) -> "Backoff":
        """One with the same waits, for something else."""
        return Backoff(self._first_ns / NS, self._longest_ns / NS)


class Reopener(Generic[T]):
    """Attempts in a thread of its own, at times of the caller's clock.

    `poll` is called every cycle and returns at once. The waits between attempts grow from `first_s` up to `longest_s`.
    `start`, or else the first attempt, creates the thread, which lives until `close`; between attempts it sleeps.

    Args:
        attempt: opens once, in bounded time; raises DriverError where it fails; any other exception is reported as
            well.
        discard: closes a device that was opened but is no longer needed.
        clock: the caller's clock.
        first_s, longest_s: shortest and longest wait between attempts.
    """

    def __init__(
        self, attempt: Callable[[], T], discard: Callable[[T], None], clock: Clock, first_s: float, longest_s: float
    ) -> None:
        self.attempts = 0
        self.error = ""
        self._attempt, self._discard, self._clock = attempt, discard, clock
        self._waits, self._due_ns, self._busy = Backoff(first_s, max(first_s, longest_s)), 0, False
        self._orders: SimpleQueue[bool] = SimpleQueue()
        self._results: SimpleQueue[T | str] = SimpleQueue()
        self._thread: threading.Thread | None = None

    def lost(self, error: str) -> None:
        """Record that it was lost now, and why; the first attempt follows after `first_s`."""
        self.error = error
        self._waits.reset()
        self._due_ns = self._clock.now_ns() + self._waits.next_ns()

    def poll(self) -> T | None:
        """The opened device, once; None while there is none."""
        if self._busy:
            if self._results.empty():
                return None
            result = self._results.get()
            self._busy = False
            if not isinstance(result, str):
                return result
            self.error = result
            self._due_ns = self._clock.now_ns() + self._waits.next_ns()
        elif self._clock.now_ns() >= self._due_ns:
            self._order()
        return None

    def start(self) -> None:
        """Create the thread now, so that no cycle has to: where memory is locked, a new thread's stack takes 10 ms."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="rtec-reopen", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """End the thread; close a device that it has opened meanwhile."""
        if self._thread is None:
            return
        self._orders.put(False)
        self._thread.join()
        self._thread, self._busy = None, False
        while not self._results.empty():
            result = self._results.get()
            if not isinstance(result, str):
                self._discard(result)

    def _order(self) -> None:
        self.attempts += 1
        self._busy = True
        self.start()
        self._orders.put(True)

    def _work(self) -> None:
        prepare_worker()
        while self._orders.get():
            try:
                self._results.put(self._attempt())
            except DriverError as e:
                self._results.put(str(e))
            except Exception as e:  # noqa: BLE001 - any exception of a library is reported; the next attempt follows
                self._results.put(unforeseen(e))


class OpenLink(Protocol):
    """The link that a worker opens."""

    def close(self) -> None:
        """Close the port; never raises."""
        ...


L = TypeVar("L", bound=OpenLink)


class Worker(Generic[L]):
    """Keeps a link alive in a thread of its own.

    Args:
        name: name of the thread.
        clock: clock of the deadlines.
        connect: opens the link or raises DriverError.
        serve: uses the link until `stopping`, or raises DriverError when the link is broken. Any other exception is
            reported, too, and the link is reopened.
        tell: called with the reason whenever the link is not open, and with "" when it is.
        backoff: waits between attempts; `serve` resets it when the device answers.

    Attributes:
        attempts: number of attempts to open the link.
    """

    def __init__(
        self,
        name: str,
        clock: Clock,
        connect: Callable[[], L],
        serve: Callable[[L], None],
        tell: Callable[[str], None],
        backoff: Backoff,
    ) -> None:
        self.attempts, self.backoff = 0, backoff
        self._name, self._clock = name, clock
        self._connect, self._serve, self._tell = connect, serve, tell
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()

    @property
    def stopping(self) -> bool:
        """Was `stop` called?"""
        return self._stop.is_set()

    def start(self, link: L | None = None) -> None:
        """Start the thread, with or without a link that is open already."""
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, args=(link,), name=self._name, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread, which closes the link; return when it has ended. A second call does nothing.

        Raises:
            DriverUnavailable: it does not end.
        """
        thread, self._thread = self._thread, None
        if thread is None:
            return
        self._stop.set()
        thread.join(STOP_TIMEOUT_S)
        if thread.is_alive():
            raise DriverUnavailable(f"{self._name}: does not end; the port's own driver hangs")

    def wait_until_ns(self, instant_ns: int) -> None:
        """Wait in the kernel until an instant, or until `stop`."""
        left_ns = instant_ns - self._clock.now_ns()
        if left_ns > 0:
            self._stop.wait(left_ns / NS)

    def _run(self, link: L | None) -> None:
        prepare_worker()
        while not self.stopping:
            why = self._once(link)
            link = None
            if self.stopping:
                return
            self._tell(why)
            self.wait_until_ns(self._clock.now_ns() + self.backoff.next_ns())

    def _once(self, link: L | None) -> str:
        self.attempts += 1
        try:
            self._use(link or self._connect())
        except DriverError as e:
            return str(e)
        except Exception as e:  # noqa: BLE001 - any exception of a library is reported, and the thread lives
            return unforeseen(e)
        return "closed"

    def _use(self, link: L) -> None:
        try:
            self._tell("")
            self._serve(link)
        finally:
            link.close()

"""Reopens a lost device; the loop never waits for it."""

import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Generic, TypeVar

from rtec.daemon.process import prepare_worker
from rtec.errors import DriverError, unforeseen
from rtec.loop.clock import Clock

T = TypeVar("T")


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
        self._first_s, self._longest_s = first_s, max(first_s, longest_s)
        self._wait_s, self._due_ns, self._busy = first_s, 0, False
        self._orders: SimpleQueue[bool] = SimpleQueue()
        self._results: SimpleQueue[T | str] = SimpleQueue()
        self._thread: threading.Thread | None = None

    def lost(self, error: str) -> None:
        """Record that it was lost now, and why; the first attempt follows after `first_s`."""
        self.error, self._wait_s = error, self._first_s
        self._due_ns = self._clock.now_ns() + round(self._first_s * 1e9)

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
            self._wait_s = min(2.0 * self._wait_s, self._longest_s)
            self._due_ns = self._clock.now_ns() + round(self._wait_s * 1e9)
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

"""Opens what was lost again, without the loop ever waiting for it."""

import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Generic, TypeVar

from rtec.daemon.process import prepare_worker
from rtec.errors import DriverError, unforeseen
from rtec.loop.clock import Clock

T = TypeVar("T")


class Reopener(Generic[T]):
    """Attempts in a thread of its own; when the next one is due, the caller's clock decides.

    `poll` is called every cycle and returns at once. Attempts come at growing distances, from `first_s` up to
    `longest_s`. The thread is made by `start`, at the latest with the first attempt, and lives until `close`; between
    attempts it sleeps.

    Args:
        attempt: opens once; bounded in time; raises DriverError where it fails; anything else is told the same way.
        discard: closes what was opened but is not wanted any more.
        clock: the caller's.
        first_s, longest_s: distance of attempts.
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
        """Note that it was lost now and why; the first attempt follows after `first_s`."""
        self.error, self._wait_s = error, self._first_s
        self._due_ns = self._clock.now_ns() + round(self._first_s * 1e9)

    def poll(self) -> T | None:
        """Give what was opened, once; None while there is nothing."""
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
        """Make the thread now, so that no cycle has to: where memory is locked, a new thread's stack takes 10 ms."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="rtec-reopen", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """End the thread; close what it has opened in the meantime."""
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
            except Exception as e:  # noqa: BLE001 - whatever a library raises: the next attempt comes, and it is told
                self._results.put(unforeseen(e))

"""A thread that keeps one link alive: open, serve until it breaks, close, wait a little longer each time, reopen.

The Modbus and the CAN drivers use it. Nothing here polls: between attempts, and while serving, the thread waits in
the kernel, and `stop` wakes it.
"""

import threading
from collections.abc import Callable
from typing import Annotated, Generic, Protocol, TypeVar

from pydantic import Field

from rtec.daemon.process import prepare_worker
from rtec.errors import DriverError, DriverUnavailable, unforeseen
from rtec.loop.clock import Clock

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

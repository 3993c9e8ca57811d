"""The only place that reads time or sleeps (a lint rule bans both elsewhere)."""

import time
from typing import Protocol


class Clock(Protocol):
    """Monotonic time in ns, and a wait until an instant of it."""

    def now_ns(self) -> int:
        """Time now, ns; never steps back, whatever happens to the wall clock."""
        ...

    def sleep_until_ns(self, instant_ns: int) -> None:
        """Return at that instant; return at once if it has passed."""
        ...


class RealClock:
    """CLOCK_MONOTONIC."""

    def now_ns(self) -> int:
        """Time now, ns."""
        return time.monotonic_ns()

    def sleep_until_ns(self, instant_ns: int) -> None:
        """Sleep in the kernel until the instant."""
        left_ns = instant_ns - time.monotonic_ns()
        if left_ns > 0:
            time.sleep(left_ns * 1e-9)


class VirtualClock:
    """Time that jumps: sleeping takes no time."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        """Give the time that the last sleep reached."""
        return self._now_ns

    def sleep_until_ns(self, instant_ns: int) -> None:
        """Jump to the instant; never back."""
        self._now_ns = max(self._now_ns, instant_ns)


def wall_clock_ns() -> int:
    """Date and time of day, ns since 1970 UTC: for records beside monotonic time, never for control."""
    return time.time_ns()


def wall_clock_iso() -> str:
    """Date and time of day in UTC, ISO 8601: for people and file names, never for control."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())

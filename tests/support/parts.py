"""A part of a daemon, for tests of what runs in it."""

from collections.abc import Callable

from rtec.daemon.supervision import DaemonPart
from rtec.loop.clock import VirtualClock


def part(report: Callable[[str], None] = lambda _: None) -> DaemonPart:
    """One that waits for half a second of real time behind its first fault."""
    return DaemonPart("part", VirtualClock(10**12), report)

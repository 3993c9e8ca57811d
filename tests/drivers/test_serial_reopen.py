"""Opening again: how often, and that nobody waits for it. Oracle: the virtual clock."""

import threading

from rtec.errors import DriverUnavailable
from rtec.loop.clock import RealClock, VirtualClock
from rtec_drivers.reopen import Reopener
from tests.support.conformance import soon

MS = 1_000_000


class Door:
    """Opens only when it may; its attempts come one by one."""

    def __init__(self) -> None:
        self.open, self.shut, self.tried, self.go = False, 0, threading.Semaphore(0), threading.Semaphore(0)

    def attempt(self) -> str | int:
        self.tried.release()
        assert self.go.acquire(timeout=10)
        if not self.open:
            raise DriverUnavailable("shut")
        return 7

    def discard(self, _: object) -> None:
        self.shut += 1


def test_attempts_come_at_growing_distances_up_to_a_bound() -> None:
    """0.1 s, then doubled up to 0.5 s, and never while one is under way."""
    clock, door = VirtualClock(), Door()
    reopener = Reopener(door.attempt, door.discard, clock, 0.1, 0.5)
    reopener.lost("pulled")
    started_ns = []
    for _ in range(6):
        before = reopener.attempts
        while reopener.attempts == before:
            clock.sleep_until_ns(clock.now_ns() + MS)
            assert reopener.poll() is None
        started_ns.append(clock.now_ns())
        assert door.tried.acquire(timeout=10)
        for _ in range(50):
            assert reopener.poll() is None
        assert reopener.attempts == before + 1
        door.go.release()
        soon(RealClock(), lambda: reopener.poll() is None and not reopener._busy)
        assert reopener.error == "shut"
    gaps_ms = [(b - a) // MS for a, b in zip([0, *started_ns], started_ns, strict=False)]
    assert gaps_ms == [100, 200, 400, 500, 500, 500]
    reopener.close()


def test_what_was_opened_too_late_is_closed() -> None:
    """Nobody took it before the end."""
    clock, door = VirtualClock(), Door()
    door.open = True
    reopener = Reopener(door.attempt, door.discard, clock, 0.1, 0.5)
    reopener.lost("pulled")
    clock.sleep_until_ns(100 * MS)
    assert reopener.poll() is None
    door.go.release()
    threads = threading.active_count()
    reopener.close()
    assert door.shut == 1
    assert threading.active_count() == threads - 1
    reopener.close()

"""Parts that fail and begin again. Oracles: a table of waits written by hand; exceptions put in by the test."""

import threading
from collections.abc import Callable

import pytest

from rtec.daemon.supervision import LOST_AFTER, DaemonParts, KeptThread, fault
from rtec.errors import RtecError
from rtec.loop.clock import VirtualClock

SECOND = 1_000_000_000
LONG_S = 60.0


class Stop(threading.Event):
    """Waiting takes no time; each wait is written down."""

    def __init__(self, clock: VirtualClock) -> None:
        super().__init__()
        self.clock, self.waits = clock, list[float]()

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        self.waits.append(timeout)
        self.clock.sleep_until_ns(self.clock.now_ns() + round(timeout * SECOND))
        return self.is_set()


class Told(list[tuple[str, str]]):
    def __call__(self, what: str, text: str) -> None:
        self.append((what, text))


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock(10**12)


def failing(times: int) -> Callable[[], None]:
    """Fails so often, then returns."""
    left = [times]

    def work() -> None:
        if left[0]:
            left[0] -= 1
            raise OverflowError(f"{left[0]} to come")

    return work


def test_waits_grow_and_each_fault_is_told_and_counted(clock: VirtualClock) -> None:
    told = Told()
    parts, stop = DaemonParts(clock, told), Stop(clock)
    part = parts.add("disk", essential=True)
    part.keep(failing(9), stop)
    assert stop.waits == pytest.approx([0.5, 1, 2, 4, 8, 16, 30, 30, 30])
    assert parts.faults == {"disk": 9}
    assert len(told) == 9
    what, text = told[0]
    assert what == "fault"
    assert text.startswith("disk: fault in the program or in a library that it uses: OverflowError: 8 to come (")
    assert "test_supervision.py:" in text
    assert text.endswith("; begun again in 0.5 s")
    assert told[LOST_AFTER - 1][1].endswith("it failed 6 times in a row")


@pytest.mark.parametrize("essential", [True, False])
def test_a_part_that_cannot_begin_again_is_lost_and_found_again(clock: VirtualClock, essential: bool) -> None:
    parts = DaemonParts(clock, Told())
    part = parts.add("control", essential)
    for k in range(LOST_AFTER):
        assert parts.lost == []
        part.failed(f"fault {k}")
        clock.sleep_until_ns(clock.now_ns() + round(part.wait_s * SECOND))
        assert part.due
    assert parts.lost == (["control"] if essential else [])
    assert parts.troubles == {"control": "fault 5"}
    clock.sleep_until_ns(clock.now_ns() + 61 * SECOND)
    assert (parts.lost, parts.troubles) == ([], {})
    part.failed("much later")
    assert part.wait_s == pytest.approx(0.5)
    assert parts.lost == []
    assert parts.faults == {"control": LOST_AFTER + 1}


def test_a_part_in_trouble_is_told_until_it_begins_again(clock: VirtualClock) -> None:
    parts = DaemonParts(clock, Told())
    part = parts.add("disk")
    assert (part.due, parts.troubles, parts.faults) == (True, {}, {})
    part.failed("no such thing")
    assert (part.due, parts.troubles) == (False, {"disk": "no such thing"})
    clock.sleep_until_ns(clock.now_ns() + SECOND)
    assert (part.due, parts.troubles) == (True, {})


def test_a_part_that_is_to_end_is_begun_once_more_at_most(clock: VirtualClock) -> None:
    """So that what waits is still written; and a part that fails for ever does not keep the daemon from ending."""
    stop, begun = Stop(clock), []
    stop.set()

    def work() -> None:
        begun.append(1)
        raise ValueError

    DaemonParts(clock, Told()).add("disk").keep(work, stop)
    assert len(begun) == 1


def test_a_thread_goes_on_behind_a_fault_and_ends_when_it_is_asked_to() -> None:
    clock, told, worked = VirtualClock(10**12), Told(), threading.Event()
    part = DaemonParts(clock, told).add("disk")
    fails = failing(1)

    def work() -> None:
        fails()
        worked.set()
        thread.stop.wait(LONG_S)

    thread = KeptThread(part, work)
    thread.start()
    assert worked.wait(LONG_S)
    assert thread.end(LONG_S)
    assert part.faults == 1


def test_a_thread_that_was_never_started_has_ended() -> None:
    assert KeptThread(DaemonParts(VirtualClock(), Told()).add("disk"), lambda: None).end(0.0)


def test_what_a_user_can_mend_is_told_as_it_stands() -> None:
    assert fault(RtecError("clients.toml: cannot be read: Permission denied")) == (
        "clients.toml: cannot be read: Permission denied"
    )

"""Wake-ups measured on the spot. Oracle: a clock that is late by known amounts."""

import json
import re
import signal
import subprocess
import sys
from collections.abc import Sequence

import pytest

from rtec.cli.main import status
from rtec.doctor.wakeup import WakeUps, judged, measure, measured
from rtec.loop.clock import VirtualClock
from rtec.loop.run_file import Realtime

WELL = WakeUps(3000, 5.0, 9.0, 14.0, 31.0, 0, "")


class LateClock(VirtualClock):
    """Wakes up late by given amounts, ns, in turn; reading it takes no time."""

    def __init__(self, late_ns: Sequence[int]) -> None:
        super().__init__(10**12)
        self._late_ns, self._k = list(late_ns), 0

    def sleep_until_ns(self, instant_ns: int) -> None:
        super().sleep_until_ns(instant_ns + self._late_ns[self._k])
        self._k += 1


def test_wake_ups_are_measured_from_absolute_deadlines() -> None:
    """Oracle: the amounts; one of them is three cycles, and the deadlines that pass meanwhile are not waited for."""
    amounts = [5_000] * 98 + [3_400_000, 20_000]
    dots: list[int] = []
    found = measure(LateClock(amounts), 1000.0, 0.1, "x", lambda: dots.append(1))
    assert (found.n, found.p50_us, found.max_us, found.late, found.refused) == (100, 5.0, 3400.0, 1, "x")
    assert len(dots) == 1


@pytest.mark.parametrize(
    ("changed", "state", "part"),
    [
        ({}, "good", ""),
        ({"p99_9_us": 150.0}, "better", "a tenth of the cycle and more"),
        ({"max_us": 1200.0, "late": 1}, "better", "1 came later than a whole cycle"),
        ({"max_us": 1200.0, "late": 4}, "wrong", "4 of 3000 came later than a whole cycle: deadlines are missed"),
        ({"refused": "no real-time treatment for: SCHED_FIFO"}, "good", "measured without: no real-time treatment"),
    ],
)
def test_wake_ups_are_judged_by_the_cycle(changed: dict[str, float], state: str, part: str) -> None:
    finding = judged(WakeUps(**{**vars(WELL), **changed}), 1000.0)
    assert finding.state == state
    assert part in finding.why


@pytest.mark.xdist_group("real-clock")
def test_wake_ups_of_this_computer() -> None:
    """In its own process, which is treated like the loop. Oracle: how many there must be; none is early."""
    done: list[tuple[int, int]] = []
    found = measured(Realtime(), 500.0, 0.5, lambda *so: done.append(so))
    assert found.n == 250
    assert 0 < found.p50_us <= found.p99_us <= found.p99_9_us <= found.max_us
    assert done[-1] == (5, 5)


@pytest.mark.xdist_group("real-clock")
def test_ctrl_c_ends_the_measurement_without_a_word() -> None:
    """A terminal sends it to both processes; the other one says that it ended. Oracle: the standard error."""
    orders = {
        "realtime": Realtime(lock_memory=False, priority=0).model_dump(mode="json"),
        "rate_hz": 100.0,
        "seconds": 60.0,
    }
    # Where the tests run as a shell's background job, SIGINT is ignored, and so it is in what they start.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    with subprocess.Popen(
        [sys.executable, "-m", "rtec.doctor.wakeup"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as process:
        signal.signal(signal.SIGINT, before)
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(json.dumps(orders).encode())
        process.stdin.close()
        assert process.stdout.readline() == b".\n"
        process.send_signal(signal.SIGINT)
        assert process.stderr is not None
        assert process.stderr.read() == b""


@pytest.mark.xdist_group("real-clock")
def test_the_command_without_a_run_file(capsys: pytest.CaptureFixture[str]) -> None:
    """On whatever computer this is: the exit status says what the JSON says."""
    code = status(["doctor", "--seconds", "0.2", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert code == (0 if found["well"] else 1)
    assert found["devices"] is None
    assert len(found["pc"]["findings"]) == 11
    assert status(["doctor", "--seconds", "0.2"]) in (0, 1)
    assert re.search(r"wake-ups +\w", capsys.readouterr().out)

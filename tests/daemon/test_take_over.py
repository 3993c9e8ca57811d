"""An actuator that cannot tell its ledger when the run begins: nothing is commanded until it does.

Oracle: the actuator's own list of commands.
"""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.correction.flags import MODE_HOLD, MODE_ON, MODE_TAKEN_OVER, OUTPUT_TROUBLE, Flag
from rtec.correction.sinks import Sink
from rtec.daemon.fastpath import first_counts
from rtec.errors import DriverTimeout, DriverUnavailable
from rtec.loop.clock import VirtualClock
from rtec.loop.devices import Ports
from rtec.loop.loop import Loop, bind_rows
from rtec.loop.output import lost
from rtec.loop.records import Commands, Samples
from rtec.loop.step import Step
from tests.support import setups

Ints = NDArray[np.int64]
MS = 1_000_000
CYCLES = 1000


class LateBox:
    """Plugged in at some cycle, with a ledger from before; counts and temperatures from elsewhere are there at once."""

    def __init__(self, clock: VirtualClock, has: tuple[int, int], at_cycle: int) -> None:
        self.clock, self.has, self.at_cycle, self.reads = clock, list(has), at_cycle, 0
        self.told: list[tuple[int, list[int]]] = []

    def read_counts(self, counts: Ints) -> int:
        self.reads += 1
        counts[:] = [50_000, 100_000]
        return self.clock.now_ns()

    def read_temperatures(self, degc: NDArray[np.float64], time_ns: Ints) -> None:
        degc[:], time_ns[:] = 27.0, self.clock.now_ns()

    def read_spindle(self) -> float:
        return 900.0

    def refuses(self, sink: Sink) -> str:
        del sink
        return ""

    def apply(self, output: Ints) -> None:
        self._there()
        self.has = output.tolist()
        self.told.append((self.reads, self.has))

    def read_output(self, output: Ints) -> None:
        self._there()
        output[:] = self.has

    def hold(self) -> None:
        pass

    def _there(self) -> None:
        if self.reads < self.at_cycle:
            raise DriverUnavailable("/dev/ttyUSB7: no such port; trying again")


def start(tmp_path: Path, has: tuple[int, int], expected: Ints | None) -> tuple[LateBox, Loop, Samples, Commands]:
    clock = VirtualClock(10**12)
    box, step = LateBox(clock, has, 200), Step(setups.setup(tmp_path).step_settings())
    samples, commands = Samples.empty(step.layout, CYCLES), Commands.empty(step.layout, CYCLES)
    rows = bind_rows(step, list(zip(samples.singles(), commands.singles(), strict=True)))
    loop = Loop(step, Ports(box, (box,), box, box, {"output": ("box",)}), clock, MS, rows, MODE_ON)
    loop.take_over(expected, np.array([5, 5]))
    loop.run(CYCLES, lambda _: True)
    return box, loop, samples, commands


@pytest.mark.parametrize("expected", [None, np.array([42, -31])])
def test_a_port_that_appears_later(tmp_path: Path, expected: Ints | None) -> None:
    box, loop, samples, commands = start(tmp_path, (40, -30), expected)
    assert (samples.mode[:199] == MODE_ON | OUTPUT_TROUBLE).all()
    both = Flag.OUTPUT_TROUBLE | Flag.HELD
    assert (commands.flags[:199] & both == both).all()
    assert samples.mode[199] == MODE_TAKEN_OVER
    assert (samples.mode[200:] == MODE_ON).all()
    assert commands.output[199].tolist() == [40, -30]
    first, output = box.told[0]
    assert first == 201
    assert np.abs(np.array(output) - [40, -30]).max() <= 1
    steps = np.abs(np.diff([told for _, told in box.told], axis=0))
    assert steps.max() == 1
    assert loop.stats.cycles == CYCLES
    assert loop.stats.misses == 0
    assert not loop.waits
    assert loop.stats.failures()["box"]["last"] == {"output": "/dev/ttyUSB7: no such port; trying again"}


def test_one_that_lost_its_ledger_meanwhile_is_waited_with(tmp_path: Path) -> None:
    box, loop, samples, _ = start(tmp_path, (0, 0), np.array([42, -31]))
    assert (samples.mode[200:] == MODE_HOLD).all()
    assert not box.told
    assert loop.waits
    (reason,) = loop.stats.reasons()["box"]
    assert "the actuator has X +0.00 µm, Z +0.00 µm, the run before left X -21.00 µm, Z +15.50 µm" in reason
    loop.order_resume()
    assert loop.stats.reasons() == {}


def test_an_output_beyond_the_stop_limit_stays_until_an_order_and_comes_back_slowly(tmp_path: Path) -> None:
    """1000 counts are 500 µm, stop_um is 100. Oracle: no command before the order; then one count a cycle at most."""
    box, loop, samples, commands = start(tmp_path, (1000, 0), None)
    assert not box.told
    assert (samples.mode[200:] == MODE_HOLD | OUTPUT_TROUBLE).all()
    assert (commands.output[199:, 0] == 1000).all()
    assert (commands.applied_um[199:, 0] == -500.0).all()
    (reason,) = loop.stats.reasons()["box"]
    assert "the actuator has X -500.00 µm, Z +0.00 µm, and stop_um of X is 100" in reason
    loop.order_resume()
    loop.mode = MODE_HOLD
    loop.run(CYCLES, lambda _: True)
    steps = np.abs(np.diff([told for _, told in box.told], axis=0))
    assert steps.max() == 1
    assert box.told[-1][1][0] < 1000


def test_an_offset_may_begin_the_day_at_zero_but_with_nothing_else(tmp_path: Path) -> None:
    """Oracle: by hand; 42 was left, 0 is a controller that was switched off, 20 is somebody else's."""
    step = Step(setups.setup(tmp_path).step_settings())
    allowed, left = np.array([5, 5]), np.array([42, -31])
    told = [bool(lost(step, left, np.array(has), allowed, or_zero=True)) for has in ([0, 0], [42, 0], [20, 0])]
    assert told == [False, False, True]


class _Silent(LateBox):
    """Sends its first counts at 0.5 s."""

    def read_counts(self, counts: Ints) -> int:
        if self.clock.now_ns() < 500_000_000:
            raise DriverTimeout("no line yet")
        counts[:] = [7, 8]
        return self.clock.now_ns()


def test_a_start_waits_for_the_first_counts_of_a_device_that_sends_them_by_itself() -> None:
    """Without them every axis would have lost its direction. Oracle: the instants on the virtual clock."""
    for begin_ns, there in ((0, True), (-2_000_000_000, False)):
        clock, counts = VirtualClock(begin_ns), np.zeros(2, np.int64)
        box = _Silent(clock, (0, 0), 0)
        ports = Ports(box, (), None, box, {})
        assert first_counts(ports, counts, clock) == there
        assert counts.tolist() == ([7, 8] if there else [0, 0])
        assert clock.now_ns() == (500_000_000 if there else begin_ns + 1_000_000_000)

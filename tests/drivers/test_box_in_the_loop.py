"""The loop on an encoder box while things happen to the line: it keeps its rate, holds, and goes on.

Virtual clock, box in memory. Oracles: the number of deadlines that passed, the plant's ledger, the flags of the log.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.correction.guard import Flag
from rtec.runtime.devices import Ports
from rtec.runtime.loop import Loop, Row, bind_rows
from rtec.runtime.records import MODE_ON, Commands, Samples
from rtec.runtime.step import Step
from tests import setups
from tests.drivers.box_rig import MS, MemoryBench, in_memory

CYCLES = 4000


class _Still:
    """Sensors that read the same for ever, always fresh, and a spindle."""

    def __init__(self, bench: MemoryBench) -> None:
        self._bench = bench

    def read_temperatures(self, degc: NDArray[np.float64], time_ns: NDArray[np.int64]) -> None:
        degc[:] = 27.0
        time_ns[:] = self._bench.clock.now_ns()

    def read_spindle(self) -> float:
        return 900.0


class Run:
    """A loop on a bench, and what it wrote."""

    def __init__(self, bench: MemoryBench, folder: Path) -> None:
        self.bench = bench
        self.step = Step(setups.setup(folder).step_settings())
        self.samples = Samples.empty(self.step.layout, CYCLES)
        self.commands = Commands.empty(self.step.layout, CYCLES)
        rows = [(self.samples.rows(i, i + 1), self.commands.rows(i, i + 1)) for i in range(CYCLES)]
        ports = Ports(bench.driver, (_Still(bench),), _Still(bench), bench.driver)
        self.loop = Loop(self.step, ports, bench.clock, MS, bind_rows(self.step, rows), MODE_ON)
        self.done = 0

    def cycles(self, n: int, each: Callable[[int], None] = lambda _: None) -> Commands:
        """So many more; give their commands."""

        def after(_: Row) -> bool:
            self.done += 1
            each(self.done)
            return True

        first = self.done
        self.loop.run(n, after)
        return self.commands.rows(first, self.done)


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Run]:
    with in_memory(monkeypatch) as bench:
        bench.plant.position = [50_000, 100_000]
        bench.driver.resume()
        run = Run(bench, tmp_path)
        run.cycles(1500)
        assert any(bench.plant.inserted)
        yield run


def held(commands: Commands) -> NDArray[np.bool_]:
    both = int(Flag.STALE_COUNTS | Flag.HELD)
    return np.asarray(commands.flags & both == both, np.bool_)


def test_silence(run: Run) -> None:
    """A second of it: not one deadline is missed, the correction stays to the count, and then goes on."""
    before = run.commands.output[run.done - 1].copy()
    run.bench.line.deaf = True
    commands = run.cycles(1000)
    assert held(commands)[10:].all()
    assert np.ptp(commands.output[50:], axis=0).max() == 0
    assert np.abs(commands.output[-1] - before).max() <= 1
    assert run.loop.stats.misses == 0
    assert "silent for" in run.loop.stats.last_error
    run.bench.line.deaf = False
    after = run.cycles(200)
    assert not held(after)[40:].any()
    run.bench.cycle(*after.output[-1])
    assert run.bench.plant.inserted == after.output[-1].tolist()


def test_one_percent_of_wrong_frames(run: Run) -> None:
    """Counts of the cycle before are good enough: nothing is held, nothing missed."""
    run.bench.faults.flip_rate = 0.01
    commands = run.cycles(1000)
    assert run.loop.stats.driver_errors >= 5
    assert run.loop.stats.misses == 0
    assert not held(commands).any()


def test_a_box_that_starts_anew(run: Run) -> None:
    """Held until somebody orders, with the reason; never commanded meanwhile; then from the box's own ledger on."""
    run.bench.box.reset()
    run.bench.plant.position = [0, 0]
    commands = run.cycles(500)
    assert held(commands)[10:].all()
    assert run.loop.stats.misses == 0
    assert run.bench.plant.inserted == [0, 0]
    assert "ordered to resume" in run.loop.stats.last_error
    run.bench.driver.resume()
    wanted = commands.output[-1]
    assert np.abs(wanted).max() > 16
    run.cycles(20)
    assert run.bench.plant.inserted == [0, 0]
    assert "must take over the box's ledger first" in run.loop.stats.last_error
    ledger = np.zeros(2, np.int64)
    run.bench.driver.read_output(ledger)
    run.step.resume(ledger)
    steps: list[list[int]] = []
    run.cycles(500, lambda _: steps.append(list(run.bench.plant.inserted)))
    assert any(run.bench.plant.inserted)
    assert np.abs(np.diff(np.array(steps), axis=0)).max() <= 2

"""The loop on an encoder box while things happen to the line: it keeps its rate, holds, and goes on.

Virtual clock, box in memory. Oracles: the number of deadlines that passed, the plant's ledger, the flags of the log.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.correction.flags import MODE_ON, MODE_TAKEN_OVER, Flag
from rtec.errors import DriverFault
from rtec.loop.devices import Ports
from rtec.loop.loop import Loop, Row, bind_rows
from rtec.loop.records import Commands, Samples
from rtec.loop.stats import LoopStats, Trouble
from rtec.loop.step import Step
from tests.support import box_rig, setups
from tests.support.box_rig import MS, MemoryBench, in_memory

CYCLES = 4000
each_box = box_rig.each_box


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
        run.cycles(400)  # it stands from the 190th on
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
    """Held with the reason at what the box has, which is nothing; never commanded until somebody orders it.

    An order to the driver alone is not enough. Oracle: the plant's ledger, which goes on from the box's, never jumps.
    """
    assert np.abs(run.commands.output[run.done - 1]).max() > 16
    run.bench.box.reset()
    run.bench.plant.position = [0, 0]
    commands = run.cycles(500)
    assert held(commands)[10:].all()
    assert (commands.flags[10:] & Flag.OUTPUT_TROUBLE).all()
    assert commands.output[10:].max() == commands.output[10:].min() == 0
    assert not commands.applied_um[10:].any()
    (reason,) = run.loop.stats.reasons()["counts"]
    assert "restarted" in reason
    assert "until it is ordered to resume" in reason
    run.bench.driver.resume()
    run.cycles(20)
    assert run.bench.plant.inserted == [0, 0]
    assert run.loop.waits
    run.loop.order_resume()
    steps: list[list[int]] = []
    after = run.cycles(500, lambda _: steps.append(list(run.bench.plant.inserted)))
    assert run.loop.stats.takeovers == 1
    assert not run.loop.waits
    assert run.loop.stats.reasons() == {}
    first = int(np.flatnonzero(run.samples.mode[run.done - 500 : run.done] == MODE_TAKEN_OVER)[0])
    assert first <= 1
    assert np.abs(np.diff(np.array(steps), axis=0)).max() <= 1
    assert np.abs(np.diff(after.applied_um[first:], axis=0)).max() <= 50.0 * 1e-3 * (1 + 1e-9)
    assert any(run.bench.plant.inserted)
    assert run.loop.stats.misses == 0
    run.bench.cycle(*after.output[-1])
    assert run.bench.plant.inserted == after.output[-1].tolist()


def test_a_needless_order_moves_nothing(run: Run) -> None:
    """The box is well: it is asked for its ledger, and all goes on from there."""
    before = run.commands.output[run.done - 1].copy()
    run.loop.order_resume()
    after = run.cycles(20)
    assert run.loop.stats.takeovers == 1
    assert np.abs(after.output - before).max() <= 1
    assert run.loop.stats.misses == 0


def test_the_order_while_the_line_is_cut(run: Run) -> None:
    """It waits until the box tells its ledger; nothing is commanded before."""
    run.bench.box.reset()
    run.cycles(50)
    run.bench.line.deaf = True
    run.cycles(100)
    run.loop.order_resume()
    run.cycles(300)
    assert run.loop.waits
    assert run.loop.stats.takeovers == 0
    assert run.bench.plant.inserted == [0, 0]
    run.bench.line.deaf = False
    after = run.cycles(300)
    assert run.loop.stats.takeovers == 1
    assert not held(after)[-1]
    assert run.loop.stats.misses == 0


def test_counts_that_jump_and_stay(run: Run) -> None:
    """More than the machine's highest speed allows: held with the reason until ordered; the temperatures stay fresh."""
    before = run.commands.output[run.done - 1].copy()
    run.bench.plant.position = [position + 10_000 for position in run.bench.plant.position]
    commands = run.cycles(400)
    assert held(commands)[10:].all()
    assert np.ptp(commands.output[50:], axis=0).max() == 0
    assert np.abs(commands.output[-1] - before).max() <= 1
    assert "the position is not known" in run.loop.stats.reasons()["counts"][0]
    newest = run.samples.rows(run.done - 1, run.done)
    assert newest.time_ns[0] - newest.degc_time_ns.min() <= 2 * MS
    assert run.loop.stats.misses == 0
    run.loop.order_resume()
    assert not held(run.cycles(300))[50:].any()


def test_a_slip_of_one_reading_costs_one_reading(run: Run) -> None:
    """A wrong number that goes back to the right one is refused, and no order is needed."""
    at = list(run.bench.plant.position)
    run.bench.plant.position = [at[0] + 10_000, at[1]]
    run.cycles(1)
    run.bench.plant.position = at
    assert not held(run.cycles(50)).any()
    assert run.loop.stats.driver_errors == 1
    assert not run.loop.waits


class _Thermometers:
    """Two devices' worth of sensors: what it fills in stands, though it raises; one sensor is stuck from some time."""

    def __init__(self, bench: MemoryBench) -> None:
        self._bench, self.stuck_since_ns = bench, -1

    def read_temperatures(self, degc: NDArray[np.float64], time_ns: NDArray[np.int64]) -> None:
        now_ns = self._bench.clock.now_ns()
        degc[:] = 27.0
        stuck = self.stuck_since_ns >= 0
        time_ns[1:] = now_ns
        time_ns[0] = self.stuck_since_ns if stuck else now_ns
        if stuck:
            raise DriverFault("T_spindle_front: has read 27 for 300 s: stuck")


def test_a_sensor_that_is_stuck_for_minutes(run: Run) -> None:
    """Its own age decides: held once it is too old; the others are as fresh as before, although reading raises."""
    sensors = _Thermometers(run.bench)
    names = {"counts": ("box",), "temperatures": ("thermometer",), "spindle": ("box",), "output": ("box",)}
    ports = Ports(run.bench.driver, (sensors,), _Still(run.bench), run.bench.driver, names)
    rows = [(run.samples.rows(i, i + 1), run.commands.rows(i, i + 1)) for i in range(CYCLES)]
    loop = Loop(run.step, ports, run.bench.clock, MS, bind_rows(run.step, rows), MODE_ON)
    loop.run(300, lambda _: True)
    sensors.stuck_since_ns = run.bench.clock.now_ns()
    run.bench.clock.sleep_until_ns(sensors.stuck_since_ns + 29 * 10**9)
    loop.run(200, lambda _: True)
    # Counts are not asked about: the box's thread is a real one, and the clock has just jumped by half a minute.
    assert not (run.commands.flags[300:500] & Flag.STALE_TEMPERATURE).any()
    run.bench.clock.sleep_until_ns(sensors.stuck_since_ns + 300 * 10**9)
    loop.run(200, lambda _: True)
    flags = int(run.commands.flags[699])
    assert flags & Flag.STALE_TEMPERATURE
    assert flags & Flag.HELD
    assert loop.stats.reasons()["thermometer"] == ["T_spindle_front: has read 27 for 300 s: stuck"]
    age_ns = run.samples.time_ns[699] - run.samples.degc_time_ns[699]
    assert age_ns[0] >= 300 * 10**9
    assert (age_ns[1:] <= 2 * MS).all()
    sensors.stuck_since_ns = -1
    loop.run(200, lambda _: True)
    assert not run.commands.flags[899] & Flag.STALE_TEMPERATURE
    assert "thermometer" not in loop.stats.reasons()
    assert loop.stats.failures()["thermometer"]["times"] == 400


def test_reasons_stand_by_device() -> None:
    """Two devices fail: each has its own reason, and a device that is well again has none."""
    stats = LoopStats.empty()
    box, heat = Trouble("box", "counts"), Trouble("heat", "temperatures")
    stats.troubles += [box, Trouble("box", "output"), heat]
    for trouble, reason in ((box, "silent"), (stats.troubles[1], "silent"), (heat, "open wire"), (box, "frozen")):
        trouble.failed(reason)
    assert stats.reasons() == {"box": ["frozen", "silent"], "heat": ["open wire"]}
    assert stats.last_error == "frozen; silent; open wire"
    heat.now = False
    assert list(stats.reasons()) == ["box"]
    assert stats.failures()["box"] == {"times": 3, "last": {"counts": "frozen", "output": "silent"}}
    assert stats.driver_errors == 4

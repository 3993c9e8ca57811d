"""Whatever becomes of a command: nothing runs away, nothing jumps, and what the machine does not have is not told.

Every actuator driver with every fault, on a virtual clock; counts stay fresh, the request changes all the time. Oracle:
the machine behind the driver, which notes what it had whenever it took a command; and the limits of the run file.
"""

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtec.correction.flags import (
    MODE_OFF,
    MODE_ON,
    MODE_TAKEN_OVER,
    ORDER_MASK,
    OUTPUT_TROUBLE,
    OUTPUT_UNCONFIRMED,
    Flag,
)
from rtec.log.writer import LogWriter
from rtec.loop.devices import Ports
from rtec.loop.loop import Loop, bind_rows
from rtec.loop.output import PATIENCE_NS
from rtec.loop.records import Commands, Samples
from rtec.loop.run_file import Setup
from rtec.loop.step import Step
from rtec.playback.replay import replay_log
from tests.support import setups
from tests.support.output_rigs import FAULTS, MS, RIGS, OutputRig, SimRig

WELL, BAD, FADE, AFTER = 500, 1000, 300, 800
"""Cycles. At 50 µm/s 25 counts of half a micrometre take 250 to fade."""
SLEW_UM_S, ACCELERATION_UM_S2 = 50.0, 2000.0
"""Of tests/support/setups.py; at 2 counts/µm and 1 kHz a cycle's 0.1 counts are one count at most."""
MOST_COUNTS = 1
TURN_CYCLES = 220
"""At the latest after so many cycles an axis turns, and the model asks for something else."""


class _Sensors:
    def __init__(self, rig: OutputRig) -> None:
        self.read_temperatures = rig.still

    def read_spindle(self) -> float:
        return 900.0


class Run:
    """A loop on a rig: moves the axes to and fro, so that the backlash of the model asks for 8 counts up or down."""

    def __init__(self, rig: OutputRig, made: Setup, mode: int = MODE_ON) -> None:
        self.rig, self.step = rig, Step(made.step_settings())
        n = WELL + BAD + FADE + AFTER
        self.samples, self.commands = Samples.empty(self.step.layout, n), Commands.empty(self.step.layout, n)
        rows = bind_rows(self.step, list(zip(self.samples.singles(), self.commands.singles(), strict=True)))
        sensors = _Sensors(rig)
        ports = Ports(rig.encoders or rig.driver, (sensors,), sensors, rig.driver, {"output": ("box",)})
        self.loop, self.done = Loop(self.step, ports, rig.clock, MS, rows, mode), 0

    def cycles(self, n: int) -> slice:
        """So many more; give their rows."""
        first = self.done

        def after(_: Any) -> bool:
            self.done += 1
            x = 100_000 + 40_000 * np.sin(self.done / 70.0)
            self.rig.move([round(x), 300_000 + round(50_000 * np.sin(self.done / 110.0))])
            return True

        self.loop.run(n, after)
        return slice(first, self.done)

    def largest_step(self) -> int:
        """The largest change that the machine ever took at once, counts."""
        return max(abs(a - b) for before, told in self.rig.taken for a, b in zip(before, told, strict=True))

    def check(self, made: Setup, folder: Path) -> None:
        """The laws that hold whatever happened."""
        assert self.largest_step() <= MOST_COUNTS
        commands, mode = self.commands.rows(0, self.done), self.samples.mode[: self.done]
        moved = np.abs(np.diff(commands.applied_um, axis=0, prepend=0.0))
        moved[(mode & ORDER_MASK) == MODE_TAKEN_OVER] = 0.0  # the machine has it already
        assert moved.max() <= SLEW_UM_S * 1e-3 * (1 + 1e-9)
        # From cycle to cycle, those not counted that only waited; slower it may be at once, where it stands.
        faster = np.diff(moved[(mode & OUTPUT_UNCONFIRMED) == 0], axis=0)
        assert faster.max() <= ACCELERATION_UM_S2 * 1e-6 * (1 + 1e-6)
        log = folder / "run.arrows"
        with LogWriter(log, self.step.layout, made.log_header()) as writer:
            writer.write(self.samples.rows(0, self.done), commands)
        report = replay_log(made, log, check=True)
        assert (report.rows, report.different, report.differences) == (self.done, 0, [])


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Setup:
    return setups.setup(tmp_path_factory.mktemp("run"))


@pytest.fixture(params=list(RIGS))
def rig(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Any:
    rig: OutputRig = RIGS[request.param](monkeypatch)
    rig.move([100_000, 300_000])
    with closing(rig), rig.driver:
        yield rig


@pytest.mark.parametrize("fault", FAULTS)
def test_a_command_is_never_further_than_one_cycle_from_what_the_machine_has(
    rig: OutputRig, made: Setup, tmp_path: Path, fault: str
) -> None:
    """The fault begins while the correction follows; in its middle somebody orders to fade, and later to go on."""
    run = Run(rig, made)
    run.cycles(WELL)
    assert rig.has() != [0, 0]
    assert len({tuple(told) for _, told in rig.taken}) > 10, "the request changes all the time"
    rig.begin(fault)
    had = rig.has()
    bad = slice(run.cycles(BAD // 2).start, run.done + BAD // 2)
    run.loop.mode = MODE_OFF
    run.cycles(BAD // 2)
    if fault != "late":
        flags, output = run.commands.flags[bad], run.commands.output[bad]
        began = PATIENCE_NS // MS + TURN_CYCLES
        # The simulated machine does not say that it was reset: the loop sees a ledger that it did not command.
        silent = fault == "reset" and isinstance(rig, SimRig)
        both = Flag.HELD | (Flag.ORDERED_HOLD if silent else Flag.OUTPUT_TROUBLE)
        assert (flags[began:] & both == both).all()
        assert "box" in run.loop.stats.reasons() or "counts" in run.loop.stats.reasons()
        assert (output[began:] == output[-1]).all(), "it stands"
        assert np.abs(output[-1] - rig.has()).max() <= MOST_COUNTS
        if fault != "reset":
            assert np.abs(output - had).max() <= MOST_COUNTS, "nothing runs away"
    rig.end()
    run.cycles(AFTER // 4)
    if fault in ("reset", "refuse") and run.loop.waits:
        run.loop.order_resume()
    run.cycles(AFTER // 4 + FADE)
    assert rig.has() == [0, 0], "it fades"
    run.loop.mode = MODE_ON
    after = run.cycles(AFTER // 2)
    assert not (run.commands.flags[after] & (Flag.OUTPUT_TROUBLE | Flag.HELD)).any(), "it goes on"
    assert np.abs(run.commands.output[run.done - 1] - rig.has()).max() <= MOST_COUNTS
    assert run.loop.stats.reasons() == {}
    run.check(made, tmp_path)


@pytest.mark.parametrize(
    "answer",
    [lambda told: [2 * n for n in told], lambda told: [n + 6 for n in told]],
    ids=["in diameter", "another adds"],
)
def test_a_machine_that_has_another_output_than_the_command_gets_no_more_commands(
    monkeypatch: pytest.MonkeyPatch, made: Setup, tmp_path: Path, answer: Callable[[list[int]], list[int]]
) -> None:
    """Oracle: the machine: whoever commands what it reads back, commands twice as much each time, or 3 µm more."""
    rig = SimRig(monkeypatch)
    rig.move([100_000, 300_000])
    with closing(rig), rig.driver:
        run = Run(rig, made)
        run.cycles(WELL)
        rig.answer = answer
        run.cycles(5)
        had, told = rig.has(), len(rig.taken)
        bad = run.cycles(BAD)
        assert rig.has() == had
        assert len(rig.taken) - told < 5  # until it showed
        assert run.loop.waits
        assert (run.commands.output[bad][-1] == had).all()  # the log has what the machine has
        rig.answer = list
        run.loop.order_resume()
        run.cycles(AFTER)
        assert not run.loop.waits
        assert len({tuple(told) for _, told in rig.taken[-AFTER:]}) > 10, "it follows again"
        run.check(made, tmp_path)


@pytest.mark.parametrize("pause_ms", [80, 3000])
def test_a_pause_is_not_made_up_for_by_one_large_command(
    rig: OutputRig, made: Setup, tmp_path: Path, pause_ms: int
) -> None:
    """The computer stands still, in the middle of a way of 8 counts, again and again; then the correction goes on."""
    run = Run(rig, made)
    run.cycles(WELL)
    for _ in range(3):
        run.cycles(TURN_CYCLES + 30)
        rig.clock.sleep_until_ns(rig.clock.now_ns() + pause_ms * MS)
    after = run.cycles(AFTER // 2)
    assert not (run.commands.flags[after][200:] & (Flag.OUTPUT_TROUBLE | Flag.HELD)).any()
    run.check(made, tmp_path)


def test_a_driver_that_confirms_at_once_loses_no_cycle(monkeypatch: pytest.MonkeyPatch, made: Setup) -> None:
    """Oracle: the same samples through a step by itself, which knows of no actuator."""
    for name in ("sim", "serial_box"):
        rig = RIGS[name](monkeypatch)
        rig.move([100_000, 300_000])
        with rig.driver:
            run = Run(rig, made)
            run.cycles(WELL)
        assert not (run.samples.mode[50:WELL] & (OUTPUT_UNCONFIRMED | OUTPUT_TROUBLE)).any(), name

"""The sign check: a step of one axis in place of the model.

Oracles: the step itself, run as a pure function, on machines whose chains differ; the limits of the run file; a clock
in the test's hands.
"""

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtec.correction.flags import MODE_HOLD, MODE_OFF, MODE_ON, Flag, Limits
from rtec.daemon.dry_run import dry_run
from rtec.daemon.reload import read_again
from rtec.daemon.sign_check import StepOrders, step_of, with_step
from rtec.daemon.status import Status
from rtec.errors import ConfigError
from rtec.loop.clock import VirtualClock
from rtec.loop.orders import OrderRefused, OrderWords
from rtec.loop.records import Samples
from rtec.loop.run_file import Setup
from rtec.loop.step import Step
from rtec.machine import Machine
from rtec.model import Model
from tests.support import machines, plain_step, setups

LIMITS = Limits(warning_um=60, stop_um=100, slew_um_s=20, acceleration_um_s2=400)
CYCLE_NS = 1_000_000


@pytest.fixture
def setup(tmp_path: Path) -> Setup:
    return setups.setup(tmp_path)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("X=20um", {"X": 20.0}),
        (" Z = -5.5 µm ", {"Z": -5.5}),
        ("X=+.5um", {"X": 0.5}),
        ("X2=3.um", {"X2": 3.0}),
    ],
)
def test_what_a_step_may_look_like(text: str, expected: dict[str, float]) -> None:
    assert step_of(text) == expected


@pytest.mark.parametrize("text", ["", "X", "20um", "X=", "X=20mm", "X=nan", "X=1e3", "X=2 0", "X=20um Z=3um", "=3um"])
def test_what_is_no_step_is_told_with_examples(text: str) -> None:
    with pytest.raises(ConfigError, match="as X=20um or X=-20um"):
        step_of(text)


def test_a_step_without_a_unit_is_refused_with_the_unit() -> None:
    """20 of what? It moves a machine. Oracle: the text with its unit."""
    for text, meant in (("X=20", "X=20um"), (" Z=-5.5 ", "Z=-5.5um")):
        with pytest.raises(ConfigError, match=f"give an axis and micrometres, as {meant}$"):
            step_of(text)


@pytest.mark.parametrize(
    ("step_um", "told"),
    [
        ({"x": 20.0}, "has no axis 'x'"),
        ({"X": 0.0}, "not zero and at most stop_um"),
        ({"X": 100.01}, r"at most stop_um of \[limits.X\], 100"),
        ({"Z": -100.01}, r"at most stop_um of \[limits.Z\], 100"),
        ({"X": float("nan")}, "at most stop_um"),
    ],
)
def test_a_step_that_cannot_be_is_refused_before_anything_runs(
    setup: Setup, step_um: dict[str, float], told: str
) -> None:
    with pytest.raises(ConfigError, match=told):
        with_step(setup, step_um)


def test_an_axis_that_rtec_must_not_move_is_refused(setup: Setup) -> None:
    axes = tuple(replace(a, compensate=False) for a in setup.machine.axes)
    with pytest.raises(ConfigError, match="compensate = false"):
        with_step(replace(setup, machine=replace(setup.machine, axes=axes)), {"X": 20.0})


def test_without_a_step_the_setup_is_the_same(setup: Setup) -> None:
    assert with_step(setup, {}) is setup


@pytest.mark.parametrize(("mode", "begins"), [("on", "off"), ("hold", "off"), ("off", "hold")])
def test_the_run_begins_in_another_mode_than_the_run_file_says(setup: Setup, mode: str, begins: str) -> None:
    """So that a kept state of a killed sign check does not switch the next ordinary run on (see `recover`)."""
    run = setup.file.run.model_copy(update={"mode": mode})
    found = with_step(replace(setup, file=setup.file.model_copy(update={"run": run})), {"X": 20.0})
    assert found.file.run.mode == begins
    assert (found.path, found.hash, found.file.limits) == (setup.path, setup.hash, setup.file.limits)


def cases() -> list[Any]:
    out = []
    for make in machines.ALL:
        out += [(make(), a.name, um) for a in make().axes if a.compensate for um in (20.0, -7.5)]
    return [pytest.param(*case, id=f"{case[0].name}-{case[1]}{case[2]:+g}") for case in out]


@pytest.mark.parametrize(("machine", "axis", "um"), cases())
def test_the_step_asks_for_its_size_on_its_axis_everywhere(
    setup: Setup, machine: Machine, axis: str, um: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the chain: at the ends of travel as in the middle, the axis alone, without any temperature."""
    plain_step.use(monkeypatch)
    limits = {a.name: LIMITS for a in machine.axes if a.compensate}
    file = setup.file.model_copy(update={"limits": limits})
    found = with_step(replace(setup, machine=machine, model=Model(machine), file=file), {axis: um})
    found.model.check()
    step = Step(replace(found.step_settings(), sinks={}))
    for part in (0.0, 0.5, 1.0):
        sample = Samples.empty(step.layout, 1)
        sample.degc[:] = sample.spindle_rpm[:] = np.nan
        for i, a in enumerate(machine.axes):
            low, high = a.travel_mm
            sample.counts[0, i] = round((low + part * (high - low)) * a.counts_per_mm)
        sample.time_ns[:] = sample.counts_time_ns[:] = 10 * CYCLE_NS
        sample.mode[:] = MODE_ON
        asked = dict(zip(machine.axis_names, step.run(sample).requested_um[0].tolist(), strict=True))
        assert asked == pytest.approx({a.name: um if a.name == axis else 0.0 for a in machine.axes}, abs=1e-9)


def test_a_dry_run_says_the_step(setup: Setup) -> None:
    found = dry_run(with_step(setup, {"Z": -12.0}))
    assert found["requested_um"] == pytest.approx({"X": 0.0, "Z": -12.0})
    assert found["reasons"] == []


def test_a_reload_does_not_bring_the_model_in(setup: Setup) -> None:
    with pytest.raises(OrderRefused, match="a sign check"):
        read_again(with_step(setup, {"X": 20.0}))


# The orders ----------------------------------------------------------------------------------------------------------


def words(mode: int = MODE_HOLD) -> OrderWords:
    out = OrderWords(np.zeros(3, np.int64))
    out.mode = mode
    return out


CYCLES = itertools.count(1)


def at(
    x_um: float, cycles: int | None = None, time_s: float = 0.0, output: int | None = None, flags: Flag | None = None
) -> Status:
    """Of a later cycle each time; its output is that of the correction, at two counts a µm, unless it is given."""
    counts = round(-2.0 * x_um) if output is None else output
    return Status(
        cycles=next(CYCLES) if cycles is None else cycles,
        applied_um={"X": x_um, "Z": 0.0},
        output={"X": counts, "Z": 0},
        time_s=time_s,
        flags=flags or Flag(0),
    )


def test_an_ordinary_run_gets_no_orders(setup: Setup) -> None:
    orders, words_ = StepOrders(setup, VirtualClock()), words()
    assert not orders.look(words_, at(3.0), ending=False)
    assert orders.look(words_, at(3.0), ending=True)
    assert words_.mode == MODE_HOLD
    assert orders.trouble(at(3.0)) == ""


def test_to_nothing_then_the_step_then_to_nothing(setup: Setup) -> None:
    """Also from where a run before left it. In between the operator's orders are let alone."""
    orders, words_ = StepOrders(with_step(setup, {"X": 20.0}), VirtualClock()), words(MODE_ON)
    for status in (at(0.0, cycles=0), at(31.0), at(0.4)):
        assert not orders.look(words_, status, ending=False)
        assert words_.mode == MODE_OFF
    for _ in range(2):
        orders.look(words_, at(0.0), ending=False)
    assert words_.mode == MODE_ON
    words_.mode = MODE_OFF  # `rtec ctl fade`
    assert not orders.look(words_, at(0.0), ending=False)
    assert words_.mode == MODE_OFF
    words_.mode = MODE_ON
    assert not orders.look(words_, at(20.0), ending=True)
    assert words_.mode == MODE_OFF
    assert not orders.look(words_, at(0.1), ending=True)
    assert not orders.look(words_, at(0.0), ending=True)
    assert orders.look(words_, at(0.0), ending=True)
    assert orders.trouble(at(0.0)) == ""


def test_after_its_time_the_way_back_begins(setup: Setup) -> None:
    orders, words_ = StepOrders(with_step(setup, {"X": 20.0}), VirtualClock()), words()
    orders.lasts_s = 5.0
    for _ in range(2):
        orders.look(words_, at(0.0, time_s=0.1), ending=False)
    assert not orders.look(words_, at(20.0, time_s=4.9), ending=False)
    assert words_.mode == MODE_ON
    assert not orders.look(words_, at(20.0, time_s=5.0), ending=False)
    assert words_.mode == MODE_OFF
    assert not orders.look(words_, at(0.0, time_s=6.0), ending=False)
    assert orders.look(words_, at(0.0, time_s=6.1), ending=False)


def test_it_ends_only_when_the_actuator_is_back_at_nothing(setup: Setup) -> None:
    """Oracle: docs/runbook.md, step 5 of the sign check. A slow controller gets the last command after the correction.

    20 counts are -10 µm at 2000 counts a mm; the flags are those of rtec/correction/guard.py.
    """
    orders, words_ = StepOrders(with_step(setup, {"X": 20.0}), VirtualClock()), words()
    waits = at(0.0, output=20)
    assert not orders.look(words_, waits, ending=True)
    assert not orders.look(words_, at(0.0, output=20), ending=True)
    assert "held at X -10.00 µm" in orders.trouble(waits)
    for flags in (Flag(0), Flag.LIMITED, Flag.OUTPUT_TROUBLE | Flag.HELD, Flag(0)):  # commanded, not confirmed, …
        assert not orders.look(words_, at(0.0, flags=flags), ending=True)
    assert orders.look(words_, at(0.0), ending=True)
    assert orders.trouble(at(0.0)) == ""
    assert "did not confirm" in orders.trouble(at(0.0, flags=Flag.OUTPUT_TROUBLE))


def test_where_something_holds_it_the_run_ends_all_the_same_and_says_so(setup: Setup) -> None:
    """Oracle: 100 µm at 50 µm/s, and 50 µm/s at 2000 µm/s², twice, and two seconds more: 6.05 s."""
    clock = VirtualClock()
    orders, words_ = StepOrders(with_step(setup, {"X": 20.0}), clock), words()
    waited_s = 0.0
    while not orders.look(words_, at(20.0), ending=True):
        clock.sleep_until_ns(clock.now_ns() + 50_000_000)
        waited_s += 0.05
    assert waited_s == pytest.approx(6.1, abs=0.06)
    assert "held at X +20.00 µm" in orders.trouble(at(20.0))

"""The guard's laws, for any input. Oracle: the limits themselves, and a time-optimal ramp worked out by hand."""

import math
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from rtec.correction import guard
from rtec.correction.flags import (
    MODE_HOLD,
    MODE_OFF,
    MODE_ON,
    MODE_TAKEN_OVER,
    OUTPUT_TROUBLE,
    OUTPUT_UNCONFIRMED,
    Flag,
    Limits,
)
from rtec.correction.guard import guard_update

DT = 0.001
limits = st.tuples(
    st.floats(1.0, 500.0),  # stop, µm
    st.floats(0.1, 1000.0),  # slew, µm/s
    st.floats(0.1, 50000.0),  # acceleration, µm/s²
)
targets = st.lists(st.tuples(st.floats(-1e4, 1e4), st.booleans()), min_size=1, max_size=300)


@given(limits, targets)
def test_limits_hold_for_any_targets_and_holds(
    limit: tuple[float, float, float], wanted: list[tuple[float, bool]]
) -> None:
    stop, slew, acceleration = limit
    applied, speed = 0.0, 0.0
    for target, hold in wanted:
        before, speed_before = applied, speed
        applied, speed = guard_update(applied, speed, target, hold, DT, stop, slew, acceleration)
        assert abs(applied) <= stop
        assert abs(speed) <= slew * (1 + 1e-12)
        assert abs(speed - speed_before) <= acceleration * DT * (1 + 1e-9)
        assert abs(applied - before) <= slew * DT * (1 + 1e-9)


@given(limits, st.floats(-400, 400), st.floats(0.0002, 0.02))
def test_comes_to_rest_at_a_still_target_without_passing_it(
    limit: tuple[float, float, float], target: float, dt: float
) -> None:
    stop, slew, acceleration = limit
    goal = max(-stop, min(stop, target))
    applied, speed = 0.0, 0.0
    # Ramp up, cruise and ramp down, each longer than it needs.
    cycles = int((abs(goal) / slew + 2 * slew / acceleration + 4 * math.sqrt(abs(goal) / acceleration)) / dt) + 60
    for _ in range(min(cycles, 20_000)):
        applied, speed = guard_update(applied, speed, target, False, dt, stop, slew, acceleration)
        assert abs(applied) <= abs(goal) * (1 + 1e-9) + 1e-12
    if cycles <= 20_000:
        assert applied == pytest.approx(goal, abs=1e-9)
        assert abs(speed) * dt <= 1e-9


def test_a_ramp_takes_as_long_as_physics_says() -> None:
    """100 µm at 20 µm/s and 40 µm/s²: 0.5 s up, 0.5 s down, 4.5 s cruise, 5.5 s in all (closed form)."""
    applied, speed, cycles = 0.0, 0.0, 0
    while applied != 100.0:
        applied, speed = guard_update(applied, speed, 100.0, False, DT, 200.0, 20.0, 40.0)
        cycles += 1
    assert cycles * DT == pytest.approx(100.0 / 20.0 + 20.0 / 40.0, abs=0.01)


@given(st.floats(-90, 90), st.floats(-1e6, 1e6), st.floats(0, 1))
def test_at_rest_a_hold_changes_nothing(applied: float, target: float, dt: float) -> None:
    assert guard_update(applied, 0.0, target, True, dt, 100.0, 10.0, 100.0) == (applied, 0.0)


def test_a_hold_in_motion_brakes_within_the_acceleration_limit() -> None:
    """From 20 µm/s at 40 µm/s² it stops within v²/2a = 5 µm."""
    applied, speed = 10.0, 20.0
    for _ in range(600):
        applied, speed = guard_update(applied, speed, math.nan, True, DT, 100.0, 20.0, 40.0)
    assert speed == 0.0
    assert 10.0 < applied <= 15.0


def test_no_time_no_motion() -> None:
    assert guard_update(3.0, 5.0, 90.0, False, 0.0, 100.0, 10.0, 100.0) == (3.0, 5.0)


@pytest.mark.parametrize("key", ["warning_um", "stop_um", "slew_um_s", "acceleration_um_s2"])
def test_every_limit_must_be_there_and_positive(key: str) -> None:
    good = {"warning_um": 50.0, "stop_um": 100.0, "slew_um_s": 10.0, "acceleration_um_s2": 100.0}
    Limits.model_validate(good)
    for bad in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(ValidationError):
            Limits.model_validate(good | {key: bad})
    with pytest.raises(ValidationError):
        Limits.model_validate({k: v for k, v in good.items() if k != key})


def test_a_warning_above_the_stop_limit_is_refused() -> None:
    with pytest.raises(ValidationError, match="above stop_um"):
        Limits(warning_um=101, stop_um=100, slew_um_s=1, acceleration_um_s2=1)


NOTHING, S = Flag(0), 10**9
NAN = math.nan


def test_what_is_read_is_judged() -> None:
    """Oracle: the limits written down here; each end of a range is inside."""
    assert [guard.judge_counts(10 * S, 10 * S - age, 5) for age in (5, 6)] == [0, Flag.STALE_COUNTS]
    assert [guard.judge_age(10 * S, 10 * S - age, 5) for age in (5, 6)] == [0, Flag.STALE_TEMPERATURE]
    # Of the future: as old as it is ahead, so that a device of another clock that falls silent is never fresh.
    assert [guard.judge_counts(10 * S, 10 * S + ahead, 5) for ahead in (5, 6)] == [0, Flag.STALE_COUNTS]
    assert [guard.not_ahead(10, instant) for instant in (3, 10, 12)] == [3, 10, 8]
    outside = Flag.OUT_OF_RANGE
    assert [guard.judge_range(x, 1.0, 2.0) for x in (0.9, 1.0, 2.0, 2.1)] == [outside, 0, 0, outside]
    degc = {NAN: Flag.STALE_TEMPERATURE, -0.1: Flag.SENSOR_FAULT, 90.1: Flag.SENSOR_FAULT, 9.9: outside, 60.1: outside}
    degc |= {10.0: NOTHING, 60.0: NOTHING}
    for value, reason in degc.items():
        assert guard.judge_sensor(value, 0.0, 90.0, 10.0, 60.0) == reason
        assert guard.known(reason) == (reason in (NOTHING, outside))
    rpm = {NAN: Flag.STALE_TEMPERATURE, 3000.1: outside, 3000.0: NOTHING}
    assert [guard.judge_spindle(value, 0.0, 3000.0) for value in rpm] == list(rpm.values())
    asked = {50.0: NOTHING, -50.1: Flag.OVER_WARNING_LIMIT, 100.1: Flag.OVER_WARNING_LIMIT | Flag.OVER_STOP_LIMIT}
    asked |= {NAN: Flag.OVER_WARNING_LIMIT | Flag.OVER_STOP_LIMIT}
    assert [guard.judge_request(value, 50.0, 100.0) for value in asked] == list(asked.values())


def test_a_gap_counts_as_one_cycle_and_never_backwards() -> None:
    found = [guard.cycle_s(5 * S + gap, 5 * S, 10**6) for gap in (-7, 0, 900_000, 3 * S)]
    assert found == pytest.approx([0.0, 0.0, 9e-4, 1e-3], rel=1e-12)


HELD, FADING, TROUBLE = Flag.HELD, Flag.FADING, Flag.OUTPUT_TROUBLE
STALE, OFF, ORDERED, LATE = Flag.STALE_COUNTS, Flag.ORDERED_OFF, Flag.ORDERED_HOLD, Flag.LIMITED


@pytest.mark.parametrize(
    ("reasons", "mode", "held_ns", "decision", "flags", "since_ns"),
    [
        (NOTHING, MODE_ON, 0, guard.FOLLOW, NOTHING, 0),
        (NOTHING, MODE_ON, 4 * S, guard.FOLLOW, NOTHING, 0),
        (Flag.OVER_WARNING_LIMIT, MODE_ON, 0, guard.FOLLOW, NOTHING, 0),
        (NOTHING, MODE_HOLD, 0, guard.HOLD, ORDERED | HELD, 10 * S),
        (NOTHING, MODE_TAKEN_OVER, 0, guard.HOLD, ORDERED | HELD, 10 * S),
        (NOTHING, MODE_OFF, 4 * S, guard.FADE, OFF, 0),
        (STALE, MODE_OFF, 0, guard.FADE, OFF, 0),
        (STALE, MODE_ON, 0, guard.HOLD, HELD, 10 * S),
        (STALE, MODE_ON, 9 * S, guard.HOLD, HELD, 9 * S),
        (STALE, MODE_ON, 4 * S, guard.FADE, FADING, 4 * S),
        (NOTHING, MODE_ON | OUTPUT_UNCONFIRMED, 0, guard.WAIT, LATE, 0),
        (NOTHING, MODE_OFF | OUTPUT_UNCONFIRMED, 0, guard.WAIT, OFF | LATE, 0),
        (STALE, MODE_ON | OUTPUT_UNCONFIRMED, 0, guard.WAIT, HELD, 10 * S),
        (NOTHING, MODE_ON | OUTPUT_TROUBLE, 0, guard.STAND, TROUBLE | HELD, 10 * S),
        (STALE, MODE_OFF | OUTPUT_TROUBLE, 4 * S, guard.STAND, OFF | TROUBLE | HELD, 4 * S),
        (STALE, MODE_ON | OUTPUT_TROUBLE, 4 * S, guard.STAND, TROUBLE | HELD, 4 * S),
    ],
)
def test_the_order_of_decisions(
    reasons: Flag, mode: int, held_ns: int, decision: int, flags: Flag, since_ns: int
) -> None:
    """Oracle: the table, which is what docs/runbook.md says; it is 10 s, and a hold fades after 5 s."""
    found = guard.decide(reasons | guard.judge_mode(mode), mode, 10 * S, held_ns, 5 * S)
    assert found == (decision, reasons | flags, since_ns)
    assert guard.may_command(decision) == (decision not in (guard.WAIT, guard.STAND))
    for_ever = guard.decide(reasons | guard.judge_mode(mode), mode, 10 * S, held_ns, 0)
    assert (FADING & for_ever[1]) == 0


def test_each_decision_moves_the_correction_in_its_own_way() -> None:
    """From 10 µm at 2 µm/s towards 90 µm; 1 ms, 20 µm/s, 400 µm/s²: 0.4 µm/s a cycle. Oracle: by hand."""

    def after(decision: int, speed: float = 2.0) -> tuple[float, float, int]:
        return guard.move(decision, 10.0, speed, 90.0, DT, 100.0, 20.0, 400.0)

    assert after(guard.FOLLOW) == pytest.approx((10.0024, 2.4, int(LATE)))
    assert after(guard.FADE) == pytest.approx((10.0016, 1.6, int(LATE)))
    assert after(guard.HOLD) == pytest.approx((10.0016, 1.6, 0))
    assert after(guard.WAIT) == pytest.approx((10.0, 1.6, 0))
    assert after(guard.WAIT, -0.3) == (10.0, 0.0, 0)
    assert after(guard.STAND) == (10.0, 0.0, 0)
    assert guard.move(guard.FOLLOW, 90.0, 0.0, 90.0, DT, 100.0, 20.0, 400.0) == (90.0, 0.0, 0)


def test_a_sink_gives_no_more_than_it_can_and_says_so() -> None:
    more = Flag.OUTPUT_SATURATED
    found = [guard.within_sink(units, 0, -8.0, 7.0) for units in (-9.0, -8.0, 7.0, 8.5)]
    assert found == [(-8.0, more), (-8.0, 0), (7.0, 0), (7.0, more)]


def test_a_ledger_outside_the_sinks_range_comes_back_as_fast_as_the_correction() -> None:
    """By hand: from 50 in a range to 7 the next command is 49.5 and not 7, and 60 is not further away."""
    found = [guard.within_sink(units, output, -8.0, 7.0)[0] for units, output in ((49.5, 50), (60.0, 50), (-20.0, -19))]
    assert found == [49.5, 50.0, -19.0]


def test_without_numba_the_guard_is_plain_python() -> None:
    """Oracle: an interpreter in which numba cannot be imported decides the same."""
    text = (
        "import sys; sys.modules['numba'] = None\n"
        "from rtec.correction import guard\n"
        "assert type(guard.decide).__name__ == 'function'\n"
        "print(guard.decide(guard.judge_mode(8), 8, 10, 0, 0), guard.move(1, 10.0, 2.0, 90.0, 1e-3, 1e2, 20.0, 4e2))"
    )
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=120, check=True)
    decided = guard.decide(guard.judge_mode(8), 8, 10, 0, 0)
    assert done.stdout == f"{decided} {guard.move(1, 10.0, 2.0, 90.0, 1e-3, 1e2, 20.0, 4e2)}\n"

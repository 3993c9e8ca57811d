"""The guard's laws, for any input. Oracle: the limits themselves, and a time-optimal ramp worked out by hand."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from rtec.correction.guard import Limits, guard_update

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

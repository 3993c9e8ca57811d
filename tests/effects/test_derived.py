"""Derived channels: the first-order lag against closed forms and a solver, the direction against a slow reference."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from rtec.effects.derived import direction_track, direction_update, lag_track, lag_update
from rtec.effects.state import State
from rtec.errors import ModelError
from rtec.jit import as_written
from tests.support.machines import turning_centre

Floats = NDArray[np.float64]
TIMES = st.floats(1e-3, 1e5)
VALUES = st.floats(-100.0, 100.0)


@pytest.mark.parametrize("update", [lag_update, as_written(lag_update)], ids=["compiled", "plain"])
@pytest.mark.parametrize("dt", [1e-6, 0.1, 7.0, 300.0, 5e4])
def test_lag_of_a_step_and_of_a_ramp(update: object, dt: float) -> None:
    """Oracle: closed forms. Step: u + (L0 - u) e^(-t/τ); ramp: L lags by τ once the start has died away."""
    assert callable(update)
    tau = 120.0
    wanted = 5.0 + (2.0 - 5.0) * math.exp(-dt / tau)
    assert update(2.0, 5.0, 5.0, dt, tau) == pytest.approx(wanted, rel=1e-12)
    slope = 0.3
    wanted = slope * (dt - tau) + slope * tau * math.exp(-dt / tau)
    assert update(0.0, 0.0, slope * dt, dt, tau) == pytest.approx(wanted, rel=1e-9, abs=1e-15 * slope * tau)


def test_lag_of_a_measured_course_against_a_solver() -> None:
    """Oracle: scipy's Runge-Kutta on τ L' + L = u, u straight between readings at uneven instants."""
    rng = np.random.default_rng(11)
    time_s = np.concatenate([[0.0], np.cumsum(rng.uniform(0.5, 90.0, 40))])
    value = 20.0 + np.cumsum(rng.normal(0, 1.0, 41))
    tau = 55.0
    got = lag_track(value, time_s, tau)
    lagged = value[0]
    for i in range(1, 41):
        span = (time_s[i - 1], time_s[i])

        def slope(t: float, y: Floats, i: int = i) -> Floats:
            return np.asarray((np.interp(t, time_s[i - 1 : i + 1], value[i - 1 : i + 1]) - y) / tau)

        lagged = solve_ivp(slope, span, [lagged], rtol=1e-10, atol=1e-11).y[0, -1]
        assert got[i] == pytest.approx(lagged, abs=1e-7)


@settings(max_examples=200, deadline=None)
@given(VALUES, VALUES, VALUES, TIMES, TIMES, st.floats(0.0, 1.0))
def test_splitting_an_interval_of_a_straight_input_changes_nothing(
    start: float, before: float, now: float, dt: float, tau: float, at: float
) -> None:
    """Oracle: the same interval in one step."""
    whole = lag_update(start, before, now, dt, tau)
    middle = before + (now - before) * at
    half = lag_update(start, before, middle, dt * at, tau)
    split = lag_update(half, middle, now, dt * (1.0 - at), tau)
    assert split == pytest.approx(whole, rel=1e-9, abs=1e-7)


@settings(max_examples=200, deadline=None)
@given(VALUES, VALUES, VALUES, st.floats(-10.0, 1e12), st.floats(0.0, 1e12))
def test_lag_stays_between_what_it_had_and_what_it_saw(
    start: float, before: float, now: float, dt: float, tau: float
) -> None:
    """Any interval and any time constant: finite, never beyond start and input; the plain source gives the same."""
    out = lag_update(start, before, now, dt, tau)
    slack = 1e-9 * max(abs(start), abs(before), abs(now), 1.0)
    assert min(start, before, now) - slack <= out <= max(start, before, now) + slack
    # The compiler joins a multiplication and an addition, so the last digit may differ.
    assert as_written(lag_update)(start, before, now, dt, tau) == pytest.approx(out, rel=1e-9, abs=1e-9)


def test_lag_at_the_ends_of_its_range() -> None:
    assert lag_update(3.0, 9.0, 9.0, 0.0, 100.0) == 3.0, "no time, no change"
    assert lag_update(3.0, 9.0, 9.0, -1.0, 100.0) == 3.0, "time that runs back changes nothing"
    assert lag_update(3.0, 9.0, 9.0, 2e-313, 9e10) == 3.0, "hardly any time, hardly any change"
    assert lag_update(3.0, 9.0, 8.0, 1.0, 0.0) == 8.0, "no slowness: the input"
    assert lag_update(3.0, 9.0, 8.0, 1e15, 1.0) == pytest.approx(8.0), "after ever so long: the input"
    assert lag_update(3.0, 9.0, 8.0, 1e-9, 1e15) == pytest.approx(3.0)
    assert len(lag_track(np.empty(0), np.empty(0), 1.0)) == 0


def test_lag_starts_settled() -> None:
    np.testing.assert_array_equal(lag_track(np.full(5, 31.0), np.arange(5.0), 60.0), np.full(5, 31.0))


def slow_directions(position: list[float], dead_band: float) -> list[float]:
    """The definition, worked out anew for every instant from the whole course before it.

    The axis reverses when it has gone back by more than the dead band from the furthest point since the reversal.
    """
    out: list[float] = []
    for n in range(1, len(position) + 1):
        direction, since = 0.0, 0
        for i in range(n):
            leg = position[since : i + 1]
            if direction == 0.0:
                gone = position[i] - position[0]
            elif direction > 0.0:
                gone = position[i] - max(leg)
            else:
                gone = position[i] - min(leg)
            if abs(gone) > dead_band and math.copysign(1.0, gone) != direction:
                direction, since = math.copysign(1.0, gone), i
        out.append(direction)
    return out


COURSES = st.lists(st.integers(-8, 8), min_size=1, max_size=30)  # in counts of 1/4 mm, so that sums are exact


@settings(max_examples=200, deadline=None)
@given(COURSES, st.integers(0, 5))
def test_direction_against_the_definition(steps: list[int], dead_band: int) -> None:
    """Oracle: `slow_directions`; compiled and plain source alike."""
    position = np.cumsum(steps) * 0.25
    wanted = slow_directions(list(position), dead_band * 0.25)
    np.testing.assert_array_equal(direction_track(position, dead_band * 0.25), wanted)
    np.testing.assert_array_equal(as_written(direction_track)(position, dead_band * 0.25), wanted)


def test_direction_by_hand() -> None:
    """0 before the first motion; kept through a dwell; jitter within the dead band is no reversal, creep adds up."""
    position = np.array([5.0, 5.0, 5.001, 5.1, 5.1, 5.1, 5.099, 5.098, 5.0975, 5.2, 5.0])
    wanted = [0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0, -1.0, 1.0, -1.0]
    np.testing.assert_array_equal(direction_track(position, 0.0021), wanted)


def test_direction_one_step_at_a_time_is_the_track() -> None:
    """The loop's form and the batch form: the same recurrence, so the same to the bit, wherever a batch is cut."""
    rng = np.random.default_rng(2)
    position = np.cumsum(rng.normal(0, 0.01, 500))
    track = direction_track(position, 0.004)
    direction, extreme = 0.0, position[0]
    for i, q in enumerate(position):
        direction, extreme = direction_update(direction, extreme, q, 0.004)
        assert direction == track[i]
    np.testing.assert_array_equal(direction_track(position[:321], 0.004), track[:321])


def test_a_state_derives_directions_and_lags() -> None:
    """Oracle: the functions above, with the dead band of the machine file in counts."""
    m = turning_centre()
    x = np.array([0.0, 0.0015, 0.0025, 0.0010, 0.0004])
    state = State(m, np.arange(5.0), {"x": x, "T_bed": np.array([20.0, 21.0, 22.0, 23.0, 24.0])}, 19.0)
    np.testing.assert_array_equal(state.value("d_x"), [0.0, 0.0, 1.0, 1.0, -1.0])
    np.testing.assert_array_equal(state.rise("T_bed"), [1.0, 2.0, 3.0, 4.0, 5.0])
    np.testing.assert_array_equal(state.lagged(2.5, 7.0), np.full(5, 2.5))
    np.testing.assert_array_equal(state.rows(slice(3, 5)).value("d_x"), [1.0, -1.0])
    np.testing.assert_array_equal(state.positions_mm()[:, 0], x)
    np.testing.assert_array_equal(state.positions_mm()[:, 1], np.zeros(5))
    np.testing.assert_array_equal(state.value("time_s"), np.arange(5.0))
    with pytest.raises(ModelError, match="channel 'T_bad' is not in this data; did you mean 'T_bed'"):
        state.value("T_bad")
    way = "'T_bed' is not in this data; add a column T_bed_degc .* --answer T_bed_degc=20 .* can then not be tested"
    with pytest.raises(ModelError, match=way):
        State(m, np.arange(5.0), {"x": x}).value("T_bed")
    with pytest.raises(ModelError, match="channel 'd_z' is not in this data"):
        state.value("d_z")


def test_a_given_direction_is_taken_as_it_is() -> None:
    state = State(turning_centre(), np.arange(2.0), {"x": np.zeros(2), "d_x": np.array([1.0, -1.0])})
    np.testing.assert_array_equal(state.value("d_x"), [1.0, -1.0])

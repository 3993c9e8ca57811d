"""Velocity, acceleration, distance since reversal, load, force, time: the arithmetic, and states and arrays of them."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm

from rtec.effects import State
from rtec.effects.derived import FAR_MM, direction_track, motion_update, since_reversal_track, since_turn_track
from rtec.effects.expression import Expression
from rtec.effects.geometry import Scale
from rtec.effects.state import Channels, Value
from rtec.errors import ConfigError, ModelError
from rtec.estimation.gram.stream import Walk
from rtec.jit import as_written
from rtec.machine import Machine, machine_from
from rtec.metrology.files.load import load_measurement, save_measurement
from rtec.model import FittedEffect, Model
from rtec.model.fit import Margin, valid_range
from rtec.model.kernel.trace import plan_model
from rtec.model.model import reversal_um
from tests.support import measurement_examples
from tests.support.compiled_model import compile_model
from tests.support.machines import turning_centre
from tests.support.motion import motion_track

Floats = NDArray[np.float64]
MACHINE = turning_centre()
TAU_S = 0.02


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def expression(text: str, component: str = "EXX", **free: float) -> FittedEffect:
    """One coefficient k of 1.7, and non-linear parameters with these values."""
    bounds = {n: {"start": v, "low": v / 10, "high": v * 10} for n, v in free.items()}
    effect = Expression.model_validate(
        {"effect": "expression", "component": component, "expression": text, "linear": {"k": "um"}, "free": bounds}
    )
    return FittedEffect(effect, {"k": 1.7}, free)


def model(*texts: str) -> Model:
    return Model(MACHINE, tuple(expression(text) for text in texts))


ALL = model(
    "k*exp(-s_x/0.4)*d_x",
    "k*v_x/100 + k*abs(v_z)**0.5",
    "k*a_x*load_kg/1000",
    "k*force_n*x/1e5",
    "k*time_s/60",
    "k*s_z/(1 + s_z)",
)


def instants(n: int, step_s: float = 1e-3) -> Floats:
    return np.asarray(np.arange(n) * step_s, dtype=np.float64)


def course(n: int = 400, seed: int = 6) -> Floats:
    """Positions of an axis that turns round often, mm."""
    rng = np.random.default_rng(seed)
    return np.asarray(100.0 + np.cumsum(np.sin(np.arange(n) / 17.0) + rng.normal(0, 0.4, n)))


def state(n: int = 400) -> State:
    """Both axes move; everything that the models above read is there."""
    rng = np.random.default_rng(9)
    channels = {"x": course(n), "z": course(n, 7)}
    channels |= {name: rng.normal(0, 50, n) for name in ("v_x", "v_z", "a_x")}
    channels |= {"load_kg": np.repeat(rng.uniform(0, 300, n // 50), 50), "force_n": rng.normal(0, 900, n)}
    return State(MACHINE, instants(n, 0.5), channels)


def slow_since(position: Floats, dead_band: float) -> list[float]:
    """The definition, worked out anew at each instant from the whole course before it, by legs.

    A leg ends where the axis has gone back by more than the dead band from its furthest point; the distance is from
    the furthest point of the leg before to the furthest of this one.
    """
    out = []
    for n in range(1, len(position) + 1):
        legs, sense = [[position[0]]], 0.0
        for q in position[1:n]:
            far = legs[-1][0] if sense == 0.0 else max(legs[-1]) if sense > 0 else min(legs[-1])
            if abs(q - far) > dead_band and math.copysign(1.0, q - far) != sense:
                if sense != 0.0:
                    legs.append([q])
                sense = math.copysign(1.0, q - far)
            if sense != 0.0:
                legs[-1].append(q)
        if len(legs) < 2:
            out.append(FAR_MM)
        else:
            ends = [max, min] if sense < 0 else [min, max]
            out.append(abs(ends[1](legs[-1]) - ends[0](legs[-2])))
    return out


COURSES = st.lists(st.integers(-8, 8), min_size=1, max_size=30)  # in counts of 1/4 mm, so that sums are exact


@settings(max_examples=200, deadline=None)
@given(COURSES, st.integers(0, 5))
def test_distance_since_reversal_against_the_definition(steps: list[int], dead_band: int) -> None:
    """Oracle: `slow_since`; compiled and plain source alike."""
    position = np.cumsum(steps) * 0.25
    wanted = slow_since(position, dead_band * 0.25)
    np.testing.assert_array_equal(since_reversal_track(position, dead_band * 0.25), wanted)
    np.testing.assert_array_equal(as_written(since_reversal_track)(position, dead_band * 0.25), wanted)


@settings(max_examples=200, deadline=None)
@given(COURSES, st.integers(0, 5))
def test_recorded_directions_give_the_same_distances(steps: list[int], dead_band: int) -> None:
    """Oracle: the distances from positions alone, where the directions recorded are those of the positions."""
    position = np.cumsum(steps) * 0.25
    direction = direction_track(position, dead_band * 0.25)
    found = since_turn_track(position, direction)
    np.testing.assert_array_equal(found, since_reversal_track(position, dead_band * 0.25))


def test_distance_since_reversal_by_hand() -> None:
    """Unknown until the first turn; jitter within the dead band neither turns nor shortens it."""
    position = np.array([5.0, 6.0, 9.0, 8.999, 8.0, 7.0, 7.001, 6.0, 6.5, 7.5])
    wanted = [FAR_MM, FAR_MM, FAR_MM, FAR_MM, 1.0, 2.0, 2.0, 3.0, 0.5, 1.5]
    np.testing.assert_allclose(since_reversal_track(position, 0.002), wanted)
    assert math.exp(-FAR_MM / 1000.0) == 0.0
    # Targets of a test there and back, overrun out of sight: the turn is at the last target, 4, not known better.
    targets, sides = np.array([0.0, 2.0, 4.0, 4.0, 2.0, 0.0]), np.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])
    np.testing.assert_array_equal(since_turn_track(targets, sides), [FAR_MM, FAR_MM, FAR_MM, 0.0, 2.0, 4.0])


@pytest.mark.parametrize("track", [motion_track, as_written(motion_track)], ids=["compiled", "plain"])
def test_velocity_and_acceleration_against_the_state_equations(track: Any) -> None:
    """Oracle: the matrix exponential of τ v' + v = u, τ a' + a = v' over each uneven interval."""
    rng = np.random.default_rng(3)
    time_s = np.cumsum(rng.uniform(2e-4, 5e-3, 300))
    position = course(300)
    v, a = track(position, time_s, TAU_S)
    system = np.array([[-1.0, 0.0, 1.0], [-1.0 / TAU_S, -1.0, 1.0 / TAU_S], [0.0, 0.0, 0.0]]) / TAU_S
    now = np.zeros(3)
    for i in range(1, 300):
        dt = time_s[i] - time_s[i - 1]
        now[2] = (position[i] - position[i - 1]) / dt
        now = expm(system * dt) @ now
        assert v[i] == pytest.approx(now[0], rel=1e-9, abs=1e-9)
        assert a[i] == pytest.approx(now[1], rel=1e-8, abs=1e-6)


def test_steady_motion_is_found_as_it_is() -> None:
    """Oracles: the speed put in; the acceleration put in, with the velocity late by τ."""
    time_s = instants(2000)
    v, a = motion_track(np.asarray(150.0 * time_s), time_s, TAU_S)
    assert v[-1] == pytest.approx(150.0, rel=1e-9)
    assert abs(a[-1]) < 1e-6
    v, a = motion_track(np.asarray(0.5 * 800.0 * time_s**2), time_s, TAU_S)
    assert a[-1] == pytest.approx(800.0, rel=1e-3)  # the speed within a cycle is its mean: a ripple of (dt/τ)² / 12
    assert v[-1] == pytest.approx(800.0 * (time_s[-1] - TAU_S), rel=1e-3)


@settings(max_examples=200, deadline=None)
@given(st.floats(-500, 500), st.floats(-5000, 5000), st.floats(-1, 1), st.floats(1e-4, 1.0), st.floats(0.01, 0.99))
def test_splitting_an_interval_of_steady_speed_changes_nothing(
    v: float, a: float, moved: float, dt_s: float, at: float
) -> None:
    """Oracle: the same interval in one step."""
    whole = motion_update(v, a, moved, dt_s, TAU_S)
    half = motion_update(v, a, moved * at, dt_s * at, TAU_S)
    assert motion_update(*half, moved * (1 - at), dt_s * (1 - at), TAU_S) == pytest.approx(whole, rel=1e-9, abs=1e-6)


def test_one_count_moves_the_velocity_by_little() -> None:
    """Oracle: c / τ for a count of size c, however short the cycle; the difference quotient would give c / dt."""
    for dt_s in (2.5e-4, 1e-3, 1e-2):
        speed, _ = motion_update(0.0, 0.0, 0.001, dt_s, TAU_S)
        assert 0.0 < speed <= 0.001 / TAU_S
    time_s = instants(5000)
    counted = np.round(3.3 * time_s, 3)  # 3.3 mm/s in counts of 1 µm
    v, _ = motion_track(counted, time_s, TAU_S)
    assert np.abs(v[500:] - 3.3).max() < 0.001 / TAU_S


def test_a_time_stamp_that_comes_again_loses_no_motion() -> None:
    """Oracle: the same course with each instant once."""
    time_s, position = instants(200), course(200)
    once = motion_track(position, time_s, TAU_S)
    late = np.repeat(np.arange(200), 3)
    fresh = position[np.minimum(late + (np.arange(600) % 3 > 0), 199)]  # the counts are new already, their stamp is old
    fresh[::3] = position
    again = motion_track(fresh, time_s[late], TAU_S)
    for found, wanted in zip(again, once, strict=True):
        np.testing.assert_array_equal(found[::3], wanted)
        np.testing.assert_array_equal(found[2::3], wanted)
    back = motion_track(position[:3], np.array([0.0, 1e-3, 0.5e-3]), TAU_S)
    assert back[0][2] == back[0][1], "time that runs back changes nothing"


def test_channels_of_a_machine() -> None:
    x = MACHINE.axis("X")
    assert x.moving_channels == ("x", "d_x", "v_x", "a_x", "s_x")
    assert MACHINE.slow_channels == (*MACHINE.sensor_names, "spindle_rpm", "load_kg", "force_n")
    assert MACHINE.channel_names[-1] == "time_s"
    axes = {"X": {"direction": "X", "travel_mm": [0, 1], "counts_per_mm": 1}}
    head = {"name": "m", "tool_chain": ["X"]}
    for sensor in ("v_x", "a_x", "s_x", "force_n"):
        with pytest.raises(ConfigError, match=f"channel '{sensor}' is already"):
            machine_from({"machine": head, "axis": axes, "temperature": {sensor: {}}}, "m")


def test_what_a_state_derives_and_what_not() -> None:
    """Oracle: the tracks above; velocity is never made up."""
    x = course(50)
    s = State(MACHINE, np.arange(50.0), {"x": x, "feed_mm_min": np.full(50, 600.0)}, dead_band_mm={"X": 0.3})
    np.testing.assert_array_equal(s.value("s_x"), since_reversal_track(x, 0.3))
    with pytest.raises(
        ModelError, match=r"'v_x' is not in this data; it comes from a column vx_mm_s \(a feed does not"
    ):
        s.value("v_x")
    with pytest.raises(ModelError, match="'a_x' is not in this data; it comes from a column ax_mm_s2"):
        s.value("a_x")
    with pytest.raises(ModelError, match="channel 's_z' is not in this data"):
        s.value("s_z")
    known = [name for name in MACHINE.channel_names if s.has(name)]
    assert known == ["x", "d_x", "s_x", "time_s"]
    given = State(MACHINE, np.arange(50.0), {"x": x, "d_x": np.ones(50)})
    np.testing.assert_array_equal(given.value("s_x"), np.full(50, FAR_MM))


def test_rows_of_a_state_remember_the_whole() -> None:
    """Oracle: the rows of the whole state's own values."""
    s = State(MACHINE, np.arange(100.0), {"x": course(100)})
    some = np.array([3, 40, 41, 90])
    assert s.remembered() == ("d_x", "s_x")
    for name in ("x", "d_x", "s_x"):
        np.testing.assert_array_equal(s.rows(some).value(name), s.value(name)[some])


def test_a_walk_sees_the_reversals_of_the_whole() -> None:
    """Oracle: the whole state, bit for bit, wherever the windows are cut; an axis not recorded stands still."""
    s = state()
    walk = Walk(s)
    parts: dict[str, list[Floats]] = {name: [] for name in ("s_x", "d_x", "v_x", "load_kg", "time_s")}
    for start, stop in ((0, 1), (1, 7), (7, 200), (200, 400)):
        walk.move(start, stop)
        for name, found in parts.items():
            found.append(walk.value(name))
    for name, found in parts.items():
        np.testing.assert_array_equal(np.concatenate(found), s.value(name))
    alone = Walk(State(MACHINE, s.time_s, {"z": s.channels["z"]}))
    alone.move(0, 5)
    np.testing.assert_array_equal(alone.value("v_x"), np.zeros(5))
    np.testing.assert_array_equal(alone.value("s_x"), np.full(5, FAR_MM))
    with pytest.raises(ModelError, match="'v_z' is not in this data"):
        alone.value("v_z")


def test_the_compiled_kernel_reads_every_channel() -> None:
    """Oracle: `Model.predict` in numpy; batches of the first k rows bit for bit."""
    s = state()
    kernel = compile_model(ALL)
    assert kernel.source.arrays == ("q", "d", "vel", "acc", "since")
    assert kernel.source.constants == ("load_kg", "force_n")
    tip, _ = kernel.predict(s)
    wanted = ALL.predict(s)
    np.testing.assert_allclose(tip, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())
    for k in (1, 37, 399):
        np.testing.assert_array_equal(kernel.predict(s.rows(slice(0, k)))[0], tip[:k])
    for fitted in ALL.effects:
        one = Model(MACHINE, (fitted,))
        np.testing.assert_allclose(compile_model(one).predict(s)[0], one.predict(s), rtol=1e-9, atol=1e-9)


def test_a_model_without_the_new_channels_has_the_kernel_that_it_had() -> None:
    """Nothing more to hand over, nothing more to keep. Oracle: the two arrays of before."""
    source = compile_model(model("k*x*d_x")).source
    assert source.arrays == ("q", "d")
    assert "def fast_part(m, q, d):" in source.text


class Forgetful(Scale):
    """An effect that does not tell all that it reads."""

    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        del machine, theta
        return [channels.value("x") * channels.value("v_x")]


def test_a_channel_that_an_effect_does_not_list_is_refused() -> None:
    """It would be zero in the kernel, silently."""
    effect = FittedEffect(Forgetful(effect="scale", component="EXX", axis="X"), {"k": 1.0})
    with pytest.raises(ModelError, match=r"scale\(EXX\): its basis reads channel 'v_x', which its channels\(\)"):
        plan_model(Model(MACHINE, (effect,)))
    with pytest.raises(ModelError, match="a lag of a position or direction"):
        plan_model(model("k*lag(v_x, 5)"))
    plan_model(model("k*lag(load_kg, 5)*x"))


def test_ranges_of_the_new_channels() -> None:
    """Oracle: lowest and highest in the data by hand; standstill belongs to every velocity."""
    s = state(50)
    fast = State(MACHINE, s.time_s, {**s.channels, "v_x": np.linspace(100.0, 120.0, 50)})
    effects = [f.effect for f in model("k*v_x", "k*s_x", "k*load_kg").effects]
    found = valid_range(effects, [(fast, np.arange(50))], Margin(share=0.1))
    load = s.channels["load_kg"]
    assert found == {"v_x": (-12.0, 132.0), "load_kg": (load[0], load[0])}
    Model(MACHINE, valid_range={"v_x": (0, 1), "a_z": (0, 1), "s_x": (0, 1), "force_n": (0, 1)}).check()
    with pytest.raises(ModelError, match="'v_xx' is no channel; did you mean 'v_x'"):
        Model(MACHINE, valid_range={"v_xx": (0, 1)}).check()


def test_the_jump_at_a_reversal_counts_what_fades_after_it() -> None:
    """Oracle: by hand. k d e^(-s/0.5) goes from -1.7 to 1.7 µm where the axis turns twice at one place; a spike that
    builds up to k d within s0 as far; plain play of B = 1.7 by B."""
    assert reversal_um(model("k*d_x*exp(-s_x/0.5)"))["X"] == pytest.approx(3.4)
    assert reversal_um(model("k*d_x*(s_x/0.02)*exp(1 - s_x/0.02)"))["X"] == pytest.approx(3.4, rel=0.05)
    assert reversal_um(model("-k*d_x*exp(-s_x/0.5)"))["X"] == 0.0
    assert reversal_um(model("0.5*k*d_x"))["X"] == pytest.approx(1.7)
    assert reversal_um(model("k*v_x", "k*load_kg*x"))["X"] == 0.0
    wide = model("k*d_x*exp(-s_x/0.5)").dead_bands_mm
    assert wide["X"] > MACHINE.axis("X").dead_band_mm == wide["Z"]


def test_columns_of_a_measurement(tmp_path: Path) -> None:
    """Force, load, velocity and acceleration are read, and written again to the letter. Oracle: the cells."""
    header = measurement_examples.HEADER + ",force_n,load_kg,vx_mm_s,ax_mm_s2"
    lines = [f"{row},{100 + i},{10 * i},{i / 2},{-i}" for i, row in enumerate(measurement_examples.rows())]
    table = measurement_examples.write(tmp_path, measurement_examples.text(lines, header))
    read = load_measurement(table, MACHINE)
    np.testing.assert_array_equal(read.channels["force_n"], 100.0 + np.arange(12))
    np.testing.assert_array_equal(read.channels["load_kg"], 10.0 * np.arange(12))
    np.testing.assert_array_equal(read.state().value("v_x"), np.arange(12) / 2)
    np.testing.assert_array_equal(read.state().value("a_x"), -np.arange(12.0))
    again = load_measurement(save_measurement(read, tmp_path / "again.csv"), MACHINE)
    assert set(again.channels) == set(read.channels)
    np.testing.assert_array_equal(again.channels["force_n"], read.channels["force_n"])

"""Simulated measurements: what is read, noise, weather, the day, and the command."""

import json
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from rtec.cli.main import status
from rtec.effects import State
from rtec.errors import ConfigError, MeasurementError, RtecError
from rtec.machine import Machine, load_machine
from rtec.metrology.files.load import load_measurement
from rtec.metrology.instruments.base import Instrument
from rtec.metrology.instruments.registry import INSTRUMENTS, make_instrument
from rtec.model import Model
from rtec.sim.campaign.campaign import Simulated, simulate, simulate_with_truth
from rtec.sim.campaign.cycle import directions, off_pitch, on_pitch
from rtec.sim.campaign.protocol import PRESETS, drift_noise, relax, with_noise
from rtec.sim.campaign.settings import (
    DRIFT_PROBES,
    DayPhase,
    ReadingNoise,
    Settings,
    Targets,
    Thermal,
    setup_table,
)
from rtec.sim.campaign.truth import effect_from_text, truth_of
from tests.support.exact_chain import exact_tip_error_um
from tests.support.instrument_examples import EXAMPLES, Example, frames
from tests.support.machines import turning_centre, vertical_mill
from tests.support.sim_example import PERFECT, QUIET

Floats = NDArray[np.float64]
MACHINE_FILE = Path(__file__).parents[2] / "configs" / "machines" / "turning-centre.toml"
EFFECTS = (
    "scale,component=EXX,axis=X,k=12",
    "backlash,component=EXX,axis=X,B=4",
    "axis_expansion,component=EZZ,axis=Z,sensor=T_bed,k=11",
    "polynomial_position,component=EBZ,axis=Z,degrees=[1,2],c1=15,c2=-8",
    "squareness,component=EB0X,alpha=25",
    "mount_expansion,component=EZ0spindle,sensor=T_spindle,k=1.5",
    "column_tilt,component=EB0spindle,front=T_spindle,back=T_bed,k=3",
)
CALM = Settings(noise=QUIET, thermal=Thermal(sensors=PERFECT))


def truth(machine: Machine | None = None, effects: tuple[str, ...] = EFFECTS) -> Model:
    return truth_of(machine or turning_centre(), effects=effects)


def laser(machine: Machine | None = None, axis: str = "X", **setup: Any) -> Instrument:
    return make_instrument("laser_linear", setup, axis, None, machine or turning_centre(), "test")


def lathe_examples() -> list[Example]:
    """One of each kind on the turning centre."""
    first = {e.name: e for e in reversed(EXAMPLES) if e.machine is turning_centre}
    return list(first.values())


# ---- what is read


@pytest.mark.parametrize("example", lathe_examples(), ids=str)
def test_without_noise_a_reading_is_geometry_plus_nuisance(example: Example) -> None:
    """Oracle: true rotations multiplied out, with the instrument placed in space, on the true component errors."""
    machine, instrument = example.machine(), example.make()
    made = simulate_with_truth(truth(machine), instrument, CALM, seed=4)
    m = made.measurement
    there = np.flatnonzero(np.isfinite(m.matrix()).any(axis=0))
    poses = m.state().positions_mm()
    for i in np.random.default_rng(0).choice(there, 12):
        errors = {c: float(v[i]) for c, v in made.components.items()}
        expected = np.array(example.read(frames(machine, poses[i], errors))) + made.nuisance_um[:, i]
        taken = np.isfinite(m.matrix()[:, i])
        np.testing.assert_allclose(m.matrix()[taken, i], expected[taken], atol=0.03)


def test_true_components_are_those_of_the_effects() -> None:
    """Oracle: the equations of the catalogue written out, and `exact_tip_error_um` of the errors that they give."""
    machine = turning_centre()
    tip = make_instrument("tool_tip", {"zero": "none"}, None, None, machine, "test")
    made = simulate_with_truth(truth(machine), tip, CALM, seed=2)
    m, degc = made.measurement, made.true_degc
    x, z, d = m.channels["x"], m.channels["z"], m.channels["d_x"]
    expected = {
        "EXX": 12.0 * x * 1e-3 + 2.0 * d,
        "EZZ": 11.0 * z * 1e-3 * (degc["T_bed"] - 20.0),
        "EB0X": np.full(len(m), 25.0),
        "EZ0spindle": 1.5 * (degc["T_spindle"] - 20.0),
        "EB0spindle": 3.0 * (degc["T_spindle"] - degc["T_bed"]),
    }
    for name, values in expected.items():
        np.testing.assert_allclose(made.components[name], values, atol=1e-9, err_msg=name)
    for i in range(0, len(m), 401):
        exact = exact_tip_error_um(machine, np.array([x[i], z[i]]), {c: v[i] for c, v in made.components.items()})
        np.testing.assert_allclose(m.matrix()[:, i], exact, atol=0.03)


@given(st.integers(0, 2**32 - 1))
def test_direction_is_that_of_the_last_move(seed: int) -> None:
    """Oracle: a plain walk, twice round the cycle; what travels overruns its target in its own direction."""
    rng = np.random.default_rng(seed)
    n, axes = int(rng.integers(1, 12)), int(rng.integers(1, 4))
    pose = rng.integers(0, 3, (n, axes)).astype(np.float64)
    travelling, way = rng.integers(-1, axes, n), rng.choice([-1.0, 1.0], n)
    last, expected = np.zeros(axes), np.zeros((n, axes))
    for i in [*range(n), *range(n)]:
        for a in range(axes):
            step = pose[i, a] - pose[i - 1, a]
            last[a] = way[i] if travelling[i] == a else np.sign(step) if step else last[a]
        expected[i] = last
    np.testing.assert_array_equal(directions(pose, travelling, way), expected)


def test_sensors_say_what_is_true_when_they_are_perfect() -> None:
    made = simulate_with_truth(truth(), laser(), CALM)
    for name, values in made.true_degc.items():
        np.testing.assert_array_equal(made.measurement.channels[name], values)


def test_a_lag_knows_what_happened_between_the_cycles() -> None:
    """Oracle: the lag integrated by scipy over the temperature of a measurement that is logged all day long."""
    lagged = "ambient_drift,component=EXX,sensor=T_bed,k=2,tau=4000"
    thermal = Thermal(sensors=PERFECT, swing_degc=0.0, walk_degc=0.0)
    model, instrument = truth(effects=(lagged,)), laser(zero="none")
    sparse = simulate_with_truth(model, instrument, Settings(noise=QUIET, thermal=thermal))
    dense = simulate(model, instrument, Settings(noise=QUIET, thermal=thermal, log_every_s=20.0))
    time_s, rise = dense.time_s, dense.channels["T_bed"] - 20.0
    wanted = sparse.measurement.time_s
    lag = solve_ivp(
        lambda t, y: (np.interp(t, time_s, rise) - y) / 4000.0,
        (0.0, wanted[-1]),
        [rise[0]],
        t_eval=wanted,
        max_step=60.0,
        rtol=1e-8,
    ).y[0]
    np.testing.assert_allclose(sparse.measurement.readings["reading_um"], 2.0 * lag, atol=0.01)
    assert np.ptp(lag) > 3.0
    unread = np.isnan(dense.readings["reading_um"])
    assert unread.any()
    # Other instants between the rows: the lag is exact for straight lines between them, so nearly the same.
    read = dense.readings["reading_um"][~unread]
    np.testing.assert_allclose(read, sparse.measurement.readings["reading_um"], atol=1e-4)


@pytest.mark.parametrize("example", lathe_examples(), ids=str)
def test_every_instrument_can_be_simulated_and_written(example: Example, tmp_path: Path) -> None:
    """Oracle: what is read back from the file. Every one of the registry is here (a law of test_instruments.py)."""
    from rtec.metrology.files.load import save_measurement

    made = simulate(truth(example.machine()), example.make(), seed=9)
    read = load_measurement(save_measurement(made, tmp_path / "m.csv"), example.machine())
    np.testing.assert_array_equal(read.matrix(), made.matrix())
    assert set(read.channels) == set(made.channels)
    assert all(np.array_equal(read.channels[c], made.channels[c]) for c in made.channels)
    assert example.name in INSTRUMENTS


def test_a_square_is_read_along_one_axis_while_the_other_travels() -> None:
    square = make_instrument("squareness", {"reference_axis": "Z"}, "X", None, turning_centre(), "test")
    m = simulate(truth(), square, CALM)
    x_travels = np.isnan(m.readings["reading_x_um"])
    np.testing.assert_array_equal(x_travels, np.isfinite(m.readings["reading_z_um"]))
    assert np.unique(m.channels["x"][~x_travels]).size == 1
    assert np.unique(m.channels["z"][x_travels]).size == 1


# ---- noise


@pytest.mark.parametrize("spacing", ["even", "uneven"])
def test_drift_noise_has_the_autocorrelation_of_its_law(spacing: str) -> None:
    """Oracle: `σ² exp(-|Δt|/τ)` at several distances; with 4000 correlation times the estimate is within 0.08."""
    rng, n, tau = np.random.default_rng(8), 80_000, 600.0
    steps = np.full(n, 30.0) if spacing == "even" else rng.exponential(30.0, n)
    time_s = np.cumsum(steps)
    noise = drift_noise(time_s, 2.0, tau, rng)
    assert noise.std() == pytest.approx(2.0, rel=0.05)
    for k in (1, 5, 20, 60):
        found = np.mean(noise[:-k] * noise[k:]) / 4.0
        expected = np.mean(np.exp(-(time_s[k:] - time_s[:-k]) / tau))
        assert found == pytest.approx(expected, abs=0.08)


def test_drift_noise_is_as_large_at_the_start_as_later() -> None:
    """Oracle: variance over 4000 seeds at the first instant and the third, σ² within 4 of its standard errors."""
    ends = np.array(
        [drift_noise(np.array([0.0, 5.0, 300.0]), 1.5, 600.0, np.random.default_rng(s)) for s in range(4000)]
    )
    np.testing.assert_allclose(ends.var(axis=0), 1.5**2, rtol=4 * np.sqrt(2 / 4000))


def test_each_kind_of_noise_is_as_large_as_said() -> None:
    """Oracle: standard deviations and shares given, within 4 standard errors of the estimate."""
    n = 50_000
    time_s, run = np.arange(float(n)), np.repeat(np.arange(500), 100)
    rng = np.random.default_rng

    def noisy(**what: float) -> Floats:
        return with_noise(np.zeros(n), time_s, run, QUIET.model_copy(update=what), rng(5))

    assert noisy().tolist() == [0.0] * n
    assert noisy(white_um=0.7).std() == pytest.approx(0.7, rel=4 / np.sqrt(2 * n))
    offsets = noisy(run_offset_um=1.1).reshape(500, 100)
    assert np.ptp(offsets, axis=1).max() == 0.0
    assert offsets[:, 0].std() == pytest.approx(1.1, rel=4 / np.sqrt(1000))
    outliers = noisy(outliers=0.02, outlier_um=20.0)
    wrong = outliers[outliers != 0.0]
    assert len(wrong) == pytest.approx(0.02 * n, abs=4 * np.sqrt(0.02 * n))
    assert np.abs(wrong).min() >= 10.0
    assert np.abs(wrong).max() <= 30.0
    assert (wrong > 0).mean() == pytest.approx(0.5, abs=2 / np.sqrt(len(wrong)))
    assert np.isnan(noisy(lost=0.05)).mean() == pytest.approx(0.05, abs=4 * np.sqrt(0.05 / n))


def test_a_display_shows_whole_steps() -> None:
    """Oracle: multiples of the step; against the unrounded reading never off by more than half of it."""
    fine = simulate(truth(), laser(), CALM)
    coarse = simulate(
        truth(), laser(), CALM.model_copy(update={"noise": QUIET.model_copy(update={"resolution_um": 0.5})})
    )
    shown = coarse.readings["reading_um"]
    np.testing.assert_array_equal(shown * 2.0, np.round(shown * 2.0))
    assert np.abs(shown - fine.readings["reading_um"]).max() <= 0.25 + 1e-9


def test_one_kind_of_noise_leaves_the_rest_as_it_was() -> None:
    """More noise must not draw another day: temperatures and nuisances stay."""
    few, many = (
        simulate_with_truth(truth(), laser(), Settings(noise=ReadingNoise(white_um=w, outliers=w / 10)), seed=6)
        for w in (0.1, 1.0)
    )
    assert few.nuisance == many.nuisance
    np.testing.assert_array_equal(few.clean, many.clean)
    for name, values in few.measurement.channels.items():
        np.testing.assert_array_equal(values, many.measurement.channels[name])


def test_nuisances_are_drawn_as_the_instrument_declares_them() -> None:
    """One zero a run where the set-up says so, one for all where not; none where the size is 0."""
    per_run = simulate_with_truth(truth(), laser(zero="run"), CALM, seed=3)
    assert {run for _, run in per_run.nuisance} == set(per_run.measurement.run.tolist())
    for run in (1, 7):
        rows = per_run.measurement.run == run
        np.testing.assert_allclose(per_run.nuisance_um[0, rows], per_run.nuisance["zero", run])
    once = simulate_with_truth(truth(), laser(), CALM, seed=3)
    assert list(once.nuisance) == [("zero", 0)]
    none = simulate_with_truth(truth(), laser(), CALM.model_copy(update={"nuisance": {"zero": 0.0}}), seed=3)
    assert not none.nuisance_um.any()


# ---- the day


def test_the_warm_up_is_that_of_the_guidelines() -> None:
    """Oracle: [G 3.1]: five cycles over the travel cold, then after every step of warming up, by being on and by
    moving; about eight hours to get warm."""
    made = simulate_with_truth(truth(), laser(), CALM)
    m = made.measurement
    names = list(dict.fromkeys(made.phase))
    assert names[:4] == ["measure cold", "measure after idle 1", "measure after move 1", "measure after move 2"]
    for name in names:
        rows = np.array([p == name for p in made.phase])
        assert len(np.unique(m.run[rows])) == 5
    assert 7.0 < m.time_s[-1] / 3600.0 < 11.0
    for run in np.unique(m.run):
        x, d = m.channels["x"][m.run == run], m.channels["d_x"][m.run == run]
        half = len(x) // 2
        assert (d[:half] == 1.0).all()
        assert (d[half:] == -1.0).all()
        np.testing.assert_array_equal(x[:half], x[half:][::-1])
        assert np.ptp(x) > 0.9 * 200.0
    bed = made.true_degc["T_bed"]
    assert bed[m.run <= 5].mean() < bed[m.run == 10].mean() < bed[m.run == 25].mean()


def test_temperatures_follow_first_order_bodies() -> None:
    """Oracle: `T_air + rise (1 - exp(-t/τ))` while the machine idles, then decay from there, by hand."""
    phases = (
        DayPhase(name="on", hours=2.0, read_every_s=100.0),
        DayPhase(name="turning", hours=1.0, rpm=2000.0, read_every_s=100.0),
        DayPhase(name="off", hours=2.0, on=False, read_every_s=100.0),
    )
    body = {"T_bed": {"tau_s": 1800.0, "on_degc": 6.0}, "T_spindle": {"tau_s": 900.0, "spindle_degc": 4.0},
            "T_column": {"follows": "T_bed", "share": 0.5}}  # fmt: skip
    thermal = {"swing_degc": 0.0, "walk_degc": 0.0, "sensors": PERFECT.model_dump(), "body": body}
    settings = Settings.model_validate({"phase": [p.model_dump() for p in phases], "thermal": thermal})
    drift = make_instrument("spindle_drift", {"probe": dict(DRIFT_PROBES)}, None, None, turning_centre(), "test")
    m = simulate(truth(), drift, settings)
    t = m.time_s
    on = np.minimum(t, 10800.0)
    bed = 6.0 * -np.expm1(-on / 1800.0) * np.exp(-(t - on) / 1800.0)
    turning = np.clip(t - 7200.0, 0.0, 3600.0)
    spindle = 4.0 * 2.0**1.2 * -np.expm1(-turning / 900.0) * np.exp(-np.maximum(t - 10800.0, 0.0) / 900.0)
    np.testing.assert_allclose(m.channels["T_bed"], 20.0 + bed, atol=1e-9)
    np.testing.assert_allclose(m.channels["T_spindle"], 20.0 + spindle, atol=1e-9)
    np.testing.assert_allclose(m.channels["T_column"], 20.0 + 0.5 * bed, atol=1e-9)
    np.testing.assert_allclose(m.channels["T_air"], 20.0)


def test_measuring_warms_the_axis_too() -> None:
    """Oracle: `rise · mean speed / (100 mm/s) · (1 - exp(-t/τ))`, mean speed from the recorded positions."""
    body = {"T_bed": {"tau_s": 600.0, "axis_degc": {"X": 20.0}}}
    thermal = {"swing_degc": 0.0, "walk_degc": 0.0, "sensors": PERFECT.model_dump(), "body": body}
    settings = Settings.model_validate({"phase": [{"name": "all day", "cycles": 40}], "thermal": thermal})
    m = simulate(truth(), laser(), settings)
    ends = np.flatnonzero(np.diff(m.run, append=0))
    seconds = float(np.diff(m.time_s[ends])[0])
    speed_mm_s = 2.0 * np.ptp(m.channels["x"]) / seconds
    expected = 20.0 + 20.0 * speed_mm_s / 100.0 * -np.expm1(-m.time_s / 600.0)
    np.testing.assert_allclose(m.channels["T_bed"], expected, atol=1e-9)
    assert m.channels["T_bed"].max() > 20.5


def test_relaxation_does_not_depend_on_how_time_is_cut() -> None:
    """Oracle: the closed form; the same end from two steps and from a thousand."""
    for n in (2, 1000):
        time_s = np.linspace(0.0, 3000.0, n)
        assert relax(20.0, np.full(n, 30.0), time_s, 1500.0)[-1] == pytest.approx(30.0 - 10.0 * np.exp(-2.0))


def test_sensors_are_wrong_as_said() -> None:
    """Oracle: the settings: one offset for good, noise, whole steps, and a lag that shows while it warms."""
    quiet = PERFECT.model_copy(update={"offset_degc": 0.5})
    made = simulate_with_truth(truth(), laser(), CALM.model_copy(update={"thermal": Thermal(sensors=quiet)}), seed=11)
    gaps = [made.measurement.channels[s] - v for s, v in made.true_degc.items()]
    assert all(np.ptp(g) < 1e-9 for g in gaps)
    assert len({round(float(g[0]), 6) for g in gaps}) == len(gaps)
    noisy = PERFECT.model_copy(update={"noise_degc": 0.05, "resolution_degc": 0.02})
    made = simulate_with_truth(truth(), laser(), CALM.model_copy(update={"thermal": Thermal(sensors=noisy)}), seed=11)
    shown = made.measurement.channels["T_bed"]
    np.testing.assert_allclose(shown / 0.02, np.round(shown / 0.02), atol=1e-6)
    assert (shown - made.true_degc["T_bed"]).std() == pytest.approx(0.05, rel=0.1)
    slow = PERFECT.model_copy(update={"lag_s": 600.0})
    made = simulate_with_truth(truth(), laser(), CALM.model_copy(update={"thermal": Thermal(sensors=slow)}), seed=11)
    after = made.measurement.run == 26  # the first cycle after the machine has moved for an hour
    assert (made.measurement.channels["T_bed"] < made.true_degc["T_bed"])[after].all()


def test_drift_goes_on_for_days_and_parts_are_cut_from_one_side() -> None:
    """Oracle: [G 3.5]: 8 h on, off over night, every ten minutes, several speeds; a part is a run."""
    drift = make_instrument("spindle_drift", {"probe": dict(DRIFT_PROBES)}, None, None, turning_centre(), "test")
    m = simulate(truth(), drift, CALM)
    rpm = m.channels["spindle_rpm"]
    assert {0.0, 1000.0, 2000.0, 3000.0} == set(rpm.tolist())
    assert all(np.count_nonzero(rpm == speed) == 48 for speed in (1000.0, 2000.0, 3000.0))
    np.testing.assert_allclose(np.diff(m.time_s), 600.0)
    part = make_instrument("work_piece", {"feature": "diameter"}, "X", None, turning_centre(), "test")
    cut = simulate(truth(), part, CALM)
    assert (cut.channels["d_x"] == 1.0).all()
    assert len(np.unique(cut.run)) == 1 + np.count_nonzero(np.diff(cut.time_s) > 1000.0) == 15


# ---- targets


@pytest.mark.parametrize("pitch", [5.0, 10.0, 12.0])
@pytest.mark.parametrize("step", [2.5, 5.0, 10.0, 20.0, 12.0, 50.0])
def test_targets_meet_every_phase_of_the_pitch(step: float, pitch: float) -> None:
    """Oracle: with 20 targets no gap between their phases is larger than a fifth of the pitch."""
    chosen = off_pitch(step, pitch) if on_pitch(step, pitch) else step
    phases = np.sort(np.mod(chosen * np.arange(20), pitch))
    gaps = np.diff(np.append(phases, phases[0] + pitch))
    assert gaps.max() <= 0.34 * pitch
    assert abs(chosen - step) <= max(0.62 * pitch, 0.01)


def test_a_step_that_hides_the_cyclic_error_is_told_or_kept() -> None:
    told = simulate(truth(), laser(), Settings(targets=Targets(step_mm=10.0)))
    assert any("multiple of the pitch" in note and "11.91 mm" in note for note in told.notes)
    np.testing.assert_allclose(np.diff(np.unique(told.channels["x"])), 11.91)
    kept = simulate(truth(), laser(), Settings(targets=Targets(step_mm=10.0, keep_step=True)))
    np.testing.assert_allclose(np.diff(np.unique(kept.channels["x"])), 10.0)
    assert not any("pitch" in note for note in kept.notes)
    usual = simulate(truth(), laser())
    assert not on_pitch(float(np.diff(np.unique(usual.channels["x"]))[0]), 5.0)


def test_lines_at_several_places_and_readings_in_a_dwell() -> None:
    targets = Targets(range_mm=(20.0, 180.0), step_mm=13.0, at_mm={"Z": (50.0, 300.0)}, readings=3, dwell_s=6.0)
    m = simulate(truth(), laser(), CALM.model_copy(update={"targets": targets, "protocol": "cold"}))
    assert set(m.channels["z"].tolist()) == {50.0, 300.0}
    assert set(m.channels["d_z"].tolist()) == {-1.0, 1.0}  # it comes to each place from its own side
    assert len(m) == 5 * 2 * 2 * 13 * 3
    np.testing.assert_array_equal(m.channels["x"][:3], 20.0)
    np.testing.assert_allclose(np.diff(m.time_s[:3]), 2.0)
    np.testing.assert_allclose(m.time_s[3] - m.time_s[2], 2.0 + 13.0 / 50.0)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"targets": {"range_mm": [-5.0, 100.0]}}, ["-5", "travels 0 to 200"]),
        ({"targets": {"range_mm": [100.0, 50.0]}}, ["first must be below"]),
        ({"targets": {"axes": ["Q"]}}, ["'Q'", "X, Z"]),
        ({"targets": {"at_mm": {"Z": [900.0]}}}, ["at_mm.Z"]),
        ({"targets": {"step_mm": 1e-5, "keep_step": True}}, ["targets", "at most"]),
        ({"phase": [{"name": "a", "hours": 1.0}]}, ["nothing is read"]),
        ({"phase": [{"name": "a", "hours": 1.0, "cycles": 2}]}, ["either cycles or hours"]),
        ({"phase": [{"name": "a", "hours": 9e4, "read_every_s": 1.0}]}, ["at most"]),
        ({"thermal": {"body": {"T_beed": {}}}}, ["T_beed", "'T_bed'"]),
        ({"thermal": {"body": {"T_bed": {"follows": "T_bed"}}}}, ["follows 'T_bed'"]),
        ({"thermal": {"body": {"T_bed": {"axis_degc": {"Q": 1.0}}}}}, ["'Q'"]),
    ],
)
def test_settings_that_cannot_be_are_told(settings: Mapping[str, Any], words: list[str]) -> None:
    with pytest.raises((ConfigError, ValueError)) as caught:
        simulate(truth(), laser(), Settings.model_validate(settings))
    assert all(word in str(caught.value) for word in words), str(caught.value)


# ---- effects and set-up as text


def test_an_effect_on_one_line_is_the_effect() -> None:
    """Oracle: the same effect built from its table."""
    machine = turning_centre()
    fitted = effect_from_text(
        "cyclic_screw, component=EXX, axis=X, harmonics=2, pitch=5, s1=1, c1=0.5, s2=0, c2=-1", machine
    )
    assert fitted.values == {"s1": 1.0, "c1": 0.5, "s2": 0.0, "c2": -1.0}
    assert fitted.theta == {"pitch": 5.0}
    assert fitted.effect.model_dump()["harmonics"] == 2


def test_an_expression_on_one_line() -> None:
    """Oracle: the formula by numpy; which of its numbers are linear follows from it."""
    machine = turning_centre()
    hump = effect_from_text("expression,component=EZX,expression=A*exp(-((x-c)/w)**2),A=3,c=100,w=30", machine)
    assert hump.values == {"A": 3.0}
    assert hump.theta == {"c": 100.0, "w": 30.0}
    x = np.linspace(0.0, 300.0, 7)
    state = State(machine, np.zeros(7), {"x": x})
    said = 3.0 * np.asarray(hump.effect.basis(machine, state, hump.theta)[0])
    np.testing.assert_allclose(said, 3.0 * np.exp(-(((x - 100.0) / 30.0) ** 2)))
    line = effect_from_text("expression,component=EBX,expression=A*x+B*sin(x/p),A=1,B=2,p=7", machine)
    assert line.values == {"A": 1.0, "B": 2.0}
    assert line.effect.model_dump()["linear"] == {"A": "urad", "B": "urad"}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("expression,component=EXX,expression=A*(,A=3", ["is no expression"]),
        ("expression,component=EXX,expression=A*foo,A=3", ["'foo' is neither a channel nor a parameter"]),
        ("scal,component=EXX,axis=X,k=1", ["'scal'", "did you mean 'scale'"]),
        ("scale,component=EXX,axis=X", ["'k' is missing"]),
        ("scale,component=EXX,axis=X,q=1", ["unknown key 'q'"]),
        ("scale,component=EXX,axis=X,k=fast", ["k is 'fast'", "no number"]),
        ("scale,component=EXX,axis=Q,k=1", ["axis 'Q'"]),
        ("scale,component=EXX,axis=X,k", ["'k' is no key=value"]),
        ("scale,component=EXX,axis=X,k=1,k=2", ["is given twice"]),
        ("scale,component=EQQ,axis=X,k=1", ["EQQ"]),
    ],
)
def test_a_wrong_effect_is_told(text: str, words: list[str]) -> None:
    with pytest.raises(RtecError) as caught:
        truth_of(turning_centre(), effects=[text])
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_a_setup_as_text() -> None:
    table = setup_table(["beam_offset_mm=[0,150,80]", "zero=run", "probe.radial1.direction=X", "slope = 'none'"])
    assert table == {
        "beam_offset_mm": [0, 150, 80], "zero": "run", "probe": {"radial1": {"direction": "X"}}, "slope": "none",
    }  # fmt: skip
    for wrong in (["zero"], ["zero=run", "zero=setup"], ["=3"]):
        with pytest.raises(MeasurementError, match="--set"):
            setup_table(wrong)


# ---- determinism and the command


def command(out: Path, *more: str) -> list[str]:
    effect = "axis_expansion,component=EXX,axis=X,sensor=T_x_nut,k=11"
    start = ["simulate", str(MACHINE_FILE), "--instrument", "laser_linear", "--axis", "X", "--effect", effect]
    return [*start, "-o", str(out), *more]


def test_the_same_seed_gives_the_same_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        folder = tmp_path / name
        assert status(command(folder / "laser", "--seed", str(seed), "--drift", "0.5", "--outliers", "0.01")) == 0
    for end in (".csv", ".toml"):
        a, b, c = ((tmp_path / n / f"laser{end}").read_bytes() for n in "abc")
        assert a == b
        assert a != c
    assert "measure cold: " in capsys.readouterr().out


def test_the_command_gives_json_a_truth_file_and_a_measurement(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth_file = tmp_path / "truth.toml"
    assert status(command(tmp_path / "laser", "--json", "--truth-out", str(truth_file), "--cycles", "2")) == 0
    facts = json.loads(capsys.readouterr().out)
    machine = load_machine(MACHINE_FILE)
    read = load_measurement(tmp_path / "laser.csv", machine)
    assert facts["rows"] == len(read)
    assert facts["runs"] == 2 * len(facts["phases"])
    again = command(tmp_path / "again", "--cycles", "2")
    at = again.index("--effect")
    assert status([*again[:at], "--truth", str(truth_file), *again[at + 2 :]]) == 0
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "laser.csv").read_bytes()


@pytest.mark.parametrize(("more", "told"), [(["--component", "EXX"], True), ([], False)])
def test_an_arm_that_has_no_say_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], told: bool
) -> None:
    """Oracle: with a component a reading is that component, whatever the place of the beam."""
    beam = ["--set", "beam_offset_mm=[0,150,80]", "--protocol", "cold", "--cycles", "1"]
    assert status(command(tmp_path / "laser", *beam, *more)) == 0
    assert ("beam_offset_mm = [0, 150, 80] is not used" in capsys.readouterr().out) is told


def test_settings_come_from_a_file_and_options_win(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "day.toml"
    file.write_text('[targets]\nrange_mm = [10.0, 90.0]\nstep_mm = 7.0\n[[phase]]\nname = "one"\ncycles = 1\n')
    assert status(command(tmp_path / "m", "--settings", str(file), "--range", "20", "60")) == 0
    x = load_measurement(tmp_path / "m.csv", load_machine(MACHINE_FILE)).channels["x"]
    assert (x.min(), x.max()) == (20.0, 55.0)
    assert status(command(tmp_path / "m", "--settings", str(file), "--protocol", "cold")) == 2
    assert "leave one out" in capsys.readouterr().err
    file.write_text("[targets]\nstepp_mm = 7.0\n")
    assert status(command(tmp_path / "m", "--settings", str(file))) == 2
    assert "did you mean 'step_mm'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--noise", "-1"], "white_um"),
        (["--noise", "nan"], "white_um"),
        (["--outliers", "2"], "outliers"),
        (["--protocol", "warmup"], "warm_up"),
        (["--set", "beam_ofset_mm=[0,0,0]"], "beam_offset_mm"),
        (["--effect", "scal,k=1"], "scale"),
        (["--component", "EBX"], "EBX"),
    ],
)
def test_wrong_use_is_one_message_and_status_2(
    more: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert status(command(tmp_path / "m", *more)) == 2
    told = capsys.readouterr().err
    assert words in told
    assert "Traceback" not in told
    assert not (tmp_path / "m.csv").exists()


def test_every_preset_can_be_lived_through() -> None:
    machine = vertical_mill()
    model = truth_of(machine, effects=["scale,component=EXX,axis=X,k=5"])
    for name in PRESETS:
        settings = Settings.model_validate({"protocol": name, "cycles": 1})
        made: Simulated = simulate_with_truth(model, laser(machine), settings) if name != "drift" else drift_of(machine)
        assert np.isfinite(made.measurement.matrix()).all()
        assert (np.diff(made.measurement.time_s) >= 0).all()


def drift_of(machine: Machine) -> Simulated:
    instrument = make_instrument("spindle_drift", {"probe": dict(DRIFT_PROBES)}, None, None, machine, "test")
    return simulate_with_truth(truth_of(machine), instrument)


def test_the_examples_of_the_documentation_are_as_the_program_reads_them() -> None:
    """Oracle: the program itself; what stands there as usual is what is taken when it is left out."""
    text = (MACHINE_FILE.parents[2] / "docs" / "instruments.md").read_text(encoding="utf-8")
    blocks = [tomllib.loads(b) for b in re.findall(r"```toml\n(.*?)```", text, re.DOTALL)]
    machine, usual = load_machine(MACHINE_FILE), Settings()
    for block in blocks:
        if "measurement" in block:
            head = block["measurement"]
            make_instrument(head["instrument"], block["setup"], head.get("axis"), None, machine, "instruments.md")
        else:
            read = Settings.model_validate(block)
            assert (read.targets, read.noise, read.cycles) == (usual.targets, usual.noise, usual.cycles)
            assert read.thermal.model_copy(update={"body": {}}) == usual.thermal
    assert len(blocks) == 3
    assert all(f"`{name}`" in text for name in (*INSTRUMENTS, *PRESETS))

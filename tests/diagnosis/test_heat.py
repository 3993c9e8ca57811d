"""Heat that no sensor, or the wrong one, recorded; curves that may be waves; two simple causes before one rich one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lsim

from rtec.bench.sets import measurements_of, model_of
from rtec.bench.trials import build
from rtec.diagnosis.heat import lag_assumed
from rtec.diagnosis.result import Diagnosis
from rtec.diagnosis.search.diagnose import diagnose
from rtec.diagnosis.search.refit import HALF_WAVES, slow_slopes
from rtec.diagnosis.search.screen import Bank, Projected, screen_all
from rtec.effects import effect_class
from rtec.estimation.candidates import library
from rtec.estimation.noise import Noise, Whitener
from rtec.estimation.readings import read
from rtec.machine import Sensor
from rtec.metrology.files.load import load_measurement
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.discovery.generator.cases import Case
from tests.discovery.generator.dataset import build as generated
from tests.discovery.translate import base_model, measurement_of
from tests.support import proof
from tests.support.diagnosis_examples import effects, recorded_by_laser, small_machine, write_laser, write_machine


def answer(group: str, what: str, seed: int) -> Diagnosis:
    trial = build(group, what, seed)
    return diagnose(model_of(trial), measurements_of(trial), draws=50)


@pytest.mark.parametrize("seed", [1, 303])
def test_slow_and_unexplained_by_anything_recorded(seed: int) -> None:
    """A screw grows; no temperature was recorded. With seed 303 a bent guide follows some of the runs' slopes."""
    d = answer("unrecorded", "no_sensors", seed)
    assert d.verdict == "undecided"
    assert "slow, and unexplained by anything recorded. Record temperatures of the screw or scale of X" in d.sentence


def test_a_sensor_that_stands_for_another_is_said_to() -> None:
    """A screw grows; sensors are on coolant, air and bed."""
    d = answer("unrecorded", "nut_unseen", 1)
    (doubt,) = d.doubts
    assert doubt.kind == "other_sensor"
    assert doubt.message.startswith("axis_expansion follows T_bed; no sensor on the screw, nut or scale of X")


@pytest.mark.parametrize("seed", proof.few([60002, 60011], 1))
def test_a_shape_beside_heat_that_nothing_recorded_is_no_whole_answer(seed: int) -> None:
    """A screw grows, its nut has no sensor, and a curve along the axis explains a part. Oracle: what was put in."""
    d = answer("unrecorded", "nut_unseen", seed)
    assert d.findings[0].effect.effect != "axis_expansion"
    assert d.verdict == "undecided"
    assert [doubt.kind for doubt in d.doubts] == ["no_temperature"]
    begin, after = "record reading_um grows and falls by ", " µm with a memory of "
    assert d.sentence.startswith(begin)
    assert float(d.sentence.removeprefix(begin).split(after)[0]) <= d.rms_residual
    asks = "In addition to T_bed, T_cool, T_air, record temperatures of the screw or scale of X, spindle, column."
    assert f"unexplained by anything recorded. {asks}" in d.sentence
    assert d.sentence.endswith(", which may be a part of that growth.")


@pytest.mark.parametrize(("what", "seed"), proof.few([("abbe", 1), ("servo", 1), ("plain_bow", 1), ("servo", 2)], 2))
def test_a_shape_alone_is_not_doubted(what: str, seed: int) -> None:
    """Oracle: the effect that was put in is the only one."""
    assert "no_temperature" not in {doubt.kind for doubt in answer("lean", what, seed).doubts}


def test_what_follows_the_direction_is_no_heat(tmp_path: Path) -> None:
    """Play and a wave are hidden; beside the wave, play changes as slowly as the axis turns. Oracle: these two."""
    true = ["scale,component=EXX,axis=X,k=12", "backlash,component=EXX,axis=X,B=3"]
    true.append("cyclic_pole,component=EXX,axis=X,s=2,c=-1,period=37.3")
    write_machine(tmp_path)
    machine = small_machine()
    path = write_laser(tmp_path, true, 5, targets={"step_mm": 1.17}, protocol="cold", cycles=4)
    d = diagnose(Model(machine, effects(true[0])), [load_measurement(path, machine)], draws=50)
    assert "no_temperature" not in {doubt.kind for doubt in d.doubts}
    assert d.findings[0].accepted


@pytest.mark.parametrize("seed", proof.few([1, 2], 1))
def test_a_curve_at_equal_targets_may_be_a_wave(seed: int) -> None:
    """Oracle: the wave that was put in is among the periods that are told."""
    d = answer("aliases", "alias", seed)
    assert d.verdict == "ambiguous"
    (wave,) = [a for a in d.findings[0].confused_with if "targets stand every" in a.why]
    assert "unequal steps along X" in wave.separating_test


def test_two_simple_effects_come_before_one_of_many_numbers() -> None:
    """A plate with two effects of one and two numbers, of which a reversal with five numbers follows some."""
    trial = build("plates", "two_on_plate", 2)
    d = diagnose(model_of(trial), measurements_of(trial), draws=50)
    assert all(len(f.parameters) <= 2 for f in d.findings[:1])
    assert not any(f.effect.effect == "backlash_position" for f in d.group)


def test_simple_effects_come_before_a_pair_of_which_one_is_rich() -> None:
    """A plate with two bent lines and a squareness; a reversal with five numbers follows two of them at once."""
    trial = build("plates", "three_on_plate", 302)
    d = diagnose(model_of(trial), measurements_of(trial), draws=50)
    assert (
        {"straightness"}
        <= {m.fitted.effect.effect for m in d.together}
        <= {"straightness", "squareness", "parallelism"}
    )
    assert {"EYX", "EXY"} <= {m.fitted.effect.component for m in d.together}


def test_columns_kept_for_the_next_look_are_those_of_its_readings() -> None:
    """Oracle: the columns of these readings alone."""
    trial = build("lean", "servo", 1)
    readings = read(measurements_of(trial), smooth=False)
    keep = np.arange(len(readings)) % 3 > 0
    candidates, _ = library(readings, ["servo_lag", "polynomial_position"])
    noise = Whitener(readings, (Noise(0.5, 1e-4, 100.0, 0.0),), (np.zeros(0),))
    bank = Bank(readings, candidates, keep)
    screen_all(bank, Projected.of(noise, np.ones((len(readings), 1)), readings.values))
    few = readings.without(~keep)
    assert bank.chunks
    for chunk in bank.chunks:
        made = [few.columns(candidates[i].effect, candidates[i].thetas[j]) for i, j in chunk.which.tolist()]
        np.testing.assert_array_equal(chunk.columns, np.concatenate(made, axis=1))


def test_directions_of_a_candidate_explain_what_least_squares_does() -> None:
    """Oracle: numpy's least squares beside the base, which has one column of a polynomial already."""
    trial = build("lean", "servo", 1)
    readings = read(measurements_of(trial), smooth=False)
    candidates, _ = library(readings, ["servo_lag", "polynomial_position"])
    noise = Whitener(readings, (Noise(0.5, 1e-4, 100.0, 0.0),), (np.zeros(0),))
    rich = next(c for c in candidates if len(c.effect.coefficients(readings.machine)) > 1)
    base = np.column_stack([np.ones(len(readings)), readings.columns(rich.effect, rich.thetas[0])[:, 0]])
    known = Projected.of(noise, base, readings.values)
    found = screen_all(Bank(readings, candidates, np.ones(len(readings), dtype=np.bool_)), known)

    def left(columns: NDArray[np.float64]) -> float:
        white, values = noise(columns), noise(readings.values)
        white = white / np.linalg.norm(white, axis=0)
        return float(np.sum((values - white @ np.linalg.lstsq(white, values, rcond=1e-9)[0]) ** 2))

    fewer = 0
    for v in found.variants:
        columns = readings.columns(candidates[v.candidate].effect, candidates[v.candidate].thetas[v.theta])
        explained = float(np.sum(found.along[v.first : v.first + v.count] ** 2))
        assert explained == pytest.approx(left(base) - left(np.hstack([base, columns])), rel=1e-6)
        made = found.directions[:, v.first : v.first + v.count].astype(np.float64)
        np.testing.assert_allclose(made.T @ made, np.eye(v.count), atol=1e-4)
        np.testing.assert_allclose(made.T @ known.left, found.along[v.first : v.first + v.count], rtol=1e-3, atol=1e-3)
        fewer += v.count < columns.shape[1]
    assert fewer >= 1, "the base absorbs a direction of one candidate at least"


def test_a_lag_says_what_it_took_for_granted() -> None:
    """Oracle: the times of the readings: 17 minutes between the runs, whatever the spindle did there."""
    trial = build("gaps", "speed_gaps", 1)
    pause_min = float(np.diff(trial.records[0].plan.time_s).max()) / 60.0
    assert 17.0 <= pause_min < 19.0
    readings = read(measurements_of(trial))
    growth = effect_class("spindle_growth", "test").model_validate(
        {"effect": "spindle_growth", "component": "EZ0spindle"}
    )
    (said,) = lag_assumed(readings, growth, {"tau": 900.0, "p": 1.0})
    assert "spindle_rpm counted as settled before the first reading" in said
    assert f"pauses (up to {pause_min:.0f} min)" in said
    (said,) = lag_assumed(readings, growth, {"tau": 9e4, "p": 1.0})
    assert "pause" not in said
    assert lag_assumed(readings, growth, {}) == ()


def table(seed: int, *, recorded: bool) -> Measurement:
    """Five runs of ISO 230-2 in 40 minutes while a part grows by numpy's exp; T_bed is absent, or rises with it."""
    rng, machine = np.random.default_rng(seed), small_machine()
    x = np.sort(np.linspace(8.0, 192.0, 10) + rng.uniform(-4.0, 4.0, 10))
    place = np.tile(np.concatenate([x, x[::-1]]), 5)
    time_s = 24.0 * np.arange(float(len(place)))
    warm = 1.0 - np.exp(-time_s / 1500.0)
    readings = 12.0 * warm * (place / 200.0) + rng.normal(0.0, 0.2, len(place))
    channels = {"x": place, "d_x": np.tile(np.repeat([1.0, -1.0], 10), 5)}
    channels |= {"T_bed": 20.0 + 6.0 * warm} if recorded else {}
    made = make_instrument("laser_linear", {}, "X", None, machine, "iso")
    return Measurement("iso", made, machine, np.repeat(np.arange(1, 6), 20), time_s, channels, {"reading_um": readings})


TO_RECORD = (
    ". No temperature was recorded, and heat that comes and goes looks like this. Record temperatures of the screw or "
    "scale of X, spindle, column, bed, air"
)


@pytest.mark.parametrize("seed", proof.few([1, 2, 3], 1))
@pytest.mark.parametrize("known", [("scale,component=EXX,axis=X,k=20",), ()])
def test_an_unnamed_error_of_place_and_time_says_which_temperatures_to_record(
    seed: int, known: tuple[str, ...]
) -> None:
    """Oracle: no temperature is in the table; without a scale in the model a part of the growth has a name."""
    model = Model(small_machine(), effects("backlash,component=EXX,axis=X,B=0.5", *known))
    d = diagnose(model, [table(seed, recorded=False)], draws=50)
    assert d.unknown is not None
    assert d.unknown.channels == ("x", "time_s")
    assert TO_RECORD in d.sentence
    assert [doubt.kind for doubt in d.doubts] == ["no_temperature"]
    assert d.verdict == "unknown_effect" or not known
    assert not d.unknown.expression  # the time of a record is none of the next day


@pytest.mark.parametrize("seed", proof.few([1, 2, 3], 2))
def test_a_temperature_that_was_recorded_is_not_asked_for(seed: int) -> None:
    model = Model(small_machine(), effects("scale,component=EXX,axis=X,k=20"))
    d = diagnose(model, [table(seed, recorded=True)], draws=50)
    assert "no_temperature" not in {doubt.kind for doubt in d.doubts}
    assert "Record temperatures" not in d.sentence


def _runs_along_x(runs: int, memory_s: float) -> Whitener:
    """Noise of so many runs over six places, whose drift has a memory."""
    x, n = np.tile(np.linspace(10.0, 190.0, 6), runs), 6 * runs
    channels = {"x": x, "d_x": np.ones(n)}
    machine = small_machine()
    made = make_instrument("laser_linear", {}, "X", None, machine, "iso")
    times, numbers = 24.0 * np.arange(float(n)), np.repeat(np.arange(runs), 6)
    m = Measurement("iso", made, machine, numbers, times, channels, {"reading_um": np.zeros(n)})
    return Whitener(read([m]), (Noise(0.5, 1.0, memory_s, 0.0),), (np.zeros(0),))


@pytest.mark.parametrize(("runs", "memory_s", "columns"), [(8, 1.0, 8), (200, 1.0, HALF_WAVES), (200, 1e6, 2)])
def test_slopes_are_as_quick_as_the_memory_and_fit_a_long_record(runs: int, memory_s: float, columns: int) -> None:
    """Oracle: a quick drift gives each of eight runs its slope, a slow one a straight line; many have a bound."""
    slopes = slow_slopes(_runs_along_x(runs, memory_s))
    assert slopes.shape == (6 * runs, columns)
    assert np.linalg.matrix_rank(slopes) == columns


@pytest.mark.parametrize(("what", "seed"), [("warm_up_line", 83002), ("warm_up_drift", 83000)])
def test_what_only_follows_the_time_is_no_effect_of_the_machine(what: str, seed: int) -> None:
    """An instrument warms up, and the temperatures of the machine change. Oracle: nothing is missing."""
    trial = build("quiet", what, seed)
    d = diagnose(model_of(trial), measurements_of(trial))
    assert d.verdict == "undecided"
    assert d.unknown is None
    assert [x.kind for x in d.doubts] == ["instrument_warm_up"]
    assert "with the time of the record and with nothing else" in d.sentence


def test_what_grows_in_other_readings_puts_no_effect_in_doubt() -> None:
    """Squareness moves the tip along X while a reading along Z grows for hours. Oracle: the hidden effect."""
    hidden = generated(Case("singles", 88031, "tool_tip", "steps", ("squareness",)))
    m = measurement_of(hidden)
    d = diagnose(base_model(hidden, m), [m], draws=50)
    assert d.verdict == "missing_effect"
    assert d.findings[0].label == "squareness(EC0Y)"
    assert [(x.kind, x.fatal) for x in d.doubts] == [("no_temperature", False)]


def probe(seed: int, wander_um: float) -> Measurement:
    """Ten hours of a probe at the spindle, noise 0.25 µm; an Ornstein-Uhlenbeck process moves it, memory two hours.

    Two bodies have a sensor, and it follows neither.
    """
    rng, machine, n = np.random.default_rng(seed), small_machine(), 300
    time_s = np.linspace(60.0, 36_000.0, n)
    keeps = float(np.exp(-(time_s[1] - time_s[0]) / 7200.0))
    wander = [float(rng.standard_normal())]
    for _ in range(n - 1):
        wander.append(keeps * wander[-1] + np.sqrt(1.0 - keeps**2) * float(rng.standard_normal()))
    reading = wander_um * np.array(wander) + 0.25 * rng.standard_normal(n)
    bed, air = 20.0 + 2.0 * (1.0 - np.exp(-time_s / 6000.0)), 21.0 + 0.5 * np.sin(time_s / 3000.0)
    channels = {"x": np.full(n, 100.0), "z": np.full(n, 100.0), "T_bed": bed, "T_air": air}
    made = make_instrument("spindle_drift", {"probe": {"x": {"direction": "X"}}}, None, None, machine, "probe")
    return Measurement("probe", made, machine, np.ones(n, dtype=np.int64), time_s, channels, {"reading_x_um": reading})


@pytest.mark.parametrize("seed", proof.few([2, 4, 6, 8], 1))
def test_a_body_without_a_sensor_is_not_called_nothing(seed: int) -> None:
    """It moves by many times the noise. Oracle: what was put in."""
    d = diagnose(Model(small_machine(), ()), [probe(seed, 2.5)], draws=50)
    assert d.verdict == "undecided"
    assert [(x.kind, x.fatal) for x in d.doubts] == [("no_temperature", True)]
    assert d.sentence.startswith("probe reading_x_um grows and falls by ")
    assert d.sentence.endswith("In addition to T_bed, T_air, record temperatures of spindle, column.")


@pytest.mark.parametrize("seed", proof.few([2, 4, 6, 8], 2))
def test_an_instrument_that_drifts_by_no_more_than_twice_its_noise_is_no_alarm(seed: int) -> None:
    d = diagnose(Model(small_machine(), ()), [probe(seed, 0.4)], draws=50)
    assert d.verdict == "nothing_missing"
    assert not d.doubts


def test_a_part_that_follows_the_coolant_late_is_named() -> None:
    """A chiller that switches every 40 min moves a part 1.8 µm/K, 240 s late. Oracle: scipy's linear system, and noise.

    Without a delayed form a tilt between coolant and bed, of a small part of it, had come first.
    """
    machine, rng = small_machine(), np.random.default_rng(4)
    machine = replace(machine, sensors=(*machine.sensors, Sensor("T_coolant")))
    time_s = np.arange(0.0, 6.0 * 3600.0, 60.0)
    room = 20.0 + 0.5 * np.sin(time_s / 9000.0)
    coolant = room + lsim(([1.0], [300.0, 1.0]), 3.0 * (time_s % 2400.0 < 900.0), time_s)[1]
    part = 1.8 * lsim(([1.0], [240.0, 1.0]), coolant - coolant[0], time_s)[1]
    warm = {"T_bed": room + time_s / 40000.0, "T_air": room, "T_coolant": coolant}
    channels = {n: np.round(v + 0.02 * rng.standard_normal(len(v)), 2) for n, v in warm.items()}
    made = make_instrument("spindle_drift", {"probe": {"z": {"direction": "Z"}}}, None, None, machine, "probe")
    read_um = part + 0.2 * rng.standard_normal(len(part))
    run = np.ones(len(time_s), dtype=np.int64)
    m = Measurement("chiller", made, machine, run, time_s, channels, {"reading_z_um": read_um})
    first = diagnose(Model(machine, name="empty"), [m], draws=50).findings[0]
    assert first.effect.effect == "coolant_expansion"
    assert first.accepted
    assert abs(first.parameters["k"].value) == pytest.approx(1.8, rel=0.1)
    assert first.parameters["tau"].value == pytest.approx(240.0, rel=0.25)


def warming_laser(seed: int) -> Measurement:
    """Ten runs along X to and fro with heavy-tailed noise while the laser warms up by 1.5 µm; the machine is cold."""
    rng = np.random.default_rng(seed)
    there = np.linspace(5.0, 195.0, 14)
    x = np.tile(np.concatenate([there, there[::-1]]), 10)
    run = np.repeat(np.arange(10) + 1, 28)
    time_s = np.cumsum(7.0 + rng.exponential(0.7, len(x))) + 900.0 * (run - 1)
    reading = 0.2 * rng.standard_t(3, len(x)) + 1.5 * (1.0 - np.exp(-time_s / 2500.0))
    channels = {"x": x, "dir_x": np.tile(np.repeat([1.0, -1.0], 14), 10)}
    coarse, bed = np.arange(0.0, time_s[-1] + 20.0, 10.0), [20.5]
    for t in coarse[1:]:
        goal = 20.5 if t < 1500 else 31.0 if t < 9000 else 26.0 if t < 13000 else 35.0
        bed.append(bed[-1] + (goal - bed[-1]) * (1.0 - np.exp(-10.0 / 2200.0)))
    for name, degc in (
        ("T_bed", np.interp(time_s, coarse, bed)),
        ("T_air", 20.1 + 2.4 * (1.0 - np.exp(-time_s / 12000.0))),
    ):
        channels[name] = np.round(degc + 0.1 + 0.03 * rng.normal(size=len(x)), 1)
    return recorded_by_laser(seed, run, time_s, channels, np.round(reading, 1))


def test_two_lags_of_one_sensor_are_no_better_than_an_instrument_that_warms_up() -> None:
    """Of 75 seeds the one in which the air, late by two times with opposite signs, was taken for two effects."""
    found = diagnose(Model(small_machine(), (), name="bare"), [warming_laser(37)])
    assert found.verdict == "undecided", found.sentence
    assert [d.kind for d in found.doubts if d.fatal] == ["instrument_warm_up"]

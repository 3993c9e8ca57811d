"""Adding effects and refitting; oracles: least squares written down here, and the true effects of a simulation."""

import dataclasses
import re

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.diagnosis.extend.add import add, new_effect, refused
from rtec.diagnosis.extend.improve import improve
from rtec.diagnosis.search.diagnose import diagnose
from rtec.errors import ModelError
from rtec.estimation.candidates import library
from rtec.estimation.outliers import clean
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from rtec.model.history import History, steps_of
from rtec.report.history import history_page, improved_page, stairs
from tests.discovery.generator.cases import Case
from tests.discovery.generator.dataset import build, model_error, oracle_cut
from tests.discovery.translate import base_model, measurement_of, said_by
from tests.support import proof
from tests.support.diagnosis_examples import NOISE_UM, effects, laser, small_machine

Floats = NDArray[np.float64]
SCALE = "scale,component=EXX,axis=X,k=12"
SCALE_Z = "scale,component=EZZ,axis=Z,k=-7"
BACKLASH = "backlash,component=EXX,axis=X,B=3"
SEEDS = (3, 4)


def model_of(*texts: str, error: float | None = None) -> Model:
    """A model with these numbers; all standard errors alike where given."""
    fitted = effects(*texts)
    if error is not None:
        fitted = tuple(
            FittedEffect(f.effect, f.values, f.theta, dict.fromkeys((*f.values, *f.theta), error)) for f in fitted
        )
    return Model(small_machine(), fitted, name="test")


def blank(text: str, model: Model) -> FittedEffect:
    """The effect of a text, as one that is to be added: without its numbers."""
    return new_effect(effects(text)[0].effect, model)


def by_hand(measurements: list[Measurement]) -> tuple[Floats, Floats]:
    """Scale and backlash of X by least squares with a zero for each laser: numbers and standard errors.

    White noise of known size; position in m, half the direction; written without the library's columns.
    """
    blocks = []
    for i, m in enumerate(measurements):
        zeros = np.zeros((len(m), len(measurements)))
        zeros[:, i] = 1.0
        blocks.append(np.column_stack([1e-3 * m.channels["x"], 0.5 * m.state().value("d_x"), zeros]))
    design, reading = np.concatenate(blocks), np.concatenate([m.readings["reading_um"] for m in measurements])
    found: Floats = np.linalg.lstsq(design, reading, rcond=None)[0]
    errors: Floats = NOISE_UM * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    return found[:2], errors[:2]


def numbers(model: Model) -> dict[str, tuple[float, float]]:
    """Every number of a model with its standard error, by effect and name."""
    return {f"{f.label} {n}": (v, f.errors[n]) for f in model.effects for n, v in {**f.values, **f.theta}.items()}


@pytest.fixture(scope="module")
def measured() -> list[Measurement]:
    return [laser([SCALE, BACKLASH], seed) for seed in SEEDS]


def test_refit_is_least_squares_of_the_true_effects(measured: list[Measurement]) -> None:
    """Oracle: least squares here; the noise is white, so the weights of the two differ by what noise was found."""
    model = model_of("scale,component=EXX,axis=X,k=0")
    added = add(model, [blank(BACKLASH, model)], measured)
    value, error = by_hand(measured)
    found = numbers(added.model)
    for name, v, e, true in zip(("scale(EXX, X) k", "backlash(EXX, X) B"), value, error, (12.0, 3.0), strict=True):
        assert found[name][0] == pytest.approx(v, abs=0.5 * e)
        assert found[name][1] == pytest.approx(e, rel=0.2)
        assert found[name][0] == pytest.approx(true, abs=4.0 * found[name][1])


def test_errors_fall_to_the_noise(measured: list[Measurement]) -> None:
    """Oracle: half of 3 µm either way is what is missing before, noise alone after."""
    model = model_of(SCALE)
    added = add(model, [blank(BACKLASH, model)], measured)
    assert added.before.held_out == pytest.approx(np.hypot(1.5, NOISE_UM), rel=0.05)
    assert added.after.held_out == pytest.approx(NOISE_UM, rel=0.1)
    assert added.floor == pytest.approx(NOISE_UM, rel=0.1)
    assert added.better
    entry = added.model.history[-1]
    assert entry["rms_before"] == added.before.held_out
    assert entry["rms_after"] == added.after.held_out
    assert entry["effects"] == ["backlash(EXX, X)"]
    assert list(entry["measurements"]) == [m.name for m in measured]


def test_what_is_not_seen_stays(measured: list[Measurement]) -> None:
    """Oracle: a laser along X says nothing of Z: number and standard error as they were, bit for bit or nearly."""
    model = model_of(SCALE, SCALE_Z, "cyclic_pole,component=EZZ,axis=Z,s=1,c=0.5,period=37", error=0.25)
    added = add(model, [blank(BACKLASH, model)], measured)
    before, after = numbers(model), numbers(added.model)
    for name, (value, error) in before.items():
        if "EZZ" in name:
            assert after[name][0] == pytest.approx(value, rel=1e-9), name
            assert after[name][1] == pytest.approx(error, rel=1e-6), name
    assert after["scale(EXX, X) k"][0] == pytest.approx(12.0, abs=0.5)


def test_what_is_seen_may_move_far() -> None:
    """Oracle: the true scale, 36 µm/m from where the model, sure of itself, believed it."""
    model = model_of("scale,component=EXX,axis=X,k=48", error=2.0)
    refitted = add(model, [], [laser([SCALE], 5)])
    assert numbers(refitted.model)["scale(EXX, X) k"][0] == pytest.approx(12.0, abs=0.3)
    assert refitted.model.history[-1]["change"] == "refit"
    assert refitted.before.as_given is not None
    # 36 µm/m over the travel, less the mean of each run: that of a straight line of this length.
    assert refitted.before.as_given == pytest.approx(36e-3 * 192.0 / np.sqrt(12.0), rel=0.08)


def test_a_poor_new_measurement_does_not_undo_a_good_model() -> None:
    """Oracle: the mean of what was known and what is read now, each weighted by one over its variance."""
    known, sure = 12.4, 0.5
    poor = laser([SCALE], 21, noise={"white_um": 4.0}, protocol="cold", cycles=3)
    values, errors = by_hand([poor])
    value, error = float(values[0]), float(errors[0]) * 4.0 / NOISE_UM
    assert error > 2.0 * sure
    expected = (known / sure**2 + value / error**2) / (1.0 / sure**2 + 1.0 / error**2)
    refitted = add(model_of(f"scale,component=EXX,axis=X,k={known}", error=sure), [], [poor])
    found, spread = numbers(refitted.model)["scale(EXX, X) k"]
    assert found == pytest.approx(expected, abs=0.1)
    assert spread == pytest.approx(1.0 / np.sqrt(1.0 / sure**2 + 1.0 / error**2), rel=0.1)


def test_the_same_readings_again_make_nothing_surer() -> None:
    """Oracle: the first fit; counted twice, the same readings would halve the variance."""
    once = dataclasses.replace(laser([SCALE], 22), sha256="a" * 64)
    first = add(model_of("scale,component=EXX,axis=X,k=0"), [], [once]).model
    again = add(first, [], [once]).model
    for name, (value, error) in numbers(first).items():
        assert numbers(again)[name][0] == pytest.approx(value, abs=0.02 * error)
        assert numbers(again)[name][1] == pytest.approx(error, rel=0.02)


def test_readings_in_memory_are_known_again_as_those_of_a_file_are() -> None:
    """Oracle: the same readings with the check sum of a file. A second step judges and fits both alike."""
    m, other = laser([SCALE, BACKLASH], SEEDS[0]), laser([SCALE, BACKLASH], SEEDS[1])
    steps = []
    for given in (m, dataclasses.replace(m, sha256="of a file")):
        first = add(model_of(), [blank(SCALE, model_of())], [given])
        steps.append(add(first.model, [blank(BACKLASH, model_of())], [given]))
    memory, file = steps
    assert (memory.before, memory.after) == (file.before, file.after)
    assert numbers(memory.model) == numbers(file.model)
    assert len({m.fingerprint, other.fingerprint, dataclasses.replace(m, time_s=m.time_s + 1.0).fingerprint}) == 3


def test_an_effect_that_is_not_there_does_not_look_better() -> None:
    """Oracle: noise alone; a straight line and twelve shapes more are fitted to it."""
    model = model_of("scale,component=EXX,axis=X,k=0")
    more = "polynomial_position,component=EXX,axis=X,degrees=[2,3,4,5,6,7,8],c2=0,c3=0,c4=0,c5=0,c6=0,c7=0,c8=0"
    added = add(model, [blank(more, model)], [laser([SCALE], 11)])
    assert not added.better
    assert added.after.inside < added.before.inside
    assert added.after.held_out > added.before.held_out


def test_periods_are_searched_for() -> None:
    """Oracle: the true period of the wave; the search begins 5 % away."""
    wave = "cyclic_pole,component=EXX,axis=X,s=2,c=-1,period=37.3"
    model = model_of(SCALE)
    start = new_effect(effects(wave)[0].effect, model, {"period": 39.0})
    added = add(model, [start], [laser([SCALE, wave], 3, targets={"step_mm": 4.1}, protocol="cold", cycles=6)])
    found = numbers(added.model)["cyclic_pole(EXX, X) period"]
    assert found[0] == pytest.approx(37.3, abs=4.0 * found[1])
    assert found[1] < 0.5


def test_a_period_that_nobody_gave_is_found_anywhere_in_its_range() -> None:
    """Oracle: the true period of the wave; the usual one of a gear, 16 mm, is far away."""
    wave = "cyclic_pole,component=EXX,axis=X,s=2,c=-1,period=37.3"
    model = model_of(SCALE)
    added = add(
        model, [blank(wave, model)], [laser([SCALE, wave], 3, targets={"step_mm": 4.1}, protocol="cold", cycles=6)]
    )
    found = numbers(added.model)["cyclic_pole(EXX, X) period"]
    assert added.better
    assert found[0] == pytest.approx(37.3, abs=4.0 * found[1])


def test_ranges_grow_and_never_shrink(measured: list[Measurement]) -> None:
    """Oracle: a range that the model knew before, wider than what was measured now."""
    model = Model(small_machine(), effects(SCALE), name="test", valid_range={"x": (-50.0, 100.0)})
    added = add(model, [blank(BACKLASH, model)], measured)
    low, high = added.model.valid_range["x"]
    assert low == -50.0
    assert high >= max(float(m.channels["x"].max()) for m in measured)


def test_measurements_that_are_not_given_are_named(measured: list[Measurement]) -> None:
    model = Model(small_machine(), effects(SCALE), name="test", measurements={"old-laser-z": "0" * 64})
    assert "old-laser-z" in " ".join(add(model, [], measured).notes)


def test_what_nothing_moves_is_refused(measured: list[Measurement]) -> None:
    """Oracle: Z stands still under a laser along X."""
    model = model_of(SCALE)
    with pytest.raises(ModelError, match=r"no reading shows scale\(EZZ, Z\)"):
        add(model, [blank(SCALE_Z, model)], measured)


def test_what_the_instrument_takes_up_is_refused() -> None:
    """Oracle: Z stands still at 130 mm, so its scale adds one and the same length to all readings: the laser's zero."""
    model = model_of(SCALE, error=0.1)
    aside = laser([SCALE], 3, targets={"step_mm": 13.7, "at_mm": {"Z": [130.0]}})
    with pytest.raises(ModelError, match=r"no reading shows scale\(EXX, Z\)"):
        add(model, [blank("scale,component=EXX,axis=Z,k=1", model)], [aside])


def test_twice_is_refused(measured: list[Measurement]) -> None:
    model = model_of(SCALE, BACKLASH)
    with pytest.raises(ModelError, match="backlash"):
        add(model, [blank(BACKLASH, model)], measured)


def test_a_number_that_it_does_not_have() -> None:
    model = model_of(SCALE)
    with pytest.raises(ModelError, match="no number 'thickness'"):
        new_effect(effects(BACKLASH)[0].effect, model, values={"thickness": 1.0})


def test_what_follows_a_temperature_late_is_added_beside_the_same_at_once() -> None:
    """A screw 40 min behind its sensor. Oracle: Euler steps of a second written down here."""
    at_once = "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=11"
    m, tau_s = laser([SCALE], 5), 2400.0
    seconds = np.arange(m.time_s[0], m.time_s[-1] + 1.0)
    sensor, late = np.interp(seconds, m.time_s, m.channels["T_bed"] - 20.0), np.empty(len(seconds))
    late[0] = sensor[0]
    for i in range(1, len(seconds)):
        late[i] = late[i - 1] + (sensor[i] - late[i - 1]) / tau_s
    grown = 11e-3 * m.channels["x"] * np.interp(m.time_s, seconds, late)
    m = dataclasses.replace(m, readings={"reading_um": m.readings["reading_um"] + grown})
    d = diagnose(model_of(SCALE, at_once), [m], draws=20, only=["axis_expansion", "mount_expansion"])
    first = d.findings[0]
    assert d.verdict == "missing_effect"
    assert (first.effect.effect, getattr(first.effect, "lag", None)) == ("axis_expansion", True)
    made = add(model_of(SCALE, at_once), [new_effect(first.effect, model_of(SCALE), first.theta)], [m])
    assert made.labels == ("axis_expansion(EXX, X, T_bed), lag",)
    found = made.model.effects[-1]
    assert abs(found.theta["tau"] - tau_s) < 3.0 * found.errors["tau"]
    assert abs(found.values["k"] - 11.0) < 3.0 * found.errors["k"]
    assert found.errors["tau"] < 0.5 * tau_s
    assert made.after.inside < 1.1 * NOISE_UM


def test_any_effect_of_the_model_that_follows_a_temperature_may_follow_it_late() -> None:
    """Oracle: the list of candidates. Heat in a ball screw's nut is tried late only where the model has it at once."""
    readings = clean([laser([SCALE], 5)]).readings
    there = model_of("backlash_temperature,component=EXX,axis=X,sensor=T_bed,k=2").effects
    with_it, without = (library(readings, ["backlash_temperature"], known)[0] for known in (there, ()))
    late = [c.effect for c in with_it if getattr(c.effect, "lag", False)]
    assert late == [there[0].effect.model_copy(update={"lag": True})]
    assert not any(getattr(c.effect, "lag", False) for c in without)


def trailing_slide(q_mm: Floats, feed_mm_s: Floats, gain_per_s: float) -> Floats:
    """How far a slide is behind where it is read, µm: its loop in steps of a millisecond, ways of positions in order.

    Before each way it stands still, half a millimetre beyond the first position.
    """
    out = np.empty(len(q_mm))
    for way in np.split(np.arange(len(q_mm)), np.flatnonzero(np.diff(feed_mm_s)) + 1):
        v, slide = feed_mm_s[way[0]], 0.0
        when = (np.abs(q_mm[way] - q_mm[way[0]]) + 0.5) / abs(v)
        lag = []
        for step in range(1, int(1000.0 * when[-1]) + 2):
            slide += 1e-3 * gain_per_s * (1e-3 * step * v - slide)
            lag.append(1e-3 * step * v - slide)
        out[way] = -1e3 * np.interp(when, 1e-3 * np.arange(1, len(lag) + 1), lag)
    return out


def test_a_servo_that_lags_only_some_way_after_a_reversal_is_one_effect() -> None:
    """Oracle: the loop itself, step by step, of which feed-forward leaves a thousandth."""
    m = laser([SCALE], 5)
    rng, way = np.random.default_rng(7), m.state().value("d_x")
    v = way * rng.choice([10.0, 20.0, 80.0], int(m.run.max()) + 1)[m.run]
    lag = trailing_slide(m.channels["x"], v, gain_per_s=8.0)
    m = dataclasses.replace(
        m, channels={**m.channels, "d_x": way, "v_x": v}, readings={"reading_um": m.readings["reading_um"] + 1e-3 * lag}
    )
    only = ["servo_lag", "lost_motion", "backlash", "reversal_spike"]
    d = diagnose(model_of(SCALE), [m], draws=20, only=only)
    assert (d.verdict, d.findings[0].label) == ("missing_effect", "servo_lag(EXX, X)")
    settled = effects("servo_lag,component=EXX,axis=X,tau=0")[0].effect
    plain, grown = (
        add(model_of(SCALE), [new_effect(e, model_of(SCALE), t)], [m])
        for e, t in ((settled, {}), (d.findings[0].effect, d.findings[0].theta))
    )
    assert grown.model.effects[-1].values["tau"] == pytest.approx(-1.0 / 8.0, rel=0.02)
    assert grown.after.inside < 1.15 * NOISE_UM < 0.6 * plain.after.inside


def test_an_effect_is_added_though_a_jump_misleads_the_numbers_of_the_model() -> None:
    """A wave, and a jump in the middle of the record. Oracle: both were hidden; the model knew the rest.

    Refitted along with the wave, the model's own numbers follow the jump, and held-out runs are predicted worse. The
    jump belongs to the record.
    """
    case = Case("pairs", 1038, "laser", "random_walk", ("coupling_misalignment", "missed_counts"))
    hidden = build(case)
    m = measurement_of(hidden)
    known = base_model(hidden, m)
    done = improve(known, [m], draws=50)
    assert [s.labels for s in done.steps] == [("coupling_misalignment(EYY, Y)",)]
    assert [e.label for e in done.events] == ["missed_counts(EYY, Y)"]
    assert done.steps[0].own_kept == len(known.effects)
    assert done.steps[0].model.effects[: len(known.effects)] == known.effects


@pytest.mark.parametrize(("seed", "effect"), proof.few([(86035, "polynomial_position"), (86050, "backlash_load")], 1))
def test_numbers_that_a_drift_hides_are_refitted_with_what_is_new(seed: int, effect: str) -> None:
    """A laser's zero wanders by more than the effect, and the model's own numbers are out of date.

    Oracle: the true shapes, fitted by ordinary least squares to the same readings, on other runs.
    """
    noise = {86035: "daily", 86050: "random_walk"}[seed]
    hidden = build(Case("singles", seed, "laser", noise, (effect,)))
    m = measurement_of(hidden)
    done = improve(base_model(hidden, m), [m], draws=50)
    _, true = oracle_cut(hidden)
    assert [f.effect.effect for f in done.model.effects][-1] == effect
    assert model_error(hidden, said_by(done.model, m)) < 1.5 * true
    last = done.steps[-1]
    told = any("mostly slow drift" in n for n in last.notes)
    assert told is (last.after.held_out > 0.98 * last.before.held_out)
    lead = improved_page(done, figures=False).lead
    hidden_by_drift = last.after.held_out > done.steps[0].before.held_out
    assert ("beyond that drift it fell from" in lead) is hidden_by_drift
    names, errors, _ = stairs(steps_of(done.model))
    assert ("beyond slow drift: " in names[-1]) is hidden_by_drift is (errors[-1] > errors[0])
    table = history_page(History(done.model), figures=False).sections[0].table
    assert table is not None
    assert table.rows[-1][3].endswith(" % beyond drift") is hidden_by_drift


def test_an_improvement_that_ends_says_what_slow_drift_remains() -> None:
    """Oracle: the drift that is simulated; play is hidden beside it."""
    record = laser(
        ["backlash,component=EXX,axis=X,B=8"], 2, noise={"white_um": 0.3, "drift_um": 1.0, "drift_tau_s": 2400.0}
    )
    done = improve(Model(small_machine(), name="empty"), [record], draws=50)
    assert [s.labels for s in done.steps] == [("backlash(EXX, X)",)]
    assert re.search(r"ended because no effect .*; [01]\.\d+ µm is slow drift", improved_page(done, figures=False).lead)


def test_an_expansion_beyond_every_material_is_not_added() -> None:
    """A sensor that shows a sixth of the warmth: the refit is better by far, and wrong on another day."""
    model = model_of(SCALE)
    grown = "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=70"
    made = add(model, [blank(grown, model)], [laser([SCALE, grown], 3)])
    assert made.after.held_out < 0.5 * made.before.held_out
    assert not made.better
    assert re.search(r"k = \d+(\.\d+)? µm/\(m·K\), and no material of a machine expands so much$", refused(made))
    usual = "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=11"
    assert add(model, [blank(usual, model)], [laser([SCALE, usual], 3)]).better


@pytest.mark.parametrize("seed", proof.few([5, 6, 1, 2, 3, 4, 7, 8], 2))
def test_a_shift_by_a_coarse_sensor_keeps_its_number(seed: int) -> None:
    """Steps of the sensor are noise to what follows each reading: such a fit gave 1.5 µm/K, and left 1.2 µm."""
    base = (SCALE, "backlash,component=EXX,axis=X,B=2.2")
    known = add(model_of(*base), [], [laser(base, 90)]).model
    m = laser(base, seed)
    part = m.time_s / m.time_s[-1]
    warm = 2.0 * (1.0 - np.cos(3.0 * part + 0.3 * seed) + 0.1 * np.sin(11.0 * part + seed))
    channels = {**m.channels, "T_bed": np.round((20.0 + warm) / 0.25) * 0.25}
    m = dataclasses.replace(m, readings={k: v + 3.0 * warm for k, v in m.readings.items()}, channels=channels)
    made = add(known, [blank("mount_expansion,component=EXX,sensor=T_bed,k=3", known)], [m])
    assert made.model.effects[-1].values["k"] == pytest.approx(3.0, abs=0.3)
    assert made.after.inside < 1.1 * made.after.held_out

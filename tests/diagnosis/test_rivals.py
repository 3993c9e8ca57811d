"""What is not asserted: rivals of each of several effects, runs that differ, an instrument that warms up."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.bench.rig import campaign
from rtec.bench.rig.machine import day
from rtec.bench.sets import measurements_of, model_of
from rtec.bench.trials import Trial, build
from rtec.diagnosis import words
from rtec.diagnosis.heat import INSTRUMENT, warm_up_curves
from rtec.diagnosis.result import Diagnosis, Member
from rtec.diagnosis.search.answer import _Answer
from rtec.diagnosis.search.confounded import alike, bent_part, plausibility
from rtec.diagnosis.search.diagnose import Search, diagnose, leaner_first
from rtec.effects import effect_class
from rtec.estimation.candidates import library
from rtec.estimation.outliers import clean
from rtec.estimation.readings import read
from rtec.machine import machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from rtec.sim.campaign.truth import effect_from_text
from tests.discovery.generator.cases import Case
from tests.discovery.generator.dataset import build as generated
from tests.discovery.translate import base_model, measurement_of
from tests.support import proof
from tests.support.diagnosis_examples import TABLE, effects, laser, read_by, small_machine

Floats = NDArray[np.float64]
Channels = Mapping[str, Floats]


def _effect(name: str, **arguments: object):  # type: ignore[no-untyped-def]
    return effect_class(name, "test").model_validate({"effect": name, **arguments})


def _day_line(
    seed: int, error: Callable[[Channels], Floats], nut: Callable[[Channels], Floats] | None = None
) -> tuple[Model, list[Measurement]]:
    """Twelve runs in six hours, each with a load of its own; `error` is read by a laser along X, µm; `nut` is a
    temperature other than that of the day.
    """
    rng = np.random.default_rng(seed)
    plan = campaign.line(rng, runs=12, per_way=8, hours=6.0)
    channels = dict(campaign.recorded(plan, day(rng, 5.0), rng))
    known = {**channels, "hours": (plan.time_s - plan.time_s[0]) / 3600.0}
    if nut is not None:
        known["T_nut"] = nut(known)
        channels["T_nut"] = known["T_nut"] + 0.02 * rng.standard_normal(len(known["T_nut"]))
    read_um = {"EXX": error(known)}
    trial = Trial("test", "runs", seed, "natural", (campaign.read(plan, read_um, rng, "white", channels),))
    return model_of(trial), measurements_of(trial)


def _short_line(seed: int, loss_um: float = 0.0, load_um: float = 0.0, zero_um: float = 0.0) -> Trial:
    """Eight short runs of which each has a zero of its own; counts are lost between the fourth and the fifth."""
    rng = np.random.default_rng(seed)
    plan = campaign.line(rng, runs=8, per_way=12, hours=4.0)
    error = zero_um * rng.standard_normal(8)[plan.run - 1] + load_um * plan.load_kg / 300.0 + loss_um * (plan.run > 4)
    channels = campaign.recorded(plan, day(rng, 5.0), rng)
    return Trial("test", "runs", seed, "natural", (campaign.read(plan, {"EXX": error}, rng, "white", channels),))


def test_every_pause_is_an_instant_that_is_tried() -> None:
    """Oracle: the times of the runs. Something is lost between two runs rather than within one."""
    trial = _short_line(1)
    readings = read(measurements_of(trial))
    (lost,) = [c for c in library(readings, ["missed_counts"])[0] if c.effect.component == "EXX"]
    tried = np.array([t["t0"] for t in lost.thetas])
    s = readings.series[0]
    for k in range(7):
        ends, begins = s.time_s[s.run == k][-1], s.time_s[s.run == k + 1][0]
        assert ((tried > ends) & (tried < begins)).any()


def test_counts_that_were_lost_between_two_runs_are_named() -> None:
    """Oracle: the record was made so; an offset of each run does not take a loss up that stays."""
    trial = _short_line(3, loss_um=4.0)
    d = diagnose(model_of(trial), measurements_of(trial), draws=50)
    assert d.verdict in ("missing_effect", "ambiguous")
    first = d.findings[0]
    assert first.effect.effect == "missed_counts"
    time, run = trial.records[0].plan.time_s, trial.records[0].plan.run
    assert time[run == 4].max() < first.theta["t0"] < time[run == 5].min()


def test_runs_that_differ_are_never_nothing_where_something_may_explain_them() -> None:
    """Zeros of the runs by chance, and a load: too few runs decide, but the load predicts held-out runs by a third."""
    trial = _short_line(11, load_um=1.0, zero_um=0.8)
    d = diagnose(model_of(trial), measurements_of(trial), draws=50)
    assert d.verdict == "undecided"
    assert "the runs differ by" in d.sentence
    assert "load_deformation" in d.sentence


def test_an_instrument_that_warms_up_by_itself_is_no_effect() -> None:
    """Nothing is hidden; each probe drifts as 1 - exp(-t/τ) from its first reading on, and back once it is off."""
    trial = build("quiet", "warm_up_drift", 301)
    d = diagnose(model_of(trial), measurements_of(trial), draws=50)
    assert d.verdict == "undecided"
    assert "instrument_warm_up" in {x.kind for x in d.doubts}
    assert "warms up by itself" in d.sentence


@pytest.mark.parametrize(("seed", "sensor"), [(3, "T_nut"), (3, "T_air"), (2, "T_air")])
def test_a_load_and_a_temperature_that_change_from_run_to_run_are_named_together(seed: int, sensor: str) -> None:
    """What either leaves looks like runs that differ by chance. Oracle: both were put in, and nothing else."""

    def error(c: Channels) -> Floats:
        return np.asarray(c["load_kg"] / 300.0 + (c[sensor] - c[sensor].mean()) / c[sensor].std())

    model, day_of = _day_line(seed, error)
    d = diagnose(model, day_of, draws=50)
    assert d.verdict in ("missing_effect", "ambiguous")
    first, second = sorted((m.fitted.effect for m in d.together), key=lambda effect: effect.effect)
    assert first.effect == "load_deformation"
    assert second.channels(model.machine) == (sensor,)


@pytest.mark.parametrize("seed", proof.few([1, 4], 1))
def test_a_load_of_its_own_in_each_run_is_no_part_of_a_slow_growth(seed: int) -> None:
    """Loads in any order stretch the runs, and the zero grows and falls by 8 µm. Oracle: both were put in."""

    def error(c: Channels) -> Floats:
        slow = 4.0 * np.sin(2.0 * np.pi * c["hours"] / 7.0 + 0.4)
        return np.asarray(0.01 * c["load_kg"] * (c["x"] - 300.0) / 300.0 + slow)

    model, day_of = _day_line(seed, error)
    d = diagnose(model, day_of, draws=50)
    assert d.verdict in ("missing_effect", "ambiguous")
    assert d.findings[0].effect.effect == "load_deformation"
    assert [(doubt.kind, doubt.fatal) for doubt in d.doubts] == [("no_temperature", False)]


@pytest.mark.parametrize(("seed", "load"), [(2, 1.5), (2, 2.5), (4, 2.5)])
def test_an_instrument_that_warms_up_hides_no_load(seed: int, load: float) -> None:
    """A load, and a zero that rises as a nut and an instrument both do. Oracle: only the load changes in any order."""

    def error(c: Channels) -> Floats:
        return np.asarray(load * c["load_kg"] / 300.0 + 1.1 * (c["T_nut"] - 20.0))

    def warming(c: Channels) -> Floats:
        return np.asarray(20.0 + 3.5 * (1.0 - np.exp(-c["hours"] / 1.2)))

    model, day_of = _day_line(seed, error, nut=warming)
    d = diagnose(model, day_of, draws=50)
    assert d.verdict in ("missing_effect", "ambiguous")
    assert d.findings[0].effect.effect == "load_deformation"
    assert {m.fitted.effect.effect for m in d.together} <= {"load_deformation"}
    assert [doubt.kind for doubt in d.doubts] == ["instrument_warm_up"]
    assert "instrument that warms up by itself" in d.sentence


def test_what_depends_on_a_position_or_is_large_is_no_instrument() -> None:
    """Oracle: an instrument that warms up does not know where the axis is, and drifts by a few µm."""
    readings = read(measurements_of(_short_line(2)))
    part = np.linspace(0.0, 0.9 * INSTRUMENT, len(readings))
    sensor = "T_nut"
    grows, along = (
        _effect("mount_expansion", component="EXX", sensor=sensor),
        _effect("axis_expansion", component="EXX", axis="X", sensor=sensor),
    )
    assert warm_up_curves(readings, grows.channels(readings.machine), part)
    assert not warm_up_curves(readings, grows.channels(readings.machine), 3.0 * part)
    assert not warm_up_curves(readings, along.channels(readings.machine), part)


def test_effects_that_explain_other_parts_are_no_rivals() -> None:
    """Oracle: the definition. Two of nearly the same evidence whose shapes have nothing in common are both missing."""
    one = _effect("axis_expansion", component="EXX", axis="X", sensor="T_nut")
    other = _effect("cyclic_screw", component="EXX", axis="X")
    assert alike(one, other, 0.05, 1.0).apart
    assert not alike(one, other, 0.6, 1.0).apart


def test_a_rival_of_the_same_name_differs_in_its_name() -> None:
    """Oracle: the argument in which both differ."""
    one, other = (
        _effect("axis_expansion", component="EXX", axis="X", sensor="T_nut", fixed_mm=f) for f in (0.0, 260.0)
    )
    assert alike(one, other, 0.99, 1.0).label == "axis_expansion(EXX, X, T_nut), fixed at 260 mm"
    assert alike(other, one, 0.99, 1.0).label != alike(one, other, 0.99, 1.0).label


def test_each_of_several_effects_is_told_with_its_rivals() -> None:
    """Oracle: the names that were given."""
    bow, warm = (
        _effect("polynomial_position", component="EXX", axis="X", degrees=[2]),
        _effect("axis_expansion_nonuniform", component="EXX", axis="X", sensor="T_nut"),
    )
    first = Member(FittedEffect(_effect("angular_motion", component="EBX", axis="X"), {}), 0.4)
    second = Member(FittedEffect(bow, {}), 0.5, (warm.label,))
    trial = _short_line(5)
    d = diagnose(model_of(trial), measurements_of(trial), draws=50)
    told: Diagnosis = words.with_sentence(replace(d, together=(first, second)), 0.1)
    assert "or axis_expansion_nonuniform(EXX, X, T_nut) in its place" in told.sentence
    assert told.sentence.count("T_nut") == 1


def test_two_shifts_of_opposite_signs_may_be_one_part_that_bends() -> None:
    """Oracle: the formula of column_tilt, k (T_front - T_back)."""
    front, back, air = (
        _effect("mount_expansion", component="EX0spindle", sensor=s) for s in ("T_front", "T_back", "T_air")
    )
    found = bent_part(back, -2.0, [(air, 0.1), (front, 2.5)])
    assert found is not None
    assert found.label == "column_tilt(T_front, T_back)"
    assert bent_part(back, 2.0, [(front, 2.5)]) is None
    assert bent_part(back, -2.0, [(front, 9.0)]) is None
    assert bent_part(_effect("mount_expansion", component="EZ0spindle", sensor="T_back"), -2.0, [(front, 2.5)]) is None


def test_every_sensor_that_moves_as_the_named_one_does_is_a_rival() -> None:
    """Oracle: two sensors that show the third's rise times 0.9 and 1.2, but for a hundredth of a kelvin."""
    machine = machine_from({**TABLE, "temperature": {n: {} for n in ("T_bed", "T_nut", "T_left")}}, "small")
    m, rng = laser(["scale,component=EXX,axis=X,k=12"], 5), np.random.default_rng(1)
    rise = m.channels["T_bed"] - 20.0
    others = {n: 20.0 + k * rise + 0.01 * rng.standard_normal(len(m)) for n, k in (("T_nut", 0.9), ("T_left", 1.2))}
    m = replace(
        m, machine=machine, channels={**m.channels, **others},
        instrument=make_instrument("laser_linear", {}, "X", None, machine, "test"),
        readings={"reading_um": m.readings["reading_um"] + 11e-3 * m.channels["x"] * rise},
    )  # fmt: skip
    model = Model(machine, (effect_from_text("scale,component=EXX,axis=X,k=12", machine),), name="test")
    d = diagnose(model, [m], draws=20, only=["axis_expansion"])
    assert d.verdict == "ambiguous"
    names = {d.findings[0].label, *(a.label.removesuffix(", lag") for a in d.findings[0].confused_with)}
    assert names == {f"axis_expansion(EXX, X, {sensor})" for sensor in machine.sensor_names}
    assert all(name in d.sentence for name in names)


def test_sensors_that_predict_alike_stay_rivals_within_what_a_sensor_can_feign() -> None:
    """Oracle: the rule; a late sensor was 13 000 to 1 likelier than the right one, at the same held-out error."""
    shifts = [_effect("mount_expansion", component="EXX", sensor=s) for s in ("T_air", "T_bed")]
    asked: Any = object.__new__(_Answer)
    asked.readings = SimpleNamespace(machine=small_machine())
    candidates = [SimpleNamespace(effect=e) for e in (*shifts, shifts[0], shifts[1])]
    asked.s = SimpleNamespace(chain=(), prior_odds=3.0, candidates=candidates)

    def fitted(number: int, log_evidence: float, drop: float) -> Any:
        return SimpleNamespace(number=number, log_evidence=log_evidence, drop=drop, within=drop, holds=True)

    shapes = np.array([[1.0, 0.0], [0.8, 0.6], [1.0, 0.0], [0.0, 1.0]])
    found: Any = SimpleNamespace(contribution=lambda number: shapes[number])
    winner = fitted(0, 60.0, 0.982)
    assert asked._disputes(found, winner, fitted(1, 60.0 - math.log(13_000.0), 0.981))
    assert not asked._disputes(found, winner, fitted(1, 40.0, 0.981))
    assert not asked._disputes(found, winner, fitted(1, 55.0, 0.95))
    assert not asked._disputes(found, winner, fitted(2, 55.0, 0.981))  # the same sensor


def test_what_halves_the_held_out_error_of_runs_that_differ_is_said_though_a_drift_is_likelier() -> None:
    """A column leans while the zero wanders for hours. Oracle: the hidden effect; "nothing is missing" is false."""
    trial = build("run_level", "column_lean", 83000)
    d = diagnose(model_of(trial), measurements_of(trial), draws=50)
    assert d.verdict == "undecided"
    assert d.findings[0].heldout_drop > 0.5
    assert "the runs differ by 2.40 µm" in d.sentence


def test_many_numbers_over_few_runs_are_not_named_where_chance_is_not_excluded() -> None:
    """Noise with heavy tails: a curve of eleven numbers follows the runs. Oracle: nothing is hidden."""
    clean = generated(Case("clean", 82056, "straightness", "heavy", ()))
    m = measurement_of(clean)
    assert diagnose(base_model(clean, m), [m]).verdict == "nothing_missing"


def test_what_predicts_better_may_explain_it_though_it_is_not_significant_by_itself() -> None:
    """The column leans by less than the noise; what the spindle's temperature explains of it was asserted.

    Oracle: the hidden effect.
    """
    trial = build("run_level", "column_lean", 83001, "faint")
    d = diagnose(model_of(trial), measurements_of(trial))
    assert d.verdict == "undecided"
    assert not any(f.accepted for f in d.findings)
    assert d.findings[0].label.startswith("column_tilt")
    assert "T_front, T_back" in d.findings[0].label
    assert f"{d.findings[0].label} may explain it" in d.sentence


def test_of_sensors_that_predict_alike_the_effect_of_fewer_numbers_is_first() -> None:
    """Oracle: numbers and shares of the held-out error that were given."""
    machine = small_machine()

    def fitted(lag: bool, drop: float, *channels: str, evidence: float = 55.0) -> Any:
        return SimpleNamespace(
            number=0, theta={"tau": 600.0} if lag else {}, columns=np.zeros((3, 1)), drop=drop, holds=True,
            log_evidence=evidence, channels=channels,
        )  # fmt: skip

    late, plain, poor = (
        fitted(True, 0.982, "T_air", evidence=60.0),
        fitted(False, 0.981, "T_bed"),
        fitted(False, 0.97, "T_bed"),
    )
    same, place, faint = (
        fitted(False, 0.982, "T_air"),
        fitted(False, 0.982, "d_x"),
        fitted(False, 0.981, "T_bed", evidence=49.0),
    )

    def first(*given: Any) -> Any:
        for i, t in enumerate(given):
            t.number = i
        effects: Any = {t.number: SimpleNamespace(component="EXX", channels=lambda _, of=t: of.channels) for t in given}
        return leaner_first(list(given), effects, machine, 5.0)[0]

    assert first(late, poor, plain) is plain
    assert first(late, poor) is late
    assert first(plain, late) is plain
    assert first(late, same, place) is late
    assert first(late, faint) is late
    # A law by the speed knows nothing of the hours before the record; one that follows it at once needs no hours.
    warming, at_once = (
        fitted(True, 0.982, "spindle_rpm", evidence=60.0),
        fitted(False, 0.982, "spindle_rpm", evidence=60.0),
    )
    assert first(warming, plain) is plain
    assert first(warming, poor) is warming
    assert first(warming, fitted(True, 0.982, "T_bed")) is warming
    assert first(at_once, plain) is at_once


@pytest.mark.parametrize(("instrument", "setup", "led_by"), [
    ("straightness", {"direction": "Z"}, "straightness"), ("level", {"about": "B"}, "angular_motion"),
])  # fmt: skip
def test_of_one_shape_what_is_read_directly_leads(instrument: str, setup: dict[str, str], led_by: str) -> None:
    """Oracle: what the instrument reads: a shift along Z, or an angle; both laws have one shape in the readings."""
    m = read_by(instrument, ["angular_motion,component=EBX,axis=X,c2=30,c3=0"], 3, setup=setup)
    search = Search(Model(small_machine(), (), name="m"), clean([m]), 1, 0.05, 50, None, False, lambda *_: None)
    found = search.refits.refitted(search.refits.weigh_all(search._projected), search.refits.weigh_without_drift())
    names = {t.number: search.candidates[t.number].effect.effect for t in found}
    angle = next(t for t in found if names[t.number] == "angular_motion")
    ordered = search._direct_first([angle, *(t for t in found if t is not angle)])
    assert names[ordered[0].number] == led_by
    assert set(map(id, ordered)) == set(map(id, found))


def test_two_waves_of_nearly_one_period_are_one() -> None:
    """Oracle: the periods: 9.97 and 10.03 mm are one wave that beats, 5 mm is another wave."""
    m = laser(["cyclic_screw,component=EXX,axis=X,s1=1,c1=0,pitch=5"], 3, targets={"step_mm": 1.7})
    search = Search(Model(small_machine(), (), name="m"), clean([m]), 1, 0.05, 50, None, False, lambda *_: None)
    names = [(c.effect.effect, c.effect.component) for c in search.candidates]
    screw: Any = SimpleNamespace(number=names.index(("cyclic_screw", "EXX")), theta={"pitch": 10.03})
    pole = names.index(("cyclic_pole", "EXX"))
    assert search.refits._same_wave(pole, {"period": 9.97}, screw)
    assert not search.refits._same_wave(pole, {"period": 5.0}, screw)
    assert not search.refits._same_wave(names.index(("backlash", "EXX")), {}, screw)


def test_a_drive_lags_rather_than_leads() -> None:
    """A lag of X and a lead of Y are one to a circle. Oracle: the sign of the lag, negative behind the command."""
    machine = small_machine()
    effect = effect_class("servo_lag", "test").model_validate({"effect": "servo_lag", "component": "EXX", "axis": "X"})
    behind, ahead = (plausibility(effect, np.array([tau]), machine) for tau in (-0.35, 0.35))
    assert behind == pytest.approx(ahead + np.log(10.0))


def test_another_delay_of_a_known_expansion_must_remove_more_than_a_late_sensor_makes() -> None:
    """Oracle: the rule of docs/diagnose.md. By another sensor, or for another component, the share does not matter."""
    known, late, other = effects(
        "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=10",
        "axis_expansion,component=EXX,axis=X,sensor=T_bed,lag=true,k=1,tau=600",
        "axis_expansion,component=EXX,axis=X,sensor=T_air,k=1",
    )
    asked: Any = object.__new__(Search)
    asked.model = Model(small_machine(), (known,), name="known")
    asked.candidates = [SimpleNamespace(effect=e.effect) for e in (late, other)]

    def hardly(number: int, drop: float) -> Any:
        return asked._hardly_refines(SimpleNamespace(number=number, drop=drop, within=0.5 * drop))

    assert [hardly(0, drop) for drop in (0.03, 0.2)] == [True, False]
    assert not hardly(1, 0.03)

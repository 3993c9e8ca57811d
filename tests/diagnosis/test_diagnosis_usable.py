"""Refits, ranges of own expressions, refusals and histories; oracles: what a simulation made true, and plain sums."""

import dataclasses
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.bench.sets import measurements_of
from rtec.bench.sets import model_of as model_of_trial
from rtec.bench.trials import build
from rtec.cli.common import interruptible, kept
from rtec.cli.main import status
from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.extend.add import add, new_effect, refused
from rtec.diagnosis.extend.improve import Improved, improve
from rtec.diagnosis.extend.parameter_scan import scan_ranges
from rtec.diagnosis.search.diagnose import diagnose
from rtec.effects import effect_class
from rtec.effects.expression import expression_from_text
from rtec.errors import MeasurementError, ModelError
from rtec.estimation import floor
from rtec.estimation.joint import joint_fit
from rtec.estimation.judge import Judgement
from rtec.estimation.outliers import clean
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model, save_model
from rtec.model.history import rescaled, steps_of
from rtec.report.history import improved_page
from tests.support.both import both
from tests.support.diagnosis_examples import NOISE_UM, effects, laser, small_machine, write_machine

Floats = NDArray[np.float64]
SCALE = "scale,component=EXX,axis=X,k=12"
OLD, NEW = "backlash,component=EXX,axis=X,B=5", "backlash,component=EXX,axis=X,B=9"
HEAT = (("T_bed", 11), ("T_air", 0.5))
WAVE = "cyclic_pole,component=EXX,axis=X,s=2,c=-1,period=5"


def model_of(*texts: str) -> Model:
    return Model(small_machine(), effects(*texts), name="test")


@cache
def improved(has: tuple[str, ...], truth: tuple[str, ...]) -> Improved:
    return improve(model_of(*has), [laser(truth, 3)])


def test_improve_fits_numbers_that_are_out_of_date_anew() -> None:
    """Oracle: the play of 9 µm that was made true; as it stood the model left half of the difference, 2 µm."""
    kept_models: list[Model] = []
    result = improve(model_of(SCALE, OLD), [laser([SCALE, NEW], 3)], step=lambda a: kept_models.append(a.model))
    assert result.refit is not None
    assert result.refit.before.held_out == pytest.approx(np.hypot(2.0, NOISE_UM), rel=0.05)
    assert result.refit.after.held_out == pytest.approx(NOISE_UM, rel=0.1)
    assert result.model.effects[1].values["B"] == pytest.approx(9.0, abs=0.15)
    assert result.model.history[0]["change"] == "refit"
    assert not result.steps
    assert kept_models == [result.refit.model]
    assert steps_of(result.model)[0]["name"] == "refit"


def test_a_drift_of_three_runs_makes_no_number_out_of_date() -> None:
    """Oracle: the numbers are those that were made true; a refit follows the slopes and misses the run held out."""
    own = [SCALE, *(f"axis_expansion,component=EXX,axis=X,sensor={t},k={k},fixed_mm=0" for t, k in HEAT)]
    whole, rng = laser(own, 26, targets={"step_mm": 20.0}), np.random.default_rng(26)
    rng.standard_normal(40)
    sloped = rng.standard_normal(100)[whole.run] * (whole.channels["x"] - 100.0) / 100.0
    few = whole.run <= np.unique(whole.run)[2]
    readings = {"reading_um": (whole.readings["reading_um"] + sloped)[few]}
    channels = {k: v[few] for k, v in whole.channels.items()}
    m = dataclasses.replace(whole, run=whole.run[few], time_s=whole.time_s[few], channels=channels, readings=readings)
    found, done = both(model_of(*own), [m], draws=50)
    assert found.verdict == "nothing_missing"
    assert found.judged is not None
    assert found.judged.refitted < 0.8 * found.rms_residual < found.judged.held_out
    assert not found.out_of_date
    assert "out of date" not in found.sentence
    assert done.refit is None


@pytest.mark.xdist_group("usable")
def test_improve_leaves_good_numbers_alone() -> None:
    """Oracle: nothing changed since the model was made."""
    result = improved((SCALE, OLD), (SCALE, OLD))
    assert result.refit is None
    assert result.model.history == ()


def test_the_whole_range_is_looked_through() -> None:
    """Oracle: the true period of 5 mm, far from the start; targets at unequal steps tell it from its aliases."""
    measured = [laser([SCALE, WAVE], 4, targets={"step_mm": 1.13}, protocol="cold", cycles=3)]
    model = model_of(SCALE)
    effect = expression_from_text("A*sin(2*pi*x/p + phi)", ["p=150:3..200"], "EXX", small_machine())
    added = add(model, [new_effect(effect, model)], measured)
    assert added.model.effects[-1].theta["p"] == pytest.approx(5.0, rel=0.002)
    assert added.after.held_out < 1.2 * NOISE_UM


def test_aliases_are_told_and_the_start_decides() -> None:
    """Oracle: waves of period p and of 1 / |1 / step - 1 / p| read alike at targets one step apart."""
    step = 13.7
    measured = [laser([SCALE, WAVE], 4)]
    model = model_of(SCALE)
    alias = 1.0 / abs(1.0 / 5.0 - 2.0 / step)
    for start, expected in ((5.1, 5.0), (alias * 1.02, alias)):
        effect = expression_from_text("A*sin(2*pi*x/p + phi)", [f"p={start}:3..200"], "EXX", small_machine())
        readings = clean(measured).readings
        found, words = scan_ranges(new_effect(effect, model), joint_fit(model.effects, readings), readings)
        assert found.theta["p"] == pytest.approx(expected, rel=0.01)
        assert "equal steps" in words[0]


def test_what_buys_nothing_is_not_better() -> None:
    """Oracle: a machine without play; the play that is found in its noise is less than two standard errors."""
    model = model_of(SCALE)
    added = add(model, [new_effect(effects(OLD)[0].effect, model)], [laser([SCALE], 6)])
    b = added.model.effects[-1]
    assert abs(b.values["B"]) < 2.0 * b.errors["B"]
    assert not added.better
    assert any("may be noise" in n for n in added.notes)
    first, second = refused(added).split("from ")[1].split(" to ")[:2]
    assert first != second.split(",")[0]


@pytest.mark.parametrize("text", ["A*x/0", "A*log(x-100)"])
def test_an_expression_that_is_not_finite(text: str) -> None:
    """Oracle: below 100 mm the logarithm is none; a division by zero is none anywhere."""
    model, measured = model_of(SCALE), laser([SCALE], 6)
    effect = expression_from_text(text, [], "EXX", small_machine())
    bad = len(measured) if "/" in text else int((measured.channels["x"] <= 100.0).sum())
    with pytest.raises(ModelError, match=f"not finite at {bad} of {len(measured)} readings"):
        add(model, [new_effect(effect, model)], [measured])


def few(n: int) -> Measurement:
    """A laser of which only the first n readings are there."""
    m = laser([SCALE], 6)
    readings = {k: np.where(np.arange(len(v)) < n, v, np.nan) for k, v in m.readings.items()}
    return dataclasses.replace(m, readings=readings)


def test_too_few_readings() -> None:
    model = model_of(SCALE)
    with pytest.raises(MeasurementError, match="too few readings: 9"):
        improve(model, [few(9)])
    with pytest.raises(MeasurementError, match="too few readings: 9"):
        add(model, [], [few(9)])
    with pytest.raises(MeasurementError, match="too few readings: 2"):
        compare(model, [few(2)])
    assert compare(model, [few(5)]).items[0].n == 5


def test_a_display_that_is_stuck() -> None:
    """Oracle: every reading set to the same value."""
    m = laser([SCALE], 6)
    m.readings["reading_um"][:] = 1.5
    assert "does not move" in compare(model_of(SCALE), [m]).notes[0]


def test_the_floor_is_that_of_compare() -> None:
    """Oracle: `compare` of the same model with the same readings; the fitted noise would hold the missing play."""
    measured, model = [laser([SCALE, NEW], 3)], model_of("scale,component=EXX,axis=X,k=0")
    added = add(model, [], measured)
    assert added.floor == pytest.approx(compare(added.model, measured).items[0].floor, rel=0.02)
    assert added.floor_from in ("repeats", "short-time differences")
    assert added.facts()["noise_floor_um"] == added.floor == added.model.history[-1]["noise_floor"]


def test_the_floor_of_a_series_without_repeats_is_of_neighbours() -> None:
    """Oracle: one run only has no repeats; the noise that was simulated."""
    readings = clean([laser([SCALE], 3, protocol="cold", cycles=1)]).readings
    left = floor.cleaned(readings, readings.values)
    (found,) = floor.noise_floors(readings, left, floor.flexible_noise(readings, readings.setup))
    assert found.source == "short-time differences"
    assert found.value == pytest.approx(NOISE_UM, rel=0.3)


def entry(change: str, before: float | None, after: float, **more: object) -> dict[str, object]:
    known = {} if before is None else {"rms_before": before}
    return {"change": change, "rms_after": after, "unit": "noise", **known, **more}


def test_history_in_multiples_of_the_noise_has_one_yardstick() -> None:
    """Oracle: 1 times a noise that is found to be 7.5 times too large is 7.5."""
    history = (entry("fit", None, 1.0), entry("add", 7.5, 1.0, same_measurements=True, measurements=["a"]))
    model = Model(small_machine(), effects(SCALE), name="t", measurements={"a": "0" * 64}, history=history)
    steps = steps_of(model)
    assert not steps[1]["other_data"]
    assert rescaled(steps) == pytest.approx([7.5, 1.0])


def test_history_says_other_measurements_only_where_they_are() -> None:
    """Oracle: names of the measurements."""
    for names, other in ((["a"], False), (["b"], True)):
        history = (entry("fit", None, 1.0), entry("add", 2.0, 1.0, measurements=names))
        model = Model(small_machine(), effects(SCALE), name="t", measurements={"a": "0" * 64}, history=history)
        assert steps_of(model)[1]["other_data"] == other


@pytest.mark.xdist_group("usable")
def test_what_was_passed_over_is_told() -> None:
    """Oracle: along one line of light, play and a turn of the slide at each reversal look alike."""
    result = improved((SCALE,), (SCALE, NEW))
    first = result.steps[0]
    rivals = [r.label for r in first.passed_over]
    assert any("angular_reversal" in label for label in rivals)
    assert "cannot distinguish it from" in first.notes[0]
    told = first.model.history[-1]["passed_over"]
    assert [r["effect"] for r in told] == rivals
    assert any(r.get("separating_test") for r in told)
    brief = improved_page(result, figures=False).brief
    assert brief is not None
    assert all(any(r in line for line in brief.text) for r in rivals[:3])


@pytest.mark.xdist_group("usable")
def test_an_end_far_above_the_noise_is_not_called_the_end_of_what_is_missing() -> None:
    """Oracle: held-out runs that are met to three times the noise, or to the noise."""
    result = improved((SCALE,), (SCALE, NEW))
    (*before, last) = result.steps

    def ended(times: float) -> str:
        far = replace(last, after=replace(last.after, held_out=times * last.floor))
        return improved_page(replace(result, steps=(*before, far), reason="nothing_missing"), figures=False).lead

    assert "no effect of the catalogue predicts the rest, 3.0 times the noise floor on held-out runs: " in ended(3.0)
    assert "no effect is missing that these readings could show" in ended(1.5)


@pytest.mark.xdist_group("usable")
def test_improve_does_not_advise_improve() -> None:
    result = improved((SCALE, OLD), (SCALE, OLD))
    said = replace(result.diagnoses[-1], sentence="The numbers are out of date (`rtec improve` refits them).")
    page = improved_page(replace(result, steps=(), diagnoses=(said,), reason="nothing_missing"), figures=False)
    assert page.lead.endswith("The numbers are out of date.")


def test_what_is_seen_and_not_worth_an_effect_is_told_as_that(monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: no fall of the error is worth an effect here, so that what is named is not what ought to be added."""
    monkeypatch.setattr("rtec.diagnosis.extend.improve.gains", lambda *_: False)
    result = improve(model_of(SCALE), [laser([SCALE, NEW], 3)])
    assert (result.reason, result.steps, result.diagnoses[-1].findings[0].accepted) == ("no_gain", (), True)
    page = improved_page(result, figures=False)
    for said in (page.lead, *page.sections[-1].text):
        assert f"Not added: {result.diagnoses[-1].findings[0].label}, which `rtec diagnose` names first." in said
        assert "and adding it removes" not in said


def test_ctrl_c_says_what_is_written(capsys: pytest.CaptureFixture[str]) -> None:
    assert kept(Path("m.toml"), []) == "nothing was written"
    assert kept(Path("m.toml"), ["refit", "step", "step"]) == "m.toml holds the refit and 2 steps"
    with pytest.raises(KeyboardInterrupt), interruptible():
        raise KeyboardInterrupt
    assert capsys.readouterr().err == "rtec: stopped; nothing was written\n"


def test_words_for_slips(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_machine(tmp_path)
    model, table = tmp_path / "m.toml", tmp_path / "laser.csv"
    save_model(model_of(SCALE), model)
    table.write_text("run,time_s\n")
    out = ["--component", "EXX", "--data", str(table), "-o", str(tmp_path / "o.toml")]
    assert status(["diagnose", str(table), str(table)]) == 2
    assert "a model file is expected first" in capsys.readouterr().err
    assert status(["add", str(model), "backlash", "--expr", "A*x", *out]) == 2
    assert "either a name, or --expr" in capsys.readouterr().err
    with pytest.raises(ModelError, match="did you mean 'x'"):
        expression_from_text("A*X", [], "EXX", small_machine())
    assert status(["add", "--help"]) == 0
    assert "A*sin(2*pi*x/p + phi)" in capsys.readouterr().out


def test_a_harmonic_is_found_beside_its_wave() -> None:
    """Oracle: the second wave, of half the period, that was made true beside one that the model has."""
    second = "cyclic_pole,component=EXX,axis=X,s=1.5,c=1,period=3.7"
    measured = [laser([SCALE, WAVE, second], 4, targets={"step_mm": 1.13}, protocol="cold", cycles=2)]
    model = model_of(SCALE, WAVE)
    found = diagnose(model, measured, draws=50, only=["cyclic_pole"])
    assert found.findings[0].accepted
    assert found.findings[0].theta["period"] == pytest.approx(3.7, rel=0.01)
    wave = effects(second)[0].effect
    added = add(model, [new_effect(wave, model, {"period": 3.7})], measured)
    assert added.model.effects[-1].theta["period"] == pytest.approx(3.7, rel=0.002)
    assert added.after.held_out < 1.2 * NOISE_UM
    with pytest.raises(ModelError, match="in the model already"):
        add(model, [new_effect(wave, model, {"period": 5.05})], measured)


def test_what_the_model_has_under_another_name_is_not_added() -> None:
    """Oracle: a straight line is a straight line."""
    effect = new_effect(expression_from_text("A*x", [], "EXX", small_machine()), model_of(SCALE))
    with pytest.raises(ModelError, match="cannot be distinguished from what the model has"):
        add(model_of(SCALE), [effect], [laser([SCALE], 6)])


def test_an_unknown_zero_costs_the_model_before_as_much_as_the_model_after() -> None:
    """Under slow drift the zero of a set-up is badly known on runs left out. Oracle: the growth of a spindle that was
    made true, which takes a third of the mean square away there; a model without effects, which has zeros only.
    """
    trial = build("improve", "any_spindle_heat", 32001)
    model, measured = model_of_trial(trial), measurements_of(trial)
    kind = effect_class("spindle_growth", "test")
    growth = kind.model_validate({"effect": "spindle_growth", "component": "EZ0spindle"})
    added = add(model, [new_effect(growth, model, {"tau": 300.0, "p": 1.1})], measured)
    empty = Judgement(model, clean(measured, model.reference_degc))
    assert added.before.held_out == pytest.approx(empty.held_out, rel=1e-9)
    assert added.after.held_out < 0.9 * added.before.held_out


def test_one_speed_determines_no_exponent() -> None:
    """Of one speed k and p are one number: a fit had p = 2.98 ± 0.005, and 14 µm at half of the speed."""
    trial = build("improve", "any_spindle_heat", 32001)
    model, measured = model_of_trial(trial), measurements_of(trial)
    kind = effect_class("spindle_growth", "test")
    growth = kind.model_validate({"effect": "spindle_growth", "component": "EZ0spindle"})

    def fitted(speeds: Callable[[Floats], Floats]) -> FittedEffect:
        given = [
            dataclasses.replace(m, channels={**m.channels, "spindle_rpm": speeds(m.channels["spindle_rpm"])})
            for m in measured
        ]
        return add(model, [new_effect(growth, model, {"tau": 300.0})], given).model.effects[-1]

    several, one = fitted(lambda rpm: rpm), fitted(lambda rpm: np.where(rpm > 0.0, 7000.0, 0.0))
    assert several.errors["p"] > 0.0
    assert several.theta["p"] != 1.0
    assert (one.theta["p"], one.errors.get("p")) == (1.0, None)


def test_the_same_readings_under_another_name_are_no_second_measurement() -> None:
    """Oracle: the copy; and another measurement at the same places and times, which is none."""
    m = laser([SCALE], 1, cycles=1)
    copy = dataclasses.replace(m, name="copy")
    for command in (compare, diagnose, improve):
        with pytest.raises(MeasurementError, match=r"copy: the same readings as .*; leave one out"):
            command(model_of(SCALE), [m, copy])
    other = {n: v + 0.01 for n, v in m.readings.items()}
    assert compare(model_of(SCALE), [m, dataclasses.replace(copy, readings=other)]).judged is not None

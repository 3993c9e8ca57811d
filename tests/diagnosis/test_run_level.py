"""Effects that change from run to run, and lean effects. Oracle: what the benchmark's own physics hid."""

import numpy as np
import pytest

from rtec.bench.sets import measurements_of, model_of
from rtec.bench.trials import build
from rtec.diagnosis.result import Diagnosis
from rtec.diagnosis.search.diagnose import diagnose
from rtec.diagnosis.search.refit import effective
from rtec.estimation.noise import Noise, Whitener
from rtec.estimation.readings import read


def answer(group: str, what: str, seed: int, size: str = "natural") -> Diagnosis:
    trial = build(group, what, seed, size)
    return diagnose(model_of(trial), measurements_of(trial))


@pytest.mark.parametrize("size", ["natural", "faint"])
@pytest.mark.parametrize("what", ["load_shift", "load_bow"])
def test_a_load_is_named(what: str, size: str) -> None:
    d = answer("run_level", what, 2, size)
    assert d.verdict in ("missing_effect", "ambiguous")
    assert d.findings[0].effect.effect == "load_deformation"


def test_few_runs_name_nothing_and_do_not_say_that_nothing_is_missing() -> None:
    """A column that leans by as much as the noise, over twenty runs."""
    d = answer("run_level", "column_lean", 1, "faint")
    assert d.verdict == "undecided"
    assert d.sentence.startswith("the runs differ by ")
    assert "column_tilt(EB0spindle, T_front, T_back) may explain it" in d.sentence
    assert "This test decides: " in d.sentence
    assert not d.findings[0].accepted
    assert d.facts()["runs_differ"]["count"] == 20


def test_what_predicts_held_out_runs_far_better_comes_before_what_a_free_drift_makes_likelier() -> None:
    """A column leans; another sensor and a drift of hours are likelier, and leave three times its held-out error."""
    d = answer("run_level", "column_lean", 303)
    first, second = d.findings[:2]
    assert first.label == "column_tilt(EB0spindle, T_front, T_back)"
    assert second.log_evidence > first.log_evidence
    assert 1.0 - first.heldout_drop < 0.5 * (1.0 - second.heldout_drop)
    assert d.verdict == "ambiguous"
    assert any("predicts held-out runs far worse" in a.why for a in first.confused_with)


def test_an_angle_times_its_arm_is_no_cross_talk() -> None:
    """A guide bent to a circle, read at four heights."""
    d = answer("lean", "abbe", 1)
    assert (d.findings[0].effect.effect, d.findings[0].effect.component) == ("angular_motion", "EBX")
    assert not any(f.effect.effect == "cross_talk" for f in d.group)


def test_an_angle_with_slope_and_bow_is_one_effect() -> None:
    d = answer("lean", "bowed_angle", 1)
    assert d.verdict == "missing_effect"
    assert d.findings[0].effect.effect == "angular_motion"
    assert set(d.findings[0].parameters) == {"c1", "c2"}


def test_what_decides_a_run_level_effect_are_the_runs() -> None:
    """Oracle: n readings in r runs of known offsets far above the noise: r for what changes by run, n within one."""
    trial = build("run_level", "load_shift", 1)
    readings = read(measurements_of(trial), smooth=False)
    n, runs = len(readings), 16
    noises = (Noise(0.5, 1e-4, 100.0, 100.0),)
    whitener = Whitener(readings, noises, (np.zeros(0),))
    rng = np.random.default_rng(1)
    by_run, within = rng.standard_normal(runs)[readings.run], rng.standard_normal(n)
    zero = np.ones((n, 1))
    told = effective(whitener, zero, np.stack([by_run, within], axis=1))
    assert told[0] == pytest.approx(runs, rel=0.2)
    assert told[1] == pytest.approx(n)

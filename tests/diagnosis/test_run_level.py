"""Effects that change from run to run, and lean effects. Oracle: what the benchmark's own physics hid."""

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.bench.sets import measurements_of, model_of
from rtec.bench.trials import build
from rtec.diagnosis.result import Diagnosis
from rtec.diagnosis.search.diagnose import beats_drift, diagnose
from rtec.diagnosis.search.refit import Refitted, effective, led
from rtec.diagnosis.search.shapes import Shape
from rtec.diagnosis.search.unnamed import Shaped
from rtec.estimation.gls import Fit
from rtec.estimation.noise import Noise, Whitener
from rtec.estimation.readings import read
from tests.support import proof

Floats = NDArray[np.float64]


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
    """A table that gives way by as much as the noise, over sixteen runs."""
    d = answer("run_level", "load_shift", 5, "faint")
    assert d.verdict == "undecided"
    assert d.sentence.startswith("the runs differ by ")
    assert "load_deformation(EXX, X) may explain it" in d.sentence
    assert "This test decides: " in d.sentence
    assert not d.findings[0].accepted
    assert d.facts()["runs_differ"]["count"] == 16


@pytest.mark.parametrize("seed", proof.few([303, 306], 1))
def test_a_column_that_leans_by_tenths_of_a_kelvin_is_named(seed: int) -> None:
    """Sensors with steps of 0.1 K; another sensor and a drift of hours follow the readings too."""
    d = answer("run_level", "column_lean", seed)
    assert d.findings[0].label == "column_tilt(EB0spindle, T_front, T_back)"


def fitted(number: int, columns: Floats, log_evidence: float, drop: float) -> Refitted:
    readings = read(measurements_of(build("run_level", "load_shift", 1)), smooth=False)
    base, noise = np.ones((len(readings), 1)), Whitener(readings, (Noise(0.5, 1e-4, 100.0, 0.0),), (np.zeros(0),))
    fit = Fit(noise, np.concatenate([base, columns], axis=1), np.zeros(1 + columns.shape[1]), 0.0)
    return Refitted(number, {}, columns, fit, log_evidence, drop, 1.0)


def test_what_predicts_held_out_runs_far_better_leads() -> None:
    """Oracle: shares of the held-out error; 40 % against 10 %, and 40 % against 30 %."""
    one = np.random.default_rng(1).standard_normal((832, 1))
    first, far, near = (fitted(k, one, e, d) for k, (e, d) in enumerate([(40.0, 0.6), (20.0, 0.9), (20.0, 0.7)]))
    base, readings = first.fit.columns[:, :1], first.fit.whitener.readings
    assert led([first, near, far], 10.0, base, readings)[0] is far
    assert led([first, near], 10.0, base, readings)[0] is first
    assert led([first, far], 30.0, base, readings)[0] is first  # the other is not sure


def test_an_effect_beats_a_drift_that_predicts_held_out_runs_far_worse() -> None:
    """Oracle: shares of the held-out error; 3 % against 13 %, and 10 % against 13 %."""
    one = np.random.default_rng(1).standard_normal((832, 1))
    far, near = fitted(0, one, 3.0, 0.97), fitted(1, one, 3.0, 0.9)
    drift, bow = (Shape("laser X", over, (4,) * len(over)) for over in (("T_bed", "time_s"), ("x",)))
    by_time, by_place = (Shaped(s, one, far.fit, 20.0, 0.87, 1.0) for s in (drift, bow))
    assert beats_drift(far, by_time)
    assert not beats_drift(near, by_time)
    assert not beats_drift(far, by_place)
    assert not beats_drift(far, None)


def test_of_nearly_as_likely_ones_the_case_of_fewer_numbers_leads() -> None:
    """Oracle: a column is a case of itself with another one, and no case of others."""
    rng = np.random.default_rng(2)
    lean, more, other = (rng.standard_normal((832, 1)) for _ in range(3))
    rich = fitted(0, np.concatenate([lean, more], axis=1), 40.0, 0.9)
    base, readings = rich.fit.columns[:, :1], rich.fit.whitener.readings
    case, apart, unlike = (fitted(k, c, e, 0.9) for k, c, e in ((1, lean, 38.0), (2, other, 38.0), (3, lean, 30.0)))
    assert led([rich, apart, case], 10.0, base, readings)[0] is case
    assert led([rich, apart, unlike], 10.0, base, readings)[0] is rich


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

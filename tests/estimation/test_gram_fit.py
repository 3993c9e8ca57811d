"""Fits of chosen terms: outliers, noise, non-linear parameters, messages."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.characterise import characterise
from rtec.effects.effect_list import AskedEffects
from rtec.errors import ModelError
from rtec.estimation.gram.fit import Estimate, estimate
from rtec.estimation.gram.projection import starting_terms
from rtec.estimation.gram.source import Source, thinned
from rtec.estimation.gram.stream import Term
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect
from tests.support.characterise_examples import MACHINE, Probe, ProbeSetup, Tip, effect, measurement, runs

Floats = NDArray[np.float64]
SCALE = effect("scale", "EXX", axis="X")
BACKLASH = effect("backlash", "EXX", axis="X")
LAGGED = effect("mount_expansion", "EXX", sensor="T_spindle", lag=True)


def true_readings(m: Measurement, tau: float = 1500.0) -> Floats:
    """Scale, backlash and lagged expansion, µm, by their equations."""
    x, d = m.channels["x"], m.channels["d_x"]
    lag = m.state().lagged(m.state().rise("T_spindle"), tau)
    return np.asarray(12e-3 * x + 1.5 * d + 1.4 * lag)


def example(seed: int = 1, noise_um: float = 0.2, zero: str = "run") -> Measurement:
    probe = Probe(ProbeSetup.model_validate({"zero": zero}), component="EXX")
    m = measurement(runs([40] * 20), instrument=probe, seed=seed, noise_um=noise_um)
    return replace(m, readings={"reading_um": m.readings["reading_um"] + true_readings(m)})


def fitted(m: Measurement, tau: float = 600.0) -> Estimate:
    return estimate([Source.of(m)], [Term(SCALE), Term(BACKLASH), Term(LAGGED, {"tau": tau})])


def test_exact_readings_give_the_exact_parameters() -> None:
    """Oracle: the truth, without noise, from a time constant that is far off."""
    fit = fitted(example(noise_um=0.0, zero="setup"), tau=100.0)
    np.testing.assert_allclose(fit.values[:3], [12.0, 3.0, 1.4], rtol=1e-5)
    assert fit.terms[2].theta["tau"] == pytest.approx(1500.0, rel=1e-4)


def test_time_constant_and_its_standard_error() -> None:
    """Oracle: the truth, over 60 draws; standard errors as the yardstick."""
    off = []
    for seed in range(60):
        fit = fitted(example(seed, noise_um=0.5))
        found = np.append(fit.values[:3], fit.terms[2].theta["tau"])
        off.append(np.abs(found - [12.0, 3.0, 1.4, 1500.0]) / fit.errors)
    table = np.array(off)
    assert np.all((table < 1.0).mean(axis=0) > 0.5)
    assert np.all((table < 3.0).mean(axis=0) >= 0.95)


def test_grid_finds_the_valley() -> None:
    """Oracle: a pitch 1.6 % from the nominal one; a search from the nominal one alone ends in another valley."""
    axes = tuple(replace(a, pitch_mm=5.0) if a.name == "X" else a for a in MACHINE.axes)
    machine = replace(MACHINE, axes=axes)
    m = replace(measurement(runs([40] * 20), noise_um=0.05), machine=machine)
    wave = 1.3 * np.sin(2 * np.pi * m.channels["x"] / 5.08)
    m = replace(m, readings={"reading_um": m.readings["reading_um"] + wave})
    cyclic = effect("cyclic_screw", "EXX", axis="X")
    start = starting_terms([cyclic], [Source.of(m)])
    assert start[0].theta["pitch"] == pytest.approx(5.08, abs=0.012)  # the grid has steps of 0.011 mm
    fit = estimate([Source.of(m)], start)
    assert fit.terms[0].theta["pitch"] == pytest.approx(5.08, abs=2e-4)
    assert np.hypot(*fit.values[:2]) == pytest.approx(1.3, abs=0.02)


def test_wrong_readings_are_left_out_and_told() -> None:
    """Oracle: the rows that were spoilt, and the coefficients of the unspoilt readings."""
    m = example()
    bad = {37: 400.0, 202: -25.0, 415: 8.0, 640: -1000.0}
    spoilt = m.readings["reading_um"].copy()
    for row, by in bad.items():
        spoilt[row] += by
    asked = AskedEffects((), (SCALE, BACKLASH, LAGGED))
    fit, clean = (
        characterise([replace(m, readings={"reading_um": r})], wanted=asked) for r in (spoilt, m.readings["reading_um"])
    )
    assert {o.row for o in fit.outliers} == set(bad)
    for o in fit.outliers:
        assert o.off == pytest.approx(bad[o.row], rel=0.03, abs=3.0)
        assert o.run == m.run[o.row]
    for one, two in zip(fit.coefficients, clean.coefficients, strict=True):
        assert two.se is not None
        assert abs(one.value - two.value) < 0.6 * two.se


def test_wrong_readings_in_company_count_less() -> None:
    """Oracle: three rows in a row, which may be real; least squares with them moves the coefficients far."""
    m = example()
    spoilt = m.readings["reading_um"].copy()
    spoilt[100:103] += 300.0
    fit = fitted(replace(m, readings={"reading_um": spoilt}))
    clean = fitted(m)
    np.testing.assert_array_less(np.abs(fit.values[:2] - clean.values[:2]), 2.0 * clean.errors[:2])


def test_clean_readings_have_no_outliers() -> None:
    """Oracle: normal noise; six standard deviations happen once in 5e8."""
    assert not characterise([example()], wanted=AskedEffects((), (SCALE, BACKLASH, LAGGED))).outliers


def test_a_wave_is_no_outlier() -> None:
    """Oracle: a strong cyclic error that the model lacks: many readings far off, none dropped or weighed less."""
    m = example()
    wave = np.where(np.sin(2 * np.pi * m.channels["x"] / 25.0) > 0.8, 6.0, 0.0)
    wavy = replace(m, readings={"reading_um": m.readings["reading_um"] + wave})
    assert not characterise([wavy], wanted=AskedEffects((), (SCALE, BACKLASH, LAGGED))).outliers


def test_measurements_are_weighed_by_their_noise() -> None:
    """Oracle: weighted least squares with the true noise, written out for one coefficient seen by both."""
    quiet = replace(measurement(runs([40] * 20), noise_um=0.1, seed=3), name="quiet")
    loud = replace(measurement(runs([40] * 20), noise_um=5.0, seed=4), name="loud")
    both = [
        replace(m, readings={"reading_um": m.readings["reading_um"] + 12e-3 * m.channels["x"]}) for m in (quiet, loud)
    ]
    fit = estimate([Source.of(m) for m in both], [Term(SCALE)])
    assert fit.noise[0][0] == pytest.approx(0.1, rel=0.05)
    assert fit.noise[1][0] == pytest.approx(5.0, rel=0.05)
    top, bottom = 0.0, 0.0
    for m, sigma in zip(both, (0.1, 5.0), strict=True):
        x, y = m.channels["x"] * 1e-3, m.readings["reading_um"]
        for r in np.unique(m.run):
            a, b = x[m.run == r] - x[m.run == r].mean(), y[m.run == r] - y[m.run == r].mean()
            top, bottom = top + float(a @ b) / sigma**2, bottom + float(a @ a) / sigma**2
    assert fit.values[0] == pytest.approx(top / bottom, rel=1e-4)


@pytest.mark.parametrize(
    ("terms", "said"),
    [
        ([Term(effect("squareness", "EC0X"))], r"no reading shows squareness\(EC0X\)"),
        ([Term(SCALE), Term(effect("polynomial_position", "EXX", axis="X", degrees=[1]))], "cannot be distinguished"),
    ],
)
def test_what_is_not_seen_is_told_by_name(terms: list[Term], said: str) -> None:
    """Oracle: algebra; the probe reads EXX alone, and a slope is a slope whatever its name."""
    with pytest.raises(ModelError, match=said):
        estimate([Source.of(example())], terms)


def test_too_few_readings() -> None:
    m = measurement(runs([2, 2, 2, 2, 2, 2, 2]))
    terms = [Term(effect("polynomial_position", "EXX", axis="X", degrees=list(range(1, 9))))]
    with pytest.raises(ModelError, match="take more"):
        estimate([Source.of(m)], terms)


def test_weights_follow_what_the_fit_leaves() -> None:
    """Oracle: the noise that was added; neighbouring readings of the first differ by far more: it jumps in X."""
    rng = np.random.default_rng(6)
    jumping = replace(measurement(runs([40] * 20), noise_um=0.1, seed=3), name="jumping")
    x = rng.uniform(0.0, 200.0, len(jumping))
    jumping = replace(jumping, channels={**jumping.channels, "x": x})
    steady = replace(measurement(runs([40] * 20), noise_um=1.0, seed=4), name="steady")
    both = [
        replace(m, readings={"reading_um": m.readings["reading_um"] + 0.2 * m.channels["x"]}) for m in (jumping, steady)
    ]
    fit = estimate([Source.of(m) for m in both], [Term(SCALE)])
    weights = [1.0 / s.weight.max() for s in fit.sources]
    np.testing.assert_allclose(weights, [0.1, 1.0], rtol=0.1)


def test_thinned_readings_keep_directions_and_fall_in_no_step() -> None:
    """Oracle: the whole measurement's own directions; a fixed stride would have one difference only."""
    m = example()
    m = replace(m, channels={k: v for k, v in m.channels.items() if k != "d_x"})
    source = Source.of(m)
    few = thinned(source, 200).measurement
    rows = np.searchsorted(m.time_s, few.time_s)
    assert 200 <= len(few) <= 220
    assert len(np.unique(np.diff(rows))) > 3
    assert np.array_equal(few.channels["d_x"], m.state().value("d_x")[rows])
    assert set(few.run) == set(m.run)


def test_very_many_readings_give_what_few_give() -> None:
    """Oracle: the truth; a first look at fewer readings finds noise and time constant for all of them."""
    m = measurement(runs([2000] * 20), instrument=Probe(ProbeSetup(), component="EXX"), noise_um=0.5)
    m = replace(m, readings={"reading_um": m.readings["reading_um"] + true_readings(m)})
    fit = fitted(m, tau=300.0)
    found = np.append(fit.values[:3], fit.terms[2].theta["tau"])
    assert np.all(np.abs(found - [12.0, 3.0, 1.4, 1500.0]) < 4 * fit.errors)
    assert fit.noise[0][0] == pytest.approx(0.5, rel=0.02)


def test_several_columns_with_noise_of_their_own() -> None:
    """Oracle: the noise that was added to each column."""
    m = measurement(runs([40] * 12), instrument=Tip(ProbeSetup()), noise_um=0.0)
    rng = np.random.default_rng(8)
    readings = {
        "reading_x_um": m.readings["reading_x_um"] + 0.2 * rng.standard_normal(len(m)),
        "reading_z_um": m.readings["reading_z_um"] + 2.0 * rng.standard_normal(len(m)),
    }
    fit = estimate([Source.of(replace(m, readings=readings))], [Term(SCALE), Term(effect("scale", "EZZ", axis="Z"))])
    np.testing.assert_allclose(fit.noise[0], [0.2, 2.0], rtol=0.08)


def test_parameter_on_its_bound_is_told() -> None:
    """Oracle: a lag of two seconds is below the least that the search allows, ten."""
    m = measurement(runs([40] * 12), instrument=Probe(ProbeSetup(zero="setup"), component="EXX"), noise_um=0.01)
    m = replace(m, readings={"reading_um": m.readings["reading_um"] * 0 + 1.4 * m.state().rise("T_spindle")})
    fit = estimate([Source.of(m)], [Term(LAGGED, {"tau": 300.0})])
    assert fit.terms[0].theta["tau"] == pytest.approx(10.0, rel=0.05)
    assert fit.found.on_bound == ((0, "tau"),)
    assert FittedEffect(LAGGED, {}).label.startswith("mount_expansion")

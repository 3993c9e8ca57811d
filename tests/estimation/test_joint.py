"""Earlier numbers of a model, and new readings.

Oracles: the density of a normal distribution, written out here, and what was hidden.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import null_space
from scipy.stats import multivariate_normal

from rtec.estimation import joint
from rtec.estimation.joint import joint_fit
from rtec.estimation.noise import find_noise
from rtec.estimation.outliers import clean
from rtec.estimation.readings import Readings, read
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from rtec.model.model import ErrorCorrelation, number_names
from tests.support import proof
from tests.support.diagnosis_examples import effects, laser, small_machine

Floats = NDArray[np.float64]

SHAPES = ("scale,component=EXX,axis=X,k={}", "backlash,component=EXX,axis=X,B={}",
          "axis_expansion,component=EXX,axis=X,sensor=T_bed,k={}")  # fmt: skip
ERRORS = (0.09, 0.045, 0.12)


def model(*values: float) -> list[FittedEffect]:
    """Scale, backlash and expansion with standard errors of an earlier fit."""
    plain = effects(*(s.format(v) for s, v in zip(SHAPES, values, strict=True)))
    return [replace(f, errors=dict.fromkeys(f.values, e)) for f, e in zip(plain, ERRORS, strict=True)]


def earlier(fitted: Sequence[FittedEffect]) -> Model:
    """The model that an earlier day gave."""
    return Model(small_machine(), tuple(fitted))


def numbers(fitted: Sequence[FittedEffect]) -> Floats:
    return np.array([v for f in fitted for v in f.values.values()])


def day(seed: int, *values: float) -> Readings:
    """A day whose laser wanders by three times its noise."""
    noise = {"white_um": 0.3, "drift_um": 1.0, "drift_tau_s": 2400.0}
    sensors = dict.fromkeys(("offset_degc", "noise_degc", "lag_s", "resolution_degc"), 0.0)
    truth = [s.format(v) for s, v in zip(SHAPES, values, strict=True)]
    return read([laser(truth, seed, noise=noise, thermal={"sensors": sensors})])


@pytest.mark.parametrize("changed", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("new", [False, True])
def test_the_evidence_is_the_density_of_a_normal_distribution(changed: float, new: bool) -> None:
    """The density of what is orthogonal to unknowns of any size: the zero of the set-up, a number without a fit.

    Some numbers have changed, so that they may move further; the errors of the others correlate.
    """
    readings = day(5, 8.0 - changed, 2.0, 6.0)
    fitted = model(8.0, 2.0, 6.0)
    fitted = [*fitted[:2], replace(fitted[2], errors={})] if new else fitted
    together = ErrorCorrelation((number_names(fitted)[0], number_names(fitted)[2]), ((), (0.7,)))
    work = joint._Work([f.effect for f in fitted], readings, fitted, replace(earlier(fitted), correlation=together))
    columns = work.columns([f.theta for f in fitted])
    whitener = find_noise(readings, columns)
    known = [0, 1] if new else [0, 1, 2]
    white, target = whitener(columns), whitener(readings.values)
    away = null_space(np.delete(white, known, axis=1).T)
    seen = away.T @ white[:, known]
    rest = away.T @ (target - white[:, known] @ numbers(fitted)[known])
    # Directions that no number moves have the same density always.
    basis, triangle = np.linalg.qr(seen)
    found, densities = [], []
    for loose in ([1.0, 1.0, 1.0], [1.0, 8.0, 1.0], [30.0, 1.0, 1.0]):
        prior = joint._prior(work, loose)
        errors = np.array(ERRORS) * loose
        correlation = np.eye(3)
        if loose[0] == 1.0 and not new:
            correlation[0, 2] = correlation[2, 0] = 0.7 * (1.0 - joint.APART_BY)
        covariance = (np.diag(errors) @ correlation @ np.diag(errors))[np.ix_(known, known)]
        spread = np.eye(len(known)) + triangle @ covariance @ triangle.T
        densities.append(2.0 * multivariate_normal.logpdf(basis.T @ rest, cov=spread))
        found.append(joint._Evidence.of(work, whitener, columns).under(prior))
    assert np.diff(found) == pytest.approx(np.diff(densities), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("seed", proof.few([1, 2, 3, 4], 2))
@pytest.mark.parametrize("changed", [10.0, 40.0])
def test_a_number_that_changed_by_many_standard_errors_is_refitted(seed: int, changed: float) -> None:
    """A scale error that was known to 0.09 µm/m changed by 10 and by 40 µm/m between two days."""
    readings = day(seed, 8.0 - changed, 2.0, 6.0)
    fit = joint_fit(model(8.0, 2.0, 6.0), readings, earlier=earlier(model(8.0, 2.0, 6.0)))
    errors = np.array([e for f in fit.effects for e in f.errors.values()])
    assert np.all(np.abs(numbers(fit.effects) - (8.0 - changed, 2.0, 6.0)) < 4.0 * errors)
    again = joint_fit(fit.effects, readings, earlier=earlier(fit.effects))
    assert np.all(np.abs(numbers(again.effects) - numbers(fit.effects)) < errors)


@pytest.mark.parametrize("drift_um", [0.0, 0.15])
@pytest.mark.parametrize("seed", proof.few(range(1, 9), 2))
def test_a_number_that_has_not_changed_loses_no_certainty(seed: int, drift_um: float) -> None:
    """Two spots of fine steps in half a kelvin: too short to tell of a change.

    Either slow drift of the readings, or noise of the sensor as the loop has it, which pulls the number towards zero.
    """
    rng, known = np.random.default_rng(seed), 20.0
    spots = np.concatenate([spot + 0.002 * np.arange(27) for spot in (20.0, 190.0)])
    x = np.tile(np.concatenate([spots, spots[::-1]]), 4)
    time_s = np.arange(len(x)) + 120.0 * (np.arange(len(x)) // 27)
    degc = 20.3 + 0.6 * (1.0 - np.exp(-time_s / 2000.0))
    drift, memory = np.zeros(len(x)), np.exp(-np.diff(time_s) / 250.0)
    for i, kept in enumerate(memory, 1):
        drift[i] = kept * drift[i - 1] + drift_um * np.sqrt(1.0 - kept**2) * rng.normal()
    once = laser([], seed)
    short = replace(
        once,
        run=np.repeat(np.arange(1, 5), 108),
        time_s=time_s,
        channels={
            "x": x,
            "d_x": np.tile(np.repeat([1.0, -1.0], 54), 4),
            "T_bed": degc + 0.02 * rng.normal(size=len(x)),
        },
        readings={"reading_um": known * 1e-3 * x * (degc - 20.0) + drift + 0.12 * rng.normal(size=len(x))},
    )
    scale, _, expansion = model(0.0, 0.0, known)
    readings = read([short]) if drift_um else clean([short], 20.0).readings
    fit = joint_fit([scale, expansion], readings, earlier=earlier([scale, expansion]))
    assert fit.effects[1].values["k"] == pytest.approx(known, abs=ERRORS[2])
    assert fit.effects[1].errors["k"] <= ERRORS[2]


KELVIN = (
    "axis_expansion,component=EXX,axis=X,sensor=T_bed,k={}",
    "axis_expansion,component=EXX,axis=X,sensor=T_air,k={}",
)


def warm_day(seed: int, level: float, rise: tuple[float, float], *, wander: float = 0.0) -> Measurement:
    """Twelve runs there and back, white noise 0.5 µm; both sensors rise; the slope of each run wanders.

    Args:
        seed: of the noise.
        level: temperature at the start, over 20 °C.
        rise: of bed and air.
        wander: standard deviation of the slope of a run, µm/m.
    """
    rng = np.random.default_rng(seed)
    x = np.tile(np.concatenate([np.linspace(0.0, 200.0, 11), np.linspace(200.0, 0.0, 11)]), 12)
    run = np.repeat(np.arange(1, 13), 22)
    bed, air = (20.0 + level + r * (1.0 - np.exp(-run / span)) for r, span in zip(rise, (4.0, 3.0), strict=True))
    way = np.tile(np.repeat([1.0, -1.0], 11), 12)
    error = 1e-3 * x * (8.0 * (bed - 20.0) + 4.0 * (air - 20.0) + wander * rng.normal(size=13)[run])
    return replace(
        laser([], seed),
        run=run, time_s=np.asarray(600.0 * run + np.arange(len(x))),
        channels={"x": x, "d_x": way, "T_bed": bed, "T_air": air},
        readings={"reading_um": error + 0.5 * rng.normal(size=len(x))},
    )  # fmt: skip


@pytest.mark.parametrize("seed", proof.few(range(1, 6), 1))
def test_numbers_of_an_earlier_day_and_new_readings_give_what_both_days_together_give(seed: int) -> None:
    """Oracle: least squares of the readings of both days at once, under the true, white noise.

    On the first day both sensors rise together: of their coefficients the sum is known well, each alone badly. On the
    second the air rises alone; by the correlation of the errors, that tells about the bed, too.
    """
    first, second = warm_day(seed, 0.0, (6.0, 6.0)), warm_day(seed + 50, 0.0, (0.0, 6.0))
    plain = effects(*(k.format(1.0) for k in KELVIN))
    known = joint_fit(plain, read([first]))
    fit = joint_fit(
        known.effects, read([second]), earlier=replace(earlier(known.effects), correlation=known.correlation)
    )
    rows, values = [], []
    for m in (first, second):
        x, slopes = m.channels["x"], (m.channels["T_bed"] - 20.0, m.channels["T_air"] - 20.0)
        columns = np.column_stack([1e-3 * x * s for s in slopes])
        zeros = (m.run[:, None] == np.unique(m.run)).astype(float)
        both = np.column_stack([columns, m.readings["reading_um"]])
        both -= zeros @ (zeros.T @ both / zeros.sum(axis=0)[:, None])
        rows.append(both[:, :2])
        values.append(both[:, 2])
    design, target = np.concatenate(rows), np.concatenate(values)
    pooled = np.linalg.solve(design.T @ design, design.T @ target)
    errors = 0.5 * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    assert np.all(np.abs(numbers(fit.effects) - pooled) < errors)


@pytest.mark.parametrize("seed", proof.few(range(1, 9), 2))
def test_what_has_changed_loosens_nothing_else(seed: int) -> None:
    """A reversal that grew from 2 to 6 µm; the expansion is as it was, and these few kelvin do not determine it.

    Oracle: what was hidden. The slope of each run wanders, as by heat that no sensor reads, and the readings of a run
    share it: to take them for independent ones would make the expansion follow it.
    """
    bed, air = effects(*(k.format(v) for k, v in zip(KELVIN, (8.0, 4.0), strict=True)))
    backlash = effects("backlash,component=EXX,axis=X,B=2")[0]
    known = [replace(f, errors=dict.fromkeys(f.values, e)) for f, e in ((backlash, 0.1), (bed, 0.5), (air, 0.5))]
    today = warm_day(seed, -1.0, (0.5, 0.5), wander=4.0)
    changed = {"reading_um": today.readings["reading_um"] + 3.0 * today.channels["d_x"]}
    fit = joint_fit(known, read([replace(today, readings=changed)]), earlier=earlier(known))
    worn, *heat = fit.effects
    assert abs(worn.values["B"]) == pytest.approx(6.0, abs=0.4)
    assert [f.values["k"] for f in heat] == pytest.approx([8.0, 4.0], abs=1.5)

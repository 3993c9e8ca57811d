"""Earlier numbers of a model, and new readings.

Oracles: the density of a normal distribution, written out here, and what was hidden.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import null_space
from scipy.stats import multivariate_normal

from rtec.estimation import joint
from rtec.estimation.joint import LOOSENESS, joint_fit
from rtec.estimation.noise import find_noise
from rtec.estimation.outliers import clean
from rtec.estimation.readings import Readings, read
from rtec.model import FittedEffect
from tests.support.diagnosis_examples import effects, laser

Floats = NDArray[np.float64]

SHAPES = ("scale,component=EXX,axis=X,k={}", "backlash,component=EXX,axis=X,B={}",
          "axis_expansion,component=EXX,axis=X,sensor=T_bed,k={}")  # fmt: skip
ERRORS = (0.09, 0.045, 0.12)


def model(*values: float) -> list[FittedEffect]:
    """Scale, backlash and expansion with standard errors of an earlier fit."""
    plain = effects(*(s.format(v) for s, v in zip(SHAPES, values, strict=True)))
    return [replace(f, errors=dict.fromkeys(f.values, e)) for f, e in zip(plain, ERRORS, strict=True)]


def numbers(fitted: tuple[FittedEffect, ...]) -> Floats:
    return np.array([v for f in fitted for v in f.values.values()])


def day(seed: int, *values: float) -> Readings:
    """A day whose laser wanders by three times its noise."""
    noise = {"white_um": 0.3, "drift_um": 1.0, "drift_tau_s": 2400.0}
    sensors = dict.fromkeys(("offset_degc", "noise_degc", "lag_s", "resolution_degc"), 0.0)
    truth = [s.format(v) for s, v in zip(SHAPES, values, strict=True)]
    return read([laser(truth, seed, noise=noise, thermal={"sensors": sensors})])


@pytest.mark.parametrize("changed", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("new", [False, True])
def test_the_looseness_is_the_likeliest_by_the_density_of_a_normal_distribution(changed: float, new: bool) -> None:
    """The density of what is orthogonal to unknowns of any size: the zero of the set-up, a number without a fit."""
    readings = day(5, 8.0 - changed, 2.0, 6.0)
    before = model(8.0, 2.0, 6.0)
    before = [*before[:2], replace(before[2], errors={})] if new else before
    columns = np.concatenate([*(readings.columns(f.effect, f.theta) for f in before), readings.setup], axis=1)
    whitener = find_noise(readings, columns)
    known = [0, 1] if new else [0, 1, 2]
    white, target = whitener(columns), whitener(readings.values)
    away = null_space(np.delete(white, known, axis=1).T)
    values, errors = numbers(tuple(before))[known], np.array(ERRORS)[known]
    seen, rest = away.T @ (white[:, known] * errors), away.T @ (target - white[:, known] @ values)
    # Directions that no number moves have the same density for every looseness.
    basis, triangle = np.linalg.qr(seen)
    densities = [
        multivariate_normal.logpdf(basis.T @ rest, cov=np.eye(len(known)) + loose**2 * triangle @ triangle.T)
        for loose in LOOSENESS
    ]
    assert joint._likeliest(before, readings, whitener, columns) == LOOSENESS[int(np.argmax(densities))]


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
@pytest.mark.parametrize("changed", [10.0, 40.0])
def test_a_number_that_changed_by_many_standard_errors_is_refitted(seed: int, changed: float) -> None:
    """A scale error that was known to 0.09 µm/m changed by 10 and by 40 µm/m between two days."""
    readings = day(seed, 8.0 - changed, 2.0, 6.0)
    fit = joint_fit(model(8.0, 2.0, 6.0), readings, loose=None)
    errors = np.array([e for f in fit.effects for e in f.errors.values()])
    assert np.all(np.abs(numbers(fit.effects) - (8.0 - changed, 2.0, 6.0)) < 4.0 * errors)
    again = joint_fit(fit.effects, readings, loose=None)
    assert np.all(np.abs(numbers(again.effects) - numbers(fit.effects)) < errors)


@pytest.mark.parametrize("drift_um", [0.0, 0.15])
@pytest.mark.parametrize("seed", range(1, 9))
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
    fit = joint_fit([scale, expansion], readings, loose=None)
    assert fit.effects[1].values["k"] == pytest.approx(known, abs=ERRORS[2])
    assert fit.effects[1].errors["k"] <= ERRORS[2]

"""Standard errors of a fit and of its refit; the quick form of `errors_proof`. Oracle: the sizes that were put in."""

from dataclasses import replace

import numpy as np

from rtec.estimation.gram.fit import estimate
from rtec.estimation.gram.source import Source
from rtec.estimation.gram.stream import Term
from tests.estimation.errors_proof import distances
from tests.estimation.refit_proof import case

SEEDS = [s for s in range(100, 140) if s % 10 < 8]
"""White noise, drift, steps, uneven runs, few runs."""


def test_errors_are_true_and_the_same_for_fit_and_refit() -> None:
    """One number comes back with the error that it had."""
    found = [distances(seed) for seed in SEEDS]
    fit, again = (np.concatenate([f[i] for f in found]) for i in (1, 2))
    for z in (fit, again):
        assert 0.7 < np.sqrt(np.mean(z**2)) < 1.3
        assert np.mean(np.abs(z) < 3.0) > 0.97
    clear = np.abs(again) > 0.1
    ratio = np.abs(again[clear] / fit[clear])
    assert np.abs(np.median(ratio) - 1.0) < 0.1
    assert np.mean(np.abs(ratio - 1.0) < 0.3) > 0.9, ratio


def test_many_readings_are_as_sure_as_they_are_many() -> None:
    """Oracle: numpy's least squares under white noise, σ²(XᵀX)⁻¹ of 40 000 readings; 8000 are looked at."""
    made = case(0)
    m, count = made.measured, 40_000 // len(made.measured) + 1
    n = count * len(m)
    rng = np.random.default_rng(3)
    columns = np.tile(made.columns, (count, 1))
    runs = np.concatenate([m.run + k * 100 for k in range(count)])
    readings = {"reading_um": 0.4 * rng.standard_normal(n)}
    channels = {k: np.tile(v, count) for k, v in m.channels.items()}
    long = replace(m, run=runs, time_s=np.linspace(0.0, 10.0 * n, n), channels=channels, readings=readings)
    fit = estimate([Source.of(long)], [Term(e) for e in made.effects])
    each = [np.flatnonzero(runs == r) for r in np.unique(runs)] if m.instrument.setup.zero == "run" else [np.arange(n)]  # type: ignore[attr-defined]
    for rows in each:
        columns[rows] -= columns[rows].mean(axis=0)
    errors = 0.4 * np.sqrt(np.diag(np.linalg.inv(columns.T @ columns)))
    np.testing.assert_allclose(fit.errors[: len(errors)], errors, rtol=0.15)

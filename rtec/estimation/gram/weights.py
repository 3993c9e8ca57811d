"""Noise of each reading, and its weight in a fit."""

from collections.abc import Sequence

import numpy as np

from rtec.arrays import Floats, robust_scatter
from rtec.estimation.gram.source import Source, project

LEAST = 0.02
"""The noise of a reading is at least this share of the spread of its column."""


def rough_noise(source: Source) -> Floats:
    """Noise of each reading column from the differences of neighbouring readings of a run, (readings,)."""
    values = source.measurement.matrix()
    out = np.empty(len(values))
    for j, column in enumerate(values):
        inside = np.diff(source.measurement.run) == 0
        step = np.diff(column)[inside]
        step = step[np.isfinite(step)]
        spread = np.nanstd(column) if np.isfinite(column).any() else 1.0
        robust = robust_scatter(step) / np.sqrt(2.0)
        out[j] = max(robust, LEAST * spread) or 1.0
    return out


def residuals_of(source: Source, predicted: Floats, explicit: Sequence[tuple[Floats, float]] = ()) -> Floats:
    """Readings minus prediction minus each run's nuisances, unweighted, (readings, n); NaN where none or excluded.

    Args:
        source: with the weights of the fit.
        predicted: weighted prediction without nuisances, (n · readings,).
        explicit: weighted columns of explicit nuisances and their coefficients.
    """
    left = source.readings * source.weight - predicted
    for column, value in explicit:
        left = left - column * value
    left = project(left, source.projected, source.run_starts)
    with np.errstate(invalid="ignore", divide="ignore"):
        plain = np.where(source.weight > 0, left / source.weight, np.nan)
    return plain.reshape(-1, source.count).T

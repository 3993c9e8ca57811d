"""How noisy each reading is, and how much it counts in a fit."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.estimation.gram.source import Source, project
from rtec.estimation.kinds import SIGMA_PER_MAD

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

FAR = 6.0
"""Residuals beyond so many robust standard deviations count less."""
FEW = 0.03
"""More of them than this share are what the machine does."""
SMALL = 0.005
"""A robust standard deviation is never less than this share of the spread: quantised readings are mostly equal."""
LEAST = 0.02
"""No reading is trusted more than to this share of the spread of its column."""


@dataclass(frozen=True)
class Outlier:
    """A reading that is off.

    Attributes:
        measurement, column: where.
        row: counted from 0; run: its number.
        off: how far from what the fit or its neighbours say, in the column's unit.
        left_out: whether it was left out, or only counts less.
    """

    measurement: str
    column: str
    row: int
    run: int
    off: float
    left_out: bool


def rough_noise(source: Source) -> Floats:
    """Noise of each reading column from how neighbouring readings of a run differ, (readings,)."""
    values = source.measurement.matrix()
    out = np.empty(len(values))
    for j, column in enumerate(values):
        inside = np.diff(source.measurement.run) == 0
        step = np.diff(column)[inside]
        step = step[np.isfinite(step)]
        spread = np.nanstd(column) if np.isfinite(column).any() else 1.0
        robust = SIGMA_PER_MAD * np.median(np.abs(step - np.median(step))) / np.sqrt(2.0) if len(step) else 0.0
        out[j] = max(robust, LEAST * spread) or 1.0
    return out


def residuals_of(source: Source, predicted: Floats, explicit: Sequence[tuple[Floats, float]] = ()) -> Floats:
    """Readings minus prediction minus each run's nuisances, unweighted, (readings, n); NaN where none or left out.

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


def huber_weights(residual: Floats, run: NDArray[np.int64]) -> Floats:
    """Weights by the residuals of a fit, (readings, n): below one for the few that are far off (Huber)."""
    out = np.ones(residual.shape)
    for j, left in enumerate(from_run_medians(residual, run)):
        scale, read = _scale(left, left), int(np.isfinite(left).sum())
        if not scale > 0:
            continue
        far = np.abs(np.nan_to_num(left)) > FAR * scale
        if far.sum() <= FEW * read:
            out[j, far] = FAR * scale / np.abs(left[far])
    return out


def from_run_medians(residual: Floats, run: NDArray[np.int64]) -> Floats:
    """Residuals less the median of their run: one gross error moves the zero of its run, and so all of the others."""
    out = residual.copy()
    edges = np.flatnonzero(np.diff(run)) + 1
    for part in np.split(np.arange(len(run)), edges):
        for row in out:
            here = row[part]
            good = here[np.isfinite(here)]
            if len(good):
                row[part] = here - np.median(good)
    return out


def describe(source: Source, residual: Floats, weight: Floats) -> list[Outlier]:
    """List the readings that count less."""
    run, names = source.measurement.run, source.measurement.instrument.columns()
    return [
        Outlier(source.measurement.name, names[j], int(i), int(run[i]), float(residual[j, i]), left_out=False)
        for j, i in zip(*np.nonzero(weight < 1.0), strict=True)
    ]


def _scale(values: Floats, column: Floats) -> float:
    good = values[np.isfinite(values)]
    if not len(good):
        return 0.0
    robust = SIGMA_PER_MAD * float(np.median(np.abs(good - np.median(good))))
    spread = float(np.nanstd(column)) if np.isfinite(column).any() else 0.0
    return max(robust, SMALL * spread)

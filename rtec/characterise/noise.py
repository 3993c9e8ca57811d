"""How noisy each reading is, and which readings are off: told with their rows, never dropped in silence."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.characterise.source import Source, project

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

SIGMA_PER_MAD = 1.4826
FAR = 6.0
"""So many robust standard deviations off is suspect."""
NEAR = 3.0
"""A suspect whose neighbours are within this is alone: one wrong reading, not a feature of the machine."""
FEW = 0.01
"""Suspects in company, when fewer than this share, count less (Huber); more of them are what the machine does."""
SMALL = 0.005
"""A robust standard deviation is never less than this share of the spread: quantised readings are mostly equal."""
MANY = 0.03
"""More single suspects than this share are no mistakes of reading."""
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


def residuals(source: Source, predicted: Floats, explicit: Sequence[tuple[Floats, float]] = ()) -> Floats:
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


def around(source: Source) -> Floats:
    """Median of five neighbours in the run, itself among them, (readings, n); NaN at the ends of runs."""
    values, run = source.measurement.matrix(), source.measurement.run
    out = np.full(values.shape, np.nan)
    if values.shape[1] >= 5:
        inner = (run[:-4] == run[2:-2]) & (run[4:] == run[2:-2])
        five = np.stack([values[:, i : values.shape[1] - 4 + i] for i in range(5)])
        out[:, 2:-2] = np.where(inner, np.median(five, axis=0), np.nan)
    return out


def spikes(source: Source) -> Bools:
    """Readings far from the median of their neighbours in the run, alone among them, (readings, n).

    Needs no model: finds gross errors before a choice is made. First and last readings of a run are left to the fit.
    """
    values = source.measurement.matrix()
    off = values - around(source)
    run, sigma = source.measurement.run, rough_noise(source)
    found = [_alone(o, s, 1.5 * FAR, run) for o, s in zip(off, sigma, strict=True)]
    return np.stack(found)


def suspects(residual: Floats, run: NDArray[np.int64]) -> tuple[Bools, Floats]:
    """Judge the residuals of a fit, (readings, n).

    Returns:
        Readings that are far off and alone, to be left out; and a weight for all, below one for suspects in company.
    """
    alone, weight = np.zeros(residual.shape, dtype=bool), np.ones(residual.shape)
    for j, left in enumerate(from_run_medians(residual, run)):
        scale, read = _scale(left, left), int(np.isfinite(left).sum())
        if not scale > 0:
            continue
        single = _alone(left, scale, FAR, run)
        if single.sum() <= MANY * read:
            alone[j] = single
        company = (np.abs(left) > FAR * scale) & ~single
        if company.sum() <= FEW * read:
            weight[j, company] = FAR * scale / np.abs(left[company])
    return alone, weight


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


def describe(source: Source, residual: Floats, alone: Bools, weight: Floats) -> list[Outlier]:
    """List the readings that are off."""
    run, names = source.measurement.run, source.measurement.instrument.columns()
    out = []
    for j, i in zip(*np.nonzero(alone | (weight < 1.0)), strict=True):
        row, gone = int(i), bool(alone[j, i])
        out.append(Outlier(source.measurement.name, names[j], row, int(run[row]), float(residual[j, i]), gone))
    return out


def _scale(values: Floats, column: Floats) -> float:
    good = values[np.isfinite(values)]
    if not len(good):
        return 0.0
    robust = SIGMA_PER_MAD * float(np.median(np.abs(good - np.median(good))))
    spread = float(np.nanstd(column)) if np.isfinite(column).any() else 0.0
    return max(robust, SMALL * spread)


def _alone(values: Floats, scale: float, far: float, run: NDArray[np.int64]) -> Bools:
    """Values beyond `far` scales whose neighbours in the run are both near, or not there."""
    big = np.abs(np.nan_to_num(values)) > far * scale
    near = ~(np.abs(np.nan_to_num(values)) > NEAR * scale)
    before, after = np.ones(len(values), bool), np.ones(len(values), bool)
    same = run[1:] == run[:-1]
    before[1:] = near[:-1] | ~same
    after[:-1] = near[1:] | ~same
    return np.asarray(big & before & after)

"""Generalised least squares with a noise that is found along with it, and the error on runs that were left out."""

import itertools
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rtec.estimation.kinds import spreads
from rtec.estimation.noise import Whitener, log_likelihood, refine
from rtec.estimation.readings import Readings, Series

Floats = NDArray[np.float64]

ROUNDS = 3
NOTHING = 1e-100
"""A column of a smaller norm is rounding, and its square would not be a number any more."""
STEPS = 24
SMALL = 1e-11


@dataclass(frozen=True)
class Fit:
    """A fit of columns to the readings.

    Attributes:
        whitener: the noise that was found.
        columns: (m, p).
        values: coefficients, (p,).
        log_likelihood: of the readings, up to a constant.
    """

    whitener: Whitener
    columns: Floats
    values: Floats
    log_likelihood: float

    @cached_property
    def left(self) -> Floats:
        """Readings less the fit, (m,)."""
        return np.asarray(self.whitener.readings.values - self.columns @ self.values)

    @cached_property
    def covariance(self) -> Floats:
        """Covariance of the coefficients under the noise that was found, (p, p)."""
        return inverse(self.whitener(self.columns))


def fit_columns(whitener: Whitener, columns: Floats, rounds: int = ROUNDS, steps: int = STEPS) -> Fit:
    """Fit columns and noise in turn, beginning with a noise that is about right."""
    readings, now = whitener.readings, whitener
    values = solve(now(columns), now(readings.values))
    for _ in range(rounds):
        now = refine(now, readings.values - columns @ values, steps)
        values = solve(now(columns), now(readings.values))
    return Fit(now, columns, values, log_likelihood(now, readings.values - columns @ values))


def solve(columns: Floats, values: Floats) -> Floats:
    """Least squares; a direction that the readings do not see gets nothing, (p,)."""
    scale = np.linalg.norm(columns, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    scaled = columns / scale
    gram = scaled.T @ scaled
    found = _pseudo(gram) @ (scaled.T @ values)
    # One step of refinement gives back the digits that the normal equations lost.
    found = found + _pseudo(gram) @ (scaled.T @ (values - scaled @ found))
    return np.asarray(found / scale)


def inverse(columns: Floats) -> Floats:
    """Inverse of the normal equations, unseen directions zero, (p, p)."""
    scale = np.linalg.norm(columns, axis=0)
    scale = np.where(scale > NOTHING, scale, 1.0)
    scaled = columns / scale
    return np.asarray(_pseudo(scaled.T @ scaled) / np.outer(scale, scale))


def resolved(columns: Floats) -> Floats:
    """How far each coefficient is decided by itself, (p,): 1, or less where others could take its place, 0 unseen."""
    scale = np.linalg.norm(columns, axis=0)
    there = scale > NOTHING
    scaled = columns / np.where(there, scale, 1.0)
    gram = scaled.T @ scaled
    return np.asarray(np.where(there, np.diag(_pseudo(gram) @ gram), 0.0))


def _pseudo(gram: Floats) -> Floats:
    if not len(gram):
        return gram
    value, vector = np.linalg.eigh(gram)
    good = value > SMALL * value[-1]
    return np.asarray((vector[:, good] / value[good]) @ vector[:, good].T)


@dataclass(frozen=True)
class HeldOut:
    """Error on runs that were left out of the fit.

    Attributes:
        white: sum of squares of whitened residuals, by fold, (folds,).
        square: mean square of plain residuals, nuisances of each run taken out.
        series: the same for each series, (series,).
        folds: sum of squares of plain residuals of each fold, each series over the mean square of the
            readings of equal instruments, (folds,).
    """

    white: Floats
    square: float
    series: Floats
    folds: Floats

    @property
    def rms(self) -> float:
        """Root mean square."""
        return float(np.sqrt(self.square))


class Weights(Protocol):
    """What weighs columns for least squares."""

    @property
    def readings(self) -> Readings:
        """The readings."""

    def __call__(self, columns: Floats) -> Floats:
        """Columns, (m,) or (m, p), weighted."""


def held_out(whitener: Weights, columns: Floats, scale: Floats | None = None) -> HeldOut:
    """Leave out fold by fold, fit the rest, predict what was left out.

    Args:
        whitener: the weights.
        columns: (m, p).
        scale: one over the unit of each series in the mean square, (series,); ones where not given.
    """
    readings = whitener.readings
    white, target = whitener(columns), whitener(readings.values)
    norm = np.linalg.norm(white, axis=0)
    norm = np.where(norm > 0, norm, 1.0)
    white, plain = white / norm, columns / norm
    folds = np.unique(readings.fold)
    rows = [np.flatnonzero(readings.fold == f) for f in folds]
    grams = [white[r].T @ white[r] for r in rows]
    rights = [white[r].T @ target[r] for r in rows]
    gram, right = np.sum(grams, axis=0), np.sum(rights, axis=0)
    lost = np.zeros(len(folds))
    left = np.empty(len(readings))
    for i, r in enumerate(rows):
        values = _pseudo(gram - grams[i]) @ (right - rights[i]) if len(folds) > 1 else _pseudo(gram) @ right
        error = target[r] - white[r] @ values
        lost[i] = float(error @ error)
        left[r] = readings.values[r] - plain[r] @ values
    cleaned = without_nuisance(readings, left)
    weight = np.ones(len(readings.series)) if scale is None else scale
    squares = [float(np.mean(cleaned[s.part] ** 2)) * w * w for s, w in zip(readings.series, weight, strict=True)]
    sizes = np.array([len(s) for s in readings.series], dtype=np.float64)
    whole = spreads(readings, without_nuisance(readings, readings.values)) ** 2
    folded = np.array([float(np.sum(cleaned[r] ** 2 / whole[readings.series_of[r]])) for r in rows])
    return HeldOut(lost, float(np.average(squares, weights=sizes)), np.array(squares), folded)


def without_nuisance(readings: Readings, left: Floats) -> Floats:
    """Residuals less what each run has anew (zero, slope), by least squares run by run, (m,) or (m, p)."""
    out = left.copy()
    for s in readings.series:
        if s.nuisance.shape[1]:
            out[s.part] = without_runs(s, out[s.part])
    return out


def without_runs(series: Series, columns: Floats) -> Floats:
    """Columns of one series less what each run has anew, (n,) or (n, p)."""
    if not series.nuisance.shape[1]:
        return columns.copy()
    edges = np.concatenate([[0], np.flatnonzero(np.diff(series.run)) + 1, [len(series)]])
    if series.nuisance.shape[1] == 1 and not np.ptp(series.nuisance):
        size = np.diff(edges).astype(np.float64)
        means = np.add.reduceat(columns, edges[:-1], axis=0) / (size if columns.ndim == 1 else size[:, None])
        return np.asarray(columns - means[series.run])
    out = columns.copy()
    for a, b in itertools.pairwise(edges):
        own = series.nuisance[a:b]
        out[a:b] -= own @ np.linalg.lstsq(own, out[a:b], rcond=None)[0]
    return out

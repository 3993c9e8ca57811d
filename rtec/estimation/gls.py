"""Generalised least squares with a noise estimated in the same fit, and the error on held-out runs."""

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from rtec.arrays import Floats
from rtec.estimation.held_out import STILL_MM
from rtec.estimation.kinds import spreads
from rtec.estimation.noise import Whitener, log_likelihood, refine
from rtec.estimation.readings import Readings, Series

ROUNDS = 3
NOTHING = 1e-100
"""A column of a smaller norm is rounding, and its square would underflow."""
STEPS = 24
SMALL = 1e-11


@dataclass(frozen=True)
class Fit:
    """A fit of columns to the readings.

    Attributes:
        whitener: the estimated noise.
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
        """Residual of the fit, (m,)."""
        return np.asarray(self.whitener.readings.values - self.columns @ self.values)

    @cached_property
    def covariance(self) -> Floats:
        """Covariance of the coefficients under the estimated noise, (p, p)."""
        return inverse(self.whitener(self.columns))


def fit_columns(whitener: Whitener, columns: Floats, rounds: int = ROUNDS, values: Floats | None = None) -> Fit:
    """Fit columns and noise in turn.

    Args:
        whitener: an approximate noise to start with.
        columns: (m, p).
        rounds: number of noise estimates.
        values: coefficients under the first noise, (p,); None where they are unknown.
    """
    readings, now = whitener.readings, whitener
    whole = np.concatenate([columns, readings.values[:, None]], axis=1)
    if values is None:
        white = now(whole)
        values = solve(white[:, :-1], white[:, -1])
    for _ in range(rounds):
        now = refine(now, readings.values - columns @ values, STEPS)
        white = now(whole)
        values = solve(white[:, :-1], white[:, -1])
    return Fit(now, columns, values, log_likelihood(now, white[:, -1] - white[:, :-1] @ values))


def bic_cost(numbers: int, readings: float) -> float:
    """Cost of numbers in log evidence: half the Bayesian information criterion's (Schwarz 1978)."""
    return 0.5 * numbers * math.log(readings)


def solve(columns: Floats, values: Floats) -> Floats:
    """Least squares, (p,), or (p, q) for values (m, q); a direction that the readings do not see gets zero."""
    gram = columns.T @ columns
    size = np.sqrt(np.diag(gram))
    size = np.where(size > NOTHING, size, 1.0)
    scale = np.outer(size, size)
    back = _pseudo(gram / scale) / scale
    found = back @ (columns.T @ values)
    # One step of refinement restores the digits that the normal equations lost.
    return np.asarray(found + back @ (columns.T @ (values - columns @ found)))


def inverse(columns: Floats) -> Floats:
    """Inverse of the normal equations, unseen directions zero, (p, p)."""
    scale = np.linalg.norm(columns, axis=0)
    scale = np.where(scale > NOTHING, scale, 1.0)
    scaled = columns / scale
    return np.asarray(_pseudo(scaled.T @ scaled) / np.outer(scale, scale))


def resolved(columns: Floats) -> Floats:
    """Share of each coefficient that is determined by itself, (p,): 1; less where others can replace it; 0 unseen."""
    scale = np.linalg.norm(columns, axis=0)
    there = scale > NOTHING
    scaled = columns / np.where(there, scale, 1.0)
    gram = scaled.T @ scaled
    return np.asarray(np.where(there, np.diag(_pseudo(gram) @ gram), 0.0))


def _pseudo(gram: Floats) -> Floats:
    """Inverses of symmetric matrices, (…, p, p), without their nearly singular directions."""
    if not gram.shape[-1]:
        return gram
    value, vector = np.linalg.eigh(gram)
    good = value > SMALL * value[..., -1:]
    back = np.where(good, 1.0 / np.where(good, value, 1.0), 0.0)
    return np.asarray((vector * back[..., None, :]) @ vector.swapaxes(-1, -2))


@dataclass(frozen=True)
class HeldOut:
    """Error on held-out runs.

    Attributes:
        white: sum of squares of whitened residuals, by fold, (folds,).
        square: mean square of plain residuals, nuisances of each run projected out.
        series: the same for each series, (series,).
        folds: sum of squares of plain residuals of each fold, each series over the mean square of the
            readings of equal instruments, (folds,).
        within: the same about the mean of each run, (folds,).
    """

    white: Floats
    square: float
    series: Floats
    folds: Floats
    within: Floats

    @property
    def rms(self) -> float:
        """Root mean square."""
        return float(np.sqrt(self.square))


class Weights(Protocol):
    """Weights of columns for least squares."""

    @property
    def readings(self) -> Readings:
        """All readings."""

    def __call__(self, columns: Floats) -> Floats:
        """Columns, (m,) or (m, p), weighted."""


def held_out(whitener: Weights, columns: Floats, scale: Floats | None = None) -> HeldOut:
    """Hold out fold by fold, fit the rest, predict the held-out readings.

    Args:
        whitener: the weights.
        columns: (m, p).
        scale: one over the unit of each series in the mean square, (series,); ones by default.
    """
    readings, runs = whitener.readings, _HeldOutRuns(whitener, columns)
    lost, left = runs.errors(columns.shape[1])
    weight = np.ones(len(readings.series)) if scale is None else scale
    squares = [float(np.mean(left[s.part] ** 2)) * w * w for s, w in zip(readings.series, weight, strict=True)]
    sizes = np.array([len(s) for s in readings.series], dtype=np.float64)
    whole = spreads(readings, without_nuisance(readings, readings.values)) ** 2
    folded, within = (
        np.array([float(np.sum(v[r] ** 2 / whole[readings.series_of[r]])) for r in runs.rows])
        for v in (left, about_runs(readings, left))
    )
    return HeldOut(lost, float(np.average(squares, weights=sizes)), np.array(squares), folded, within)


class HeldOutGain(NamedTuple):
    """What columns improve on held-out runs.

    Attributes:
        drop: relative fall of the mean square.
        gain: mean gain of the folds in whitened squares.
        within: relative fall of the mean square about the mean of each run, which no drift from run to run changes.
    """

    drop: float
    gain: float
    within: float


def held_out_gain(whitener: Weights, base: Floats, columns: Floats, kept: Floats | None = None) -> HeldOutGain:
    """Improvement on held-out runs by columns, (m, k), beside a base, (m, p).

    Args:
        whitener: the weights.
        base: columns of the current model; their coefficients are refitted to the other folds.
        columns: further columns.
        kept: prediction of the current model with the numbers that it has from other readings, (m,). Then the better of
            both counts, without and with the columns: few runs determine a number that changes from run to run badly.
    """
    ways = [(_HeldOutRuns(whitener, np.concatenate([base, columns], axis=1)), base.shape[1])]
    if kept is not None:
        setup = whitener.readings.setup
        ways.append((_HeldOutRuns(whitener, np.concatenate([setup, columns], axis=1), kept), setup.shape[1]))

    def best(more: int) -> tuple[Floats, Floats]:
        return min((runs.errors(width + more) for runs, width in ways), key=lambda e: float(e[1] @ e[1]))

    (without, before), (with_it, after) = best(0), best(columns.shape[1])
    falls = [
        1.0 - float(b @ b) / max(float(a @ a), 1e-300)
        for a, b in ((before, after), (about_runs(whitener.readings, before), about_runs(whitener.readings, after)))
    ]
    return HeldOutGain(falls[0], float(np.mean(without - with_it)), falls[1])


ALONG = 0.5
"""Share of its own mean square that an effect has within runs where it acts along them."""


def about_runs(readings: Readings, left: Floats) -> Floats:
    """Residuals about the mean of their run, (m,); as they are where no axis moves in the runs."""
    out = left.copy()
    for s in readings.series:
        if _moves(readings, s):
            out[s.part] = _about_means(s, left[s.part, None])[:, 0]
    return out


def along_runs(readings: Readings, columns: Floats) -> bool:
    """Whether an effect, columns (m, k), changes mostly along the runs, as axes move; not from run to run."""
    within = whole = 0.0
    for s in readings.series:
        part = columns[s.part]
        whole += float(np.sum((part - part.mean(axis=0)) ** 2))
        within += float(np.sum(_about_means(s, part) ** 2)) if _moves(readings, s) else 0.0
    return within > ALONG * whole


def _about_means(s: Series, columns: Floats) -> Floats:
    """Columns of a series about their means of each run, (n, k)."""
    sums = np.stack([np.bincount(s.run, c) for c in columns.T], axis=1)
    return np.asarray(columns - (sums / np.maximum(np.bincount(s.run), 1)[:, None])[s.run])


def _moves(readings: Readings, s: Series) -> bool:
    """Whether an axis moves within the runs of a series."""
    first = np.flatnonzero(np.diff(s.run, prepend=-1))
    places = readings.poses_mm[s.source][s.row]
    return bool(np.max(np.abs(places - places[first][s.run]), initial=0.0) > STILL_MM)


class _HeldOutRuns:
    """Normal equations of each fold, for fits of the first columns, any number of them, to all other folds."""

    def __init__(self, whitener: Weights, columns: Floats, less: Floats | None = None) -> None:
        self.readings = readings = whitener.readings
        self.values = readings.values if less is None else readings.values - less
        white, self.target = whitener(columns), whitener(self.values)
        norm = np.sqrt(np.einsum("ij,ij->j", white, white))
        norm = np.where(norm > 0, norm, 1.0)
        white, self.plain = white / norm, columns / norm
        self.rows = [np.flatnonzero(readings.fold == f) for f in np.unique(readings.fold)]
        self.parts = [white[r] for r in self.rows]
        self.grams = np.stack([w.T @ w for w in self.parts])
        self.rights = np.stack([w.T @ self.target[r] for w, r in zip(self.parts, self.rows, strict=True)])
        self.alone: dict[int, tuple[Floats, Floats]] = {}
        for fold in np.flatnonzero(readings.alone.any(axis=1)).tolist():
            own = readings.setup[:, readings.alone[fold]]
            self.alone[fold] = whitener(own)[self.rows[fold]], own[self.rows[fold]]

    def errors(self, width: int) -> tuple[Floats, Floats]:
        """Sums of squares of the whitened errors by fold, (folds,); errors less the unknowns of each run, (m,).

        An unknown of the set-up that only one fold has is fitted to it: the others do not predict it.
        """
        grams, rights = self.grams[:, :width, :width], self.rights[:, :width]
        if len(self.rows) > 1:
            grams, rights = grams.sum(axis=0) - grams, rights.sum(axis=0) - rights
        values = (_pseudo(grams) @ rights[..., None])[..., 0]
        lost, left = np.zeros(len(self.rows)), np.empty(len(self.readings))
        for i, (r, part) in enumerate(zip(self.rows, self.parts, strict=True)):
            error = self.target[r] - part[:, :width] @ values[i]
            left[r] = self.values[r] - self.plain[r, :width] @ values[i]
            if i in self.alone:
                white, plain = self.alone[i]
                own = solve(white, error)
                error, left[r] = error - white @ own, left[r] - plain @ own
            lost[i] = float(error @ error)
        return lost, without_nuisance(self.readings, left)


def without_nuisance(readings: Readings, left: Floats) -> Floats:
    """Residuals less the unknowns of each run (zero, slope), by least squares run by run, (m,) or (m, p)."""
    out = left.copy()
    for s in readings.series:
        if s.nuisance.shape[1]:
            out[s.part] = without_runs(s, out[s.part])
    return out


def without_runs(series: Series, columns: Floats, weight: Floats | None = None) -> Floats:
    """Columns of one series less the unknowns of each run, (n,) or (n, p), by least squares, weighted by (n,)."""
    if not series.nuisance.shape[1]:
        return columns.copy()
    edges = np.concatenate([[0], np.flatnonzero(np.diff(series.run)) + 1, [len(series)]])
    each = (np.ones(len(series)) if weight is None else weight).reshape(-1, *[1] * (columns.ndim - 1))
    if series.nuisance.shape[1] == 1 and not np.ptp(series.nuisance):
        means = np.add.reduceat(columns * each, edges[:-1], axis=0) / np.add.reduceat(each, edges[:-1], axis=0)
        return np.asarray(columns - means[series.run])
    out, roots = columns.copy(), np.sqrt(each)
    for a, b in itertools.pairwise(edges):
        own, root = series.nuisance[a:b], roots[a:b]
        out[a:b] -= own @ np.linalg.lstsq(own * root.reshape(-1, 1), out[a:b] * root, rcond=None)[0]
    return out

"""Wrong readings: single ones far from their neighbours in the run, in what no smooth dependence explains."""

import itertools

import numpy as np
from numpy.typing import NDArray

from rtec.estimation.gls import solve
from rtec.estimation.readings import Readings, Series

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

FAR, NEAR, COMPANY = 7.0, 3.0, 0.3
"""Robust standard deviations; and the share of a wrong reading that its neighbours may be off at the most."""
ROUNDS = 3
"""A wrong reading bends the smooth part, so that it is looked for again without those that were found."""
REACH = 5
SIGMA_PER_MAD, SMALL = 1.4826, 0.02


def wrong_readings(readings: Readings, columns: Floats, left: Floats) -> Bools:
    """Single readings that are far off, (m,); two beside each other are what the machine does.

    Args:
        readings: of all series.
        columns: smooth dependences, (m, p).
        left: measured minus predicted, (m,).
    """
    wrong = np.zeros(len(left), dtype=bool)
    for _ in range(ROUNDS):
        rough = less(readings, columns, left, wrong)
        found = np.zeros(len(left), dtype=bool)
        for s in readings.series:
            found[s.part] = _single(rough[s.part], s, float(np.std(left[s.part])), wrong[s.part])
        if not (found & ~wrong).any():
            break
        wrong |= found
    return wrong


def _single(rough: Floats, s: Series, spread: float, wrong: Bools) -> Bools:
    off = rough - _of_neighbours(np.where(wrong, np.nan, rough), rough, s)
    sigma = max(SIGMA_PER_MAD * float(np.median(np.abs(off))), SMALL * spread, 1e-9)
    size = np.abs(off)
    beside = np.zeros(len(off))
    same = np.diff(s.run) == 0
    beside[1:] = np.where(same, size[:-1], 0.0)
    beside[:-1] = np.maximum(beside[:-1], np.where(same, size[1:], 0.0))
    return np.asarray((size > FAR * sigma) & (beside < np.maximum(NEAR * sigma, COMPANY * size)))


def _of_neighbours(values: Floats, own: Floats, s: Series) -> Floats:
    """Median of the nearest readings of the run, five on either side, the reading itself left out, (n,).

    Args:
        values: NaN where a reading is known to be wrong, (n,).
        own: given back where a reading has no neighbours, (n,).
        s: the series.
    """
    n = len(values)
    shifts = [k for k in range(-REACH, REACH + 1) if k and abs(k) < n]
    if not shifts:
        return own
    there = np.full((len(shifts), n), np.nan)
    for row, k in zip(there, shifts, strict=True):
        to = slice(max(k, 0), n + min(k, 0))
        at = slice(max(-k, 0), n - max(k, 0))
        row[at] = np.where(s.run[to] == s.run[at], values[to], np.nan)
    alone = np.isnan(there).all(axis=0)
    # A run of one reading has no neighbours: nothing is said of it.
    there[:, alone] = own[alone]
    return np.asarray(np.nanmedian(there, axis=0))


def less(readings: Readings, columns: Floats, values: Floats, without: Bools | None = None) -> Floats:
    """Values less what the columns explain of them by least squares, series by series, (m,).

    Args:
        readings: of all series.
        columns: (m, p).
        values: (m,).
        without: readings that the fit does not see, (m,).
    """
    out = values.copy()
    for s in readings.series:
        mine = without_runs(s, columns[s.part])
        seen = np.ones(len(s), dtype=bool) if without is None else ~without[s.part]
        out[s.part] -= mine @ solve(mine[seen], values[s.part][seen])
    return out


def without_runs(series: Series, columns: Floats) -> Floats:
    """Columns of one series less what each run has anew, (n, p)."""
    out = columns.copy()
    if series.nuisance.shape[1]:
        edges = np.concatenate([[0], np.flatnonzero(np.diff(series.run)) + 1, [len(series)]])
        for a, b in itertools.pairwise(edges):
            own = series.nuisance[a:b]
            out[a:b] -= own @ np.linalg.lstsq(own, out[a:b], rcond=None)[0]
    return out

"""Least squares, plain and on held-out runs. Oracle: numpy's least squares, and each step written out."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.estimation.gls import fit_columns, held_out, held_out_gain, solve, without_nuisance
from rtec.estimation.noise import Whitener, find_noise, log_likelihood
from rtec.estimation.readings import read
from tests.support.diagnosis_examples import laser

Floats = NDArray[np.float64]
READINGS = read([laser(["scale,component=EXX,axis=X,k=12"], 3)])
X = READINGS.channel("x")
BASE = np.stack([X, np.sin(X / 9.0)], axis=1)
MORE = np.stack([X**2, X**3], axis=1)


@cache
def noise() -> Whitener:
    """Found by the first test that needs it, not by every worker that collects the tests."""
    return find_noise(READINGS, BASE)


def test_solve_is_least_squares_and_gives_nothing_to_what_is_not_seen() -> None:
    """Columns of very different sizes, two of them one, one empty; two sets of values at once.

    Oracle: numpy's least squares of the columns at one size, each number divided by its column's.
    """
    rng = np.random.default_rng(4)
    even, sizes = rng.standard_normal((60, 4)), np.array([1.0, 1e6, 1e-6, 1.0])
    columns = even * sizes
    whole = np.concatenate([columns, columns[:, :1], np.zeros((60, 1))], axis=1)
    values = rng.standard_normal((60, 2))
    found, plain = solve(whole, values), np.linalg.lstsq(even, values, rcond=None)[0] / sizes[:, np.newaxis]
    assert found[1:4] == pytest.approx(plain[1:], rel=1e-9)
    assert found[0] == pytest.approx(plain[0] / 2.0, rel=1e-9)
    assert found[4] == pytest.approx(plain[0] / 2.0, rel=1e-9)
    assert not found[5].any()
    assert solve(whole, values[:, 0]) == pytest.approx(found[:, 0], rel=1e-12)


def test_a_fit_that_goes_on_ends_where_one_without_a_pause_does() -> None:
    columns = np.concatenate([BASE, MORE], axis=1)
    first = fit_columns(noise(), columns, 1)
    on, whole = fit_columns(first.whitener, columns, 2, values=first.values), fit_columns(noise(), columns, 3)
    assert on.log_likelihood == pytest.approx(whole.log_likelihood, rel=1e-12)
    assert on.values == pytest.approx(whole.values, rel=1e-9)
    assert log_likelihood(on.whitener, on.whitener(on.left)) == pytest.approx(on.log_likelihood, rel=1e-9)


def test_held_out_runs_are_those_that_the_fit_did_not_see() -> None:
    """Fold by fold: whiten, fit the other folds, predict this one."""

    def errors(columns: Floats) -> tuple[Floats, list[float]]:
        white, target = noise()(columns), noise()(READINGS.values)
        left, lost = np.empty(len(READINGS)), []
        for fold in np.unique(READINGS.fold):
            mine = READINGS.fold == fold
            values = np.linalg.lstsq(white[~mine], target[~mine], rcond=None)[0]
            lost.append(float(np.sum((target[mine] - white[mine] @ values) ** 2)))
            left[mine] = READINGS.values[mine] - columns[mine] @ values
        return without_nuisance(READINGS, left), lost

    without, lost = errors(BASE)
    with_it, less = errors(np.concatenate([BASE, MORE], axis=1))
    drop, gain, within = held_out_gain(noise(), BASE, MORE)
    assert drop == pytest.approx(1.0 - np.mean(with_it**2) / np.mean(without**2), rel=1e-6)
    assert gain == pytest.approx(np.mean(np.array(lost) - less), rel=1e-6)
    (s,) = READINGS.series
    one, other = (v - np.array([v[s.run == k].mean() for k in s.run]) for v in (with_it, without))
    assert within == pytest.approx(1.0 - np.mean(one**2) / np.mean(other**2), rel=1e-6)
    assert held_out(noise(), BASE).square == pytest.approx(np.mean(without**2), rel=1e-6)
    # With numbers that are known better than these readings tell, the better of both counts, without and with.
    kept = READINGS.values - 1e-3 * MORE[:, 0] + 0.1 * np.sin(X)
    whole = held_out_gain(noise(), BASE, MORE, kept)[0]
    target, known = noise()(READINGS.values - kept), []
    for columns in (READINGS.setup, np.concatenate([READINGS.setup, MORE], axis=1)):
        white, left = noise()(columns), np.empty(len(READINGS))
        for fold in np.unique(READINGS.fold):
            mine = READINGS.fold == fold
            values = np.linalg.lstsq(white[~mine], target[~mine], rcond=None)[0]
            left[mine] = (READINGS.values - kept)[mine] - columns[mine] @ values
        known.append(float(np.mean(without_nuisance(READINGS, left) ** 2)))
    least = min(known[1], float(np.mean(with_it**2))), min(known[0], float(np.mean(without**2)))
    assert least[0] == known[1]
    assert whole == pytest.approx(1.0 - least[0] / least[1], rel=1e-6)

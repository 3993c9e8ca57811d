"""Whitening and the search for the noise; oracles: dense linear algebra, and noise that was drawn."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize

from rtec.estimation import noise as noise_module
from rtec.estimation.noise import Noise, Whitener, find_noise, noise_bounds
from rtec.estimation.readings import Readings, read
from rtec.estimation.smoothing import Windows, smoothed, spline
from rtec.estimation.whitening import drift_draws, gains, innovations, likelihood, noise_cost, walk
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.wording import duration
from tests.support.machines import turning_centre

Floats = NDArray[np.float64]


def covariance(t: Floats, run: NDArray[np.int64], unknown: Floats, noise: Noise, wide: Floats) -> Floats:
    """Written down as it is defined."""
    same = run[:, None] == run
    out = np.eye(len(t)) + noise.offset * same + noise.drift * np.exp(-np.abs(t[:, None] - t) / noise.tau_s)
    for k in range(unknown.shape[1]):
        out += wide[k] * same * np.outer(unknown[:, k], unknown[:, k])
    return np.asarray(out)


@pytest.mark.parametrize("unknowns", [0, 1, 2])
@pytest.mark.parametrize("offset", [0.0, 0.7])
def test_innovations_are_those_of_a_cholesky_factor(unknowns: int, offset: float) -> None:
    """Oracle: `L⁻¹ y` and `log det Σ` of the dense matrix."""
    rng = np.random.default_rng(3)
    n, p = 240, 4
    t, run = np.sort(rng.uniform(0.0, 2e4, n)), np.arange(n) // 40
    unknown = np.stack([np.ones(n), rng.normal(size=n)], axis=1)[:, :unknowns]
    wide, noise = np.array([1e3, 4e2])[:unknowns], Noise(1.0, 2.5, 800.0, offset)
    decay, gain, scale = np.empty(n), np.empty((n, 2 + unknowns)), np.empty(n)
    log_det = gains(t, run, unknown, noise.drift, noise.tau_s, noise.offset, wide, decay, gain, scale)
    y = rng.normal(size=(n, p))
    white = y.copy()
    innovations(run, unknown, decay, gain, scale, white)
    sigma = covariance(t, run, unknown, noise, wide)
    np.testing.assert_allclose(white, np.linalg.solve(np.linalg.cholesky(sigma), y), atol=1e-9)
    assert log_det == pytest.approx(np.linalg.slogdet(sigma)[1], abs=1e-9)


def drawn(seed: int, runs: int = 20, each: int = 42, drift: float = 2.0, tau_s: float = 1800.0) -> Measurement:
    """Tip readings that are noise alone, σ = 0.4 µm."""
    rng = np.random.default_rng(seed)
    machine, n = turning_centre(), runs * each
    t = np.arange(n) * 30.0 + np.repeat(np.arange(runs), each) * 300.0
    noise = rng.standard_normal((n, 3))
    drift_draws(t, tau_s, noise)
    noise = 0.4 * (rng.standard_normal((n, 3)) + np.sqrt(drift) * noise)
    x = np.tile(np.linspace(5.0, 195.0, each), runs)
    names = ("reading_x_um", "reading_y_um", "reading_z_um")
    return Measurement(
        "tip",
        make_instrument("tool_tip", {}, None, None, machine, "test"),
        machine,
        np.repeat(np.arange(runs), each),
        t,
        {"x": x, "z": np.full(n, 100.0)},
        dict(zip(names, noise.T, strict=True)),
    )


@pytest.mark.parametrize("unknowns", [0, 1])
def test_the_compiled_likelihood_is_that_of_the_dense_matrix(unknowns: int) -> None:
    """Oracle: `log det Σ` and `yᵀ Σ⁻¹ y` of the dense matrix."""
    rng = np.random.default_rng(8)
    n = 150
    t, run = np.sort(rng.uniform(0.0, 1e4, n)), np.arange(n) // 30
    unknown, wide, y = np.ones((n, unknowns)), np.full(unknowns, 500.0), rng.normal(size=n)
    found = likelihood(t, run, unknown, wide, y, 1.5, 700.0, 0.4)
    sigma = covariance(t, run, unknown, Noise(1.0, 1.5, 700.0, 0.4), wide)
    np.testing.assert_allclose(found, [np.linalg.slogdet(sigma)[1], y @ np.linalg.solve(sigma, y)], rtol=1e-9)


def test_refining_lowers_the_cost_as_scipys_walk_does() -> None:
    """Oracle: scipy's Nelder-Mead on the same cost from the same place."""
    readings = read([drawn(4)])
    s = readings.series[0]
    y, wide = readings.values[s.part], np.zeros(0)
    data = (s.time_s, s.run, s.nuisance, wide, y, float(len(y)))
    start = np.log([0.3, 4000.0, 0.1])
    bounds = noise_bounds(s)
    mine = noise_cost(*data, walk(*data, start, bounds, 120), bounds)

    def cost(x: Floats) -> float:
        return float(noise_cost(*data, x, bounds))

    scipys = float(minimize(cost, start, method="Nelder-Mead").fun)
    assert mine < noise_cost(*data, start, bounds)
    assert mine == pytest.approx(scipys, abs=0.1)


def test_drift_is_found_as_it_was_drawn() -> None:
    """Oracle: what was drawn; the median over seeds and lanes, for one record holds little of a long drift."""
    found: list[Noise] = []
    for seed in range(6):
        readings = read([drawn(seed)])
        found += find_noise(readings, np.zeros((len(readings), 0))).noises
    assert float(np.median([n.sigma for n in found])) == pytest.approx(0.4, rel=0.06)
    assert float(np.median([n.drift for n in found])) == pytest.approx(2.0, rel=0.35)
    assert float(np.median([n.tau_s for n in found])) == pytest.approx(1800.0, rel=0.5)


def test_white_noise_has_no_drift() -> None:
    readings = read([drawn(11, drift=0.0)])
    noises = find_noise(readings, np.zeros((len(readings), 0))).noises
    assert noises
    for noise in noises:
        assert noise.sigma * np.sqrt(1.0 + noise.drift) == pytest.approx(0.4, rel=0.1)
        assert noise.floor == pytest.approx(0.4, rel=0.12)


def test_a_noise_that_was_searched_before_is_that_of_its_own_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: each search without a memory; a number, a place or a step changed gives a search of its own."""
    monkeypatch.setattr(noise_module, "KEPT", 3)
    searched: list[Noise] = []
    search = noise_module._search

    def counted(cost: Any, start: Noise, steps: int) -> Noise:
        searched.append(search(cost, start, steps))
        return searched[-1]

    monkeypatch.setattr(noise_module, "_search", counted)
    readings = read([drawn(29)])
    line = np.linspace(-1.0, 1.0, len(readings))[:, None]
    late = replace(readings, series=tuple(replace(s, time_s=1.5 * s.time_s) for s in readings.series))
    asked: list[tuple[Readings, Floats, int]] = [
        (readings, line[:, :0], 60), (readings, line, 60), (readings, line**3, 60), (readings, line, 20),
        (late, line, 60),
    ]  # fmt: skip
    alone = [find_noise(r, base, steps).noises for r, base, steps in asked]
    assert len(set(searched)) == len(searched) == len(asked) * len(readings.series)  # each is another
    for (r, base, steps), noises in [*zip(asked, alone, strict=True), *zip(asked[::-1], alone[::-1], strict=True)]:
        assert find_noise(r, base, steps).noises == noises
    before = len(searched)
    assert find_noise(*asked[0]).noises == alone[0]
    assert len(searched) == before


def test_whitened_noise_is_white() -> None:
    """Oracle: variance one, and no correlation between neighbours beyond what chance gives, 3/sqrt(n)."""
    readings = read([drawn(5)])
    whitener: Whitener = find_noise(readings, np.zeros((len(readings), 0)))
    white = whitener(readings.values)
    assert float(np.var(white)) == pytest.approx(1.0, rel=0.1)
    for s in readings.series:
        z = white[s.part]
        assert abs(float(np.corrcoef(z[1:], z[:-1])[0, 1])) < 3.0 / np.sqrt(len(z))


def test_columns_whiten_as_the_readings_do() -> None:
    """Whitening is linear: that of a sum is the sum."""
    readings = read([drawn(5)])
    whitener = find_noise(readings, np.zeros((len(readings), 0)))
    rng = np.random.default_rng(1)
    a, b = rng.standard_normal((2, len(readings), 3))
    np.testing.assert_allclose(whitener(2 * a - b), 2 * whitener(a) - whitener(b), atol=1e-9)


def test_smoothing_keeps_a_straight_line_and_lowers_noise() -> None:
    """Oracle: a line goes through unchanged, also across gaps and at the ends; white noise falls by the window."""
    rng = np.random.default_rng(2)
    t = np.sort(np.concatenate([np.arange(0.0, 9000.0, 30.0), np.arange(20000.0, 26000.0, 30.0)]))
    line = 20.0 + 1e-3 * t
    np.testing.assert_allclose(smoothed(Windows(t), line), line, atol=1e-9)
    rough = smoothed(Windows(t), line + 0.03 * rng.standard_normal(len(t))) - line
    assert float(np.std(rough)) < 0.03 / 2.0
    holes = line.copy()
    holes[[5, 50, 51]] = np.nan
    np.testing.assert_allclose(smoothed(Windows(t), holes), line, atol=1e-9)


def test_smoothing_is_the_cubic_spline_of_its_walk() -> None:
    """Oracle: the dense least squares of readings and of the walk's own covariance, at uneven times with a gap."""
    rng = np.random.default_rng(5)
    t = np.sort(np.concatenate([rng.uniform(0.0, 900.0, 25), rng.uniform(2000.0, 2600.0, 15)]))
    y, walk = np.cumsum(rng.standard_normal(40)), 3e-6
    low, high = np.minimum(t[:, None], t), np.maximum(t[:, None], t)
    low, high = low - t[0], high - t[0]
    prior = walk * (low**2 * (3.0 * high - low) / 6.0)
    line = np.stack([np.ones(40), t], axis=1)
    weight = np.linalg.inv(prior + np.eye(40))
    at = np.linalg.solve(line.T @ weight @ line, line.T @ weight @ y)
    best = line @ at + prior @ weight @ (y - line @ at)
    np.testing.assert_allclose(spline(t, y, walk), best, atol=1e-3)


def test_a_jump_of_a_temperature_stays_a_jump() -> None:
    """Oracle: the levels on either side; noise falls on both."""
    t = np.arange(0.0, 30000.0, 60.0)
    level = np.where(t > 15000.0, 25.0, 20.0)
    made = smoothed(Windows(t), level + 0.03 * np.random.default_rng(1).standard_normal(len(t)))
    assert float(np.abs(made - level).max()) < 0.03


@pytest.mark.parametrize(("seconds", "said"), [(90.0, "90 s"), (1800.0, "30 min"), (9000.0, "2.5 h")])
def test_times_are_told_as_people_do(seconds: float, said: str) -> None:
    assert duration(seconds) == said

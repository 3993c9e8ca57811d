"""Noise of the generator: its sizes and its forms, each against what is known of it from elsewhere."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import welch

from tests.discovery.generator import noise

Floats = NDArray[np.float64]
TIME = np.arange(0.0, 9.0 * 3600.0, 20.0)
MANY = 60


def _drifts(form: str) -> Floats:
    return np.stack([noise.drift(np.random.default_rng([s, 5]), form, TIME) for s in range(MANY)])


@pytest.mark.parametrize("form", ["random_walk", "flicker", "steps"])
def test_drifts_have_the_stated_size(form: str) -> None:
    """Oracle: 0.2 to 0.9 µm about their mean."""
    sizes = _drifts(form).std(axis=1)
    assert sizes.min() >= 0.199
    assert sizes.max() <= 0.901


@pytest.mark.parametrize(("form", "low", "high"), [("random_walk", -2.3, -1.7), ("flicker", -1.25, -0.75)])
def test_drifts_have_the_stated_spectrum(form: str, low: float, high: float) -> None:
    """Oracle: Welch's estimate falls as 1/f² for a random walk, as 1/f for flicker noise."""
    f, power = welch(_drifts(form), 1.0 / 20.0, nperseg=512, axis=1)
    band = (f > 5e-4) & (f < 1e-2)
    slope = np.polyfit(np.log(f[band]), np.log(power.mean(axis=0)[band]), 1)[0]
    assert low < slope < high


def test_ornstein_uhlenbeck_forgets_as_stated() -> None:
    """Oracle: correlations at lags of half an hour of processes whose τ is 10 to 67 min lie between their bounds."""
    tracks = _drifts("ou")
    size = np.sqrt((tracks**2).mean())
    assert 0.35 < size < 0.75
    at = 90  # of 20 s: half an hour
    unit = tracks / tracks.std(axis=1, keepdims=True)
    forgotten = float((unit[:, :-at] * unit[:, at:]).mean())
    assert np.exp(-30.0 / 10.0) - 0.2 < forgotten < np.exp(-30.0 / 67.0)


def test_steps_are_steps_and_the_day_is_a_day() -> None:
    """Oracle: most instants of a track of steps are like the one before; the swing fits a sine of 24 h exactly."""
    steps = np.diff(_drifts("steps"), axis=1)
    still = np.abs(steps) < 1e-12
    assert still.mean() > 0.96
    assert (~still).sum(axis=1).min() >= 15
    angle = 2.0 * np.pi * TIME / 86400.0
    design = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    for track in _drifts("daily")[:5]:
        found = np.linalg.lstsq(design, track, rcond=None)[0]
        np.testing.assert_allclose(design @ found, track, atol=1e-9)
        assert 0.2 * np.sqrt(2) <= np.hypot(*found) <= 0.9 * np.sqrt(2)


def test_heavy_tails_are_heavier_than_the_normal_ones() -> None:
    """Oracle: share of readings beyond four robust standard deviations, 6e-5 for a normal distribution."""
    run = np.repeat(np.arange(20), 81)

    def far(form: str) -> float:
        values = [noise.draw(np.random.default_rng([s, 8]), form, TIME, run) for s in range(40)]
        part = np.concatenate([(v.values - v.drift)[~v.outlier] for v in values])
        sigma = 1.4826 * np.median(np.abs(part))
        return float((np.abs(part) > 4.0 * sigma).mean())

    assert far("heavy") > 4.0 * far("white")


def test_white_noise_is_white_and_sized() -> None:
    """Oracle: 0.2 to 1 µm, the offset of each run 0.05 to 0.35 µm beside it, no correlation from reading to reading."""
    run = np.repeat(np.arange(20), 81)
    for seed in range(12):
        drawn = noise.draw(np.random.default_rng([seed, 9]), "white", TIME, run)
        rest = drawn.values.copy()
        rest[drawn.outlier] = np.nan
        rest = rest.reshape(20, 81) - np.nanmean(rest.reshape(20, 81), axis=1, keepdims=True)
        assert 0.19 < np.nanstd(rest) < 1.05
        assert abs(float(np.nanmean(rest[:, 1:] * rest[:, :-1]))) < 0.15 * float(np.nanvar(rest))
        assert drawn.outlier.mean() < 0.012

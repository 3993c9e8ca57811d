"""Noise of readings: white, drift (Ornstein-Uhlenbeck), offsets of runs, resolution, outliers, missing readings."""

import numpy as np
from numpy.typing import NDArray

from rtec.jit import njit
from rtec.sim.campaign.settings import ReadingNoise

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def drift_noise(time_s: Floats, sigma: float, tau_s: float, rng: np.random.Generator) -> Floats:
    """Noise with the autocorrelation `σ² exp(-|Δt|/τ)` at any instants, (n,); stationary from the start."""
    fresh = rng.standard_normal(len(time_s))
    return _ornstein_uhlenbeck(fresh, np.ascontiguousarray(time_s), tau_s) * sigma


@njit
def _ornstein_uhlenbeck(fresh: Floats, time_s: Floats, tau_s: float) -> Floats:
    out = np.empty(len(fresh))
    for i in range(len(fresh)):
        if i == 0:
            out[0] = fresh[0]
        else:
            step = (time_s[i] - time_s[i - 1]) / tau_s
            out[i] = out[i - 1] * np.exp(-step) + np.sqrt(-np.expm1(-2.0 * step)) * fresh[i]
    return out


def with_noise(reading: Floats, time_s: Floats, run: Ints, noise: ReadingNoise, rng: np.random.Generator) -> Floats:
    """A reading with all its noise, (n,); every kind has its own random numbers, drawn in a fixed order."""
    n = len(reading)
    _, first = np.unique(run, return_inverse=True)
    out = reading + noise.white_um * rng.standard_normal(n)
    out = out + drift_noise(time_s, noise.drift_um, noise.drift_tau_s, rng)
    out = out + (noise.run_offset_um * rng.standard_normal(int(first.max()) + 1))[first]
    wrong = rng.random(n) < noise.outliers
    size = rng.uniform(0.5, 1.5, n) * np.where(rng.random(n) < 0.5, -1.0, 1.0)
    out = out + np.where(wrong, noise.outlier_um * size, 0.0)
    out = quantised(out, noise.resolution_um)
    return np.where(rng.random(n) < noise.lost, np.nan, out)


def quantised(values: Floats, step: float) -> Floats:
    """Values in whole steps, (n,), without the residue of binary arithmetic; a step of 0 does not change them."""
    return np.round(np.round(values / step) * step, 9) if step > 0 else values

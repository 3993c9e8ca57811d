"""What readings have besides the machine: white noise, and a drift of one of several forms."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

FORMS = ("white", "ou", "random_walk", "flicker", "steps", "daily", "heavy")
"""White only; Ornstein-Uhlenbeck; random walk; 1/f; many small steps; a day's swing; heavy tails and outliers."""
WHITE_UM, DRIFT_UM, OFFSET_UM = (0.2, 1.0), (0.2, 0.9), (0.05, 0.35)
TAU_MIN = (10.0, 67.0)
OUTLIERS = {"heavy": 0.012}
FEW_OUTLIERS = 0.003
QUANTUM_UM = 0.1
GRID_S = 20.0


@dataclass(frozen=True)
class Noise:
    """Noise of one reading column.

    Attributes:
        values: all of it, µm or µrad, (n,).
        drift: the part with memory, (n,).
        outlier: which readings have a jump of their own, (n,).
    """

    values: Floats
    drift: Floats
    outlier: Bools


def draw(rng: np.random.Generator, form: str, time_s: Floats, run: Ints) -> Noise:
    """Noise of one column at given instants."""
    n = len(time_s)
    sigma = rng.uniform(*WHITE_UM)
    white = rng.standard_t(3, n) / np.sqrt(3.0) if form == "heavy" else rng.standard_normal(n)
    slow = drift(rng, form, time_s)
    runs, place = np.unique(run, return_inverse=True)
    offsets = (rng.uniform(*OFFSET_UM) * rng.standard_normal(len(runs)))[place]
    jump = rng.random(n) < OUTLIERS.get(form, FEW_OUTLIERS)
    size = rng.choice([-1.0, 1.0], n) * rng.uniform(4.0, 15.0, n)
    return Noise(sigma * white + slow + offsets + jump * size, slow, jump)


def drift(rng: np.random.Generator, form: str, time_s: Floats) -> Floats:
    """The part with memory, (n,)."""
    size = rng.uniform(*DRIFT_UM)
    if form in ("white", "heavy"):
        return np.zeros_like(time_s)
    if form == "daily":
        phase = rng.uniform(0.0, 2.0 * np.pi)
        return np.asarray(np.sqrt(2.0) * size * np.sin(2.0 * np.pi * time_s / 86400.0 + phase))
    grid = np.arange(0.0, time_s[-1] + 2.0 * GRID_S, GRID_S)
    if form == "ou":
        return np.interp(time_s, grid, size * _ornstein_uhlenbeck(rng, len(grid), 60.0 * rng.uniform(*TAU_MIN)))
    make = {"random_walk": _random_walk, "flicker": flicker, "steps": _steps}[form]
    values = np.interp(time_s, grid, make(rng, len(grid)))
    centred = values - values.mean()
    return np.asarray(size * centred / np.sqrt(np.mean(centred**2)))


def quantised(values: Floats) -> Floats:
    """As the display shows them."""
    return np.round(values / QUANTUM_UM) * QUANTUM_UM


def flicker(rng: np.random.Generator, n: int) -> Floats:
    """Noise whose power falls as 1/f, by its spectrum; twice as long as needed, so that its ends do not meet."""
    whole = 2 * n
    f = np.arange(1, whole // 2 + 1, dtype=np.float64)
    spectrum = (rng.standard_normal(len(f)) + 1j * rng.standard_normal(len(f))) / np.sqrt(f)
    return np.asarray(np.fft.irfft(np.concatenate([[0.0], spectrum]), whole)[:n])


def _ornstein_uhlenbeck(rng: np.random.Generator, n: int, tau_s: float) -> Floats:
    """Unit variance, correlation exp(-t/τ), stationary from the start."""
    keep = float(np.exp(-GRID_S / tau_s))
    push = np.sqrt(1.0 - keep**2) * rng.standard_normal(n)
    out = np.empty(n)
    here = float(rng.standard_normal())
    for i in range(n):
        here = keep * here + push[i]
        out[i] = here
    return out


def _random_walk(rng: np.random.Generator, n: int) -> Floats:
    return np.cumsum(rng.standard_normal(n))


def _steps(rng: np.random.Generator, n: int) -> Floats:
    """Some 20 to 60 small steps at times of their own; they add up."""
    count = int(rng.integers(20, 60))
    out = np.zeros(n)
    for at in rng.integers(0, n, count):
        out[at:] += rng.standard_normal()
    return out

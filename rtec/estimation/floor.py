"""What noise alone would leave of the readings, and what a model leaves of them."""

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rtec.estimation.compare_floor import repeats_floor
from rtec.estimation.compare_noise import flexible_columns
from rtec.estimation.gls import solve, without_nuisance
from rtec.estimation.noise import Whitener, find_noise
from rtec.estimation.readings import Readings
from rtec.estimation.whitening import drift_draws

Floats = NDArray[np.float64]
Unit = Literal["um", "urad", "noise"]
DRAWS = 24


def unit_of(readings: Readings) -> Unit:
    """Unit in which all readings can be told: µm, µrad, or multiples of the noise where there are both."""
    units = {s.unit for s in readings.series}
    if len(units) > 1:
        return "noise"
    return "um" if units == {"um"} else "urad"


def floors(whitener: Whitener, seed: int = 1) -> Floats:
    """Root mean square that noise alone leaves of each series once the nuisances of each run are taken out.

    Drawn: the drift within a run is left, that between runs goes with their zeros.
    """
    readings = whitener.readings
    rng = np.random.default_rng([seed, 77])
    total = np.zeros(len(readings.series))
    drawn = [_draws(whitener, i, rng) for i in range(len(readings.series))]
    for k in range(DRAWS):
        left = without_nuisance(readings, np.concatenate([d[:, k] for d in drawn]))
        total += [float(np.mean(left[s.part] ** 2)) for s in readings.series]
    return np.sqrt(total / DRAWS)


def as_compared(readings: Readings, left: Floats, columns: Floats) -> tuple[Floats, tuple[str, ...]]:
    """The floor of each series as `rtec compare` has it, and where it comes from: repeats where there are enough.

    A noise fitted along with a wrong model holds a part of what the model misses; what differs between repeats does
    not.

    Args:
        readings: the readings.
        left: what the model leaves of them, nuisances taken out, (m,).
        columns: of the model and the set-up, (m, p).

    Returns:
        Root mean square, (series,), and "repeats" or "fitted noise model" for each.
    """
    repeated = [repeats_floor(readings, s, left[s.part]) for s in readings.series]
    if None in repeated:
        # Noise is never more than what is left.
        fitted = np.minimum(
            floors(find_noise(readings, flexible_columns(readings, columns))), rms_by_series(readings, left)
        )
    else:
        fitted = np.zeros(len(repeated))
    values = np.array([f if r is None else r for r, f in zip(repeated, fitted, strict=True)])
    return values, tuple("fitted noise model" if r is None else "repeats" for r in repeated)


def _draws(whitener: Whitener, number: int, rng: np.random.Generator) -> Floats:
    series, noise = whitener.readings.series[number], whitener.noises[number]
    steps = rng.standard_normal((len(series), DRAWS))
    drift_draws(series.time_s, noise.tau_s, steps)
    offset = rng.standard_normal((int(series.run[-1]) + 1, DRAWS))[series.run] * math.sqrt(noise.offset)
    white = rng.standard_normal((len(series), DRAWS))
    return np.asarray(noise.sigma * (white + math.sqrt(noise.drift) * steps + offset))


def cleaned(readings: Readings, left: Floats) -> Floats:
    """Residuals less what the instruments cannot know: terms of the set-up, then those of each run, (m,)."""
    if readings.setup.shape[1]:
        setup = np.stack([without_nuisance(readings, c) for c in readings.setup.T], axis=1)
        flat = without_nuisance(readings, left)
        return np.asarray(flat - setup @ solve(setup, flat))
    return without_nuisance(readings, left)


def rms_by_series(readings: Readings, left: Floats) -> Floats:
    """Root mean square of each series, (series,)."""
    return np.array([float(np.sqrt(np.mean(left[s.part] ** 2))) for s in readings.series])


def pooled(readings: Readings, by_series: Floats, scale: Floats) -> float:
    """Root mean square of all readings from that of each series; each times its scale."""
    sizes = np.array([len(s) for s in readings.series], dtype=np.float64)
    return float(np.sqrt(np.average((by_series * scale) ** 2, weights=sizes)))

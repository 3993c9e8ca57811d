"""Series of equal instruments get similar weights: a series that shows less of an error is not worth more.

Otherwise a cold day with little error would outweigh the hot one that shows it. The residual of the hot day is not its
noise but what the model misses, and no reading deserves more weight than the model is accurate.
"""

from collections.abc import Hashable, Sequence

import numpy as np

from rtec.arrays import Floats, Ints, robust_sigma
from rtec.estimation.readings import Readings

QUANTISED = 0.005
"""The noise between neighbours is at least this share of the residual: quantised readings are mostly equal."""


def kinds_of(readings: Readings) -> list[Hashable]:
    """Kind of each series: equal for equal instruments on the same axis or component."""
    made_by = [readings.measurements[s.source].instrument for s in readings.series]
    return [(m.name, m.axis, m.component, s.column) for m, s in zip(made_by, readings.series, strict=True)]


def spreads(readings: Readings, values: Floats) -> Floats:
    """Root mean square of values, (m,), over all series of equal instruments, (series,)."""
    count = np.array([len(s) for s in readings.series])
    rms = np.array([max(float(np.sqrt(np.mean(values[s.part] ** 2))), 1e-15) for s in readings.series])
    return alike(kinds_of(readings), rms, np.zeros(len(rms)), count)


def neighbour_noise(left: Floats, run: Ints) -> float:
    """Robust noise of residuals, (n,), from how each differs from the middle of its neighbours in its run."""
    size = float(np.sqrt(np.nanmean(left**2))) if np.isfinite(left).any() else 0.0
    bend = (left[1:-1] - 0.5 * (left[:-2] + left[2:]))[run[2:] == run[:-2]]
    bend = bend[np.isfinite(bend)]
    quick = max(robust_sigma(bend) / np.sqrt(1.5), QUANTISED * size) if len(bend) else size
    return float(max(quick, 1e-12))


def alike(kinds: Sequence[Hashable], sigma: Floats, quick: Floats, count: Ints) -> Floats:
    """Residual size of each series, (series,): its noise between neighbours, and the rest common to its kind.

    Args:
        kinds: of the series.
        sigma: residual of each series, (series,).
        quick: its noise between neighbours, (series,).
        count: its readings, (series,).
    """
    out = sigma.copy()
    for kind in set(kinds):
        mine = np.array([k == kind for k in kinds])
        own = np.minimum(quick[mine], sigma[mine]) ** 2
        common = np.average(sigma[mine] ** 2 - own, weights=np.maximum(count[mine], 1))
        out[mine] = np.sqrt(own + common)
    return out

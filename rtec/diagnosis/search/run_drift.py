"""Drift from run to run (cycle to cycle) of a series; reported beside the diagnosis, for it is no geometric error."""

import math

import numpy as np

from rtec.arrays import Floats
from rtec.estimation.readings import Readings, Series
from rtec.wording import ERROR_UNITS, significant

FEWEST = 4
"""Runs that a trend needs."""
CHANCE = 0.01


def run_drifts(readings: Readings, left: Floats) -> tuple[str, ...]:
    """Series whose runs drift steadily in one direction, in words.

    Args:
        readings: the readings.
        left: residual of the best fit, in the unit of each reading, (m,).
    """
    notes = []
    for s in readings.series:
        trend = _trend(s, left[s.part])
        if trend is not None and trend[1] < CHANCE:
            unit = ERROR_UNITS.get(s.unit, s.unit)
            name = f"{readings.measurements[s.source].name} {s.column}"
            way = "rises" if trend[0] > 0.0 else "falls"
            notes.append(
                f"drift between the runs (cycles) of {name}: their mean {way} steadily, by "
                f"{significant(abs(trend[0]), 2)} {unit} from the first to the last. "
                "An effect of geometry would be the same in each: suspect the zero, the "
                "instrument, or heat that was not recorded"
            )
    return tuple(notes)


def _trend(series: Series, left: Floats) -> tuple[float, float] | None:
    """Change of the runs' means along a straight line in time, and its probability by noise alone."""
    from scipy.special import stdtr

    runs = int(series.run[-1]) + 1
    if runs < FEWEST or bool((np.ptp(series.nuisance, axis=0) == 0.0).any() if series.nuisance.size else False):
        return None  # too few, or the zero of each run is unknown
    size = np.bincount(series.run, minlength=runs)
    mean, time = (np.bincount(series.run, v, minlength=runs) / size for v in (left, series.time_s))
    line = np.polynomial.Polynomial.fit(time, mean, 1)
    free = runs - 2
    spread = float(np.sum((time - time.mean()) ** 2))
    error = math.sqrt(max(float(np.sum((mean - line(time)) ** 2)) / free, 1e-24))
    change = float(line(time[-1]) - line(time[0]))
    slope = change / float(time[-1] - time[0])
    chance = 2.0 * float(stdtr(free, -abs(slope) * math.sqrt(spread) / error))
    return change, chance


MEANS, PER_RUN = 0.01, 2
"""Runs differ where noise alone makes such differences with less than this probability; readings that a run needs."""


def runs_differ(readings: Readings, left: Floats, scale: Floats) -> tuple[float, int] | None:
    """Difference between the means of the runs beyond the scatter of their readings, and the number of runs.

    Args:
        readings: the readings.
        left: residual of a fit, (m,).
        scale: one over the unit of each series, (series,).

    Returns:
        The largest of all series; None where the runs of no series differ, or the zero of each run is unknown.
    """
    from scipy.special import fdtrc

    found: list[tuple[float, int]] = []
    for s, unit in zip(readings.series, scale, strict=True):
        runs, n = int(s.run[-1]) + 1, len(s)
        unknown = bool((np.ptp(s.nuisance, axis=0) == 0.0).any()) if s.nuisance.size else False
        if runs < FEWEST or n < PER_RUN * runs or unknown:
            continue
        mine = left[s.part] * unit
        size = np.bincount(s.run, minlength=runs)
        mean = np.bincount(s.run, mine, minlength=runs) / size
        within = float(np.sum((mine - mean[s.run]) ** 2)) / (n - runs)
        between = float(np.sum(size * (mean - mine.mean()) ** 2)) / (runs - 1)
        if fdtrc(runs - 1, n - runs, between / max(within, 1e-24)) < MEANS:
            found.append((math.sqrt(max(between - within, 0.0) * runs / n), runs))
    return max(found, default=None)

"""The display of an instrument: readings that are whole multiples of a coarse step.

A reading is rounded to the step. Where the noise is smaller than half of the step, the rounding error is the same at
each visit to a place, so it looks like an error of the machine that no mean removes. Its root mean square is at most
the step over √12.
"""

import math
from collections.abc import Sequence

import numpy as np

from rtec.arrays import Floats
from rtec.estimation.floor import cleaned, rms_by_series
from rtec.estimation.gls import solve
from rtec.estimation.readings import Readings

WHOLE = 0.02
"""A reading is a multiple of the step up to this share of it: files round to a few decimals."""
OFTEN = 4.0
"""A step is visible where each value comes again this many times on average."""
STEADY = math.sqrt(1.0 / 12.0 + 0.25)
"""Noise of half a step, together with the rounding, in steps: with more noise the mean of visits is not rounded."""


def display_step(values: Floats) -> float:
    """Step of which all readings, (n,), are multiples apart; zero where there is none."""
    levels = np.unique(np.round(values, 6))
    if len(levels) < 2 or len(values) < OFTEN * len(levels):
        return 0.0
    apart = np.diff(levels)
    step = float(apart.min())
    # The smallest difference is rounded; over the whole range its error would add up.
    step = float((levels[-1] - levels[0]) / max(round(float(levels[-1] - levels[0]) / step), 1))
    return step if np.all(np.abs(apart / step - np.round(apart / step)) < WHOLE) else 0.0


def display_errors(readings: Readings, base: Floats) -> Floats:
    """Largest root mean square error of the display of each series that comes again at each visit, (series,).

    Args:
        readings: the readings.
        base: columns of the current model, (m, p).
    """
    rms = rms_by_series(readings, _beyond(readings, base, readings.values))
    steps = np.array([display_step(readings.values[s.part]) for s in readings.series])
    return np.asarray(np.where(rms < STEADY * steps, steps / math.sqrt(12.0), 0.0))


def within_display(readings: Readings, base: Floats, part: Floats, errors: Sequence[float] | Floats) -> bool:
    """Whether what an effect adds to the readings is no larger than the errors of the displays.

    Args:
        readings: the readings.
        base: columns of the current model, (m, p).
        part: what the effect adds, (m,).
        errors: from `display_errors`, (series,).
    """
    return bool(np.all(rms_by_series(readings, _beyond(readings, base, part)) <= np.asarray(errors)))


def _beyond(readings: Readings, base: Floats, values: Floats) -> Floats:
    """Values less what the current model and the unknowns of the instruments explain, (m,)."""
    return cleaned(readings, values - base @ solve(base, values))

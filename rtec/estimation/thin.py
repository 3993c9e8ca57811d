"""Fewer readings for a first look where there are very many."""

import numpy as np
from numpy.typing import NDArray

from rtec.at_once import MANY
from rtec.estimation.readings import Readings

RUNS = 40
"""Whole runs are taken where there are at least so many; else single readings, evenly."""


def looked_at(readings: Readings) -> NDArray[np.bool_]:
    """Which readings a first look takes, (m,): all where they are not many."""
    keep = np.ones(len(readings), dtype=bool)
    if len(readings) <= MANY:
        return keep
    # Drawn, not every so-and-so many: the runs of a campaign have patterns (there and back, fast and slow).
    rng = np.random.default_rng(0)
    share = MANY / len(readings)
    for s in readings.series:
        runs = int(s.run[-1]) + 1
        if runs >= RUNS:
            keep[s.part] = (rng.permutation(runs) < max(share * runs, RUNS // 2))[s.run]
        else:
            keep[s.part] = rng.permutation(len(s)) < share * len(s)
    return keep

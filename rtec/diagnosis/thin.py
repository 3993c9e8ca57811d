"""Fewer readings for a first look where there are very many, and several looks at once."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis.readings import Readings

MANY = 16_000
"""From so many readings on a first look takes about so many of them, and threads pay."""
RUNS = 40
"""Whole runs are taken where there are at least so many; else single readings, evenly."""

T = TypeVar("T")
R = TypeVar("R")


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


def each(work: Callable[[T], R], items: Iterable[T], readings: int) -> list[R]:
    """Work on each, in order; at once where there are many readings, as numpy lets go of the interpreter then."""
    workers = min(os.cpu_count() or 1, 4)
    if readings <= MANY or workers == 1:
        return [work(i) for i in items]
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(work, items))

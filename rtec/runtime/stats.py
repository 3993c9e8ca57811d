"""Times of a loop in histograms of 1 µs, so that a week of cycles takes the memory of a minute."""

from dataclasses import dataclass

import numpy as np

BINS = 20_000
"""The last bin holds everything from 20 ms on; the largest time is kept beside."""


class Histogram:
    """Counts of durations by whole µs."""

    def __init__(self) -> None:
        self.counts = np.zeros(BINS, dtype=np.int64)
        self.largest_ns = 0

    def add(self, duration_ns: int) -> None:
        """Count one duration."""
        index = duration_ns // 1000
        self.counts[index if 0 <= index < BINS else (0 if index < 0 else BINS - 1)] += 1
        self.largest_ns = max(self.largest_ns, duration_ns)

    def percentile_us(self, percent: float) -> float:
        """Upper edge of the bin that holds this percentage, µs; 0 where nothing was counted."""
        total = int(self.counts.sum())
        if not total:
            return 0.0
        index = int(np.searchsorted(np.cumsum(self.counts), total * percent / 100.0))
        return min(float(index + 1), self.largest_ns * 1e-3)

    def summary(self) -> dict[str, float]:
        """p50, p99, p99.9 and largest, µs."""
        names = {"p50_us": 50.0, "p99_us": 99.0, "p99_9_us": 99.9}
        out = {name: self.percentile_us(p) for name, p in names.items()}
        return {**out, "max_us": self.largest_ns * 1e-3}


@dataclass
class LoopStats:
    """What a loop did.

    Attributes:
        cycles: samples taken.
        misses: deadlines that had passed before their cycle could begin.
        wake_up: from the deadline to the loop running.
        compute: from there to the command sent.
        driver_errors: cycles in which a device failed.
        last_error: its message.
    """

    cycles: int
    misses: int
    wake_up: Histogram
    compute: Histogram
    driver_errors: int = 0
    last_error: str = ""

    @classmethod
    def empty(cls) -> "LoopStats":
        """Before the first cycle."""
        return cls(0, 0, Histogram(), Histogram())

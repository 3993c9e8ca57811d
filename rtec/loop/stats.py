"""Times of a loop, in histograms (a week takes the memory of a minute), and failures of its devices."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from rtec.text import clean

BINS, SLOW_BINS = 20_000, 10_000
"""Bins of 1 µs; from 20 ms on, bins of 1 ms, the last of which holds everything from 10 s on."""


class Histogram:
    """Counts of durations by whole µs, from 20 ms on by whole ms."""

    def __init__(self) -> None:
        self.counts, self.slow = np.zeros(BINS, dtype=np.int64), np.zeros(SLOW_BINS, dtype=np.int64)
        self.largest_ns = 0

    def add(self, duration_ns: int) -> None:
        """Count one duration."""
        index = max(duration_ns // 1000, 0)
        if index < BINS:
            self.counts[index] += 1
        else:
            self.slow[min(index // 1000, SLOW_BINS - 1)] += 1
        self.largest_ns = max(self.largest_ns, duration_ns)

    def percentile_us(self, percent: float) -> float:
        """Upper edge of the bin that holds this percentage, µs; 0 without any durations."""
        below = np.cumsum(np.concatenate([self.counts, self.slow]))
        if not below[-1]:
            return 0.0
        index = int(np.searchsorted(below, below[-1] * percent / 100.0))
        edge_us = index + 1 if index < BINS else 1000 * (index - BINS + 1)
        last = index == BINS + SLOW_BINS - 1
        return self.largest_ns * 1e-3 if last else min(float(edge_us), self.largest_ns * 1e-3)

    def summary(self) -> dict[str, float]:
        """p50, p99, p99.9 and largest, µs."""
        names = {"p50_us": 50.0, "p99_us": 99.0, "p99_9_us": 99.9}
        out = {name: self.percentile_us(p) for name, p in names.items()}
        return {**out, "max_us": self.largest_ns * 1e-3}


@dataclass(slots=True)
class Trouble:
    """Failures of one role of one device.

    Attributes:
        device: its name.
        does: "counts", "zero", "temperatures", "spindle" or "output".
        now: did the last call fail?
        times: number of cycles in which it failed.
        reason: reason of the last failure.
    """

    device: str
    does: str
    now: bool = False
    times: int = 0
    reason: str = ""

    def failed(self, reason: str) -> None:
        """Record a failure and its reason."""
        self.now, self.reason = True, clean(reason)
        self.times += 1


@dataclass
class LoopStats:
    """Times and failures of a loop.

    Attributes:
        cycles: samples taken.
        misses: deadlines that had passed before their cycle could begin.
        wake_up: from the deadline to the start of the cycle.
        compute: from there to the end of the command.
        troubles: failures of the devices, one element for each role of each device.
        takeovers: number of orders to resume that were carried out.
    """

    cycles: int
    misses: int
    wake_up: Histogram
    compute: Histogram
    troubles: list[Trouble] = field(default_factory=list)
    takeovers: int = 0

    @classmethod
    def empty(cls) -> "LoopStats":
        """Statistics before the first cycle."""
        return cls(0, 0, Histogram(), Histogram())

    @property
    def driver_errors(self) -> int:
        """Failures of all devices together."""
        return sum(t.times for t in self.troubles)

    @property
    def last_error(self) -> str:
        """Last reason of every device that ever failed; empty where none did."""
        return "; ".join(dict.fromkeys(t.reason for t in self.troubles if t.reason))

    def reasons(self) -> dict[str, list[str]]:
        """Present failures by device; a reason that two of its roles share is listed once."""
        out: dict[str, list[str]] = {}
        for trouble in self._now():
            texts = out.setdefault(trouble.device, [])
            if trouble.reason not in texts:
                texts.append(trouble.reason)
        return out

    def failures(self) -> dict[str, dict[str, object]]:
        """Failures in the whole run, by device: their number, and the last reason of each of its roles."""
        out: dict[str, dict[str, object]] = {}
        for device in dict.fromkeys(t.device for t in self.troubles if t.times):
            mine = [t for t in self.troubles if t.device == device and t.times]
            out[device] = {"times": sum(t.times for t in mine), "last": {t.does: t.reason for t in mine}}
        return out

    def _now(self) -> Iterator[Trouble]:
        return (t for t in self.troubles if t.now)

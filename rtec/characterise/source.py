"""One measurement made ready for the fit: weights, blocks, and what the instrument cannot know.

A nuisance that each run has anew is projected out of that run's readings and columns, run by run: the same
coefficients as with one explicit column for each run, at the cost of none. Where a run lies in several blocks, and
for what a whole set-up shares, the columns are explicit.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rtec.effects import State
from rtec.estimation.held_out import Blocks, cut
from rtec.machine import Axis
from rtec.metrology.instruments.base import Nuisance
from rtec.metrology.measurement import Measurement

Floats = NDArray[np.float64]

SAMPLE = 2000
"""Instants at which lever arms are looked at."""
EMPTY = 1e-9
"""What is left of a nuisance, relative to its size, below which it is a copy of those before it."""


@dataclass(frozen=True)
class Explicit:
    """A nuisance that has a column of its own.

    Attributes:
        name: measurement, nuisance and run, for people.
        nuisance: which.
        rows: the rows in which it acts.
    """

    name: str
    nuisance: Nuisance
    rows: slice


@dataclass(frozen=True)
class Source:
    """A measurement with weights; everything is flattened instant by instant, reading by reading.

    Attributes:
        measurement: as given.
        blocks: how it is cut.
        weight: one over the noise of each reading, (n · readings,); zero where there is no reading or where it is
            left out.
    """

    measurement: Measurement
    blocks: Blocks
    weight: Floats

    @classmethod
    def of(cls, measurement: Measurement, leave_out_h: float | None = None) -> "Source":
        """Every reading that is there with weight one."""
        there = np.isfinite(measurement.matrix()).T.ravel()
        return cls(measurement, cut(measurement, leave_out_h), there.astype(np.float64))

    def weighted(self, weight: Floats) -> "Source":
        """The same with other weights."""
        return Source(self.measurement, self.blocks, weight)

    @property
    def count(self) -> int:
        """Readings an instant."""
        return len(self.measurement.instrument.columns())

    @cached_property
    def state(self) -> State:
        """The state; directions are worked out once, before it is walked through."""
        return self.measurement.state()

    @cached_property
    def longest_arms(self) -> Floats:
        """Longest lever arm of each component on any reading, (components,)."""
        rows = np.unique(np.linspace(0, len(self.measurement) - 1, SAMPLE).astype(np.int64))
        arms = self.measurement.instrument.arms(self.measurement.machine, self.state.positions_mm()[rows])
        return np.asarray(np.abs(arms).max(axis=(0, 1)))

    def speeds(self, axis: Axis) -> Floats | None:
        """Velocity of an axis, mm/s, (n,): as recorded; zero where it never moved; None where nobody knows."""
        channels = self.measurement.channels
        if axis.velocity_channel in channels:
            return channels[axis.velocity_channel]
        still = axis.channel not in channels or not np.ptp(channels[axis.channel]) > 0.0
        return np.zeros(len(self.measurement)) if still else None

    @cached_property
    def readings(self) -> Floats:
        """Readings as read, zero where there is none, (n · readings,)."""
        return np.nan_to_num(self.measurement.matrix().T.ravel(), nan=0.0)

    @cached_property
    def nuisances(self) -> tuple[Nuisance, ...]:
        """What the instrument cannot know."""
        return self.measurement.instrument.nuisance(self.state, self.measurement.run)

    @cached_property
    def run_starts(self) -> NDArray[np.int64]:
        """First reading of each run, and their number, (runs + 1,)."""
        return self.blocks.run_edges * self.count

    @cached_property
    def whole(self) -> NDArray[np.bool_]:
        """Runs that lie in one block, (runs,)."""
        edges, runs = self.blocks.edges, self.blocks.run_edges
        first, last = np.searchsorted(edges, runs[:-1], "right"), np.searchsorted(edges, runs[1:] - 1, "right")
        return np.asarray(first == last)

    @cached_property
    def explicit(self) -> tuple[Explicit, ...]:
        """Nuisances with a column of their own."""
        out = []
        for nuisance in self.nuisances:
            label = f"{nuisance.name} of {self.measurement.name}"
            if nuisance.per == "setup":
                out.append(Explicit(label, nuisance, slice(0, len(self.measurement))))
                continue
            for i in np.flatnonzero(~self.whole):
                rows = slice(int(self.blocks.run_edges[i]), int(self.blocks.run_edges[i + 1]))
                out.append(Explicit(f"{label}, run {self.measurement.run[rows.start]}", nuisance, rows))
        return tuple(out)

    @cached_property
    def projected(self) -> tuple[Floats, ...]:
        """Weighted nuisances of each run made orthonormal run by run, each (n · readings,)."""
        return orthonormal(
            [flat(n.values) * self.weight for n in self.nuisances if n.per == "run"],
            self.run_starts,
            np.repeat(self.whole, np.diff(self.run_starts)),
        )

    @cached_property
    def lanes(self) -> tuple[int | None, ...]:
        """For each of `projected`: the one reading column that it touches; None where it touches several."""
        touched = [[j for j in range(self.count) if q[j :: self.count].any()] for q in self.projected]
        return tuple(t[0] if len(t) == 1 and self.count > 1 else None for t in touched)

    def lost(self) -> Floats:
        """How many numbers each run spends on its nuisances, (runs,)."""
        spent = [np.add.reduceat(q * q, self.run_starts[:-1]) for q in self.projected]
        return np.asarray(np.sum(spent, axis=0)) if spent else np.zeros(len(self.run_starts) - 1)

    def arms(self, start: int, stop: int, components: list[int]) -> Floats:
        """Weighted lever arms of some components at instants start … stop - 1, (components, instants · readings)."""
        machine = self.measurement.machine
        arms = self.measurement.instrument.arms(machine, self._poses[start:stop])[:, :, components]
        flat_arms = np.ascontiguousarray(arms.transpose(2, 1, 0)).reshape(len(components), -1)
        return flat_arms * self.weight[start * self.count : stop * self.count]

    @cached_property
    def _poses(self) -> Floats:
        return self.state.positions_mm()


def flat(values: Floats) -> Floats:
    """(readings, n) to (n · readings,), instant by instant."""
    return np.ascontiguousarray(values.T, dtype=np.float64).ravel()


def orthonormal(columns: list[Floats], starts: NDArray[np.int64], where: NDArray[np.bool_]) -> tuple[Floats, ...]:
    """Gram-Schmidt, twice, within each stretch `starts[i] … starts[i + 1] - 1`; zero where `where` is false.

    What is a copy of the columns before it in some stretch is zero there.
    """
    out: list[Floats] = []
    lengths = np.diff(starts)
    for column in columns:
        left = column * where
        before = np.sqrt(np.add.reduceat(left * left, starts[:-1]))
        for _ in range(2):
            for q in out:
                left = left - np.repeat(np.add.reduceat(q * left, starts[:-1]), lengths) * q
        size = np.sqrt(np.add.reduceat(left * left, starts[:-1]))
        factor = np.where(size > EMPTY * before, 1.0 / np.where(size > 0, size, 1.0), 0.0)
        out.append(left * np.repeat(factor, lengths))
    return tuple(out)


def project(values: Floats, directions: tuple[Floats, ...], starts: NDArray[np.int64]) -> Floats:
    """Take the orthonormal directions out of (m,) values, stretch by stretch; gives new values."""
    lengths = np.diff(starts)
    for q in directions:
        values = values - np.repeat(np.add.reduceat(q * values, starts[:-1]), lengths) * q
    return values

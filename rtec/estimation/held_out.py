"""Cuts a measurement into blocks that are held out together, and that count as one in a standard error.

Neighbouring readings share the drift of the hour, so holding out single readings proves nothing. Where there are
enough runs, a block is one or more whole runs; else it is a stretch of hours. A run without unknowns of its own is only
a numbering: where such runs are shorter than a way there and back, or all are one run, blocks are made of such ways.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.metrology.measurement import Measurement

ENOUGH_RUNS = 6
"""From this many runs on, whole runs are held out; below, stretches of time."""
MOST_BLOCKS = 40
MANY_BLOCKS = 400
"""Many measurements are cut into fewer blocks each, so that the total is no larger than this."""
FOLDS = 8
"""Blocks are dealt into this many folds in turn, as cards are: each fold spans the day, so that no prediction leaves
the measured range."""
STRETCH_H = 4.0
"""A part of a thermal cycle: long against the machine's quick drift, short against a day."""
STILL_MM = 1e-3
QUARTER = 0.25
NEAR = 0.01
"""Places within this share of the visited range are one."""
FEWEST = 8
"""A measurement too short for five such stretches is cut into this many equal ones."""


@dataclass(frozen=True)
class Blocks:
    """Edges of blocks, and their folds and runs.

    Attributes:
        edges: first row of each block, and the number of rows, (blocks + 1,).
        fold: fold of each block, (blocks,).
        run_edges: first row of each run, and the number of rows, (runs + 1,).
        by_time: blocks are stretches of time, so a run may be in several.
    """

    edges: Ints
    fold: Ints
    run_edges: Ints
    by_time: bool

    def at(self, rows: Ints) -> "Blocks":
        """The same cuts for a part of the rows; without blocks that become empty."""
        edges = np.searchsorted(rows, self.edges)
        kept = np.diff(edges) > 0
        runs = np.unique(np.searchsorted(rows, self.run_edges))
        return Blocks(np.append(edges[:-1][kept], edges[-1]), self.fold[kept], runs, self.by_time)

    @property
    def one(self) -> "Blocks":
        """Everything in one block, where only the sum is needed."""
        ends = np.array([self.edges[0], self.edges[-1]])
        return Blocks(ends, np.zeros(1, dtype=np.int64), self.run_edges, self.by_time)

    @property
    def described(self) -> str:
        """In words, for reports."""
        return f"{len(self.fold)} {'stretches of time' if self.by_time else 'blocks of runs'}"


def cuts(measurements: Sequence[Measurement], leave_out_h: float | None = None) -> list[Blocks]:
    """Cut measurements that are judged together; every command holds out by this cut.

    Args:
        measurements: their rows are in order of time; a run number that comes back later is another run.
        leave_out_h: as of `cut`.
    """
    most = min(MOST_BLOCKS, max(MANY_BLOCKS // max(len(measurements), 1), FOLDS))
    return [cut(m, leave_out_h, most) for m in measurements]


def cut(measurement: Measurement, leave_out_h: float | None = None, most: int = MOST_BLOCKS) -> Blocks:
    """Cut one measurement.

    Args:
        measurement: its rows are in order of time; a run number that comes back later is another run.
        leave_out_h: length of a held-out stretch, hours; None: whole runs where there are at least 6 with a zero of
            their own or an axis that comes back, else 4 h, or an eighth where the whole is shorter than 20 h.
        most: largest number of blocks of whole runs.
    """
    run_edges = edges_of(measurement.run)
    whole = _whole(measurement, run_edges)
    if leave_out_h is None and len(whole) > ENOUGH_RUNS:
        return _by_runs(whole, run_edges, most)
    return _by_time(measurement, run_edges, leave_out_h)


def _whole(measurement: Measurement, run_edges: Ints) -> Ints:
    """First row of each run that counts as one, and the number of rows."""
    nuisances = measurement.instrument.nuisance(measurement.state(), measurement.run)
    if any(n.per == "run" for n in nuisances):
        return run_edges
    machine, channels = measurement.machine, measurement.channels
    if not any(np.ptp(channels[a.channel]) > STILL_MM for a in machine.axes if a.channel in channels):
        return run_edges[[0, -1]]
    ways = cycles(measurement)
    finer = len(ways) > 2 and len(ways) <= len(run_edges)
    return ways if finer or len(run_edges) <= ENOUGH_RUNS else run_edges


def cycles(measurement: Measurement) -> Ints:
    """First row of each way there and back, and the number of rows.

    The axis is the one that the instrument follows, or of which it reads a component; else the one with the fewest
    ways. A way begins at the lowest place between two visits to the upper quarter of the visited range, so that neither
    the jitter of a place nor the numbering of runs counts. Where no axis comes back, the measurement is one way.
    """
    machine, channels, n = measurement.machine, measurement.channels, len(measurement)
    instrument, found = measurement.instrument, []
    own = instrument.axis or (instrument.component or "")[2:]
    for axis in [a for a in machine.axes if a.name == own] or machine.axes:
        place = channels.get(axis.channel)
        if place is not None and np.ptp(place) > STILL_MM:
            starts = _returns(place)
            if len(starts):
                found.append(np.concatenate([[0], starts, [n]]))
    return min(found, key=len) if found else np.array([0, n])


def _returns(place: Floats) -> Ints:
    """Rows at which all ways but the first begin: the last at the lowest place between visits to the upper quarter."""
    low, high = float(place.min()), float(place.max())
    side = np.where(place > high - QUARTER * (high - low), 1, np.where(place < low + QUARTER * (high - low), -1, 0))
    far = np.flatnonzero(side)
    turns = np.flatnonzero(np.diff(side[far]) != 0)
    # Stretches of rows on one side, one after the other: upper, lower, upper …
    first, last = far[np.concatenate([[0], turns + 1])], far[np.concatenate([turns, [len(far) - 1]])]
    out = []
    for k in range(1, len(first) - 1):
        if side[first[k]] < 0:
            part = place[first[k] : last[k] + 1]
            near = np.flatnonzero(part <= part.min() + NEAR * (high - low))
            out.append(int(first[k] + near[len(near) // 2]))
    return np.array(out, dtype=np.int64)


def edges_of(label: Ints) -> Ints:
    """First row of each stretch of equal labels, and the number of rows."""
    change = np.flatnonzero(np.diff(label)) + 1
    return np.concatenate([[0], change, [len(label)]]).astype(np.int64)


def _by_runs(whole: Ints, run_edges: Ints, most: int) -> Blocks:
    runs = len(whole) - 1
    blocks = min(runs, most)
    first = np.unique(np.arange(blocks + 1) * runs // blocks)
    return Blocks(whole[first], np.arange(blocks) % FOLDS, run_edges, by_time=False)


def _by_time(measurement: Measurement, run_edges: Ints, leave_out_h: float | None) -> Blocks:
    n, hours = len(measurement), (measurement.time_s - measurement.time_s[0]) / 3600.0
    span = float(hours[-1])
    if span <= 0.0:
        hours, span = np.arange(n) / max(n - 1, 1), 1.0
    length = leave_out_h or (STRETCH_H if span >= 5 * STRETCH_H else span / FEWEST)
    # A rest at the end that is shorter than half a stretch belongs to the last one.
    count = max(int(span / length + 0.5), 1)
    label = np.minimum((hours / length).astype(np.int64), count - 1)
    edges = edges_of(label)
    return Blocks(edges, np.arange(len(edges) - 1) % FOLDS, run_edges, by_time=True)

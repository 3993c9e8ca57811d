"""One measurement prepared for the fit: weights, blocks, and the unknowns of the instrument.

A nuisance of each run is projected out of that run's readings and columns, run by run: this gives the same coefficients
as one explicit column for each run, without its cost. Where a run is in several blocks, and for what a whole set-up
shares, the columns are explicit.

Also: a subset of a long measurement, for the choice of terms; the chosen terms are fitted to all readings.

Also: which temperatures varied, and which axes went both ways.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rtec.arrays import Bools, Floats, Ints
from rtec.effects import State
from rtec.estimation.held_out import Blocks, cuts
from rtec.estimation.visible import NO_ARM, longest_arms, longest_s
from rtec.machine import Axis
from rtec.metrology.instruments.base import Nuisance
from rtec.metrology.measurement import Measurement

EMPTY = 1e-9
"""A nuisance is a copy of those before it where they leave less than this share of its size."""


@dataclass(frozen=True)
class Explicit:
    """A nuisance that has a column of its own.

    Attributes:
        name: measurement, nuisance and run, for messages.
        nuisance: the nuisance.
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
        blocks: its cut.
        weight: one over the noise of each reading, (n · readings,); zero where there is no reading or where it is
            excluded.
    """

    measurement: Measurement
    blocks: Blocks
    weight: Floats

    @classmethod
    def of(cls, measurement: Measurement, blocks: Blocks | None = None) -> "Source":
        """Every existing reading with weight one."""
        there = np.isfinite(measurement.matrix()).T.ravel()
        return cls(measurement, blocks or cuts([measurement])[0], there.astype(np.float64))

    def weighted(self, weight: Floats) -> "Source":
        """The same with other weights."""
        return Source(self.measurement, self.blocks, weight)

    @property
    def count(self) -> int:
        """Readings an instant."""
        return len(self.measurement.instrument.columns())

    @cached_property
    def state(self) -> State:
        """The state, with directions computed once before the pass."""
        return self.measurement.state()

    @cached_property
    def longest_arms(self) -> Floats:
        """Longest lever arm of each component on any reading, (components,)."""
        return longest_arms(self.measurement)

    def rate(self, axis: Axis, channel: str) -> Floats | None:
        """Velocity of an axis, mm/s, or acceleration, mm/s², by its channel, (n,).

        As recorded; zero where the instrument reads at rest or the axis never moved; None where it is unknown.
        """
        if self.state.has(channel):
            return self.state.value(channel)
        channels = self.measurement.channels
        still = axis.channel not in channels or not np.ptp(channels[axis.channel]) > 0.0
        return np.zeros(len(self.measurement)) if still else None

    @cached_property
    def readings(self) -> Floats:
        """Readings as read, zero where there is none, (n · readings,)."""
        return np.nan_to_num(self.measurement.matrix().T.ravel(), nan=0.0)

    @cached_property
    def nuisances(self) -> tuple[Nuisance, ...]:
        """Unknowns of the instrument."""
        return self.measurement.instrument.nuisance(self.state, self.measurement.run)

    @cached_property
    def run_starts(self) -> Ints:
        """First reading of each run, and their number, (runs + 1,)."""
        return self.blocks.run_edges * self.count

    @cached_property
    def whole(self) -> Bools:
        """Runs that are in one block, (runs,)."""
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
        """For each of `projected`: the one reading column that it affects; None where it affects several."""
        touched = [[j for j in range(self.count) if q[j :: self.count].any()] for q in self.projected]
        return tuple(t[0] if len(t) == 1 and self.count > 1 else None for t in touched)

    def lost(self) -> Floats:
        """Degrees of freedom of each run's nuisances, (runs,)."""
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


def orthonormal(columns: list[Floats], starts: Ints, where: Bools) -> tuple[Floats, ...]:
    """Gram-Schmidt, twice, within each stretch `starts[i] … starts[i + 1] - 1`; zero where `where` is false.

    A copy of earlier columns in some stretch is zero there.
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


def project(values: Floats, directions: tuple[Floats, ...], starts: Ints) -> Floats:
    """Project the orthonormal directions out of (m,) values, stretch by stretch; returns new values."""
    lengths = np.diff(starts)
    for q in directions:
        values = values - np.repeat(np.add.reduceat(q * values, starts[:-1]), lengths) * q
    return values


GOLDEN = (5.0**0.5 - 1.0) / 2.0


def thinned(source: Source, most: int) -> Source:
    """At most `most` instants, one from each of equal stretches at a place that never repeats.

    A fixed stride would fall in step with a screw's pitch. Directions are those of the whole; lags stay valid because
    temperatures are slow against the stride.
    """
    m = source.measurement
    n = len(m)
    if n <= most:
        return source
    place = (np.arange(most) + (np.arange(most) * GOLDEN) % 1.0) * (n / most)
    rows = np.unique(np.concatenate([np.minimum(place.astype(np.int64), n - 1), source.blocks.run_edges[:-1]]))
    state = source.state
    moving = {a.direction_channel: state.value(a.direction_channel) for a in m.machine.axes if a.channel in m.channels}
    few = replace(
        m,
        run=m.run[rows],
        time_s=m.time_s[rows],
        channels={name: values[rows] for name, values in {**m.channels, **moving}.items()},
        readings={name: values[rows] for name, values in m.readings.items()},
        unread={name: values[rows] for name, values in m.unread.items()},
    )
    weight = source.weight.reshape(n, -1)[rows].ravel()
    return Source(few, source.blocks.at(rows), weight)


TAU_S = (150.0, 300.0, 600.0, 1200.0, 2400.0, 4800.0, 9600.0, 19200.0)
LONGEST_LAG = 0.5
"""Longest delay as a share of the longest measurement: a free choice would use longer ones for drift."""
REAL_K = 0.5
"""A temperature that varies by less shows only its sensor's noise."""
INNER = (1.0, 99.0)
"""Percentiles between which a temperature's variation is taken: single wrong readings do not count."""
LEAVE_OUT = "leave the sensor out of the machine file"
REAL_RPM = 1.0


def reads(source: Source, component: str) -> bool:
    """Whether an instrument's reading depends on a component error at all."""
    return bool(source.longest_arms[source.measurement.machine.components.index(component)] > NO_ARM)


def varying_sensors(sources: Sequence[Source]) -> tuple[list[str], list[tuple[str, str]]]:
    """Sensors that every measurement has and that vary by at least 0.5 K; why others are not among them, and what to
    do about it.
    """
    good: list[str] = []
    why: list[tuple[str, str]] = []
    still: dict[str, float] = {}
    for sensor in sources[0].measurement.machine.sensor_names:
        series = [s.measurement.channels.get(sensor) for s in sources]
        if any(v is None for v in series):
            missing = [s.measurement.name for s, v in zip(sources, series, strict=True) if v is None]
            if len(missing) < len(series):
                way = f"write the temperature into them (rtec import --answer {sensor}_degc=VALUE), or {LEAVE_OUT}"
                why.append((f"{sensor} is not used: {', '.join(missing)} did not record it", way))
            continue
        whole = np.concatenate([v for v in series if v is not None])
        if not np.isfinite(whole).all():
            lost = f"{sensor} is not used: {int((~np.isfinite(whole)).sum())} of its readings are missing"
            why.append((lost, f"write them into the file, or {LEAVE_OUT}"))
        elif (varied := varied_k(sources, sensor)) < REAL_K:
            still[sensor] = varied
        else:
            good.append(sensor)
    return good, [*why, *_still(still)]


def varied_k(sources: Sequence[Source], front: str, back: str = "") -> float:
    """Range of a temperature, or of the difference of two: of the inner 98 % of the readings of all files, K."""
    read = [s.measurement.channels for s in sources]
    whole = np.concatenate([c[front] - c[back] if back else c[front] for c in read])
    return float(np.ptp(np.percentile(whole, INNER)))


def _still(ranges_k: dict[str, float]) -> list[tuple[str, str]]:
    """One sentence for all sensors that hardly varied, and what to do."""
    if not ranges_k:
        return []
    are = "is" if len(ranges_k) == 1 else "are"
    listed = ", ".join(f"{name} ({k:.2f} K)" for name, k in ranges_k.items())
    text = f"{listed} {are} not used: varied by less than {REAL_K:g} K (98 % of the readings)"
    return [(text, f"let it warm up more, or {LEAVE_OUT}")]


def lags_s(sources: Sequence[Source]) -> list[float]:
    """Grid of time constants: longer than two readings apart, and no longer than `LONGEST_LAG` allows."""
    steps = [np.diff(s.measurement.time_s) for s in sources]
    longest = LONGEST_LAG * longest_s([s.measurement for s in sources])
    apart = min((float(np.median(d[d > 0])) for d in steps if (d > 0).any()), default=np.inf)
    return [tau for tau in TAU_S if 2 * apart <= tau <= longest]


def speed_varies(sources: Sequence[Source]) -> bool:
    """Whether every measurement recorded the spindle's speed, and it changed."""
    series = [s.measurement.channels.get("spindle_rpm") for s in sources]
    there = [v for v in series if v is not None]
    whole = np.concatenate(there) if there else np.zeros(1)
    return len(there) == len(series) and bool(np.isfinite(whole).all() and np.ptp(whole) > REAL_RPM)


def both_ways(axis: Axis, sources: Sequence[Source]) -> bool:
    """Whether an axis moved both ways in any measurement."""
    for s in sources:
        if axis.channel in s.measurement.channels or axis.direction_channel in s.measurement.channels:
            d = s.state.value(axis.direction_channel)
            if (d > 0).any() and (d < 0).any():
                return True
    return False


def gone_along(axis: Axis, sources: Sequence[Source]) -> bool:
    """Whether an axis covered over half of its visited range in any one run.

    Patches that each have a zero of their own (plates on a grid, say) show local slopes and bends. A curve made of
    pieces would be undetermined in height between them.
    """
    there = [s for s in sources if axis.channel in s.measurement.channels]
    whole = [s.measurement.channels[axis.channel] for s in there]
    low, high = min(float(p.min()) for p in whole), max(float(p.max()) for p in whole)
    for s, place in zip(there, whole, strict=True):
        if len(place):
            edges = s.blocks.run_edges
            longest = np.maximum.reduceat(place, edges[:-1]) - np.minimum.reduceat(place, edges[:-1])
            if float(longest.max()) >= 0.5 * (high - low):
                return True
    return False

"""All readings of several measurements in one vector, and the columns of effects at them.

A *series* is one reading column of one measurement: its readings in order of time, with its own noise. The vector
holds the series one after the other, without NaN readings and wrong ones.

Also: a subset of very many readings for a quick screen.
"""

import itertools
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from rtec.arrays import Bools, Floats, Ints
from rtec.effects import Effect, State
from rtec.errors import MeasurementError, ModelError
from rtec.estimation.held_out import Blocks, cuts
from rtec.estimation.smoothing import Windows, smoothed
from rtec.machine import Machine
from rtec.metrology.instruments.base import Nuisance
from rtec.metrology.measurement import Measurement
from rtec.parallel import each

FADED = 0.25
"""An unknown whose mean square elsewhere is below this share of that in one fold is determined there alone."""


@dataclass(frozen=True)
class Series:
    """One reading column of one measurement.

    Attributes:
        source: number of the measurement.
        lane: number of the column in it.
        column: its name.
        unit: "um" or "urad".
        row: instants that have a reading, (n,).
        time_s: of these instants, (n,).
        run: number of each reading's run, counted from 0 in order, (n,).
        fold: number of each reading's held-out fold, (n,).
        nuisance: values of the unknowns of each run (zero, slope …), (n, k).
        start: index of the first reading in the vector.
    """

    source: int
    lane: int
    column: str
    unit: str
    row: Ints
    time_s: Floats
    run: Ints
    fold: Ints
    nuisance: Floats
    start: int

    def __len__(self) -> int:
        return len(self.row)

    @property
    def part(self) -> slice:
        """Its place in the vector of all readings."""
        return slice(self.start, self.start + len(self.row))

    @cached_property
    def pace_s(self) -> tuple[float, float]:
        """Time from the first reading to the last, at least 1; and the usual time between readings; both s."""
        apart = np.diff(self.time_s)
        usual = float(np.median(apart[apart > 0])) if (apart > 0).any() else 1.0
        return max(float(self.time_s[-1] - self.time_s[0]), 1.0), usual


@dataclass(frozen=True)
class Readings:
    """Every reading of several measurements.

    Attributes:
        measurements: as given.
        states: their channels; temperatures smoothed.
        series: the reading columns, one after the other.
        values: all readings, µm or µrad, (m,).
        setup: values of the unknowns that a whole set-up shares (misalignment …), (m, s).
        setup_names: their names.
    """

    measurements: tuple[Measurement, ...]
    states: tuple[State, ...]
    series: tuple[Series, ...]
    values: Floats
    setup: Floats
    setup_names: tuple[str, ...]
    _arms: dict[str, Floats] = field(default_factory=dict, repr=False, compare=False)

    def __len__(self) -> int:
        return len(self.values)

    @property
    def machine(self) -> Machine:
        """The machine of all measurements."""
        return self.measurements[0].machine

    @cached_property
    def fold(self) -> Ints:
        """Held-out fold of each reading, (m,); measurements without a common run share folds by number."""
        return np.concatenate([s.fold for s in self.series])

    @cached_property
    def alone(self) -> Bools:
        """Which unknowns of the set-up one of several folds determines and the others hardly do, (folds, s).

        Only that fold has them; or they fade, as what a body remembers from before the record.
        """
        folds = [self.setup[self.fold == f] for f in np.unique(self.fold)]
        squares = np.array([np.sum(f**2, axis=0) for f in folds])
        there = np.array([np.count_nonzero(f, axis=0) for f in folds])
        others, elsewhere = squares.sum(axis=0) - squares, np.maximum(there.sum(axis=0) - there, 1)
        faded = FADED * squares / np.maximum(there, 1) > others / elsewhere
        return np.asarray((squares > others) & faded & (len(folds) > 1))

    @cached_property
    def run(self) -> Ints:
        """Run of each reading, with a separate number for each run of each series, (m,)."""
        ends = np.cumsum([0, *(int(s.run[-1]) + 1 for s in self.series)])
        return np.concatenate([s.run + int(first) for s, first in zip(self.series, ends[:-1], strict=True)])

    @cached_property
    def series_of(self) -> Ints:
        """Number of the series of each reading, (m,)."""
        return np.repeat(np.arange(len(self.series)), [len(s) for s in self.series])

    @cached_property
    def time_s(self) -> Floats:
        """Time of each reading since its measurement began, s, (m,)."""
        return np.concatenate([s.time_s for s in self.series])

    @cached_property
    def poses_mm(self) -> tuple[Floats, ...]:
        """Axis positions of each measurement, (n, axes)."""
        return tuple(s.positions_mm() for s in self.states)

    def arms(self, component: str) -> Floats:
        """Lever arm of a component error at each reading, (m,)."""
        if component not in self._arms:
            self._arms[component] = np.concatenate(list(self._arms_by_series(component)))
        return self._arms[component]

    def _arms_by_series(self, component: str) -> Iterator[Floats]:
        """Computed where there are readings, for all lanes with readings at the same instants at once."""
        source, row, lanes = -1, np.zeros(0, dtype=np.int64), np.zeros((0, 0))
        for s in self.series:
            if s.source != source or not np.array_equal(s.row, row):
                source, row, m = s.source, s.row, self.measurements[s.source]
                lanes = m.instrument.arms_of(m.machine, self.poses_mm[source][row], component)
            yield lanes[s.lane]

    def columns(self, effect: Effect, theta: Mapping[str, float]) -> Floats:
        """Contribution of one unit of each coefficient of an effect to each reading, (m, coefficients).

        Raises:
            ModelError: a measurement that sees the component lacks a channel of the effect.
        """
        arms = self.arms(effect.component)
        width = len(effect.coefficients(self.machine))
        out = np.zeros((len(self.values), width))
        basis: dict[int, list[Floats]] = {}
        for s in self.series:
            arm = arms[s.part]
            if not arm.any():
                continue
            if s.source not in basis:
                basis[s.source] = self._basis(effect, theta, s.source)
            for k, value in enumerate(basis[s.source]):
                out[s.part, k] = arm * value[s.row]
        return out

    def channel(self, name: str) -> Floats:
        """A channel at each reading, (m,); NaN where a measurement did not record it."""
        whole: list[Floats] = []
        for state in self.states:
            try:
                whole.append(np.asarray(state.value(name), dtype=np.float64))
            except ModelError:
                whole.append(np.full(len(state), np.nan))
        return np.concatenate([whole[s.source][s.row] for s in self.series])

    def without(self, spike: Bools) -> "Readings":
        """The same without the readings marked in `spike`, (m,)."""
        series, kept, start = [], ~spike, 0
        for s in self.series:
            keep = kept[s.part]
            if not keep.any():
                continue
            run = np.unique(s.run[keep], return_inverse=True)[1]
            one = replace(
                s, row=s.row[keep], time_s=s.time_s[keep], run=run, fold=s.fold[keep],
                nuisance=s.nuisance[keep], start=start,
            )  # fmt: skip
            series.append(one)
            start += len(one)
        return Readings(
            self.measurements, self.states, tuple(series), self.values[kept], self.setup[kept], self.setup_names
        )

    def with_states(self, states: Sequence[State]) -> "Readings":
        """The same readings with other channels."""
        axes = [a.channel for a in self.machine.axes]
        pairs = zip(self.states, states, strict=True)
        at_rest = all(one.channels[c] is other.channels[c] for one, other in pairs for c in axes)
        return replace(self, states=tuple(states), _arms=self._arms if at_rest else {})

    def smoothed(self) -> "Readings":
        """The same with the temperatures smoothed both ways in time, which the loop cannot do."""
        states = tuple(
            _state(m, s.reference_degc, smooth=True) for m, s in zip(self.measurements, self.states, strict=True)
        )
        return self.with_states(states)

    def at_constant(self, effect: Effect, theta: Mapping[str, float], channel: str) -> Floats:
        """Columns of an effect if a channel were constant, and every other temperature at the reference, (m, k).

        A temperature is 1 K above the reference, any other channel is at its largest value.
        """
        sensors, states = self.machine.sensor_names, []
        high = max(
            (float(np.nanmax(np.abs(s.channels[channel]))) for s in self.states if channel in s.channels), default=0
        )
        for s in self.states:
            still = {n: np.full(len(s), s.reference_degc + (n == channel)) for n in sensors if n in s.channels}
            still |= {channel: np.full(len(s), high)} if channel not in sensors and channel in s.channels else {}
            states.append(replace(s, channels={**s.channels, **still}, _cache={}))
        return self.with_states(states).columns(effect, theta)

    def _basis(self, effect: Effect, theta: Mapping[str, float], source: int) -> list[Floats]:
        state = self.states[source]
        values = effect.basis(self.machine, state, theta)
        whole = [np.asarray(v, dtype=np.float64) for v in values]
        return [v if v.shape == (len(state),) else np.broadcast_to(v, (len(state),)) for v in whole]


def read(
    measurements: Sequence[Measurement],
    reference_degc: float = 20.0,
    *,
    smooth: bool = True,
    leave_out_h: float | None = None,
) -> Readings:
    """Join the readings of measurements.

    Args:
        measurements: of one machine.
        reference_degc: temperature at which temperature effects are zero.
        smooth: smooth the temperatures, as a search for a missing effect should.
        leave_out_h: length of a held-out stretch, hours; None: as in `cuts`.

    Raises:
        MeasurementError: none given, of different machines, one given twice, or without any reading.
    """
    _check(measurements)
    states = tuple(_state(m, reference_degc, smooth=smooth) for m in measurements)
    series: list[Series] = []
    values: list[Floats] = []
    shared: list[list[tuple[str, Floats]]] = []
    start = 0
    blocks = cuts(measurements, leave_out_h)
    for source, (m, state) in enumerate(zip(measurements, states, strict=True)):
        nuisances = m.instrument.nuisance(state, m.run)
        fold, run = _folds(blocks[source]), _runs(m)
        for lane, column in enumerate(m.instrument.columns()):
            row = np.flatnonzero(np.isfinite(m.readings[column]))
            if not len(row):
                continue
            own = [n.values[lane, row] for n in nuisances if n.per == "run" and n.values[lane, row].any()]
            series.append(
                Series(
                    source, lane, column, "urad" if column.endswith("urad") else "um", row, m.time_s[row],
                    np.unique(run[row], return_inverse=True)[1], fold[row],
                    np.stack(own, axis=1) if own else np.zeros((len(row), 0)), start,
                )
            )  # fmt: skip
            values.append(m.readings[column][row])
            shared.append(_shared(nuisances, m, lane, row))
            start += len(row)
    setup, names = _setup(shared, [len(v) for v in values])
    return Readings(tuple(measurements), states, tuple(series), np.concatenate(values), setup, names)


def _state(m: Measurement, reference_degc: float, *, smooth: bool) -> State:
    channels = dict(m.channels)
    for axis in m.machine.axes:
        # As everywhere, an axis that was not recorded is at rest at zero.
        if axis.channel not in channels:
            channels |= {axis.channel: np.zeros(len(m)), axis.direction_channel: np.zeros(len(m))}
    if smooth:
        sensors = [s for s in m.machine.sensor_names if s in channels]
        windows = Windows(m.time_s)
        curves = each(lambda s: smoothed(windows, channels[s]), sensors, len(m))
        channels |= dict(zip(sensors, curves, strict=True))
    return State(m.machine, m.time_s, channels, reference_degc, at_rest=m.instrument.at_rest)


def _shared(nuisances: Sequence[Nuisance], m: Measurement, lane: int, row: Ints) -> list[tuple[str, Floats]]:
    return [(f"{n.name} of {m.name}", n.values[lane, row]) for n in nuisances if n.per == "setup"]


def _setup(shared: Sequence[list[tuple[str, Floats]]], sizes: Sequence[int]) -> tuple[Floats, tuple[str, ...]]:
    names = tuple(dict.fromkeys(name for part in shared for name, _ in part))
    out, start = np.zeros((sum(sizes), len(names))), 0
    for part, size in zip(shared, sizes, strict=True):
        for name, value in part:
            out[start : start + size, names.index(name)] = value
        start += size
    kept = np.abs(out).max(axis=0, initial=0.0) > 0
    return out[:, kept], tuple(n for n, k in zip(names, kept, strict=True) if k)


def _runs(m: Measurement) -> Ints:
    """Runs counted in order; a number that comes back later is another run."""
    return np.concatenate([[0], np.cumsum(np.diff(m.run) != 0)]).astype(np.int64)


def _folds(blocks: Blocks) -> Ints:
    """Held-out fold of each row, (n,)."""
    return np.repeat(blocks.fold, np.diff(blocks.edges))


def _check(measurements: Sequence[Measurement]) -> None:
    if not measurements:
        raise MeasurementError("no measurement was given")
    if faults := faults_of(measurements):
        raise MeasurementError("\n".join(faults))


def faults_of(measurements: Sequence[Measurement]) -> list[str]:
    """Why measurements cannot be used together, in words: other machines, no readings, the same readings twice."""
    first, names = measurements[0], [m.name for m in measurements]
    faults = [
        f"{m.name}: measured on machine {m.machine.name!r}, which is not that of {first.name}"
        for m in measurements
        if m.machine.hash != first.machine.hash
    ]
    faults += [f"{m.name}: has no reading" for m in measurements if not np.isfinite(m.matrix()).any()]
    faults += [f"{n}: given twice" for n in sorted({n for n in names if names.count(n) > 1})]
    for one, other in itertools.combinations(measurements, 2):
        if one.name != other.name and _copied(one, other):
            faults.append(f"{other.name}: the same readings as {one.name}; leave one out")
    return faults


def _copied(one: Measurement, other: Measurement) -> bool:
    """Whether two files have the same readings at the same times, channel by channel."""
    pairs = ((one.readings, other.readings), (one.channels, other.channels))
    return np.array_equal(one.time_s, other.time_s) and all(
        a.keys() == b.keys() and all(np.array_equal(a[n], b[n], equal_nan=True) for n in a) for a, b in pairs
    )


MIX = np.uint64(0x9E3779B97F4A7C15)
"""Odd, its bits spread evenly (the golden ratio): places get different numbers."""


def row_codes(columns: Floats) -> Ints:
    """A number for each distinct row of whole numbers, (n,), of columns, (k, n).

    Sorting rows of many columns would take most of the time, so each row is first hashed to one number.
    """
    key = np.zeros(columns.shape[1], dtype=np.uint64)
    for column in columns:
        key = key * MIX + column.astype(np.int64).view(np.uint64)
        key ^= key >> np.uint64(29)
    return np.asarray(np.unique(key, return_inverse=True)[1].ravel(), dtype=np.int64)


LOOK = 2500
"""This many readings select candidates as well as all do; the selected ones are fitted to all."""
RUNS = 40
"""Whole runs are taken where there are at least this many; else single readings, evenly."""


def looked_at(readings: Readings) -> Bools:
    """Which readings a screen uses, (m,): all, unless they are many."""
    keep = np.ones(len(readings), dtype=bool)
    if len(readings) <= LOOK:
        return keep
    # Random runs, not every n-th: the runs of a campaign have patterns (there and back, fast and slow).
    share = LOOK / len(readings)
    for s in readings.series:
        # By its readings, so that the same ones are drawn in whatever order the files are given.
        rng = np.random.default_rng(zlib.crc32(readings.measurements[s.source].readings[s.column].tobytes()))
        runs = int(s.run[-1]) + 1
        if runs >= RUNS:
            keep[s.part] = (rng.permutation(runs) < max(share * runs, RUNS // 2))[s.run]
        else:
            keep[s.part] = rng.permutation(len(s)) < share * len(s)
    return keep

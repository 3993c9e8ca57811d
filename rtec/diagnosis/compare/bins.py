"""Cuts the channels of a series into stretches with round ends, and describes a stretch in plain words."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.diagnosis.compare.result import Bound
from rtec.diagnosis.words import spoken, unit_of_channel
from rtec.estimation.readings import Readings, Series
from rtec.estimation.visible import moves
from rtec.machine import Machine

FINE, COARSE = 20, 8
"""Most stretches of a channel by itself, and of each of a pair."""
FEW_VALUES = 8
"""A channel with at most this many values is described by its values."""
REAL_DEGC = 0.5
LADDER = (1.0, 2.0, 5.0, 10.0)


@dataclass(frozen=True)
class Variable:
    """A channel of a series, cut into stretches.

    Attributes:
        name: of the channel; `run` is the run number.
        unit: of `low` and `high`.
        low, high: ends of each stretch, (k,); equal where the channel has single values.
        code: stretch of each reading, (n,).
    """

    name: str
    unit: str
    low: Floats
    high: Floats
    code: Ints

    def __len__(self) -> int:
        return len(self.low)

    @property
    def stepped(self) -> bool:
        """Whether it has single values: directions, speeds."""
        return bool((self.low == self.high).all())

    def bound(self, first: int, last: int) -> Bound:
        """The stretches from first to last, both included, as one."""
        return Bound(self.name, float(self.low[first]), float(self.high[last]), self.unit)


def variables_of(readings: Readings, series: Series, most: int) -> list[Variable]:
    """Channels of a series that vary, cut: positions, directions, speeds, load, temperatures, time, run.

    Args:
        readings: that the series belongs to.
        series: reading column.
        most: largest number of stretches of each channel.
    """
    out = []
    for name, value in _values(readings, series):
        cut = cut_into(name, value, most)
        if cut is not None:
            out.append(cut)
    return out


def _values(readings: Readings, series: Series) -> list[tuple[str, Floats]]:
    state, rows, machine = readings.states[series.source], series.row, readings.machine
    out: list[tuple[str, Floats]] = []
    for axis in machine.axes:
        place = state.value(axis.channel)[rows]
        if moves(readings.measurements[series.source], axis, rows):
            out += [(axis.channel, place), (axis.direction_channel, np.sign(state.value(axis.direction_channel)[rows]))]
            if axis.velocity_channel in state.channels:
                out.append((axis.velocity_channel, state.channels[axis.velocity_channel][rows]))
    for name in ("feed_mm_min", "spindle_rpm", "load_kg"):
        if name in state.channels:
            out.append((name, state.channels[name][rows]))
    for sensor in machine.sensor_names:
        if sensor in state.channels and np.nanmax(value := state.channels[sensor][rows]) - np.nanmin(value) > REAL_DEGC:
            out.append((sensor, value))
    runs = readings.measurements[series.source].run[rows]
    return [*out, ("time_s", series.time_s - series.time_s[0]), ("run", runs.astype(np.float64))]


def cut_into(name: str, value: Floats, most: int) -> Variable | None:
    """Cut a channel; None where it does not vary or was not always recorded."""
    if not np.isfinite(value).all() or np.ptp(value) == 0.0:
        return None
    levels = np.unique(value)
    if len(levels) <= min(FEW_VALUES, most) and not name.startswith("T_"):
        return Variable(name, unit_of(name), levels, levels, np.searchsorted(levels, value).astype(np.int64))
    edges = round_edges(float(levels[0]), float(levels[-1]), most, _scale(name, float(np.ptp(value))))
    if name == "run":
        edges = np.unique(np.ceil(edges))
    code = np.clip(np.searchsorted(edges, value, side="right") - 1, 0, len(edges) - 2)
    high = edges[1:] - 1.0 if name == "run" else edges[1:]
    if name == "run":
        high[-1] = max(high[-1], levels[-1])
    return Variable(name, unit_of(name), edges[:-1], high, code.astype(np.int64))


def round_edges(low: float, high: float, most: int, scale: float = 1.0) -> Floats:
    """Edges at multiples of 1, 2 or 5 times a power of ten (of `scale`) that cover low to high in at most `most`."""
    low, high = low / scale, high / scale
    rough = (high - low) / most
    power = 10.0 ** math.floor(math.log10(rough))
    for factor in (*LADDER, 20.0, 50.0):
        step = factor * power
        first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
        if last - first <= most:
            break
    return np.asarray(np.round(np.arange(first, max(last, first + 1) + 1) * step, 12) * scale)


def _scale(name: str, span: float) -> float:
    """Times are cut at round hours or minutes."""
    if name != "time_s":
        return 1.0
    return time_unit(span)[0]


def time_unit(span_s: float) -> tuple[float, str]:
    """Unit of times over a span: its seconds and its name."""
    if span_s > 7200.0:
        return 3600.0, "h"
    return (60.0, "min") if span_s > 300.0 else (1.0, "s")


def unit_of(name: str) -> str:
    """Unit of a channel."""
    return "1" if name == "run" else unit_of_channel(name)


def words_of(bounds: Sequence[Bound], machine: Machine, moving: int, span_s: float) -> str:
    """A region in plain words: "X 350-400 mm moving −"; `moving` axes were moved, the record lasted `span_s`."""
    return ", ".join(_words(b, machine, moving, span_s) for b in bounds).replace(", moving", " moving")


def _words(b: Bound, machine: Machine, moving: int, span_s: float) -> str:
    axis = next((a for a in machine.axes if b.channel in a.moving_channels or b.channel == a.channel), None)
    if axis is not None and b.channel == axis.direction_channel:
        return f"{f'{axis.name} ' if moving > 1 else ''}moving {_sign(b)}"
    if b.channel == "time_s":
        seconds, unit = time_unit(span_s)
        return f"{_range(b.low / seconds, b.high / seconds)} {unit} after the first reading"
    if b.channel == "run":
        return f"run {b.low:.0f}" if b.low == b.high else f"runs {b.low:.0f}-{b.high:.0f}"
    name = {"spindle_rpm": "spindle", "load_kg": "load", "feed_mm_min": "feed"}.get(b.channel, b.channel)
    if axis is not None:
        name = axis.name if b.channel == axis.channel else f"velocity of {axis.name}"
    return f"{name} {_range(b.low, b.high)} {spoken(b.unit)}"


def _sign(b: Bound) -> str:
    if b.low != b.high:
        return "either way"
    return "+" if b.low > 0 else "−" if b.low < 0 else "not at all"


def _range(low: float, high: float) -> str:
    if low == high:
        return f"{low:g}"
    joint = " to " if low < 0 else "-"
    return f"{low:g}{joint}{high:g}"

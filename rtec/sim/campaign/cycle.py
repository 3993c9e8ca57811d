"""One measuring cycle: the poses in order, the time of each reading, and its direction of approach."""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rtec.errors import ConfigError
from rtec.machine import Axis, Machine
from rtec.metrology.instruments.base import Instrument
from rtec.sim.campaign.settings import Targets
from rtec.tomlfile import nearest

Floats = NDArray[np.float64]
GOLDEN = 0.3819660112501051
"""Steps of (k + this) pitches cover all phases of the pitch evenly."""
MARGIN, INTERVALS = 0.02, 20
MOST_ROWS = 2_000_000


@dataclass(frozen=True)
class Cycle:
    """One cycle.

    Attributes:
        pose_mm: axis positions, (n, axes).
        direction: last direction of each axis, (n, axes); 0 for an axis that never moves.
        after_s: time from the start of the cycle to each reading, (n,).
        travelling: index of the axis that travels, (n,).
        seconds: length of the cycle.
        path_mm: travel of each axis in the cycle, (axes,).
        notes: choices, in words.
        more: other channels by name, (n,): velocities, accelerations, angle, feed.
        part: number of the run within the cycle, from 0, (n,); None: the cycle is one run.
    """

    pose_mm: Floats
    direction: Floats
    after_s: Floats
    travelling: NDArray[np.int64]
    seconds: float
    path_mm: Floats
    notes: tuple[str, ...]
    more: Mapping[str, Floats] = field(default_factory=dict)
    part: NDArray[np.int64] | None = None


def make_cycle(machine: Machine, instrument: Instrument, targets: Targets) -> Cycle:
    """Make the cycle of an instrument that stops at targets.

    Raises:
        ConfigError: an axis does not exist, or a place or range is outside the travel.
    """
    axes = travelling_axes(machine, instrument, targets)
    both = targets.both_directions
    if both is None:
        both = instrument.name != "work_piece"
    at = _places(machine, targets)
    lines, notes = [], []
    for name in axes:
        positions, note = line(machine.axis(name), targets)
        notes += note
        lines += _lines(machine, name, positions, at, both)
    if not lines:
        lines = [(np.array([[at[a][0] for a in machine.axis_names]]), -1, 0.0)]
    pose = np.repeat(np.concatenate([p for p, _, _ in lines]), targets.readings, axis=0)
    travelling = np.concatenate([np.full(len(p) * targets.readings, k) for p, k, _ in lines])
    way = np.concatenate([np.full(len(p) * targets.readings, d) for p, _, d in lines])
    moved = np.abs(pose - np.roll(pose, 1, axis=0))
    dwell_s = np.full(len(pose), targets.dwell_s / targets.readings)
    after_s = np.cumsum(moved.max(axis=1) / (targets.feed_mm_min / 60.0) + dwell_s)
    return Cycle(
        pose,
        directions(pose, travelling, way),
        after_s,
        travelling,
        float(after_s[-1]),
        moved.sum(axis=0),
        tuple(notes),
    )


def travelling_axes(machine: Machine, instrument: Instrument, targets: Targets) -> tuple[str, ...]:
    """Names of the axes that travel, in order."""
    if targets.axes is not None:
        for name in targets.axes:
            if name not in machine.axis_names:
                raise ConfigError(f"[targets] axes: {name!r} is none of the machine{nearest(name, machine.axis_names)}")
        return targets.axes
    if instrument.name == "spindle_drift":
        return ()
    if instrument.axis is None:
        return machine.axis_names
    other = getattr(instrument.setup, "reference_axis", None)
    return (instrument.axis, other) if other is not None else (instrument.axis,)


def line(axis: Axis, targets: Targets) -> tuple[Floats, list[str]]:
    """Targets along an axis, mm, and notes on them."""
    low, high = axis.travel_mm
    first, last = targets.range_mm or (low + MARGIN * (high - low), high - MARGIN * (high - low))
    if first < low or last > high:
        raise ConfigError(f"[targets] range_mm {first:g} to {last:g}: axis {axis.name} travels {low:g} to {high:g} mm")
    # Round positions, as a person would choose them; a travel of less than a millimetre keeps its step.
    step = targets.step_mm or round((last - first) / INTERVALS, 3) or (last - first) / INTERVALS
    notes = []
    if not targets.keep_step and axis.pitch_mm is not None and on_pitch(step, axis.pitch_mm):
        better = off_pitch(step, axis.pitch_mm)
        if targets.step_mm is not None:
            notes.append(
                f"axis {axis.name}: steps of {step:g} mm are a multiple of the pitch, {axis.pitch_mm:g} mm, and would "
                f"hide the error that repeats with it; {better:g} mm taken instead"
            )
        step = better
    count = math.floor((last - first) / step + 1e-9) + 1
    if count * targets.readings > MOST_ROWS:
        raise ConfigError(
            f"[targets] step_mm {step:g}: {count} targets on axis {axis.name}, {targets.readings} readings each; at "
            f"most {MOST_ROWS} rows"
        )
    return first + step * np.arange(count, dtype=np.float64), notes


def on_pitch(step_mm: float, pitch_mm: float) -> bool:
    """Whether steps cover less than three phases of the pitch, or nearly so."""
    halves = step_mm / (0.5 * pitch_mm)
    return step_mm > 0.4 * pitch_mm and abs(halves - round(halves)) < 0.1


def off_pitch(step_mm: float, pitch_mm: float) -> float:
    """The step nearest to `step_mm` that covers all phases of the pitch evenly."""
    whole = max(round(step_mm / pitch_mm - GOLDEN), 0)
    return round((whole + GOLDEN) * pitch_mm, 3)


def _places(machine: Machine, targets: Targets) -> dict[str, tuple[float, ...]]:
    """Positions of each axis while another one travels, by axis name."""
    out: dict[str, tuple[float, ...]] = {a.name: (0.5 * sum(a.travel_mm),) for a in machine.axes}
    for name, places in targets.at_mm.items():
        if name not in out:
            raise ConfigError(f"[targets] at_mm: {name!r} is none of the machine{nearest(name, machine.axis_names)}")
        low, high = machine.axis(name).travel_mm
        if any(not low <= p <= high for p in places):
            raise ConfigError(f"[targets] at_mm.{name} {list(places)}: it travels {low:g} to {high:g} mm")
        out[name] = places
    return out


def _lines(
    machine: Machine, name: str, positions: Floats, at: dict[str, tuple[float, ...]], both: bool
) -> list[tuple[Floats, int, float]]:
    """Lines along one axis: poses (n, axes), index of the axis, direction."""
    index, out = machine.axis_names.index(name), []
    for places in itertools.product(*(at[a] if a != name else (0.0,) for a in machine.axis_names)):
        pose = np.tile(np.array(places), (len(positions), 1))
        pose[:, index] = positions
        out.append((pose, index, 1.0))
        if both:
            out.append((pose[::-1], index, -1.0))
    return out


def directions(pose: Floats, travelling: NDArray[np.int64], way: Floats) -> Floats:
    """Last direction of every axis in a repeated cycle, (n, axes); the travelling axis overruns its end targets."""
    moved = np.sign(pose - np.roll(pose, 1, axis=0))
    rows = np.flatnonzero(travelling >= 0)
    moved[rows, travelling[rows]] = way[rows]
    # The row of the last move up to each row; where there is none yet, that of the last in the cycle before.
    since = np.maximum.accumulate(np.where(moved != 0, np.arange(len(pose))[:, None], -1))
    since = np.where(since >= 0, since, since[-1])
    return np.asarray(np.take_along_axis(moved, since, axis=0) + 0.0)

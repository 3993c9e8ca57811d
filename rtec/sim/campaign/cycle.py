"""One measuring cycle: the poses in order, the time of each reading, its direction of approach; or a path in motion.

Paths are circles of a ball bar; squares, lines and Ls on a grid plate. They record velocities and accelerations with
the positions, so that servo effects can be simulated and diagnosed.
"""

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.errors import ConfigError
from rtec.machine import Axis, Machine
from rtec.machine.chain import MM_URAD_TO_UM
from rtec.metrology.instruments.ball_bar import BallBar, axis_along, circle_channels
from rtec.metrology.instruments.base import Instrument
from rtec.metrology.instruments.grid_encoder import GridEncoder, GridEncoderSetup
from rtec.metrology.instruments.laser import LaserDiagonal
from rtec.sim.campaign.settings import DrivenPath, Settings, Targets
from rtec.tomlfile import nearest

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
    travelling: Ints
    seconds: float
    path_mm: Floats
    notes: tuple[str, ...]
    more: Mapping[str, Floats] = field(default_factory=dict)
    part: Ints | None = None


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
    if isinstance(instrument, LaserDiagonal):
        lines += _diagonal(machine, instrument.line, targets, both)
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
    if instrument.name in ("spindle_drift", "laser_diagonal"):
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


def _diagonal(machine: Machine, line: Floats, targets: Targets, both: bool) -> list[tuple[Floats, int, float]]:
    """There and back through the middle of the travels along a line, as far as all axes reach."""
    parts = np.array([line["XYZ".index(a.direction)] for a in machine.axes])
    low, high = np.array([a.travel_mm for a in machine.axes]).T
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    reach = (1.0 - 2.0 * MARGIN) * np.min(half[parts != 0.0] / np.abs(parts[parts != 0.0]))
    count = INTERVALS if targets.step_mm is None else max(math.floor(2.0 * reach / targets.step_mm + 1e-9), 1)
    pose = np.round(middle + np.linspace(-reach, reach, count + 1)[:, None] * parts, 3)
    return [(pose, -1, 0.0), (pose[::-1], -1, 0.0)] if both else [(pose, -1, 0.0)]


def directions(pose: Floats, travelling: Ints, way: Floats) -> Floats:
    """Last direction of every axis in a repeated cycle, (n, axes); the travelling axis overruns its end targets."""
    moved = np.sign(pose - np.roll(pose, 1, axis=0))
    rows = np.flatnonzero(travelling >= 0)
    moved[rows, travelling[rows]] = way[rows]
    # The row of the last move up to each row; where there is none yet, that of the last in the cycle before.
    since = np.maximum.accumulate(np.where(moved != 0, np.arange(len(pose))[:, None], -1))
    since = np.where(since >= 0, since, since[-1])
    return np.asarray(np.take_along_axis(moved, since, axis=0) + 0.0)


APPROACH_S = 2.0
"""Time from one path to the next."""


def make_path(machine: Machine, instrument: Instrument, settings: Settings) -> Cycle | None:
    """The cycle of an instrument that reads in motion; None for one that stops at targets.

    Raises:
        ConfigError: the path leaves the travel of an axis, or has far too many readings.
    """
    if isinstance(instrument, BallBar):
        out = _circle(machine, instrument, settings.path)
    elif isinstance(instrument, GridEncoder):
        out = _grid(machine, instrument.setup, settings.path)
    else:
        return None
    low, high = np.array([a.travel_mm for a in machine.axes]).T
    outside = (out.pose_mm < low - 1e-9) | (out.pose_mm > high + 1e-9)
    if outside.any():
        place = int(np.argmax(outside.any(axis=0)))
        axis, values = machine.axes[place], out.pose_mm[:, place]
        raise ConfigError(
            f"[path] axis {axis.name} would go from {values.min():g} to {values.max():g} mm, and travels "
            f"{axis.travel_mm[0]:g} to {axis.travel_mm[1]:g} mm; move the middle or take a smaller path"
        )
    return out


def readings_um(instrument: Instrument, machine: Machine, pose_mm: Floats, components: Mapping[str, Floats]) -> Floats:
    """Readings of component errors, (readings, n): by the instrument's arms, or the exact length of a ball bar."""
    if not isinstance(instrument, BallBar):
        out = np.zeros((len(instrument.columns()), len(pose_mm)))
        for component, values in components.items():
            out += instrument.arms_of(machine, pose_mm, component) * values
        return out
    chain, offset = machine.chain, np.asarray(instrument.setup.offset_mm)
    affine = np.concatenate([np.ones((len(pose_mm), 1)), pose_mm], axis=1)
    tip = np.zeros((len(pose_mm), 3))
    for component, values in components.items():
        k = chain.components.index(component)
        arms = affine @ chain.terms[:, k].T + np.cross(chain.turns[:, k], offset) * MM_URAD_TO_UM
        tip += arms * values[:, None]
    return instrument.exact_um(machine, pose_mm, tip)


def _circle(machine: Machine, instrument: BallBar, path: DrivenPath) -> Cycle:
    setup = instrument.setup
    around = setup.arc_deg + 2.0 * setup.overshoot_deg
    count = round(around / path.step_deg)
    if not 8 <= count <= MOST_ROWS:
        raise ConfigError(f"[path] step_deg {path.step_deg:g}: {count} readings on the circle; 8 to {MOST_ROWS} do")
    way_deg = np.linspace(-setup.overshoot_deg, setup.arc_deg + setup.overshoot_deg, count + 1)
    angle = np.deg2rad(setup.start_deg + setup.sense * way_deg)
    channels = circle_channels(machine, setup, angle)
    pose = np.stack([channels.pop(a.channel, np.zeros(len(angle))) for a in machine.axes], axis=1)
    direction = np.stack([channels.pop(a.direction_channel, np.zeros(len(angle))) for a in machine.axes], axis=1)
    length = np.deg2rad(way_deg - way_deg[0]) * setup.radius_mm
    after = APPROACH_S + length / (setup.feed_mm_min / 60.0)
    channels["feed_mm_min"] = np.full(len(angle), setup.feed_mm_min)
    moved = np.abs(np.diff(pose, axis=0)).sum(axis=0)
    still = np.full(len(angle), -1)
    return Cycle(pose, direction, after, still, float(after[-1]) + APPROACH_S, moved, (), channels)


Leg = tuple[int, Floats, Floats, float, int]
"""Index of the axis, places along it, places along the other, mm, feed, number of the run."""


def _grid(machine: Machine, setup: GridEncoderSetup, path: DrivenPath) -> Cycle:
    first, second = (axis_along(machine, d) for d in setup.letters)
    if first is None or second is None:
        raise ConfigError(
            f"[path] plane {setup.plane}: machine {machine.name!r} cannot travel in both of its directions"
        )
    axes = (machine.axes.index(first), machine.axes.index(second))
    centre = np.array([setup.origin_mm["XYZ".index(a.direction)] if a in (axis_along(machine, d) for d in "XYZ")
                       else 0.0 for a in machine.axes])  # fmt: skip
    poses, travelling, way, speed, feed, part = [], [], [], [], [], []
    for which, own, other, feed_mm_min, run in _legs(path):
        pose = np.tile(centre, (len(own), 1))
        pose[:, axes[which]] += own
        pose[:, axes[1 - which]] += other
        sign = float(np.sign(own[-1] - own[0]))
        poses.append(pose)
        travelling.append(np.full(len(own), axes[which]))
        way.append(np.full(len(own), sign))
        feed.append(np.full(len(own), feed_mm_min))
        speed.append(np.full(len(own), sign * feed_mm_min / 60.0))
        part.append(np.full(len(own), run))
    whole, going = np.concatenate(poses), np.concatenate(travelling)
    parts, feeds, speeds = np.concatenate(part), np.concatenate(feed), np.concatenate(speed)
    moved = np.abs(np.diff(whole, axis=0, prepend=whole[:1]))
    fresh = np.diff(parts, prepend=-1) != 0
    after = np.cumsum(moved.max(axis=1) / (feeds / 60.0) + np.where(fresh, APPROACH_S, 1e-3))
    more = {"feed_mm_min": feeds}
    for axis, k in ((first, axes[0]), (second, axes[1])):
        more[axis.velocity_channel] = np.where(going == k, speeds, 0.0)
        more[axis.acceleration_channel] = np.zeros(len(going))
    return Cycle(
        whole, directions(whole, going, np.concatenate(way)), after, going, float(after[-1]) + APPROACH_S,
        moved.sum(axis=0), (), more, parts.astype(np.int64),
    )  # fmt: skip


def _legs(path: DrivenPath) -> Iterator[Leg]:
    """Every straight piece, relative to the plate's middle."""
    half, run = 0.5 * path.travel_mm, 0
    for feed in path.feeds_mm_min:
        for kind in path.kinds:
            for corners in PATHS[kind]:
                for (a0, b0), (a1, b1) in itertools.pairwise(corners):
                    which = 0 if a0 != a1 else 1
                    start, end, other = (a0, a1, b0) if which == 0 else (b0, b1, a0)
                    count = max(round(abs(end - start) * half / path.step_mm), 4)
                    if count > MOST_ROWS:
                        raise ConfigError(f"[path] step_mm {path.step_mm:g}: {count} readings on an edge are too many")
                    own = np.linspace(start * half, end * half, count + 1)
                    yield which, own, np.full(len(own), other * half), feed, run
                run += 1


Corners = tuple[tuple[float, float], ...]
ROUND: Corners = ((-1, 1), (-1, -1), (1, -1), (1, 1), (-1, 1))
PATHS: Mapping[str, tuple[Corners, ...]] = {
    "square": (ROUND, ROUND[::-1]),
    "straight": (((-1, 0), (1, 0), (-1, 0)), ((0, -1), (0, 1), (0, -1))),
    "l_shaped": (((-1, -1), (0, -1), (0, 1)), ((1, -1), (0, -1), (0, 1))),
}
"""Corners in half travels relative to the middle; each path is one run."""

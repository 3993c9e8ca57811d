"""Paths that are read in motion: circles of a ball bar; squares, lines and Ls on a grid plate.

They record velocities and accelerations with the positions, so that servo effects can be simulated and diagnosed.
"""

import itertools
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from rtec.errors import ConfigError
from rtec.machine import Machine
from rtec.machine.chain import MM_URAD_TO_UM
from rtec.metrology.instruments.ball_bar import BallBar, axis_along, circle_channels
from rtec.metrology.instruments.base import Instrument
from rtec.metrology.instruments.grid_encoder import GridEncoder, GridEncoderSetup
from rtec.sim.campaign.cycle import MOST_ROWS, Cycle, directions
from rtec.sim.campaign.settings import Path, Settings

Floats = NDArray[np.float64]
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


def _circle(machine: Machine, instrument: BallBar, path: Path) -> Cycle:
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


def _grid(machine: Machine, setup: GridEncoderSetup, path: Path) -> Cycle:
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


def _legs(path: Path) -> Iterator[Leg]:
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

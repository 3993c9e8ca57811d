"""What a report on a grid plate is made of: its lines, and the names and signs of a plane."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtec.machine import Machine
from rtec.metrology.grid.paths import Edge
from rtec.metrology.instruments.ball_bar import axis_along
from rtec.metrology.instruments.grid_encoder import GridEncoderSetup

COVERAGE = 2.0
FEED = 0.02
"""Feeds that differ by a smaller share are the same."""


@dataclass(frozen=True)
class Item:
    """One line of a report.

    Attributes:
        name: component error, with what it depends on.
        means: what it is, in a plain sentence.
        where: measured range.
        value: in `unit`.
        unit: as people read it.
        u: expanded uncertainty, coverage factor 2: repeatability of the readings, and the plate's own accuracy where
            that does not fall out.
        chance: how often noise alone would give as much; NaN where the question is not asked.
    """

    name: str
    means: str
    where: str
    value: float
    unit: str
    u: float
    chance: float = float("nan")


@dataclass(frozen=True)
class Lean:
    """Names and signs of a plane.

    Attributes:
        letters: its two directions.
        normal: the third.
        turn: letter of the rotation about it.
        signs: σ_a, σ_b.
        axes: names of the axes that make the two directions.
    """

    letters: tuple[str, str]
    normal: str
    turn: str
    signs: tuple[float, float]
    axes: tuple[str, str]


def lean_of(machine: Machine, setup: GridEncoderSetup) -> Lean:
    """Names and signs of a plane on a machine."""
    a, b = setup.letters
    unit = {d: np.eye(3)[i] for i, d in enumerate("XYZ")}
    normal = unit[setup.normal]
    signs = (float(np.cross(normal, unit[a]) @ unit[b]), float(np.cross(normal, unit[b]) @ unit[a]))
    names = tuple(getattr(axis_along(machine, d), "name", d) for d in (a, b))
    turn = dict(zip("XYZ", "ABC", strict=True))[setup.normal]
    return Lean((a, b), setup.normal, turn, signs, (names[0], names[1]))


def slowest(edges: Sequence[Edge]) -> float:
    """Lowest feed, NaN where none is recorded."""
    known = [e.feed_mm_min for e in edges if np.isfinite(e.feed_mm_min)]
    return min(known) if known else float("nan")


def same_feed(one: float, other: float) -> bool:
    """Are two feeds the same? Those that are not recorded are."""
    return not (np.isfinite(one) and np.isfinite(other)) or abs(one - other) <= FEED * max(abs(one), abs(other))

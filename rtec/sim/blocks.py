"""Moves as rows of one table, and where a row is at a time: what the interpolator of the controller works on.

Every move starts and ends at rest with constant acceleration between (trapezoidal speed along the path).
A row's columns are named below; the last `2 · axes` are start and displacement of every axis. Times are in
servo ticks, whole numbers, so that a program repeats without a remainder.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

(
    START,
    END,
    LENGTH,
    SPEED,
    ACCELERATION,
    RPM,
    ARC,
    AXIS_I,
    AXIS_J,
    CENTRE_I,
    CENTRE_J,
    RADIUS,
    ANGLE,
    SWEEP,
    POSITIONS,
) = range(15)


@dataclass(frozen=True)
class Arc:
    """Turn about a centre in the plane of two axes: from axis i towards axis j is positive."""

    axis_i: int
    axis_j: int
    centre_mm: tuple[float, float]
    radius_mm: float
    angle_rad: float
    sweep_rad: float


@dataclass(frozen=True)
class Move:
    """One block of a program: a line, an arc (with straight motion of other axes) or a wait.

    Attributes:
        start_mm, end_mm: (axes,).
        feed_mm_s: highest speed along the path.
        wait_s: for a dwell, which goes nowhere.
        rpm: spindle speed from here on, signed, 1/min.
    """

    start_mm: tuple[float, ...]
    end_mm: tuple[float, ...]
    feed_mm_s: float
    wait_s: float
    rpm: float
    arc: Arc | None = None

    @property
    def length_mm(self) -> float:
        """Length of the path."""
        step = [b - a for a, b in zip(self.start_mm, self.end_mm, strict=True)]
        if self.arc is None:
            return math.hypot(*step)
        step = [d for k, d in enumerate(step) if k not in (self.arc.axis_i, self.arc.axis_j)]
        return math.hypot(self.arc.radius_mm * self.arc.sweep_rad, *step)


def table_of(moves: list[Move], axes: int, acceleration_mm_s2: float, period_s: float) -> Floats:
    """Rows for the interpolator, (moves, 15 + 2·axes)."""
    out = np.zeros((len(moves), POSITIONS + 2 * axes))
    tick = 0
    for row, move in zip(out, moves, strict=True):
        length = move.length_mm
        speed = min(move.feed_mm_s, math.sqrt(length * acceleration_mm_s2))
        seconds = length / speed + speed / acceleration_mm_s2 if length > 0 else move.wait_s
        row[START], tick = tick, tick + math.ceil(seconds / period_s - 1e-9)
        row[END:ARC] = tick, length, speed, acceleration_mm_s2, move.rpm
        if move.arc is not None:
            a = move.arc
            row[ARC:POSITIONS] = 1, a.axis_i, a.axis_j, *a.centre_mm, a.radius_mm, a.angle_rad, a.sweep_rad
        row[POSITIONS : POSITIONS + axes] = move.start_mm
        row[POSITIONS + axes :] = np.subtract(move.end_mm, move.start_mm)
    return out

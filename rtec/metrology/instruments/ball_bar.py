"""Double ball bar: the distance between a ball at the tool and a ball on the table while a circle is run.

Geometry, all in mm in machine coordinates, of the tool relative to the workpiece:

    B = centre + height · n       ball on the table, `n` the third machine direction
    r = p - B                     from it to the ball at the tool, p the place that is commanded
    reading = |r + e| - |r|       exactly; |r| = L0 = √(radius² + height²) on the circle
            = u · e + (e² - (u · e)²) / 2L0 …   with u = r / |r|

The first term is the linear functional: its arms are `u · J(pose)`, and it gives the characteristic functions of
[BB Table 1]. The rest is 0.3 nm for an error of 10 µm across a bar of 150 mm. A rotation of either ball's carrier about
the other ball changes no distance, so that the side of the chain on which a rotation occurs does not matter.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from rtec.arrays import Floats, Ints
from rtec.effects import State
from rtec.machine import Axis, Machine
from rtec.metrology.instruments.base import (
    ORIGIN,
    Instrument,
    InstrumentSetup,
    Nuisance,
    Scope,
    component_index,
    point,
    zero,
)
from rtec.quantities import Degrees, Millimetres, MillimetresPerMinute, MillimetresPositive, Vector

Plane = Literal["XY", "YZ", "ZX", "XZ"]
JUST_BEFORE_RAD = 1e-6
"""Angle before a turning point at which the direction is taken: at the point itself the axis keeps its last one."""
COVERED_DEG = 1.0
"""If two counts of turns cover the arc equally well within this, the one that fits the overshoot is chosen."""


TURN_DEG = 360.0
OF_LENGTH = 0.1
"""A reading above this share of the radius is no deviation."""


class BallBarSetup(InstrumentSetup):
    """`[setup]` of a ball bar.

    Attributes:
        plane: plane of the circle; angles count from the first letter's direction towards the second's.
        centre_mm: commanded machine coordinates of the circle's centre.
        radius_mm: radius of the programmed circle.
        height_mm: height of the table-side ball's centre over the circle's plane, along the third machine direction;
            the length of the bar is then √(radius² + height²).
        height_uncertainty_mm: standard uncertainty of that height; `rtec ballbar` estimates the height of each test
            with it as the prior. 0: the height is exact.
        direction: "ccw" runs from the first letter towards the second.
        feed_mm_min: feed along the circle.
        start_deg: angle at which the measured arc begins.
        arc_deg: length of the measured arc.
        overshoot_deg: motion before and after the arc at full feed; analyses do not use these readings.
        offset_mm: vector from the tool tip to the ball at the tool.
        zero: how often the bar's length is unknown: once, or in every run. "none": it was calibrated on its reference.
        centre: how often the table-side ball is off the centre by an unknown amount: once, in every run, or not at all.
    """

    plane: Plane
    centre_mm: Vector
    radius_mm: MillimetresPositive
    height_mm: Millimetres = 0.0
    height_uncertainty_mm: Annotated[float, Field(ge=0, le=10)] = 0.05
    direction: Literal["ccw", "cw"]
    feed_mm_min: MillimetresPerMinute
    start_deg: Degrees = 0.0
    arc_deg: Annotated[float, Field(ge=0.1, le=360)] = 360.0
    overshoot_deg: Annotated[float, Field(ge=0, le=360)] = 0.0
    offset_mm: Vector = ORIGIN
    zero: Scope = "none"
    centre: Scope = "setup"

    @property
    def letters(self) -> tuple[str, str, str]:
        """Machine directions: first and second of the plane, and the third, along which the height counts."""
        first, second = self.plane
        return first, second, next(d for d in "XYZ" if d not in self.plane)

    @property
    def rows(self) -> tuple[int, int, int]:
        """Indices of these directions in a vector."""
        first, second, third = ("XYZ".index(d) for d in self.letters)
        return first, second, third

    @property
    def sense(self) -> int:
        """+1 for "ccw", -1 for "cw"."""
        return 1 if self.direction == "ccw" else -1

    @property
    def length_mm(self) -> float:
        """L0, nominal length of the bar."""
        return float(np.hypot(self.radius_mm, self.height_mm))


@dataclass(frozen=True)
class BallBar(Instrument):
    """Length of the bar minus its nominal length, µm."""

    name = "ball_bar"
    title = "Double ball bar"
    at_rest = False
    setup_model = BallBarSetup
    axis_use = "none"
    setup: BallBarSetup

    def columns(self) -> tuple[str, ...]:
        """One reading."""
        return ("reading_um",)

    def of_unknown_length(self) -> "BallBar":
        """The same bar as if nobody knew its length in any run."""
        return replace(self, setup=self.setup.model_copy(update={"zero": "run"}))

    def length_fault(self, reading_um: Floats) -> str:
        """Why readings are no deviations but lengths of the bar, with what to do; empty where they may be."""
        known = np.abs(reading_um[np.isfinite(reading_um)])
        usual_mm = 1e-3 * float(np.median(known)) if len(known) else 0.0
        if usual_mm <= OF_LENGTH * self.setup.radius_mm:
            return ""
        return (
            f"reading_um is about {usual_mm:.6g} mm with radius_mm = {self.setup.radius_mm:g}: that is no deviation of "
            "the bar's length; import the file of the instrument with `rtec import`, which takes the nominal length "
            f"off, or subtract {1e3 * self.setup.length_mm:.10g} from the column"
        )

    def on_arc_deg(self, angle_deg: Floats) -> Floats:
        """Angles on the circle, shifted by whole turns to within half a turn of the middle of the arc, (n,)."""
        middle = (self.setup.start_deg + 0.5 * self.setup.sense * self.setup.arc_deg) % TURN_DEG
        return np.asarray(middle + (angle_deg - middle + 0.5 * TURN_DEG) % TURN_DEG - 0.5 * TURN_DEG)

    def bar_mm(self, machine: Machine, pose_mm: Floats) -> Floats:
        """Nominal vector from the ball on the table to the ball at the tool, mm, (n, 3)."""
        out = np.zeros((len(pose_mm), 3))
        for i, axis in enumerate(machine.axes):
            out[:, "XYZ".index(axis.direction)] += pose_mm[:, i]
        out -= np.asarray(self.setup.centre_mm)
        third = self.setup.rows[2]
        if not any(a.direction == "XYZ"[third] for a in machine.axes):
            out[:, third] = 0.0  # no axis moves along this direction
        out[:, third] -= self.setup.height_mm
        return out

    def exact_um(self, machine: Machine, pose_mm: Floats, tip_um: Floats) -> Floats:
        """Exact reading for an error of the ball at the tool relative to the workpiece, µm, (1, n).

        Args:
            machine: the measured machine.
            pose_mm: commanded positions, (n, axes).
            tip_um: error of that ball, (n, 3), in machine coordinates.
        """
        bar, error = self.bar_mm(machine, pose_mm), np.asarray(tip_um) * 1e-3
        before = np.linalg.norm(bar, axis=1)
        after = np.linalg.norm(bar + error, axis=1)
        # (|r+e|² - |r|²) / (|r+e| + |r|) keeps the digits that the difference of two lengths would lose.
        change = (2.0 * bar * error + error**2).sum(axis=1) / (after + before)
        return np.asarray(change * 1e3, dtype=np.float64)[None]

    def arms(self, machine: Machine, pose_mm: Floats) -> Floats:
        """`u · J(pose)`, (1, n, components)."""
        along = self._along(machine, pose_mm)
        out = np.einsum("nd,dck,nk->nc", along, self._points(machine), _affine(pose_mm), optimize=True)
        return np.asarray(out, dtype=np.float64)[None]

    def arms_of(self, machine: Machine, pose_mm: Floats, component: str) -> Floats:
        """One component's part of `arms`, (1, n)."""
        terms = self._points(machine)[:, component_index(machine, component, self.name)]
        out = ((_affine(pose_mm) @ terms.T) * self._along(machine, pose_mm)).sum(axis=1)
        return np.asarray(out, dtype=np.float64)[None]

    def nuisance(self, state: State, run: Ints) -> tuple[Nuisance, ...]:
        """Zero of the length, and the offset of the table-side ball in the plane and in its height.

        A different height of the ball changes all readings equally, as a different length of the bar does: an unknown
        zero therefore includes the height.
        """
        del run
        out = list(zero(len(state), 1, self.setup.zero, "um"))
        along = self._along(state.machine, state.positions_mm())
        if self.setup.centre != "none":
            for letter, row in zip(self.setup.letters[:2], self.setup.rows[:2], strict=True):
                out.append(Nuisance(f"centre {letter}", "um", -along[None, :, row], self.setup.centre))
        if self.setup.height_mm and self.setup.height_uncertainty_mm and self.setup.zero == "none":
            out.append(Nuisance("height", "um", -along[None, :, self.setup.rows[2]], "setup"))
        return tuple(out)

    def faults(self, machine: Machine) -> list[str]:
        """A direction of the plane in which no axis moves."""
        moved = {a.direction for a in machine.axes}
        return [
            f"[setup] plane {self.setup.plane!r}: machine {machine.name!r} has no axis along {d}"
            for d in self.setup.letters[:2]
            if d not in moved
        ]

    def _along(self, machine: Machine, pose_mm: Floats) -> Floats:
        bar = self.bar_mm(machine, pose_mm)
        return np.asarray(bar / np.linalg.norm(bar, axis=1, keepdims=True), dtype=np.float64)

    def _points(self, machine: Machine) -> Floats:
        directions: tuple[Literal["X", "Y", "Z"], ...] = ("X", "Y", "Z")
        return np.stack([point(machine, d, self.setup.offset_mm) for d in directions])


def axis_along(machine: Machine, direction: str) -> Axis | None:
    """The axis along a machine direction, of several the compensated one; None where there is none."""
    found = [a for a in machine.axes if a.direction == direction]
    return next((a for a in found if a.compensate), found[0] if found else None)


def circle_channels(machine: Machine, setup: BallBarSetup, angle_rad: Floats) -> dict[str, Floats]:
    """Channels of the axes on a circle, by name, (n,) each.

    Positions, mm; last direction of motion; velocity, mm/s, and acceleration, mm/s², at the programmed feed. Further
    axes along the same direction are at zero.
    """
    first, second = np.cos(angle_rad), np.sin(angle_rad)
    before = angle_rad - setup.sense * JUST_BEFORE_RAD
    speed = setup.feed_mm_min / 60.0
    shape = {
        setup.letters[0]: (first, -np.sin(before), -second),
        setup.letters[1]: (second, np.cos(before), first),
    }
    out: dict[str, Floats] = {"angle_deg": np.rad2deg(angle_rad)}
    for letter, centre in zip("XYZ", setup.centre_mm, strict=True):
        axis = axis_along(machine, letter)
        if axis is None:
            continue
        out[axis.channel] = np.full(len(angle_rad), centre)
        if letter in shape:
            place, way, tangent = shape[letter]
            out[axis.channel] = centre + setup.radius_mm * place
            out[axis.direction_channel] = np.where(setup.sense * way > 0.0, 1.0, -1.0)
            out[axis.velocity_channel] = setup.sense * speed * tangent
            out[axis.acceleration_channel] = -(speed**2) / setup.radius_mm * place
    return out


def travelled_deg(setup: BallBarSetup, angle_deg: Floats, run: Ints) -> Floats:
    """Angle of each reading from the start of the arc, degrees, (n,), run by run.

    Negative before the arc, above `arc_deg` after it; recorded angles may restart at 360 or continue. Whole turns are
    added so that a recording covers the arc; if several numbers of turns do, the one whose start is nearest to the
    overshoot of the set-up.
    """
    out = np.empty(len(angle_deg))
    for number in np.unique(run):
        rows = run == number
        way = setup.sense * (np.rad2deg(np.unwrap(np.deg2rad(angle_deg[rows]))) - setup.start_deg)
        out[rows] = way + 360.0 * _turns(setup, way)
    return out


def _turns(setup: BallBarSetup, way_deg: Floats) -> int:
    """Whole turns to add to a run."""
    low, high = float(way_deg.min()), float(way_deg.max())
    near = round(-way_deg[0] / 360.0)
    span = int((high - low) // 360.0) + 2
    choices = range(near - span, near + span + 1)

    def covered(turns: int) -> float:
        return min(high + 360.0 * turns, setup.arc_deg) - max(low + 360.0 * turns, 0.0)

    most = max(covered(k) for k in choices)
    good = [k for k in choices if covered(k) > most - COVERED_DEG]
    return min(good, key=lambda k: abs(float(way_deg[0]) + 360.0 * k + setup.overshoot_deg))


def _affine(pose_mm: Floats) -> Floats:
    return np.concatenate([np.ones((len(pose_mm), 1)), pose_mm], axis=1)

"""One ball-bar test for the procedures: angles, readings and geometry."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rtec.arrays import Bools, Floats, Ints
from rtec.effects import State
from rtec.effects.derived import FAR_MM
from rtec.errors import MeasurementError
from rtec.machine import Machine
from rtec.metrology.files.columns import on_circle
from rtec.metrology.instruments.ball_bar import (
    JUST_BEFORE_RAD,
    BallBar,
    BallBarSetup,
    axis_along,
    circle_channels,
    travelled_deg,
)
from rtec.metrology.measurement import Measurement

END_DEG = 0.01  # commanded positions are rounded to 1 µm
QUADRANT_RAD = np.deg2rad(0.05)
LEAST = 24
"""Smallest number of readings on an arc; fewer do not show its shape."""
GAP_DEG = 20.0
"""Longest gap in the readings of an arc; with a longer one it is not the arc of the set-up, or not a full circle."""


@dataclass(frozen=True)
class CircleTest:
    """The measured arc of one test, without overshoot and missing readings.

    Attributes:
        name: name of the measurement.
        machine, instrument: of the measurement.
        angle_rad: angle on the circle, continued past 2π, (n,).
        travel_deg: angle from the start of the arc, (n,).
        reading_um: readings, (n,).
        run: run of each reading, (n,).
        left_out: number of readings that are missing or outside the arc.
        phase_rate: servo phase in this test divided by that in the first test: 1 if the phase is the same angle in all
            tests; if it is the same time, the ratio of the angular speeds.
    """

    name: str
    machine: Machine
    instrument: BallBar
    angle_rad: Floats
    travel_deg: Floats
    reading_um: Floats
    run: Ints
    left_out: int = 0
    phase_rate: float = 1.0

    def __len__(self) -> int:
        return len(self.angle_rad)

    @property
    def setup(self) -> BallBarSetup:
        """Set-up of the test."""
        return self.instrument.setup

    @property
    def closed(self) -> bool:
        """Whether the arc is a full turn."""
        return self.setup.arc_deg > 359.0

    @property
    def full(self) -> bool:
        """Whether the arc is a full turn with readings everywhere."""
        return self.closed and not self.gaps

    @cached_property
    def gaps(self) -> tuple[tuple[float, float], ...]:
        """Long parts of the arc without readings: start and end, degrees from the arc's start."""
        ways = np.concatenate([[0.0], np.sort(self.travel_deg), [self.setup.arc_deg]])
        return tuple((float(ways[i]), float(ways[i + 1])) for i in np.flatnonzero(np.diff(ways) > GAP_DEG))

    @property
    def omega_rad_s(self) -> float:
        """Angular speed on the circle."""
        return self.setup.feed_mm_min / 60.0 / self.setup.radius_mm

    @property
    def step_rad(self) -> float:
        """Typical angle from one reading to the next."""
        apart = np.abs(np.diff(self.angle_rad))
        return float(np.median(apart[apart > 0.0])) if (apart > 0.0).any() else float("inf")

    @cached_property
    def pose_mm(self) -> Floats:
        """Commanded axis positions, (n, axes)."""
        channels = circle_channels(self.machine, self.setup, self.angle_rad)
        zero = np.zeros(len(self))
        return np.stack([channels.get(a.channel, zero) for a in self.machine.axes], axis=1)

    @cached_property
    def bar_mm(self) -> Floats:
        """Nominal vector from the ball on the table to the ball at the tool, (n, 3)."""
        return self.instrument.bar_mm(self.machine, self.pose_mm)

    @cached_property
    def along(self) -> Floats:
        """Unit vector along the bar, (n, 3)."""
        return np.asarray(self.bar_mm / np.linalg.norm(self.bar_mm, axis=1, keepdims=True))

    @cached_property
    def on_circle_mm(self) -> tuple[Floats, Floats]:
        """Position relative to the centre along the plane's first and second letter, (n,) each."""
        return self.setup.radius_mm * np.cos(self.angle_rad), self.setup.radius_mm * np.sin(self.angle_rad)

    @cached_property
    def apart_rad(self) -> Floats:
        """Angle from the reading before, (n,); infinity where a run begins."""
        apart = np.abs(np.diff(self.angle_rad, prepend=np.inf))
        return np.where(np.diff(self.run, prepend=self.run[0]) != 0, np.inf, apart)

    @cached_property
    def state(self) -> State:
        """The state for effects: positions, directions, velocities, accelerations, distance since the last reversal."""
        channels = circle_channels(self.machine, self.setup, self.angle_rad)
        for place, letter in enumerate(self.setup.letters[:2]):
            axis = axis_along(self.machine, letter)
            if axis is not None:
                channels[axis.since_reversal_channel] = self.since_reversal_mm(place)
        return State(self.machine, np.zeros(len(self)), channels)

    def since_turn_rad(self, place: int) -> Floats:
        """Angle since the last reversal along the plane's first (0) or second (1) letter, (n,); π at the next one."""
        turns = self.setup.sense * (self.angle_rad - 0.5 * np.pi * place) - JUST_BEFORE_RAD
        return np.asarray(turns % np.pi + JUST_BEFORE_RAD, dtype=np.float64)

    def since_reversal_mm(self, place: int) -> Floats:
        """Distance since that reversal, (n,); FAR_MM where the machine was not yet moving at it."""
        angle = self.since_turn_rad(place)
        moving = np.rad2deg(angle) <= self.travel_deg + self.setup.overshoot_deg + END_DEG
        return np.where(moving, self.setup.radius_mm * (1.0 - np.cos(angle)), FAR_MM)

    def way(self, place: int) -> Floats:
        """Direction of motion along the plane's first (0) or second (1) letter, -1 or +1, (n,)."""
        before = self.angle_rad - self.setup.sense * JUST_BEFORE_RAD
        tangent = -np.sin(before) if place == 0 else np.cos(before)
        return np.where(self.setup.sense * tangent > 0.0, 1.0, -1.0)

    def near_quadrant(self, window_deg: float) -> Bools:
        """Whether each reading is nearer than `window_deg` to 0, 90, 180 or 270 degrees, (n,)."""
        off = np.rad2deg(self.angle_rad) % 90.0
        return np.asarray(np.minimum(off, 90.0 - off) < window_deg)

    def taking_up(self, clearance_um: tuple[float, float], late_s: float = 0.0) -> Bools:
        """Whether each reading is so near to a reversal that the axis may still be crossing its clearance, (n,).

        Args:
            clearance_um: clearance of both axes.
            late_s: largest time by which the axes may reach the reversal later than commanded.
        """
        out = np.zeros(len(self), dtype=np.bool_)
        for place, clearance in enumerate(clearance_um):
            way = min(abs(clearance) * 1e-3 / self.setup.radius_mm, 1.0)
            # Angles are rounded: a reading at a quadrant may be on either side of it.
            after = self.since_turn_rad(place)
            crossing = max(float(np.arccos(1.0 - way)), QUADRANT_RAD)
            out |= np.minimum(after, np.pi - after) < crossing
            out |= after < crossing + late_s * self.omega_rad_s
        return out

    def later(self, time_s: float) -> "CircleTest":
        """The test at the angles that the machine has reached if it lags the command by `time_s`."""
        return replace(self, angle_rad=self.angle_rad - self.setup.sense * time_s * self.omega_rad_s)

    def rows(self, keep: Bools) -> "CircleTest":
        """The test with only these readings, (n,)."""
        return CircleTest(
            self.name, self.machine, self.instrument, self.angle_rad[keep], self.travel_deg[keep],
            self.reading_um[keep], self.run[keep], self.left_out, self.phase_rate,
        )  # fmt: skip


def circle_of(measurement: Measurement) -> CircleTest:
    """The measured arc of a measurement.

    Raises:
        MeasurementError: the instrument is not a ball bar, there are neither angles nor positions, or the arc has too
            few readings.
    """
    name, instrument = measurement.name, measurement.instrument
    if not isinstance(instrument, BallBar):
        raise MeasurementError(f"{name}: instrument is {instrument.name}; this needs ball_bar")
    channels, reading = dict(measurement.channels), measurement.readings["reading_um"]
    if "angle_deg" not in channels:
        channels = on_circle(instrument, measurement.machine, channels, measurement.run, name)
    angle_deg = channels["angle_deg"]
    setup = instrument.setup
    travel = travelled_deg(setup, angle_deg, measurement.run)
    keep = np.isfinite(reading) & (travel >= -END_DEG) & (travel <= setup.arc_deg + END_DEG)
    if keep.sum() < LEAST:
        raise MeasurementError(
            f"{name}: {int(keep.sum())} readings on the arc of {setup.arc_deg:g}° from {setup.start_deg:g}°, need "
            f"{LEAST}; are start_deg, arc_deg and direction right?"
        )
    low, high = float(travel[keep].min()), float(travel[keep].max())
    if low > GAP_DEG or high < setup.arc_deg - GAP_DEG:
        ends = (setup.start_deg + setup.sense * way for way in (low, high))
        raise MeasurementError(
            f"{name}: [setup] arc_deg is {setup.arc_deg:g} from start_deg {setup.start_deg:g} {setup.direction}, but "
            f"the readings only go from {' to '.join(f'{end:.0f}' for end in ends)}°; set start_deg and arc_deg "
            f"({high - low:.0f} or less) to what was measured"
        )
    angle = np.deg2rad(setup.start_deg + setup.sense * travel)
    return CircleTest(
        name, measurement.machine, instrument, angle[keep], travel[keep], reading[keep], measurement.run[keep],
        int((~keep).sum()),
    )  # fmt: skip


def circles_of(measurements: Sequence[Measurement]) -> tuple[CircleTest, ...]:
    """Several tests of one plane on one machine.

    Raises:
        MeasurementError: there is no test, machines or planes differ, or as `circle_of`.
    """
    out = tuple(circle_of(m) for m in measurements)
    if not out:
        raise MeasurementError("no ball-bar test given")
    for other in out[1:]:
        if other.machine.hash != out[0].machine.hash:
            raise MeasurementError(f"{other.name} and {out[0].name} were made on different machines")
        if other.setup.plane != out[0].setup.plane:
            raise MeasurementError(
                f"{out[0].name} is in plane {out[0].setup.plane}, {other.name} in {other.setup.plane}; "
                "diagnose each plane by itself"
            )
    return out

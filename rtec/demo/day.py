"""The working day: production that warms the machine up, a part every half hour, a night to cool, check cuts in it.

A part is one continuous contour, as in finish turning: face inwards (70 mm), turn a cylinder (200 mm) towards the
chuck, shoulder outwards (70 mm). The same day is simulated twice: with the correction off, by the simulated machine
alone; and on, through the loop of `rtec run` with a clock that moves the simulated machine when it sleeps.

The measured sizes of a workpiece follow from the tip errors along its cuts. The operator sets the tool offsets on the
first part, so that diameter and length errors are relative to it, on the uncorrected day as on the corrected one.
Straightness is absolute.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rtec.arrays import Bools, Floats, Ints

NS = 1_000_000_000
FACE_Z_MM, SHOULDER_Z_MM = 330.0, 130.0
CYLINDER_X_MM, OUTSIDE_X_MM = 40.0, 110.0
FEED_MM_MIN = 720.0
EVERY_NS = 40_000_000
"""Interval of records of the tool tip along a cut: one every half millimetre."""
WAIT_S = 10
"""Interval of the loop's cycles between cuts."""
CUT_EVERY_S, CHECK_EVERY_S = 1800, 7200
WARM_H, NIGHT_H = 8, 16
FACE, CYLINDER, SHOULDER, OTHER = 0, 1, 2, -1
PROGRAM = f"""
G0 X{OUTSIDE_X_MM:g} Z{FACE_Z_MM + 5:g}
G1 Z{FACE_Z_MM:g} F{FEED_MM_MIN:g}
G4 P0.5
G1 X{CYLINDER_X_MM:g}
G4 P0.2
G1 Z{SHOULDER_Z_MM:g}
G4 P0.2
G1 X{OUTSIDE_X_MM:g}
G4 P0.2
G0 Z{FACE_Z_MM + 5:g}
"""


@dataclass(frozen=True)
class Work:
    """The machine works, or is at rest (speed 0), without records of the tip."""

    seconds: int
    rpm: float
    feed_duty: float


@dataclass(frozen=True)
class Cut:
    """A part is cut; if the machine was at rest before, the spindle turns for the cut only."""

    rpm: float

    @property
    def program(self) -> str:
        """Part program; X is a radius."""
        return f"M3 S{self.rpm:.0f}\n{PROGRAM}M5\nM30\n"


@dataclass(frozen=True)
class Plan:
    """Length of the day; a whole day by default, a shorter one for tests.

    Attributes:
        warm_h, night_h: hours of production and of cooling.
        cut_every_s, check_every_s: time from part to part, by day and by night.
    """

    warm_h: float = WARM_H
    night_h: float = NIGHT_H
    cut_every_s: int = CUT_EVERY_S
    check_every_s: int = CHECK_EVERY_S

    def steps(self, seed: int) -> Iterator[Work | Cut]:
        """Steps of the day of a seed: each hour of production has its own spindle speed and share of motion."""
        rng = np.random.default_rng([seed, 20])
        speeds = rng.uniform(1800.0, 3000.0, 24).round(-1)
        duties = rng.uniform(0.2, 0.5, 24)
        yield Cut(float(speeds[0]))
        for i in range(round(self.warm_h * 3600 / self.cut_every_s)):
            hour = i * self.cut_every_s // 3600
            yield Work(self.cut_every_s, float(speeds[hour]), float(duties[hour]))
            yield Cut(float(speeds[hour]))
        for _ in range(round(self.night_h * 3600 / self.check_every_s)):
            yield Work(self.check_every_s, 0.0, 0.0)
            yield Cut(2000.0)

    @property
    def cuts(self) -> int:
        """Number of parts."""
        return 1 + round(self.warm_h * 3600 / self.cut_every_s) + round(self.night_h * 3600 / self.check_every_s)


@dataclass(frozen=True)
class Track:
    """Record of one day: n instants, along the cuts every 40 ms, between them every 10 s.

    Attributes:
        time_ns: simulated time, (n,).
        part: number of the part, from 0; -1 between parts, (n,).
        surface: FACE, CYLINDER, SHOULDER or OTHER, (n,).
        commanded_mm: (n, 2).
        reading_mm: encoder positions, not rounded to counts, (n, 2).
        raw_counts: encoder counts, (n, 2).
        inserted_counts: counts inserted at that instant, (n, 2).
        tip_um: tool relative to workpiece, actual minus commanded, (n, 3).
        geometric_um: tool relative to workpiece, actual minus encoder positions, (n, 3): the error that a model
            predicts.
        degc: sensors, (n, sensors).
        body_degc: true temperatures, (n, bodies + air).
    """

    time_ns: Ints
    part: Ints
    surface: Ints
    commanded_mm: Floats
    reading_mm: Floats
    raw_counts: Ints
    inserted_counts: Ints
    tip_um: Floats
    geometric_um: Floats
    degc: Floats
    body_degc: Floats

    def rows(self, index: Bools | Ints) -> "Track":
        """The track with some instants only."""
        return Track(**{k: v[index] for k, v in vars(self).items()})

    @property
    def hours(self) -> Floats:
        """Time in hours, (n,)."""
        return self.time_ns / (3600.0 * NS)


def surface_of(commanded_mm: Floats) -> Ints:
    """Surface that is cut at commanded positions (n, 2): OTHER near its ends."""
    x, z = commanded_mm.T
    inside = (x > CYLINDER_X_MM + 1.0) & (x < OUTSIDE_X_MM - 1.0)
    along = (z > SHOULDER_Z_MM + 1.0) & (z < FACE_Z_MM - 1.0)
    out = np.full(len(x), OTHER, dtype=np.int64)
    out[inside & (z == FACE_Z_MM)] = FACE
    out[along & (x == CYLINDER_X_MM)] = CYLINDER
    out[inside & (z == SHOULDER_Z_MM)] = SHOULDER
    return out


STRAIGHT_MM = 70.0
SMOOTH_MM = 2.5
"""Cut-off of the filter of a stylus instrument; 2.5 mm is usual for fine turning."""
NIST_SIZE, NIST_STRAIGHT = (10.0, 20.0), (4.0, 5.0)
"""Improvement factors that the guidelines report for a real turning centre [G 4]."""


@dataclass(frozen=True)
class Sizes:
    """Errors of the parts of one day, one entry a part.

    Attributes:
        hours: start of the cut, (parts,).
        diameter_um: twice the radial error at places along the cylinder, (parts, places).
        place_mm: these places, mm from the end of the cylinder, (places,).
        length_um: error of the length between face and shoulder, (parts,).
        straight_um: straightness of the cylinder's line over the worst 70 mm of it, (parts,).
        face_straight_um: straightness of the face over its 70 mm, (parts,).
        tip_um: mean radial and axial tip error, absolute, (parts, 2).
    """

    hours: Floats
    diameter_um: Floats
    place_mm: Floats
    length_um: Floats
    straight_um: Floats
    face_straight_um: Floats
    tip_um: Floats

    def largest(self) -> dict[str, float]:
        """Largest error of each kind over all parts, µm, without sign."""
        return {name: float(np.abs(value).max()) for name, value in self._kinds()}

    def typical(self) -> dict[str, float]:
        """Root mean square of each kind over all parts, µm."""
        return {name: float(np.sqrt(np.mean(value**2))) for name, value in self._kinds()}

    def _kinds(self) -> list[tuple[str, Floats]]:
        return [
            ("diameter", self.diameter_um),
            ("length", self.length_um),
            ("straightness", self.straight_um),
            ("face straightness", self.face_straight_um),
        ]


def sizes_of(track: Track) -> Sizes:
    """Measure the parts of a day."""
    parts = range(int(track.part.max()) + 1)
    lines = [line(track, part, CYLINDER) for part in parts]
    faces = [line(track, part, FACE) for part in parts]
    shoulders = [line(track, part, SHOULDER) for part in parts]
    radial = np.stack([error for _, error in lines])
    length = np.array([f.mean() - s.mean() for (_, f), (_, s) in zip(faces, shoulders, strict=True)])
    place = lines[0][0]
    return Sizes(
        hours=np.array([track.hours[track.part == part][0] for part in parts]),
        diameter_um=2.0 * (radial - radial[0].mean()),
        place_mm=place - place[0],
        length_um=length - length[0],
        straight_um=np.array([worst_straightness(x, error, STRAIGHT_MM) for x, error in lines]),
        face_straight_um=np.array([straightness(x, error) for x, error in faces]),
        tip_um=np.stack([radial.mean(axis=1), np.array([error.mean() for _, error in faces])], axis=1),
    )


def straightness(place_mm: Floats, error_um: Floats) -> float:
    """Range of the error about its best-fit line, µm."""
    slope, start = np.polyfit(place_mm, error_um, 1)
    return float(np.ptp(error_um - slope * place_mm - start))


def worst_straightness(place_mm: Floats, error_um: Floats, length_mm: float) -> float:
    """Straightness over the worst interval of a length, µm; intervals start every 5 mm."""
    starts = np.arange(place_mm[0], place_mm[-1] - length_mm + 1e-9, 5.0)
    inside = [(place_mm >= s) & (place_mm <= s + length_mm) for s in starts]
    return max(straightness(place_mm[i], error_um[i]) for i in inside)


def line(track: Track, part: int, surface: int) -> tuple[Floats, Floats]:
    """One surface of a part at places `SMOOTH_MM` apart: place, rising, and mean error across the surface around it."""
    along, across = (1, 0) if surface == CYLINDER else (0, 2)
    rows = (track.part == part) & (track.surface == surface)
    place, error = track.commanded_mm[rows, along], track.tip_um[rows, across]
    cell = np.floor(place / SMOOTH_MM).astype(np.int64)
    cells, inverse = np.unique(cell, return_inverse=True)
    mean = np.bincount(inverse, error) / np.bincount(inverse)
    return (cells + 0.5) * SMOOTH_MM, mean

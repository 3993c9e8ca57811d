"""From tip errors along the cuts to the measured sizes of a workpiece: diameter, length, straightness.

The operator sets the tool offsets on the first part, so that diameter and length errors are relative to it, on the
uncorrected day as on the corrected one. Straightness is absolute.
"""

from dataclasses import dataclass

import numpy as np

from rtec.demo.day import CYLINDER, FACE, SHOULDER, Floats, Track

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

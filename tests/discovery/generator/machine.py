"""The machine: a three-axis mill, and its lever arms worked out by hand.

A column stands on the base, the head Z slides on it, spindle and tool hang below. The saddle Y slides on the base and
carries the table X. Positions in mm, arms in m for turns (µrad in, µm out), errors of the tool relative to the work.

Where everything is, from the base's origin, with the axes at x y z:

    tool tip   (0, 70, 300 + z)
    column     (0, 250, 0)            spindle   (0, 70, 440 + z)         head Z   (0, 70, 650 + z)
    saddle Y   (0, -y, 120)           table X   (-x, -y, 210)

so the tip lies from each of them at

    X (x, 70 + y, 90 + z)   Y (0, 70 + y, 180 + z)   Z (0, 0, -350)   column (0, -180, 300 + z)   spindle (0, 0, -140)
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Place = tuple[float, float, float]

AXES: dict[str, dict[str, object]] = {
    "X": {"direction": "X", "travel_mm": [0.0, 500.0], "pitch_mm": 10.0, "offset_mm": [0.0, 0.0, 90.0]},
    "Y": {"direction": "Y", "travel_mm": [0.0, 400.0], "pitch_mm": 12.0, "offset_mm": [0.0, 0.0, 120.0]},
    "Z": {"direction": "Z", "travel_mm": [0.0, 400.0], "pitch_mm": 8.0, "offset_mm": [0.0, -180.0, 650.0]},
}
LINKS: dict[str, Place] = {
    "column": (0.0, 250.0, 0.0),
    "spindle": (0.0, 0.0, -210.0),
    "tool": (0.0, 0.0, -140.0),
    "table": (-20.0, 10.0, 60.0),
}
TOOL_CHAIN = ("column", "Z", "spindle", "tool")
WORK_CHAIN = ("Y", "X", "table")
TRAVEL_MM: dict[str, tuple[float, float]] = {"X": (0.0, 500.0), "Y": (0.0, 400.0), "Z": (0.0, 400.0)}
PITCH_MM = {"X": 10.0, "Y": 12.0, "Z": 8.0}
COUNTS_PER_MM = 2000.0


@dataclass(frozen=True)
class Column:
    """One number that an instrument reads.

    Attributes:
        name: `reading_um`, `reading_x_um` ….
        kind: a displacement of a point, or a turn.
        letter: direction X Y Z, or turn A B C.
        offset_mm: from the tool tip to the point.
    """

    name: str
    kind: str
    letter: str
    offset_mm: Place = (0.0, 0.0, 0.0)


def arm_m(link: str, pose_mm: Mapping[str, Floats], offset_mm: Place) -> tuple[Floats, Floats, Floats]:
    """Where the point beside the tool tip lies from a link, m."""
    x, y, z = (pose_mm[a] for a in "XYZ")
    o = np.zeros_like(x)
    table = {
        "X": (x, 70.0 + y, 90.0 + z),
        "Y": (o, 70.0 + y, 180.0 + z),
        "Z": (o, o, o - 350.0),
        "column": (o, o - 180.0, 300.0 + z),
        "spindle": (o, o, o - 140.0),
    }
    a, b, c = table[link]
    return 1e-3 * (a + offset_mm[0]), 1e-3 * (b + offset_mm[1]), 1e-3 * (c + offset_mm[2])


def lever(component: str, pose_mm: Mapping[str, Floats], column: Column) -> Floats:
    """What one µm or µrad of a component error adds to a reading, (n,)."""
    letter, tag = component[1], component[2:]
    n = np.zeros_like(pose_mm["X"])
    if tag[0] == "0" and tag[1:] in AXES:
        # A line of travel that is not square: the tilt acts on the way travelled, and turns nothing.
        way = [n, n, n]
        way["XYZ".index(tag[1:])] = 1e-3 * pose_mm[tag[1:]]
        return n if column.kind == "turn" else _turned(letter, (way[0], way[1], way[2]))["XYZ".index(column.letter)]
    if column.kind == "turn":
        return n + float(letter == column.letter)
    if letter in "XYZ":
        return n + float(letter == column.letter)
    return _turned(letter, arm_m(tag.removeprefix("0"), pose_mm, column.offset_mm))["XYZ".index(column.letter)]


def _turned(letter: str, arm: tuple[Floats, Floats, Floats]) -> tuple[Floats, Floats, Floats]:
    """A small turn of one µrad times an arm."""
    a, b, c = arm
    o = np.zeros_like(a)
    return {"A": (o, -c, b), "B": (c, o, -a), "C": (-b, a, o)}[letter]

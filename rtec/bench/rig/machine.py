"""A small travelling-column mill: positions of its parts, and the effect of their rotations and shifts on a point.

Rotations are exact matrices (Rodrigues), not arms times angles.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

TRAVEL_MM = {"X": (0.0, 600.0), "Y": (0.0, 300.0), "Z": (0.0, 350.0)}
PITCH_MM = {"X": 10.0, "Y": 10.0, "Z": 5.0}
SENSORS = ("T_spindle", "T_front", "T_back", "T_bed", "T_nut", "T_cool", "T_air")
TOOL_CHAIN, WORK_CHAIN = ("column", "Z", "spindle", "tool"), ("Y", "X", "table")
OFFSET_MM: dict[str, tuple[float, float, float]] = {
    "column": (0.0, 220.0, 0.0),
    "Z": (0.0, -160.0, 520.0),
    "spindle": (0.0, -40.0, -180.0),
    "tool": (0.0, 0.0, -120.0),
    "Y": (0.0, 0.0, 80.0),
    "X": (0.0, 0.0, 70.0),
    "table": (0.0, 0.0, 50.0),
}


def description(pitch_mm: Mapping[str, float] | None = None) -> dict[str, Any]:
    """Content of the machine's file.

    Args:
        pitch_mm: wrong pitches of screws in the file, by axis.
    """
    pitch = {**PITCH_MM, **(pitch_mm or {})}
    return {
        "machine": {"name": "rig", "tool_chain": list(TOOL_CHAIN), "work_chain": list(WORK_CHAIN)},
        "axis": {
            a: {
                "direction": a,
                "travel_mm": list(TRAVEL_MM[a]),
                "pitch_mm": pitch[a],
                "counts_per_mm": 1000.0,
                "offset_mm": list(OFFSET_MM[a]),
            }
            for a in TRAVEL_MM
        },
        "link": {n: {"offset_mm": list(o)} for n, o in OFFSET_MM.items() if n not in TRAVEL_MM},
        "temperature": {s: {} for s in SENSORS},
    }


def _origins(pose_mm: Mapping[str, Floats]) -> dict[str, Floats]:
    """Origin of each part, (n, 3) mm; a part that carries the work moves in the opposite direction."""
    n = len(pose_mm["X"])
    out: dict[str, Floats] = {}
    for chain, way in ((TOOL_CHAIN, 1.0), (WORK_CHAIN, -1.0)):
        here = np.zeros((n, 3))
        for part in chain:
            here = here + np.asarray(OFFSET_MM[part])
            if part in TRAVEL_MM:
                here[:, "XYZ".index(part)] += way * pose_mm[part]
            out[part] = here.copy()
    return out


def rotation(axis: int, angle_rad: Floats) -> Floats:
    """Exact rotation matrices about a main axis, (n, 3, 3)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    out = np.zeros((len(angle_rad), 3, 3))
    out[:, axis, axis] = 1.0
    a, b = (axis + 1) % 3, (axis + 2) % 3
    out[:, a, a], out[:, b, b] = c, c
    out[:, a, b], out[:, b, a] = -s, s
    return out


def displaced(
    errors: Mapping[str, Floats], pose_mm: Mapping[str, Floats], offset_mm: Sequence[float] = (0.0, 0.0, 0.0)
) -> Floats:
    """Displacement of a point beside the tool tip relative to the work, (n, 3) µm.

    Args:
        errors: component errors of the tool relative to the work, µm or µrad, (n,) each.
        pose_mm: axis positions.
        offset_mm: vector from the tool tip to the point.
    """
    where = _origins(pose_mm)
    tip = where["tool"] + np.asarray(offset_mm)
    out: Floats = np.zeros_like(tip)
    for component, error in errors.items():
        letter, part = component[1], component[2:]
        if letter in "XYZ":
            out[:, "XYZ".index(letter)] += error
            continue
        if part[0] == "0" and part[1:] in TRAVEL_MM:
            # Squareness: only the direction of travel is rotated.
            arm = np.zeros_like(tip)
            arm[:, "XYZ".index(part[1:])] = pose_mm[part[1:]]
        else:
            arm = tip - where[part.removeprefix("0")]
        moved: Floats = np.einsum("nij,nj->ni", rotation("ABC".index(letter), 1e-6 * error), arm)
        out += 1e3 * (moved - arm)
    return out


def turned(errors: Mapping[str, Floats], about: str, n: int) -> Floats:
    """Reading of an angular instrument about a main axis, (n,) µrad."""
    parts = [e for c, e in errors.items() if c[1] == about and not (c[2] == "0" and c[3:] in TRAVEL_MM)]
    return np.asarray(np.sum(parts, axis=0) if parts else np.zeros(n))

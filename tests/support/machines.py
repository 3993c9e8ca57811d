"""Machines for the tests, each built through the same door as a machine file."""

from collections.abc import Mapping, Sequence
from typing import Any

from rtec.machine import Machine, machine_from

Offset = Sequence[float]
X1, X4, Z4 = 35.0, 120.0, 80.0  # mm, the constant offsets of [G 2.10] and [G 2.13]
SENSORS = ("T_bed", "T_spindle", "T_column", "T_air")


def axis(direction: str, offset_mm: Offset = (0.0, 0.0, 0.0), **more: Any) -> dict[str, Any]:
    """Table of an axis; `more` replaces or adds keys."""
    table = {"direction": direction, "travel_mm": [0.0, 400.0], "counts_per_mm": 1000, "offset_mm": list(offset_mm)}
    return {**table, **more}


def machine(
    name: str,
    tool: Sequence[str],
    work: Sequence[str],
    axes: Mapping[str, Mapping[str, Any]],
    links: Mapping[str, Offset] | None = None,
    sensors: Sequence[str] = (),
) -> Machine:
    """Machine from chains, axis tables and link offsets."""
    data = {
        "machine": {"name": name, "tool_chain": list(tool), "work_chain": list(work)},
        "axis": dict(axes),
        "link": {k: {"offset_mm": list(v)} for k, v in (links or {}).items()},
        "temperature": {s: {} for s in sensors},
    }
    return machine_from(data, name)


def turning_centre(tool_mm: Offset = (X4, 0.0, Z4), probe_mm: Offset | None = None) -> Machine:
    """Two-axis turning centre of [G 2.10-2.23]; `probe_mm` adds one more fixed link at the tool tip."""
    tool, links = ["Z", "X", "turret", "tool"], {"tool": tool_mm}
    if probe_mm is not None:
        tool, links = [*tool, "probe"], {**links, "probe": probe_mm}
    axes = {
        "X": axis("X", travel_mm=[0.0, 200.0], pitch_mm=5.0),
        "Z": axis("Z", [X1, 0.0, 0.0], pitch_mm=10.0),
    }
    return machine("turning-centre", tool, ["spindle", "workpiece"], axes, links, SENSORS)


def vertical_mill() -> Machine:
    """3½-axis vertical machining centre of [G 2.27-2.28]: tool W, Z, S, C; work Y, X, P."""
    axes = {
        "W": axis("Z", [3.0, -20.0, 900.0], compensate=False),
        "Z": axis("Z", [5.0, 310.0, -40.0], pitch_mm=12.0),
        "Y": axis("Y", [1.0, 2.0, 110.0]),
        "X": axis("X", [-4.0, 6.0, 90.0]),
    }
    links = {"S": [0.0, 15.0, -130.0], "C": [0.5, -0.25, -95.0], "P": [40.0, 25.0, 60.0]}
    return machine("vertical-mill", ["W", "Z", "S", "C"], ["Y", "X", "P"], axes, links, SENSORS)


def bridge() -> Machine:
    """Bridge machine of [XT eq. 1]: table X on the work side, Y then Z on the tool side, no offsets."""
    return machine("bridge", ["Y", "Z"], ["X"], {k: axis(k, travel_mm=[-2000.0, 2000.0]) for k in "XYZ"})


ALL = (turning_centre, vertical_mill, bridge)

"""Tip error by the exact product of transforms [G 2.9]: slow, and the judge of `chain.py`.

Same conventions as there; nothing is dropped, so the two differ by second-order terms only: each pair of errors
`ε₁ × (ε₂ × arm)` and `ε × δ`, 2.5 nm for 50 µm and 50 µrad at 1 m.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from rtec.machine.machine import Machine

Floats = NDArray[np.float64]


def error_matrix(rotation_rad: Floats, displacement_mm: Floats) -> Floats:
    """`E(ε, δ)` of [G 2.6], 4 × 4."""
    a, b, c = rotation_rad
    out = np.eye(4)
    out[:3, :3] = [[1, -c, b], [c, 1, -a], [-b, a, 1]]
    out[:3, 3] = displacement_mm
    return out


def exact_tip_error_um(machine: Machine, pose_mm: Floats, errors: Mapping[str, float]) -> Floats:
    """Actual tool position relative to the workpiece minus nominal, µm, (3,), for one pose (axes,).

    Args:
        machine: whose two chains are multiplied out.
        pose_mm: axis positions.
        errors: component errors by name, µm and µrad; those not named are zero.
    """
    real = {side: _side(machine, side, pose_mm, errors) for side in ("tool", "work")}
    ideal = {side: _side(machine, side, pose_mm, {}) for side in ("tool", "work")}
    # The cutting point is where the nominal tool tip touches the nominal workpiece.
    contact = np.linalg.inv(ideal["work"]) @ ideal["tool"]
    out = contact[:3, :3].T @ (np.linalg.inv(real["work"]) @ real["tool"] - contact)[:3, 3]
    return np.asarray(out * 1e3, dtype=np.float64)


def _side(machine: Machine, side: str, pose_mm: Floats, errors: Mapping[str, float]) -> Floats:
    work = side == "work"
    out = np.eye(4)
    for name in machine.work_chain if work else machine.tool_chain:
        is_axis = name in machine.axis_names
        tag = name if is_axis else f"0{name}"
        flip = -1.0 if work and is_axis else 1.0
        shift = np.array([errors.get(f"E{k}{tag}", 0.0) * 1e-3 for k in "XYZ"])
        turn = np.array([errors.get(f"E{k}{tag}", 0.0) * 1e-6 for k in "ABC"])
        place = np.array(machine.axis(name).offset_mm if is_axis else machine.links[name].offset_mm, dtype=float)
        if is_axis:
            axis = machine.axis(name)
            line = np.array([float(axis.direction == k) for k in "XYZ"])
            tilt = np.array([errors.get(f"E{k}0{name}", 0.0) * 1e-6 for k in "ABC"])
            position = pose_mm[machine.axis_names.index(name)]
            place = place + flip * position * (line + np.cross(tilt, line))
        nominal = np.eye(4)
        nominal[:3, 3] = place
        out = out @ nominal @ error_matrix(flip * turn, flip * shift)
    return out

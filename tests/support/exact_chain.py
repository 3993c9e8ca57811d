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
    """`E(ε, δ)` of [G 2.6], (n, 4, 4), of rotations and displacements (n, 3)."""
    a, b, c = rotation_rad.T
    out = np.tile(np.eye(4), (len(rotation_rad), 1, 1))
    out[:, 0, 1], out[:, 0, 2] = -c, b
    out[:, 1, 0], out[:, 1, 2] = c, -a
    out[:, 2, 0], out[:, 2, 1] = -b, a
    out[:, :3, 3] = displacement_mm
    return out


def exact_tip_error_um(machine: Machine, pose_mm: Floats, errors: Mapping[str, float]) -> Floats:
    """Actual tool position relative to the workpiece minus nominal, µm, (3,), for one pose (axes,).

    Args:
        machine: whose two chains are multiplied out.
        pose_mm: axis positions.
        errors: component errors by name, µm and µrad; those not named are zero.
    """
    return np.asarray(exact_tip_errors_um(machine, np.asarray(pose_mm)[None], errors)[0])


def exact_tip_errors_um(machine: Machine, poses_mm: Floats, errors: Mapping[str, Floats | float]) -> Floats:
    """The same of many poses (n, axes), (n, 3); each error is one number for all of them, or (n,)."""
    real = {side: _side(machine, side, poses_mm, errors) for side in ("tool", "work")}
    ideal = {side: _side(machine, side, poses_mm, {}) for side in ("tool", "work")}
    # The cutting point is where the nominal tool tip touches the nominal workpiece.
    contact = np.linalg.inv(ideal["work"]) @ ideal["tool"]
    away = (np.linalg.inv(real["work"]) @ real["tool"] - contact)[:, :3, 3]
    return np.asarray((contact[:, :3, :3].transpose(0, 2, 1) @ away[:, :, None])[:, :, 0] * 1e3, dtype=np.float64)


def _side(machine: Machine, side: str, poses_mm: Floats, errors: Mapping[str, Floats | float]) -> Floats:
    work, n = side == "work", len(poses_mm)

    def of(letters: str, tag: str, unit: float) -> Floats:
        return np.stack([np.full(n, errors.get(f"E{k}{tag}", 0.0)) * unit for k in letters], axis=1)

    out = np.tile(np.eye(4), (n, 1, 1))
    for name in machine.work_chain if work else machine.tool_chain:
        is_axis = name in machine.axis_names
        tag = name if is_axis else f"0{name}"
        flip = -1.0 if work and is_axis else 1.0
        shift, turn = of("XYZ", tag, 1e-3), of("ABC", tag, 1e-6)
        place = np.array(machine.axis(name).offset_mm if is_axis else machine.links[name].offset_mm, dtype=float)
        if is_axis:
            axis = machine.axis(name)
            line = np.array([float(axis.direction == k) for k in "XYZ"])
            tilt = of("ABC", f"0{name}", 1e-6)
            position = poses_mm[:, machine.axis_names.index(name), None]
            place = place + flip * position * (line + np.cross(tilt, line))
        nominal = np.tile(np.eye(4), (n, 1, 1))
        nominal[:, :3, 3] = place
        out = out @ nominal @ error_matrix(flip * turn, flip * shift)
    return out

"""How far a model's correction jumps when an axis turns round."""

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from rtec.effects import State

if TYPE_CHECKING:
    from rtec.model.model import Model

PLACES = 3
"""Positions along each axis and levels of the temperatures that are tried."""


def reversal_um(model: "Model") -> dict[str, float]:
    """Largest jump of the tip error along each axis from moving negative to moving positive, µm, by axis name.

    Zero where the error falls at every such turn, as with ordinary play: the correction that follows then moves the
    axis further on the way it has turned to. Where the error rises, the correction moves it back.

    Tried at the ends and the middle of every axis' travel, and at both ends of the temperatures' fitted range.
    """
    machine = model.machine
    turning = {a.name for a in machine.axes if a.direction_channel in model.channels}
    out = dict.fromkeys(machine.axis_names, 0.0)
    if not turning:
        return out
    poses = np.array(list(product(*(np.linspace(*a.travel_mm, PLACES) for a in machine.axes))))
    for axis in (a for a in machine.axes if a.name in turning):
        for level in range(PLACES):
            jump = _tip(model, poses, level, axis.name, 1.0) - _tip(model, poses, level, axis.name, -1.0)
            out[axis.name] = max(out[axis.name], float(jump[:, "XYZ".index(axis.direction)].max()))
    return out


def _tip(model: "Model", poses: np.ndarray, level: int, turned: str, direction: float) -> np.ndarray:
    machine, n = model.machine, len(poses)
    channels = {a.channel: poses[:, i] for i, a in enumerate(machine.axes)}
    channels |= {a.direction_channel: np.full(n, direction if a.name == turned else 1.0) for a in machine.axes}
    for name in (*machine.sensor_names, "spindle_rpm"):
        usual = 0.0 if name == "spindle_rpm" else model.reference_degc
        low, high = model.valid_range.get(name, (usual, usual))
        channels[name] = np.full(n, (low, usual, high)[level])
    return model.predict(State(machine, np.zeros(n), channels, model.reference_degc))

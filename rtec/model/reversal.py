"""How far a model's correction jumps when an axis turns round."""

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from rtec.effects import State
from rtec.effects.derived import FAR_MM
from rtec.machine.machine import CONSTANT_CHANNELS, Axis

if TYPE_CHECKING:
    from rtec.model.model import Model

PLACES = 3
"""Positions along each axis and levels of the temperatures that are tried."""


def reversal_um(model: "Model") -> dict[str, float]:
    """Largest rise of the tip error along each axis from moving negative to moving positive, µm, by axis name.

    Zero where the error falls at every such turn, as with ordinary play: the correction that follows then moves the
    axis further on the way it has turned to. Where the error rises, the correction moves it back.

    Tried at the ends and the middle of every axis' travel, and at both ends of the temperatures' fitted range.
    """
    machine = model.machine
    turning = {a.name for a in machine.axes if {a.direction_channel, a.since_reversal_channel} & set(model.channels)}
    out = dict.fromkeys(machine.axis_names, 0.0)
    if not turning:
        return out
    poses = np.array(list(product(*(np.linspace(*a.travel_mm, PLACES) for a in machine.axes))))
    for axis in (a for a in machine.axes if a.name in turning):
        for level in range(PLACES):
            positive, negative = (_along(model, poses, level, axis, direction) for direction in (1.0, -1.0))
            out[axis.name] = max(out[axis.name], float((positive.max(axis=0) - negative.min(axis=0)).max()))
    return out


def _along(model: "Model", poses: np.ndarray, level: int, axis: Axis, direction: float) -> np.ndarray:
    """Tip error along an axis, µm, (distances, poses): at standstill, the other axes far from their reversal.

    Where the model reads the distance since the reversal, at many of them: what builds up within micrometres moves the
    axis back just as a jump does, and an axis may turn again before it has faded.
    """
    fades = axis.since_reversal_channel in model.channels
    since_mm = np.array([0.0, *np.logspace(-4, 3, 29), FAR_MM]) if fades else np.array([FAR_MM])
    rows = np.tile(poses, (len(since_mm), 1))
    tip = _tip(model, rows, level, axis.name, direction, np.repeat(since_mm, len(poses)))
    return tip[:, "XYZ".index(axis.direction)].reshape(len(since_mm), len(poses))


def _tip(
    model: "Model", poses: np.ndarray, level: int, turned: str, direction: float, since_mm: np.ndarray
) -> np.ndarray:
    machine, n = model.machine, len(poses)
    channels = {a.channel: poses[:, i] for i, a in enumerate(machine.axes)}
    channels |= {a.direction_channel: np.full(n, direction if a.name == turned else 1.0) for a in machine.axes}
    channels |= {a.since_reversal_channel: since_mm if a.name == turned else np.full(n, FAR_MM) for a in machine.axes}
    channels |= {c: np.zeros(n) for a in machine.axes for c in (a.velocity_channel, a.acceleration_channel)}
    for name in machine.slow_channels:
        usual = 0.0 if name in ("spindle_rpm", *CONSTANT_CHANNELS) else model.reference_degc
        low, high = model.valid_range.get(name, (usual, usual))
        channels[name] = np.full(n, (low, usual, high)[level])
    return model.predict(State(machine, np.zeros(n), channels, model.reference_degc))

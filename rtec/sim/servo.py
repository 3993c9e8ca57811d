"""Numbers that the compiled controller runs on, from the truth."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtec.machine import Machine
from rtec.sim import controller as c
from rtec.sim.blocks import table_of
from rtec.sim.geometry import Geometry
from rtec.sim.program import Reader
from rtec.sim.truth import Truth

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
TABLE_STEP_MM = 0.5
RUN_OUT_MM = 20.0
"""Encoder tables reach this far beyond the travel."""


def table_nodes_mm(machine: Machine) -> Floats:
    """Positions of the nodes of the axes' encoder tables, (axes, nodes): the longest travel and some more."""
    longest = max(a.travel_mm[1] - a.travel_mm[0] for a in machine.axes) + 2 * RUN_OUT_MM
    low = np.array([[a.travel_mm[0] - RUN_OUT_MM] for a in machine.axes])
    return np.asarray(low + TABLE_STEP_MM * np.arange(math.ceil(longest / TABLE_STEP_MM) + 1))


def servo_parameters(machine: Machine, truth: Truth, geometry: Geometry, nodes_mm: Floats) -> Floats:
    """Parameters of the axes, (axes, 15), in the columns of `rtec.sim.controller`."""
    out = np.zeros((len(machine.axes), c.AXIS_PARAMETERS))
    period_s = truth.servo.period_us * 1e-6
    for row, axis, shape, nodes in zip(out, machine.axes, geometry.axes, nodes_mm, strict=True):
        drive = truth.axis[axis.name].drive
        lag_s = drive.lag_ms * 1e-3
        decay = math.exp(-period_s / lag_s)
        amplitude1_um, phase1, amplitude2_um, phase2 = shape.encoder_sines()
        row[c.COUNTS_PER_MM : c.OMEGA] = axis.counts_per_mm, shape.half_play_mm, shape.on_scale
        row[c.OMEGA] = 2 * math.pi / axis.pitch_mm if axis.pitch_mm else 0.0
        row[c.AMPLITUDE1 : c.KV] = amplitude1_um * 1e-3, phase1, amplitude2_um * 1e-3, phase2
        row[c.KV : c.TABLE_LOW] = drive.kv_per_s, drive.feed_forward, decay, lag_s * (1.0 - decay)
        row[c.TABLE_LOW :] = nodes[0], TABLE_STEP_MM
    return out


def at_rest(machine: Machine, geometry: Geometry, start_mm: ArrayLike) -> tuple[Floats, Ints]:
    """State (axes, 7) and integers (axes, 5) of axes that stand at a position, in the middle of their play."""
    low, high = np.array([a.travel_mm for a in machine.axes]).T
    start = np.clip(np.asarray(start_mm, dtype=np.float64), low, high)
    axes = np.zeros((len(start), c.AXIS_STATES))
    counts = np.zeros((len(start), c.COUNT_STATES), np.int64)
    for a, (axis, shape) in enumerate(zip(machine.axes, geometry.axes, strict=True)):
        axes[a, [c.COMMAND, c.READING]] = start[a]
        axes[a, [c.MOTOR, c.SLIDE]] = shape.motor_at(start[a : a + 1])[0]
        counts[a, c.COUNTS] = math.floor(start[a] * axis.counts_per_mm + 0.5)
    return axes, counts


def program_table(reader: Reader, truth: Truth, text: str, repeat: bool) -> Floats:
    """A part program as rows of `rtec.sim.blocks`; one that repeats ends with a rapid move back to its start.

    Raises:
        ConfigError: line, what it says, what is allowed.
    """
    start = reader.position_mm
    moves = reader.read(text)
    if repeat and reader.position_mm != start:
        moves = reader.go_back(start)
    return table_of(moves, len(start), truth.servo.acceleration_mm_s2, truth.servo.period_us * 1e-6)

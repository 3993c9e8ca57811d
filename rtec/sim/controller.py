"""The controller and its servo drives: one compiled function that runs any number of servo ticks.

Each tick, per axis (positions mm, h the servo period, all in the order below):

    error    = round(command · c) + origin - (counts + inserted) + following        counts
    target   = Kv · error / c + feed_forward · (v₁ - v₀ D) / (1 - D),  D = exp(-h/τ)      mm/s
               v₀, v₁: command's speed now and a tick later; a drive of lag τ needs this to get from one to the other
    motor    first-order drive with time constant τ, exact over h
    play     the slide follows the motor within ± half the backlash
    reading  = base + a1 sin(ωb + φ1) + a2 sin(2ωb + φ2) + table(b),  b = motor, or the slide where there is a scale
    counts   = floor(reading · c + ½)      (the zero mark is in the middle of count 0)

The controller reads `counts + inserted`, so that +k inserted counts stop the slide k counts sooner. The numbers come
from the truth.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from rtec.arrays import Floats, Ints
from rtec.jit import njit
from rtec.machine import Machine
from rtec.sim.geometry import Geometry
from rtec.sim.program import (
    ACCELERATION,
    ANGLE,
    ARC,
    AXIS_I,
    AXIS_J,
    CENTRE_I,
    CENTRE_J,
    END,
    LENGTH,
    POSITIONS,
    RADIUS,
    RPM,
    SPEED,
    START,
    SWEEP,
    ProgramReader,
    table_of,
)
from rtec.sim.truth import Truth

MOTOR, VELOCITY, SLIDE, READING, COMMAND, COMMAND_VELOCITY, TRAVELLED, AXIS_STATES = range(8)
"""Columns of an axis' state: mm and mm/s; TRAVELLED is the length of the motor's path, for its heat."""
COUNTS_PER_MM, HALF_PLAY, ON_SCALE, OMEGA, AMPLITUDE1, PHASE1, AMPLITUDE2, PHASE2 = range(8)
KV, FEED_FORWARD, DECAY, GAIN, TABLE_LOW, TABLE_STEP, AXIS_PARAMETERS = range(8, 15)
"""Columns of an axis' parameters; amplitudes and table in mm."""
TICK, PROGRAM_TICK, BLOCK, REPEAT, CLOCK_STATES = range(5)
"""Servo ticks since the start, tick at which the program began, its block, whether it repeats."""
SPINDLE_RPM, SPINDLE_RAMP, TURNS, SPINDLE_STATES = range(4)
"""Present speed, 1/min; its change a tick; turns (without sign) since the start."""
COUNTS, INSERTED, FOLLOWING, ORIGIN, NEXT_ORIGIN, COUNT_STATES = range(6)
"""Columns of an axis' integers, all in counts; a new origin takes effect with the next block."""
T_COMMAND, T_MOTOR, T_SLIDE, T_READING, TRACE_COLUMNS = range(5)
"""Columns of a recording, mm."""


Setup = tuple[float, Floats, Floats, Floats]
"""Servo period, s; parameters (axes, 15); encoder tables (axes, nodes), mm; blocks of `rtec.sim.program`."""
State = tuple[Floats, Ints, Ints, Floats]
"""Axes (axes, 7), counts (axes, 5), clock (4,), spindle (3,). Plain tuples: named ones cost 5 µs a call."""


@njit
def move_axis(axis: Floats, counts: Ints, own: Floats, table: Floats, next_speed: tuple[float, float]) -> None:
    """One servo tick of one axis: its state (7,) and integers (5,) change; its parameters (15,) and table do not.

    `next_speed` is the command's speed at the end of the tick, mm/s, and the tick's length, s.
    """
    speed, period_s = next_speed
    counts_per_mm, decay = own[COUNTS_PER_MM], own[DECAY]
    target = math.floor(axis[COMMAND] * counts_per_mm + 0.5) + counts[ORIGIN]
    error = target - counts[COUNTS] - counts[INSERTED] + counts[FOLLOWING]
    ahead = (speed - axis[COMMAND_VELOCITY] * decay) / (1.0 - decay)
    target = own[KV] * error / counts_per_mm + own[FEED_FORWARD] * ahead
    lag = axis[VELOCITY] - target
    step = target * period_s + lag * own[GAIN]
    axis[VELOCITY] = target + lag * decay
    axis[MOTOR] += step
    axis[TRAVELLED] += abs(step)
    axis[SLIDE] = min(max(axis[SLIDE], axis[MOTOR] - own[HALF_PLAY]), axis[MOTOR] + own[HALF_PLAY])
    base = axis[SLIDE] if own[ON_SCALE] > 0.0 else axis[MOTOR]
    turn = own[OMEGA] * base
    reading = base + own[AMPLITUDE1] * math.sin(turn + own[PHASE1])
    reading += own[AMPLITUDE2] * math.sin(2.0 * turn + own[PHASE2])
    spot = (base - own[TABLE_LOW]) / own[TABLE_STEP]
    node = min(max(int(spot), 0), len(table) - 2)
    reading += table[node] + (table[node + 1] - table[node]) * (spot - node)
    axis[READING] = reading
    counts[COUNTS] = math.floor(reading * counts_per_mm + 0.5)


@njit
def next_block(blocks: Floats, clock: Ints) -> bool:
    """Advance to the block of this tick, or to the first one where the program repeats; True at a change or at rest."""
    block = clock[BLOCK]
    while block < len(blocks) and clock[TICK] - clock[PROGRAM_TICK] >= blocks[block, END]:
        block += 1
        if block == len(blocks) and clock[REPEAT] > 0 and blocks[block - 1, END] > 0.0:
            clock[PROGRAM_TICK] += int(blocks[block - 1, END])
            block = 0
    changed = block != clock[BLOCK] or block == len(blocks)
    clock[BLOCK] = block
    return bool(changed)


@njit
def place_on(row: Floats, seconds: float, position: Floats, velocity: Floats) -> None:
    """Fill position, mm, and velocity, mm/s, (axes,), at a time since the row's start."""
    n = len(position)
    length, top, acc = row[LENGTH], row[SPEED], row[ACCELERATION]
    part, rate = 0.0, 0.0
    if length > 0.0:
        ramp = top / acc
        total = length / top + ramp
        if seconds < ramp:
            part, rate = 0.5 * acc * seconds * seconds, acc * seconds
        elif seconds < total - ramp:
            part, rate = top * (seconds - 0.5 * ramp), top
        elif seconds < total:
            left = total - seconds
            part, rate = length - 0.5 * acc * left * left, acc * left
        else:
            part = length
        part /= length
        rate /= length
    for a in range(n):
        position[a] = row[POSITIONS + a] + row[POSITIONS + n + a] * part
        velocity[a] = row[POSITIONS + n + a] * rate
    if row[ARC] > 0.0:
        i, j = int(row[AXIS_I]), int(row[AXIS_J])
        angle = row[ANGLE] + row[SWEEP] * part
        spin = row[RADIUS] * row[SWEEP] * rate
        position[i] = row[CENTRE_I] + row[RADIUS] * math.cos(angle)
        position[j] = row[CENTRE_J] + row[RADIUS] * math.sin(angle)
        velocity[i] = -spin * math.sin(angle)
        velocity[j] = spin * math.cos(angle)


@njit
def run_ticks(ticks: int, setup: Setup, state: State, trace: Floats, stride: int) -> None:
    """Run the machine for some servo ticks.

    Args:
        ticks: number of ticks.
        setup: constants, tables and program.
        state: changed in place.
        trace: (rows, axes, 4), filled at ticks divisible by `stride`; without rows nothing is recorded.
        stride: see `trace`.
    """
    period_s, parameters, tables, blocks = setup
    axes, counts, clock, spindle = state
    place, velocity = np.zeros(len(axes)), np.zeros(len(axes))
    written = 0
    for _ in range(ticks):
        clock[TICK] += 1
        if next_block(blocks, clock):
            for a in range(len(axes)):
                counts[a, ORIGIN] = counts[a, NEXT_ORIGIN]
        if len(blocks) > 0:
            row = blocks[min(clock[BLOCK], len(blocks) - 1)]
            place_on(row, (clock[TICK] - clock[PROGRAM_TICK] - row[START]) * period_s, place, velocity)
            change = row[RPM] - spindle[SPINDLE_RPM]
            spindle[SPINDLE_RPM] += min(max(change, -spindle[SPINDLE_RAMP]), spindle[SPINDLE_RAMP])
        for a in range(len(axes)):
            move_axis(axes[a], counts[a], parameters[a], tables[a], (velocity[a], period_s))
            axes[a, COMMAND_VELOCITY] = velocity[a]
            if len(blocks) > 0:
                axes[a, COMMAND] = place[a]
        spindle[TURNS] += abs(spindle[SPINDLE_RPM]) * period_s / 60.0
        if written < len(trace) and clock[TICK] % stride == 0:
            for a in range(len(axes)):
                trace[written, a, T_COMMAND] = axes[a, COMMAND]
                trace[written, a, T_MOTOR] = axes[a, MOTOR]
                trace[written, a, T_SLIDE] = axes[a, SLIDE]
                trace[written, a, T_READING] = axes[a, READING]
            written += 1


TABLE_STEP_MM = 0.5
RUN_OUT_MM = 20.0
"""Length by which encoder tables extend beyond the travel."""


def table_nodes_mm(machine: Machine) -> Floats:
    """Positions of the nodes of the axes' encoder tables, (axes, nodes), beyond both ends of the travel."""
    longest = max(a.travel_mm[1] - a.travel_mm[0] for a in machine.axes) + 2 * RUN_OUT_MM
    low = np.array([[a.travel_mm[0] - RUN_OUT_MM] for a in machine.axes])
    return np.asarray(low + TABLE_STEP_MM * np.arange(math.ceil(longest / TABLE_STEP_MM) + 1))


def servo_parameters(machine: Machine, truth: Truth, geometry: Geometry, nodes_mm: Floats) -> Floats:
    """Parameters of the axes, (axes, 15), in the columns of `rtec.sim.controller`."""
    out = np.zeros((len(machine.axes), AXIS_PARAMETERS))
    period_s = truth.servo.period_us * 1e-6
    for row, axis, shape, nodes in zip(out, machine.axes, geometry.axes, nodes_mm, strict=True):
        drive = truth.axis[axis.name].drive
        lag_s = drive.lag_ms * 1e-3
        decay = math.exp(-period_s / lag_s)
        amplitude1_um, phase1, amplitude2_um, phase2 = shape.encoder_sines()
        row[COUNTS_PER_MM:OMEGA] = axis.counts_per_mm, shape.half_play_mm, shape.on_scale
        row[OMEGA] = 2 * math.pi / axis.pitch_mm if axis.pitch_mm else 0.0
        row[AMPLITUDE1:KV] = amplitude1_um * 1e-3, phase1, amplitude2_um * 1e-3, phase2
        row[KV:TABLE_LOW] = drive.kv_per_s, drive.feed_forward, decay, lag_s * (1.0 - decay)
        row[TABLE_LOW:] = nodes[0], TABLE_STEP_MM
    return out


def at_rest(machine: Machine, geometry: Geometry, start_mm: ArrayLike) -> tuple[Floats, Ints]:
    """State (axes, 7) and integers (axes, 5) of axes at rest at a position, in the middle of their play."""
    low, high = np.array([a.travel_mm for a in machine.axes]).T
    start = np.clip(np.asarray(start_mm, dtype=np.float64), low, high)
    axes = np.zeros((len(start), AXIS_STATES))
    counts = np.zeros((len(start), COUNT_STATES), np.int64)
    for a, (axis, shape) in enumerate(zip(machine.axes, geometry.axes, strict=True)):
        axes[a, [COMMAND, READING]] = start[a]
        axes[a, [MOTOR, SLIDE]] = shape.motor_at(start[a : a + 1])[0]
        counts[a, COUNTS] = math.floor(start[a] * axis.counts_per_mm + 0.5)
    return axes, counts


def program_table(reader: ProgramReader, truth: Truth, text: str, repeat: bool) -> Floats:
    """A part program as rows of `rtec.sim.program`; one that repeats ends with a rapid move back to its start.

    Raises:
        ConfigError: a line is wrong; the message has its number, its text and what is allowed.
    """
    start = reader.position_mm
    moves = reader.read(text)
    if repeat and reader.position_mm != start:
        moves = reader.go_back(start)
    return table_of(moves, len(start), truth.servo.acceleration_mm_s2, truth.servo.period_us * 1e-6)

"""Derived channels: values with memory, by one recurrence for one instant and for many.

Each function takes its memory as arguments and returns it, so that the loop, the replay and the batch functions give
the same numbers.
"""

import math

import numpy as np

from rtec.arrays import Floats
from rtec.jit import njit

FAR_MM = 1e9
"""Distance since the last reversal, mm, before the first one: finite, but so long that every fading effect is zero."""


@njit
def lag_update(lagged: float, before: float, now: float, dt_s: float, tau_s: float) -> float:
    """First-order lag `τ L' + L = u` over one interval, exact for an input that is linear between readings.

    Args:
        lagged: L at the start of the interval.
        before: input u at its start.
        now: input u at its end.
        dt_s: length of the interval, s; of any size, as the discretisation is exact.
        tau_s: time constant, s.

    Returns:
        L at the end. Splitting the interval at a point of the straight line does not change it.
    """
    if dt_s <= 0.0:
        return lagged
    if tau_s <= 0.0:
        return now
    h = dt_s / tau_s
    if h == 0.0:  # the quotient underflows in a very short interval
        return lagged
    decay = math.exp(-h)
    mean = -math.expm1(-h) / h
    return lagged * decay + before * (mean - decay) + now * (1.0 - mean)


@njit
def direction_update(direction: float, extreme: float, position: float, dead_band: float) -> tuple[float, float]:
    """Last non-zero direction of motion with a dead band.

    Args:
        direction: -1, +1, or 0 before the first motion.
        extreme: furthest position in that direction since the last reversal, mm; while direction is 0, the start.
        position: current position, mm.
        dead_band: motion back by at most this much is no reversal, mm.

    Returns:
        The new direction and extreme.
    """
    if direction > 0.0:
        if position >= extreme:
            return 1.0, position
        return (-1.0, position) if extreme - position > dead_band else (1.0, extreme)
    if direction < 0.0:
        if position <= extreme:
            return -1.0, position
        return (1.0, position) if position - extreme > dead_band else (-1.0, extreme)
    if position - extreme > dead_band:
        return 1.0, position
    if extreme - position > dead_band:
        return -1.0, position
    return 0.0, extreme


@njit
def reversal_update(
    direction: float, extreme: float, turn: float, position: float, dead_band: float
) -> tuple[float, float, float]:
    """`direction_update` that also remembers the position of the last reversal.

    Args:
        direction, extreme, position, dead_band: as there.
        turn: position of the last reversal, mm; infinity before the first one. The first motion is not a reversal: how
            far the axis had travelled before it is unknown.

    Returns:
        The new direction, extreme and turn.
    """
    now, furthest = direction_update(direction, extreme, position, dead_band)
    if now * direction < 0.0:
        turn = extreme
    return now, furthest, turn


@njit
def since_reversal(extreme: float, turn: float) -> float:
    """Distance travelled since the last reversal, mm; FAR_MM before the first one."""
    return min(abs(extreme - turn), FAR_MM)


@njit
def motion_update(velocity: float, acceleration: float, moved: float, dt_s: float, tau_s: float) -> tuple[float, float]:
    """Velocity and acceleration from counts, through a first-order low-pass each, over one interval.

    State equations, `u` the difference quotient of position, constant within the interval:

        τ v' + v = u        τ a' + a = v'

    solved exactly, with `h = dt / τ`:

        a ← e^(-h) (a + (u - v) h / τ)        v ← u + (v - u) e^(-h)

    At a steady speed v is that speed, at a steady acceleration a is that acceleration and v lags by τ. One count of
    size c that comes and goes moves v by at most c / τ. Splitting an interval of steady speed changes nothing.

    Args:
        velocity, acceleration: v mm/s and a mm/s² at the start of the interval.
        moved: change of position within it, mm.
        dt_s: its length, by the time stamps of the counts, s. Zero or less (a repeated stamp) changes nothing; the
            caller then keeps position and stamp of the start, so that no motion is lost.
        tau_s: time constant, s.

    Returns:
        v and a at the end.
    """
    if dt_s <= 0.0:
        return velocity, acceleration
    speed = moved / dt_s
    h = dt_s / tau_s
    decay = math.exp(-h)
    return speed + (velocity - speed) * decay, decay * (acceleration + (speed - velocity) * h / tau_s)


@njit
def lag_track(value: Floats, time_s: Floats, tau_s: float) -> Floats:
    """First-order lag of n values at n instants, (n,); settled at the first instant."""
    out = np.empty(len(value))
    for i in range(len(value)):
        if i == 0:
            out[i] = value[i]
        else:
            out[i] = lag_update(out[i - 1], value[i - 1], value[i], time_s[i] - time_s[i - 1], tau_s)
    return out


@njit
def direction_track(position: Floats, dead_band: float) -> Floats:
    """Last non-zero direction at each of n positions in order, (n,): -1, +1, or 0 before the first motion."""
    out = np.empty(len(position))
    direction, extreme = 0.0, 0.0
    for i in range(len(position)):
        if i == 0:
            extreme = position[i]
        direction, extreme = direction_update(direction, extreme, position[i], dead_band)
        out[i] = direction
    return out


@njit
def since_reversal_track(position: Floats, dead_band: float) -> Floats:
    """Distance travelled since the last reversal at each of n positions in order, mm, (n,)."""
    out = np.empty(len(position))
    direction, extreme, turn = 0.0, 0.0, math.inf
    for i in range(len(position)):
        if i == 0:
            extreme = position[i]
        direction, extreme, turn = reversal_update(direction, extreme, turn, position[i], dead_band)
        out[i] = since_reversal(extreme, turn)
    return out


@njit
def since_turn_track(position: Floats, direction: Floats) -> Floats:
    """Distance since the last reversal at each of n positions with their recorded directions, mm, (n,).

    The axis reversed between two readings; the further of the two is taken as the turning point, so that the distance
    is the shortest that the readings allow. A direction of 0 is no reversal.
    """
    out = np.empty(len(position))
    sense, extreme, turn = 0.0, 0.0, math.inf
    for i in range(len(position)):
        if i == 0 or (sense == 0.0 and direction[i] != 0.0):
            sense, extreme = direction[i], position[i]
        elif direction[i] != 0.0 and direction[i] != sense:
            turn = max(extreme, position[i]) if sense > 0.0 else min(extreme, position[i])
            sense, extreme = direction[i], position[i]
        elif sense != 0.0:
            extreme = max(extreme, position[i]) if sense > 0.0 else min(extreme, position[i])
        out[i] = since_reversal(extreme, turn)
    return out

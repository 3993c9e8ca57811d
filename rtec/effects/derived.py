"""Derived channels: values with memory, the same recurrence for one instant and for many.

Each function takes its memory as arguments and gives it back, so that the loop, the replay and the batch forms
are the same numbers.
"""

import math

import numpy as np
from numpy.typing import NDArray

from rtec.jit import njit


@njit
def lag_update(lagged: float, before: float, now: float, dt_s: float, tau_s: float) -> float:
    """First-order lag `τ L' + L = u` over one interval, exact for an input that is straight between readings.

    Args:
        lagged: L at the start of the interval.
        before: input u at its start.
        now: input u at its end.
        dt_s: length of the interval; any, the discretisation is exact.
        tau_s: time constant.

    Returns:
        L at the end. Splitting the interval at a point of the straight line changes nothing.
    """
    if dt_s <= 0.0:
        return lagged
    if tau_s <= 0.0:
        return now
    h = dt_s / tau_s
    decay = math.exp(-h)
    mean = -math.expm1(-h) / h
    return lagged * decay + before * (mean - decay) + now * (1.0 - mean)


@njit
def direction_update(direction: float, extreme: float, position: float, dead_band: float) -> tuple[float, float]:
    """Last non-zero direction of motion with a dead band.

    Args:
        direction: -1, +1, or 0 while nothing has moved yet.
        extreme: furthest position in that direction since the last reversal (while 0: where it started).
        position: position now.
        dead_band: motion back by at most this much is no reversal.

    Returns:
        direction and extreme now.
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
def lag_track(value: NDArray[np.float64], time_s: NDArray[np.float64], tau_s: float) -> NDArray[np.float64]:
    """First-order lag of n values at n instants, (n,); settled at the first."""
    out = np.empty(len(value))
    for i in range(len(value)):
        if i == 0:
            out[i] = value[i]
        else:
            out[i] = lag_update(out[i - 1], value[i - 1], value[i], time_s[i] - time_s[i - 1], tau_s)
    return out


@njit
def direction_track(position: NDArray[np.float64], dead_band: float) -> NDArray[np.float64]:
    """Last non-zero direction at each of n positions in order, (n,): -1, +1, or 0 before the first motion."""
    out = np.empty(len(position))
    direction, extreme = 0.0, 0.0
    for i in range(len(position)):
        if i == 0:
            extreme = position[i]
        direction, extreme = direction_update(direction, extreme, position[i], dead_band)
        out[i] = direction
    return out

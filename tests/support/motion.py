"""Velocity and acceleration at many positions at once, by the recurrence of the loop."""

import numpy as np
from numpy.typing import NDArray

from rtec.effects.derived import motion_update
from rtec.jit import njit


@njit
def motion_track(
    position: NDArray[np.float64], time_s: NDArray[np.float64], tau_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Velocity mm/s and acceleration mm/s² at each of n positions, (n,) each: what the loop makes of its counts."""
    velocity, acceleration = np.zeros(len(position)), np.zeros(len(position))
    v, a, last = 0.0, 0.0, 0
    for i in range(len(position)):
        if time_s[i] > time_s[last]:
            v, a = motion_update(v, a, position[i] - position[last], time_s[i] - time_s[last], tau_s)
            last = i
        velocity[i], acceleration[i] = v, a
    return velocity, acceleration

"""The ledger: the part of the correction that is in the machine, as integers.

A correction of c µm is `units_per_um · c` units of the sink. The ledger holds the whole units that were output. No
remainder is lost, because each cycle starts from the whole correction again. For pulse insertion the units are encoder
counts and, at every instant,

    raw counts + inserted counts = corrected counts.

Sign: inserted counts make the controller believe that the axis is further on, so the axis stops sooner [G 4.2.1]:
`inserted = -correction · counts per µm`. Offsets added to a command have the sign of the correction.
"""

import math

from rtec.correction.sinks import DEAD_BAND
from rtec.jit import njit


@njit
def ledger_update(
    wanted: float, output: int, allowance: float, dt: float, quantum: int, rate: float
) -> tuple[int, float]:
    """Move the ledger towards the wanted units for one cycle.

    Args:
        wanted: the applied correction in units, not rounded.
        output: units in the ledger.
        allowance: units that may be output now, accumulated at `rate`.
        dt: length of the cycle, s.
        quantum: smallest step, units (4: whole encoder cycles).
        rate: units per second that the sink and the controller can follow.

    Returns:
        output and allowance after the cycle. Output changes by whole quanta, at most at the rate.
    """
    allowance = min(allowance + rate * dt, quantum + rate * dt)
    left = wanted - output
    if abs(left) <= DEAD_BAND * quantum:
        return output, allowance
    steps = math.floor(abs(left) / quantum + 0.5)
    moved = min(steps, math.floor(allowance / quantum)) * quantum
    return output + (moved if left > 0.0 else -moved), allowance - moved

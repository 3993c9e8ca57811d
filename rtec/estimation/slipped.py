"""A probe that slips while the machine stands still: its readings jump once and stay, and no axis moved."""

import numpy as np

from rtec.arrays import robust_scatter
from rtec.estimation.candidates import REAL, real
from rtec.estimation.moved_zero import MovedZero
from rtec.estimation.readings import Readings, Series
from rtec.wording import ERROR_UNITS, significant

FEWEST = 20
"""Fewest readings of a series that tell a jump from the steps between all readings."""
NOISE, OTHERS = 8.0, 3.0
"""A jump is at least this many times the usual step between readings, and this many times the largest other step."""
GAP = 3.0
"""After a pause of this many times the usual one, a machine that cools down has moved, too."""
DRIVERS = ("spindle_rpm", "load_kg", "force_n")
"""A machine that gives way at once has one of these as its reason."""
STEP = "write the readings before and after the jump into two files, so that each has a zero of its own"


def slipped(readings: Readings) -> list[MovedZero]:
    """Series that jump between two readings for no recorded reason, while no axis moves; each with what follows."""
    out = []
    for i, s in enumerate(readings.series):
        if (jump := _jump(readings, s)) is None:
            continue
        at, by = jump
        after = np.zeros(len(readings), dtype=np.bool_)
        after[s.part][at + 1 :] = True
        m = readings.measurements[s.source]
        size = f"{significant(abs(by), 2)} {ERROR_UNITS[s.unit]}"
        message = (
            f"{m.name} {s.column} jumps by {size} at {s.time_s[at + 1]:.0f} s, from one reading to the next, while no "
            "axis moves and neither speed nor load changes: did the probe slip, or was it touched?"
        )
        first, last = (int(m.run[s.row[k]]) for k in (at + 1, -1))
        out.append(MovedZero(i, first, last, by, after, message))
    return out


def _jump(readings: Readings, s: Series) -> tuple[int, float] | None:
    """The reading after which a series at rest jumps, and by how much, with sign; None where it does not."""
    poses = readings.poses_mm[s.source][s.row]
    if len(s) < FEWEST or float(np.ptp(poses, axis=0).max()) > REAL["mm"]:
        return None
    if s.nuisance.shape[1] and not np.ptp(s.nuisance, axis=0).all():
        return None  # each run has a zero of its own
    steps = np.diff(readings.values[s.part])
    at = int(np.argmax(np.abs(steps)))
    by, others = float(steps[at]), np.delete(steps, at)
    usual = robust_scatter(others)
    if abs(by) < max(NOISE * usual, OTHERS * float(np.abs(others).max())):
        return None
    if s.time_s[at + 1] - s.time_s[at] > GAP * s.pace_s[1]:
        return None
    channels = readings.states[s.source].channels
    for name in DRIVERS:
        before, after = (channels[name][s.row[k]] if name in channels else 0.0 for k in (at, at + 1))
        if abs(after - before) > real(readings.machine, name):
            return None
    return at, by

"""Runs that are at one of two levels, to and fro, for no recorded reason.

Something with two states acts on whole runs: coolant or hydraulics on and off, a clamp, the seat of a probe. A machine
whose states nobody noted shows readings that no effect of a recorded channel describes, and a temperature that happens
to go with them is blamed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtec.arrays import Bools, Floats, Ints, robust_sigma
from rtec.estimation.candidates import real
from rtec.estimation.contradiction import PER_MM
from rtec.estimation.readings import Readings, Series, row_codes
from rtec.wording import ERROR_UNITS, significant

FEW_RUNS, MANY_RUNS, EACH = 5, 60, 2
"""Fewest and most runs that are looked at, and fewest runs of each level."""
CHANGES = 3
"""Fewest changes between the levels: one that lasts is a loss of counts or a touched set-up, one to and fro a zero that
moved."""
FEW_PLACES = 5
"""Fewest places that a run shares with half of the runs."""
SHARP, SHARPER = 110.0, 40.0
"""Least variance ratio of the two levels, of very many runs, and how it grows for few: of runs that differ by a normal
scatter, or by a random walk, one in a thousand has more (20 000 drawn for each of seven numbers of runs)."""
VISIBLE = 3.0
"""The levels are apart by at least this many times the scatter of the readings of a run."""
FOLLOWED = 3.0
"""A channel is a reason if a straight line through it leaves at most this many times the scatter within the levels."""
WAYS = 400
"""Ways to divide the runs beyond which a limit of a channel that divides them so is no chance."""
STEP = (
    "Find what was different in these runs (coolant, hydraulics, a clamp, the seat of a probe) and diagnose the runs "
    'of one state alone; or write zero = "run" in the [setup] of the file, so that each run has a zero of its own.'
)


@dataclass(frozen=True)
class TwoLevels:
    """A series whose runs are at one of two levels.

    Attributes:
        series: number of the series.
        high: which runs are at the higher level, (runs,).
        readings: what the levels make of each reading, zero in other series, (m,).
        message: in words.
    """

    series: int
    high: Bools
    readings: Floats
    message: str


def two_levels(readings: Readings, left: Floats) -> list[TwoLevels]:
    """Series whose runs are at one of two levels while no recorded channel does.

    Series in which each run has a zero of its own are excluded.

    Args:
        readings: the readings.
        left: their residual, (m,).
    """
    found = (_of(readings, i, left[s.part]) for i, s in enumerate(readings.series) if _shares_a_zero(s))
    return [f for f in found if f is not None]


def _shares_a_zero(s: Series) -> bool:
    return not s.nuisance.shape[1] or bool(np.ptp(s.nuisance, axis=0).all())


def _of(readings: Readings, number: int, left: Floats) -> TwoLevels | None:
    s = readings.series[number]
    runs = int(s.run[-1]) + 1
    if not FEW_RUNS <= runs <= MANY_RUNS:
        return None
    apart = _apart_from_others(readings, s, left)
    values = [apart[(s.run == k) & np.isfinite(apart)] for k in range(runs)]
    if any(len(v) < FEW_PLACES for v in values):
        return None
    heights = np.array([np.median(v) for v in values])
    scatter = robust_sigma(np.concatenate([v - h for v, h in zip(values, heights, strict=True)]))
    high, ratio = _split(heights)
    if not high.any():
        return None
    gap = float(heights[high].mean() - heights[~high].mean())
    changes = int(np.count_nonzero(high[1:] != high[:-1]))
    least = SHARP * (1.0 + SHARPER / (runs - 2) ** 2)
    if changes < CHANGES or ratio < least or gap < VISIBLE * scatter:
        return None
    within = gap * np.sqrt(high.mean() * (~high).mean() * runs / ratio)
    if _has_reason(readings, s, heights, high, float(within)):
        return None
    out = np.zeros(len(readings))
    out[s.part] = gap * high[s.run]
    m, first = readings.measurements[s.source], s.row[np.searchsorted(s.run, np.arange(runs))]
    named = _listed(m.run[first[high]])
    message = (
        f"{m.name} {s.column}: the runs are at two levels, {significant(gap, 2)} {ERROR_UNITS[s.unit]} apart, and "
        f"agree within {significant(float(within), 1)} at each; {named} are higher. Nothing that was recorded "
        "separates them."
    )
    return TwoLevels(number, high, out, message)


def _apart_from_others(readings: Readings, s: Series, left: Floats) -> Floats:
    """Residuals less the mean of all runs at the same place, reached from the same side; NaN where few went, (n,)."""
    pose, state = readings.poses_mm[s.source][s.row], readings.states[s.source]
    ways = [np.sign(state.value(a.direction_channel)[s.row]) for a in readings.machine.axes]
    place = row_codes(np.stack([*np.round(PER_MM * pose).T, *ways]))
    place = np.unique(place, return_inverse=True)[1]
    visits = np.bincount(place)
    mean = np.bincount(place, weights=left) / visits
    return np.where(visits[place] >= 0.5 * (int(s.run[-1]) + 1), left - mean[place], np.nan)


def _split(heights: Floats) -> tuple[Bools, float]:
    """Which runs are higher, for the division by height that has the largest variance ratio; and that ratio."""
    order, runs = np.argsort(heights), len(heights)
    high, most = np.zeros(runs, dtype=np.bool_), 0.0
    for low in range(EACH, runs - EACH + 1):
        below, above = heights[order[:low]], heights[order[low:]]
        within = float(np.sum((below - below.mean()) ** 2) + np.sum((above - above.mean()) ** 2)) / (runs - 2)
        between = float(above.mean() - below.mean()) ** 2 * low * (runs - low) / runs
        if between > most * max(within, 1e-12):
            most = between / max(within, 1e-12)
            high = np.isin(np.arange(runs), order[low:])
    return high, most


def _has_reason(readings: Readings, s: Series, heights: Floats, high: Bools, within: float) -> bool:
    """Whether the levels follow a recorded channel: by a straight line, or each level has values of its own."""
    state, machine = readings.states[s.source], readings.machine
    ways = [a.direction_channel for a in machine.axes]
    speeds = [a.velocity_channel for a in machine.axes]
    places = [a.channel for a in machine.axes]
    for name in (*machine.sensor_names, "spindle_rpm", "load_kg", "force_n", "feed_mm_min", *speeds, *places, *ways):
        if name not in state.channels and name not in ways:
            continue
        values = state.value(name)[s.row]
        values = np.abs(values) if name in speeds else values
        middle = np.array([np.nanmean(values[s.run == k]) for k in range(len(heights))])
        if not np.isfinite(middle).all() or np.ptp(middle) <= (1e-6 if name in ways else real(machine, name)):
            continue
        line = np.stack([np.ones(len(middle)), middle - middle.mean()], axis=1)
        off = heights - line @ np.linalg.lstsq(line, heights, rcond=None)[0]
        straight = float(np.sqrt(np.sum(off**2) / (len(heights) - 2))) <= FOLLOWED * within
        if straight or _separates(middle, high):
            return True
    return False


def _separates(values: Floats, high: Bools) -> bool:
    """Whether the nearest value to that of each run is one of its own level, or one level is above a limit.

    Of few runs a limit divides any two levels by chance.
    """
    if math.comb(len(high), int(high.sum())) > WAYS:
        up, down = values[high], values[~high]
        if up.min() > down.max() or up.max() < down.min():
            return True
    apart = np.abs(values[:, None] - values)
    np.fill_diagonal(apart, np.inf)
    same = high[:, None] == high
    own, other = (np.where(which, apart, np.inf).min(axis=1) for which in (same, ~same))
    return bool(np.all(own < other))


def _listed(runs: Sequence[int] | Ints) -> str:
    """Runs by their numbers, those in a row as a range."""
    numbers = [int(r) for r in runs]
    parts: list[list[int]] = []
    for n in numbers:
        if parts and n == parts[-1][-1] + 1:
            parts[-1].append(n)
        else:
            parts.append([n])
    texts = [f"{p[0]} to {p[-1]}" if len(p) > 2 else ", ".join(map(str, p)) for p in parts]
    listed = ", ".join(texts)
    return f"runs {listed}"

"""From the rows of a positioning measurement to the visits of each target."""

import numpy as np
from numpy.typing import NDArray

from rtec.errors import MeasurementError
from rtec.metrology.measurement import Measurement
from rtec.metrology.procedures.iso230_2 import Visits

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
SAME_TARGET_MM = 0.001


def visits_of(measurement: Measurement) -> Visits:
    """Visits of the targets of a laser_linear measurement; its readings are actual minus nominal along the axis.

    Raises:
        MeasurementError: the instrument has no axis, or the measurement lacks that axis or `reading_um`.
    """
    name, axis = measurement.name, measurement.instrument.axis
    if axis is None or axis not in measurement.machine.axis_names:
        raise MeasurementError(f"{name}: ISO 230-2 needs one axis of the machine; the measurement names {axis!r}")
    channel = measurement.machine.axis(axis)
    if channel.channel not in measurement.channels or "reading_um" not in measurement.readings:
        raise MeasurementError(f"{name}: needs the columns {channel.channel}_mm and reading_um")
    direction = measurement.state().value(channel.direction_channel)
    reading = measurement.readings["reading_um"]
    return stops(name, measurement.channels[channel.channel], direction, measurement.run, reading)


def stops(name: str, position_mm: Floats, direction: Floats, run: Ints, reading_um: Floats) -> Visits:
    """Group rows, in order of time, into visits.

    Rows in a row at one target, in one direction and run, are one stop; their mean counts. The k-th visit of a target
    in one direction belongs to cycle k.

    Args:
        name: for messages.
        position_mm: commanded, (n,).
        direction: of approach, -1, 0, +1, (n,).
        run: (n,).
        reading_um: (n,); NaN where there is none.

    Raises:
        MeasurementError: nothing can be used.
    """
    target = _targets(position_mm)
    change = np.ones(len(target), bool)
    change[1:] = (np.diff(target) != 0) | (np.diff(direction) != 0) | (np.diff(run) != 0)
    first = np.flatnonzero(change)
    means = [_mean(part) for part in np.split(reading_um, first[1:])]
    found: dict[tuple[float, int], list[float]] = {}
    for i, value in zip(first, means, strict=True):
        found.setdefault((float(target[i]), int(direction[i])), []).append(value)
    return _table(name, found)


def _table(name: str, found: dict[tuple[float, int], list[float]]) -> Visits:
    """Visits of all targets that were approached often enough; the others are told."""
    ways = [d for d in (1, -1) if any(len(v) > 1 for (_, way), v in found.items() if way == d)]
    targets = sorted({t for t, _ in found})
    kept = [t for t in targets if ways and all(np.isfinite(found.get((t, d), [])).sum() > 1 for d in ways)]
    if not kept:
        raise MeasurementError(
            f"{name}: no target was approached twice from the same side; ISO 230-2 needs repeated cycles"
        )
    notes = []
    left = [t for t in targets if t not in kept]
    if left:
        some = ", ".join(f"{round(t, 3):g}" for t in left[:6]) + (", …" if len(left) > 6 else "")
        notes.append(
            f"{len(left)} places were not approached twice from {'both sides' if len(ways) == 2 else 'one side'} "
            f"and are left out: {some} mm."
        )
    if any(d == 0 for _, d in found):
        notes.append("The first place has no direction of approach and its first reading is left out.")
    cycles = max(len(found[t, d]) for t in kept for d in ways)
    grid = {d: np.full((len(kept), cycles), np.nan) for d in (1, -1)}
    for d in ways:
        for i, t in enumerate(kept):
            grid[d][i, : len(found[t, d])] = found[t, d]
    return Visits(name, np.array(kept), grid[1], grid[-1], tuple(notes))


def _targets(position_mm: Floats) -> Floats:
    """Positions that are the same target get the same number."""
    order = np.argsort(position_mm, kind="stable")
    rising = position_mm[order]
    group = np.concatenate([[0], np.cumsum(np.diff(rising) > SAME_TARGET_MM)])
    first = rising[np.searchsorted(group, np.arange(group[-1] + 1))]
    out = np.empty_like(position_mm)
    out[order] = first[group]
    return out


def _mean(values: Floats) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else float("nan")

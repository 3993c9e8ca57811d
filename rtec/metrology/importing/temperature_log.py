"""Matches a log of temperatures to the readings of another file, by their clocks.

Temperatures are interpolated. Spindle speed, feed and load step: each reading gets that of the row before.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path

import numpy as np

from rtec.arrays import Floats
from rtec.errors import MeasurementError
from rtec.metrology.importing.clock import RowClock, said
from rtec.metrology.importing.zones import SUCH_AS
from rtec.quantities import DAY_S

LONGEST_GAP_S, LONGEST_GAP_STEPS = 600.0, 3.0
"""Between two readings of a log the temperature is interpolated, and a speed held, where they are at most so far apart,
or so many of the log's usual steps."""


@dataclass(frozen=True)
class LoggedTemperatures:
    """A log of temperatures.

    Attributes:
        source: name of the file, for messages.
        clock: time of each row.
        columns: temperatures, and spindle speed, feed and load, by the column that they become, (n,) each.
        notes: what of the file is not used.
    """

    source: str
    clock: RowClock
    columns: Mapping[str, Floats]
    notes: tuple[str, ...] = ()


def beside(log: Path, file: Path) -> str:
    """Path of a log as a map has it: from the folder of the imported file."""
    return Path(os.path.relpath(log.resolve(), file.resolve().parent)).as_posix()


def matched(clock: RowClock, source: str, log: LoggedTemperatures) -> tuple[dict[str, Floats], list[str]]:
    """The columns of a log at the times of a measurement, NaN where the log has no value; and notes.

    Args:
        clock: clock of the measurement.
        source: name of its file, for messages.
        log: the log.

    Raises:
        MeasurementError: a file has no time of day, the day is not known, or the log is of another time.
    """
    for name, one in ((source, clock), (log.source, log.clock)):
        if one.of_day is None:
            sensor = next((n for n in log.columns if n.endswith("_degc")), "SENSOR_degc")
            way = f"one temperature for all rows, without the log: --answer {sensor}=20.5"
            raise MeasurementError(f"{name}: no time of day to match {log.source} to {source} by; {way}")
        if len(one.restarts):
            raise MeasurementError(f"{name}: its clock falls: no time to match {log.source} to {source} by")
    for one, name, other in ((clock, source, log.source), (log.clock, log.source, source)):
        if one.zone is None and (clock.zone or log.clock.zone):
            where = "[time]" if one is clock else "[temperatures.time]"
            raise MeasurementError(
                f"{name}: says no time zone, and {Path(other).name} says one; say that of its times: {where} zone = …, "
                f"{SUCH_AS}"
            )
    at_s = clock.time_s + _apart_s(clock, source, log)
    out, notes = {}, []
    for name, values in log.columns.items():
        steps = not name.endswith("_degc")
        out[name], step_s = _at(at_s, log.clock.time_s, values, steps=steps)
        note = f"{name} at the time of each reading, between readings of the log {step_s:.4g} s apart"
        if steps:
            note = f"{name} as the last row of the log before each reading has it, rows {step_s:.4g} s apart"
        if lost := int(np.isnan(out[name]).sum()):
            note = f"{name}: {lost} of {len(at_s)} rows have none: the log has no reading near them"
        notes.append(note)
    if not any(np.isfinite(v).any() for v in out.values()):
        raise MeasurementError(
            f"{log.source}: is of another time: it is {_span(log.clock)}, {source} is {_span(clock)}; is one clock set "
            "wrong, or in another time zone? Then say both: zone = … in [time] and in [temperatures.time] of a map"
        )
    how = "by date and time" if clock.began and log.clock.began else "by time of day, on the same day"
    return out, [f"temperatures from {log.source}, matched {how}: {_span(log.clock, clock.zone)}", *notes, *log.notes]


def _apart_s(clock: RowClock, source: str, log: LoggedTemperatures) -> float:
    """Time of the log at which the measurement begins. Without a date on both sides it is that of the covering day."""
    assert clock.of_day is not None  # noqa: S101 (both were looked at)
    assert log.clock.of_day is not None  # noqa: S101
    both = bool(clock.began and log.clock.began)
    begins = [c.of_day if both else _on_the_wall(c, other) for c, other in ((clock, log.clock), (log.clock, clock))]
    assert begins[0] is not None  # noqa: S101
    assert begins[1] is not None  # noqa: S101
    apart_s = (begins[0] - begins[1]).total_seconds()
    if clock.began and log.clock.began:
        return apart_s
    last_s = float(log.clock.time_s[-1])
    days = np.arange(-1.0, np.ceil(last_s / DAY_S) + 1.0)
    first_s = apart_s % DAY_S + DAY_S * days
    covered = [int(((b + clock.time_s >= 0.0) & (b + clock.time_s <= last_s)).sum()) for b in first_s]
    best = max(covered)
    if best and (several := covered.count(best)) > 1:
        name = source if clock.began is None else log.source
        raise MeasurementError(
            f"{name}: has no date, and {log.source} fits on {several} days; name the column of the date in a map, "
            "[time] date = …, or take one day of the log"
        )
    return float(first_s[covered.index(best)])


def _on_the_wall(clock: RowClock, other: RowClock) -> datetime | None:
    """Time of day of the first row, as the clock of the file that has no date shows it."""
    if clock.began is None or other.zone is None:
        return clock.of_day
    return clock.began.astimezone(other.zone).replace(tzinfo=UTC)


def _at(at_s: Floats, time_s: Floats, values: Floats, *, steps: bool) -> tuple[Floats, float]:
    """Values at some times, and the log's usual step, s. Beyond a reading by up to a step its value is held.

    Args:
        at_s: the times, (m,).
        time_s, values: of the log, (n,).
        steps: the value steps: between two rows it is that of the row before, and not interpolated.
    """
    known = np.isfinite(values)
    time_s, first = np.unique(time_s[known], return_index=True)
    values = values[known][first]
    if not len(time_s):
        return np.full(len(at_s), np.nan), np.nan
    step_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    after = np.searchsorted(time_s, at_s, side="left").clip(0, len(time_s) - 1)
    before = (np.searchsorted(time_s, at_s, side="right") - 1).clip(0)
    near = np.where(np.abs(time_s[after] - at_s) < np.abs(time_s[before] - at_s), after, before)
    inside = (time_s[before] <= at_s) & (at_s <= time_s[after])
    bridged = inside & (time_s[after] - time_s[before] <= max(LONGEST_GAP_S, LONGEST_GAP_STEPS * step_s))
    held = np.where(np.abs(time_s[near] - at_s) <= step_s, values[near], np.nan)
    between = values[before] if steps else np.interp(at_s, time_s, values)
    return np.where(bridged, between, held), step_s


def _span(clock: RowClock, zone: tzinfo | None = None) -> str:
    """From when to when a clock ran, in its own zone or another."""
    assert clock.of_day is not None  # noqa: S101
    ends = clock.of_day, clock.of_day + timedelta(seconds=float(clock.time_s[-1] - clock.time_s[0]))
    if clock.began is None:
        return "from {:%H:%M:%S} to {:%H:%M:%S}".format(*ends)
    return "from {} to {}".format(*(said(e, zone or clock.zone) for e in ends))

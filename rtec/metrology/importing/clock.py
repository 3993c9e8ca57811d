"""Converts a file's times to seconds, and decides where runs begin."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, tzinfo
from typing import Any

import numpy as np

from rtec.arrays import Bools, Floats, Ints
from rtec.effects.derived import direction_track
from rtec.errors import MeasurementError
from rtec.metrology.importing.map import Run, Time
from rtec.metrology.importing.zones import ABSOLUTE, SUCH_AS, dated, in_utc, parsed, written, zone_of
from rtec.metrology.readers.base import EPOCH_EXCEL, EPOCH_FILETIME, EPOCH_UNIX, ForeignTable
from rtec.metrology.units import convert
from rtec.quantities import DAY_S
from rtec.tomlfile import nearest
from rtec.wording import counted


@dataclass(frozen=True)
class RowClock:
    """Time of each row.

    Attributes:
        time_s: (n,).
        restarts: rows at which the file's clock restarts.
        notes: notes for the measurement.
        began: date and time of time 0, where the file has dates; local times of an unknown zone are taken as UTC.
        of_day: the same where the file has times of day only, local and on a day that means nothing; None without a
            clock.
        zone: time zone of the file; None where that is unknown.
    """

    time_s: Floats
    restarts: Ints
    notes: tuple[str, ...]
    began: datetime | None = None
    of_day: datetime | None = None
    zone: tzinfo | None = None


def seconds(table: ForeignTable, time: Time, source: str) -> RowClock:
    """Time of each row.

    Raises:
        MeasurementError: a cell is no time, by line; or the time falls and `restarts` is not set.
    """
    if time.column is None:
        step_s = time.step_s or 1.0
        order: Floats = np.arange(len(table), dtype=np.float64) * step_s
        made_up = f"the file has no time: its rows are taken as {step_s:g} s apart"
        return RowClock(order, np.empty(0, dtype=np.int64), (made_up,))
    has_date, zone = True, zone_of(time.zone) if time.zone else UTC if time.unit in ABSOLUTE else None
    if time.format is not None or time.unit == "iso":
        has_date = dated(time.format)
        time_s, epoch, zone = _of_day(table, time, source, zone)
    else:
        values = table.numbers(time.column, source)
        unit = time.unit or table.units.get(time.column)
        if not unit:
            raise MeasurementError(f"{source}: [time] column {time.column!r}: the file tells no unit; say unit = …")
        time_s, epoch = _since(values, unit)
        if zone is not None and epoch is not None and unit == "excel":
            epoch = in_utc(epoch.replace(tzinfo=None), zone, None)
    lost = np.flatnonzero(np.isnan(time_s))
    if len(lost):
        line = f"{source}: line {table.lines[lost[0]]}: no time ({len(lost)} rows in all)"
        raise MeasurementError(f"{line}; leave them out: [rows] require = [{time.column!r}]")
    notes: list[str] = []
    if epoch is not None and not has_date and not time.restarts:
        time_s = _over_midnight(time_s, notes)
    falls = np.flatnonzero(np.diff(time_s) < 0) + 1
    if len(falls) and not time.restarts:
        unknown_zone = epoch is not None and zone is None
        raise MeasurementError(f"{source}: line {table.lines[falls[0]]}: {_fault(time_s, falls, unknown_zone)}")
    if len(falls):
        time_s = _one_clock(time_s, falls, time.restart_gap_s, notes)
    first = epoch + timedelta(seconds=float(time_s[0])) if epoch is not None and len(time_s) else None
    if first is not None and has_date:
        notes.append(f"time 0 is {said(first, zone)}")
        time_s = time_s - time_s[0]
    elif time.from_zero and len(time_s) and time_s[0] != 0.0:
        notes.append(f"time 0 is {time_s[0]:.10g} s of the file")
        time_s = time_s - time_s[0]
    return RowClock(time_s, falls, tuple(notes), first if has_date else None, first, zone)


STANDS_MM = 1e-3
HOUR_S = 3_600.0
EPOCHS = {"filetime": (EPOCH_FILETIME, 1e-7), "excel": (EPOCH_EXCEL, 86400.0), "unix": (EPOCH_UNIX, 1.0)}


def _since(values: Floats, unit: str) -> tuple[Floats, datetime | None]:
    """Seconds, and the date and time of second 0 where the unit has one."""
    if unit not in EPOCHS or not np.isfinite(values).any():
        return values if unit in EPOCHS else convert(values, unit, "s"), None
    epoch, second = EPOCHS[unit]
    least = float(np.nanmin(values))
    try:
        return (values - least) * second, epoch + timedelta(seconds=least * second)
    except OverflowError:
        return (values - least) * second, None


def _of_day(
    table: ForeignTable, time: Time, source: str, zone: tzinfo | None
) -> tuple[Floats, datetime | None, tzinfo | None]:
    """Seconds since the first time of day, that first one, and the zone: the file's own, or the given one."""
    name, pattern = time.column or "", time.format
    texts = table.column(name, source)
    if time.date is not None:
        texts = np.array(
            [f"{d} {t}".strip() for d, t in zip(table.column(time.date, source), texts, strict=True)], dtype=np.object_
        )
    out = np.full(len(table), np.nan)
    first, before, local = None, None, zone if dated(pattern) else None
    for i, text in enumerate(texts):
        if not (cell := str(text).strip()) or cell == "nan":
            continue
        try:
            moment = parsed(cell, pattern)
        except (ValueError, OverflowError) as e:
            line = f"{source}: line {table.lines[i]}: column {name!r}: {cell[:40]!r}"
            way = "correct format" if pattern else 'say format = "%d.%m.%Y %H:%M:%S" or what fits'
            raise MeasurementError(f"{line} is no time ({e}); {way}") from e
        zone = moment.tzinfo or zone
        before = in_utc(moment, local, before)
        first = first or before
        out[i] = (before - first).total_seconds()
    return out, first, zone


def _over_midnight(time_s: Floats, notes: list[str]) -> Floats:
    """Times of day without a date, going on over midnight."""
    midnights = np.diff(time_s, prepend=time_s[:1]) < -DAY_S / 2
    if midnights.any():
        notes.append(f"times of day without a date pass midnight {counted(int(midnights.sum()), 'time')}")
    return np.asarray(time_s + DAY_S * np.cumsum(midnights))


def _fault(time_s: Floats, falls: Ints, unknown_zone: bool) -> str:
    """What is wrong with times that fall, and the remedy."""
    if unknown_zone and _falls_by_an_hour(time_s):
        return (
            f"local time falls by an hour, as at the end of summer time; say the time zone: [time] zone = …, {SUCH_AS}"
        )
    return (
        f"time falls from {time_s[falls[0] - 1]:.10g} to {time_s[falls[0]]:.10g} s ({len(falls)} times in all); if "
        "every run starts its clock again: [time] restarts = true, else put the rows in order"
    )


def _one_clock(time_s: Floats, falls: Ints, gap_s: float, notes: list[str]) -> Floats:
    """Times of a clock that starts again at some rows, with a gap before each of them."""
    later = np.zeros(len(time_s))
    later[falls] = time_s[falls - 1] + gap_s - time_s[falls]
    notes.append(f"the clock starts again {len(falls)} times; {gap_s:g} s are put between")
    return np.asarray(time_s + np.cumsum(later))


def said(moment: datetime, zone: tzinfo | None) -> str:
    """A date and time in words, with the zone where that is known."""
    local = moment.astimezone(zone) if zone is not None else moment
    return f"{local:%Y-%m-%d %H:%M:%S}" + (f" {written(local.utcoffset())}" if zone is not None else "")


def summer_time_ends(table: ForeignTable, time: Mapping[str, Any], source: str) -> bool:
    """Whether local times with a date, of an unknown zone, fall once by an hour; `time` has the keys of `[time]`."""
    if time.get("zone") or not (time.get("format") or time.get("unit") == "iso") or not dated(time.get("format")):
        return False
    try:
        time_s, _, zone = _of_day(table, Time(**time), source, None)
    except MeasurementError:
        return False
    return zone is None and _falls_by_an_hour(time_s[np.isfinite(time_s)])


def _falls_by_an_hour(time_s: Floats) -> bool:
    """Whether the only fall of a clock is by an hour, but for the time from one row to the next."""
    steps = np.diff(time_s)
    falls = steps[steps < 0]
    usual = float(np.median(steps[steps >= 0])) if (steps >= 0).any() else 0.0
    return len(falls) == 1 and -HOUR_S - 1.0 <= falls[0] <= min(-HOUR_S + 10.0 * usual, -HOUR_S / 2)


def runs(
    table: ForeignTable, run: Run, clock: RowClock, columns: Mapping[str, Floats], source: str
) -> tuple[Ints, list[str]]:
    """Run number of each row, from 1, and notes.

    Args:
        table: the table of the file.
        run: rules for the start of a run.
        clock: a restart of the clock always begins a run.
        columns: columns of the measurement; has the positions.
        source: name of the file, for messages.
    """
    if run.column is not None:
        values = table.numbers(run.column, source)
        wrong = np.flatnonzero(~(values == np.round(values)) | (np.abs(values) > 2.0**53))
        if len(wrong):
            i = wrong[0]
            raise MeasurementError(
                f"{source}: line {table.lines[i]}: column {run.column!r}: {values[i]:.10g} is no run number; "
                "these are integers"
            )
        return values.astype(np.int64), [f"{counted(len(np.unique(values)), 'run')} by column {run.column!r}"]
    begins = np.zeros(len(table), dtype=np.bool_)
    begins[clock.restarts] = True
    if run.direction_of is not None:
        begins |= _reversals(run.direction_of, run.dead_band_mm, columns, clock.time_s, source)
    if run.gap_s is not None:
        begins |= np.diff(clock.time_s, prepend=clock.time_s[:1]) > run.gap_s
    if run.jump_mm is not None:
        for name in (n for n in columns if n.endswith("_mm")):
            begins |= np.abs(np.diff(columns[name], prepend=columns[name][:1])) > run.jump_mm
    numbers = 1 + np.cumsum(begins).astype(np.int64)
    return numbers, [f"{numbers[-1]} runs" if numbers[-1] > 1 else "all rows are one run"]


def _reversals(name: str, dead_band_mm: float, columns: Mapping[str, Floats], time_s: Floats, source: str) -> Bools:
    """Rows at which the motion back begins, (n,).

    The rows at the turning point are split at the longest pause; if there is none, in the middle, as both directions
    read the same targets.
    """
    positions = [n for n in columns if n.endswith("_mm")]
    if name not in positions:
        raise MeasurementError(f"{source}: [run] direction_of = {name!r} is no position{nearest(name, positions)}")
    position = np.ascontiguousarray(columns[name])
    direction = direction_track(position, dead_band_mm)
    begins = np.zeros(len(position), dtype=np.bool_)
    for i in np.flatnonzero((np.diff(direction) != 0.0) & (direction[:-1] != 0.0)) + 1:
        first = i - 1
        while first > 0 and abs(position[first - 1] - position[i - 1]) <= STANDS_MM:
            first -= 1
        pauses = np.diff(time_s[first:i])
        long = len(pauses) > 0 and pauses.max() > 1.5 * np.median(pauses)
        begins[first + 1 + int(np.argmax(pauses)) if long else i - (i - first) // 2] = True
    return begins

"""Seconds from what a file says about time, and where runs begin."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.effects.derived import direction_track
from rtec.errors import MeasurementError
from rtec.metrology.importing.map import Run, Time
from rtec.metrology.readers.base import Floats, ForeignTable, Ints
from rtec.metrology.readers.times import parsed
from rtec.metrology.units import convert
from rtec.tomlfile import nearest


@dataclass(frozen=True)
class RowClock:
    """Time of each row, s, (n,); rows at which the file's own clock starts again; what to tell about it."""

    time_s: Floats
    restarts: Ints
    notes: tuple[str, ...]


def seconds(table: ForeignTable, time: Time, source: str) -> RowClock:
    """Time of each row.

    Raises:
        MeasurementError: a cell that is no time, by line; or a time that falls where `restarts` is not said.
    """
    if time.column is None:
        step_s = time.step_s or 1.0
        order: Floats = np.arange(len(table), dtype=np.float64) * step_s
        return RowClock(order, np.empty(0, dtype=np.int64), (f"time is the order of rows, {step_s:g} s apart",))
    if time.format is not None or time.unit == "iso":
        time_s = _of_day(table, time.column, time.format, source)
    else:
        values = table.numbers(time.column, source)
        unit = time.unit or table.units.get(time.column)
        if not unit:
            raise MeasurementError(f"{source}: [time] column {time.column!r}: the file tells no unit; say unit = …")
        time_s = _since(values, unit)
    lost = np.flatnonzero(np.isnan(time_s))
    if len(lost):
        line = f"{source}: line {table.lines[lost[0]]}: no time ({len(lost)} rows in all)"
        raise MeasurementError(f"{line}; leave them out: [rows] require = [{time.column!r}]")
    return _put_in_order(time_s, table, time, source)


def _since(values: Floats, unit: str) -> Floats:
    if unit == "filetime":
        return (values - np.nanmin(values)) * 1e-7 if np.isfinite(values).any() else values
    return values * 86400.0 if unit == "excel" else convert(values, unit, "s")


def _of_day(table: ForeignTable, name: str, pattern: str | None, source: str) -> Floats:
    """Seconds since the first time of day."""
    texts = table.column(name, source)
    out = np.full(len(table), np.nan)
    first = None
    for i, text in enumerate(texts):
        if not (written := str(text).strip()) or written == "nan":
            continue
        try:
            moment = parsed(written, pattern)
        except (ValueError, OverflowError) as e:
            line = f"{source}: line {table.lines[i]}: column {name!r}: {written[:40]!r}"
            way = "correct format" if pattern else 'say format = "%d.%m.%Y %H:%M:%S" or what fits'
            raise MeasurementError(f"{line} is no time ({e}); {way}") from e
        first = first or moment
        out[i] = (moment - first).total_seconds()
    return out


def _put_in_order(time_s: Floats, table: ForeignTable, time: Time, source: str) -> RowClock:
    notes = []
    falls = np.flatnonzero(np.diff(time_s) < 0) + 1
    if len(falls) and not time.restarts:
        i = falls[0]
        raise MeasurementError(
            f"{source}: line {table.lines[i]}: time falls from {time_s[i - 1]:.10g} to {time_s[i]:.10g} s "
            f"({len(falls)} times in all); if every run starts its clock again: [time] restarts = true, "
            "else put the rows in order"
        )
    if len(falls):
        time_s = time_s.copy()
        for i in falls:
            time_s[i:] += time_s[i - 1] + time.restart_gap_s - time_s[i]
        notes.append(f"the clock starts again {len(falls)} times; {time.restart_gap_s:g} s are put between")
    if time.from_zero and len(time_s) and time_s[0] != 0.0:
        notes.append(f"time 0 is {time_s[0]:.10g} s of the file")
        time_s = time_s - time_s[0]
    return RowClock(time_s, falls, tuple(notes))


def runs(
    table: ForeignTable, run: Run, clock: RowClock, columns: Mapping[str, Floats], source: str
) -> tuple[Ints, list[str]]:
    """Run number of each row, from 1, and what to tell about it.

    Args:
        table: of the file.
        run: what begins a run.
        clock: where it starts again a run begins in any case.
        columns: of the measurement, for positions.
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
        return values.astype(np.int64), [f"{len(np.unique(values))} runs by column {run.column!r}"]
    begins = np.zeros(len(table), dtype=np.bool_)
    begins[clock.restarts] = True
    if run.direction_of is not None:
        begins |= _reversals(run.direction_of, run.dead_band_mm, columns, source)
    if run.gap_s is not None:
        begins |= np.diff(clock.time_s, prepend=clock.time_s[:1]) > run.gap_s
    if run.jump_mm is not None:
        for name in (n for n in columns if n.endswith("_mm")):
            begins |= np.abs(np.diff(columns[name], prepend=columns[name][:1])) > run.jump_mm
    numbers = 1 + np.cumsum(begins).astype(np.int64)
    return numbers, [f"{numbers[-1]} runs" if numbers[-1] > 1 else "all rows are one run"]


def _reversals(name: str, dead_band_mm: float, columns: Mapping[str, Floats], source: str) -> NDArray[np.bool_]:
    positions = [n for n in columns if n.endswith("_mm")]
    if name not in positions:
        raise MeasurementError(f"{source}: [run] direction_of = {name!r} is no position{nearest(name, positions)}")
    direction = direction_track(np.ascontiguousarray(columns[name]), dead_band_mm)
    before = np.concatenate([direction[:1], direction[:-1]])
    return np.asarray((direction != before) & (before != 0.0))

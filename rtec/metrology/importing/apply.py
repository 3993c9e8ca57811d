"""Applies a map: turns a table of another program into the columns of a measurement, with notes on every step."""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import numpy as np

from rtec.arrays import Bools, Floats
from rtec.errors import MeasurementError
from rtec.files import check_named
from rtec.machine import Machine
from rtec.metrology.files.columns import is_own
from rtec.metrology.files.load import Column as Values
from rtec.metrology.files.load import write_files
from rtec.metrology.files.toml import TABLES
from rtec.metrology.importing.clock import runs, seconds
from rtec.metrology.importing.cycles import from_cycles
from rtec.metrology.importing.frame import of_frame
from rtec.metrology.importing.map import Column, ImportMap, RowRules, TemperatureLog
from rtec.metrology.importing.rows import condition, from_events
from rtec.metrology.importing.temperature_log import LoggedTemperatures, matched
from rtec.metrology.measurement import Measurement
from rtec.metrology.readers import read_tables
from rtec.metrology.readers.base import ForeignTable, Texts
from rtec.metrology.units import convert, unit_of_column
from rtec.metrology.unread import not_read, varies
from rtec.result import Kind, Result, frame
from rtec.text import clean
from rtec.tomlfile import nearest

ROTARY = re.compile(r"[abc]_deg|angle_deg")
"""Angles of rotary axes, which nothing reads; one is that of a ball bar's circle, too."""
PLACE = re.compile(r"[a-z][a-z0-9]*_mm")
MOST_NAMED = 20
LEAST_TRAVEL_MM = 1.0
DOUBTFUL, LIKE = 0.01, 0.1
"""Machines err by less than the first share of the travel; readings that differ from positions by less than the second
are positions."""


NO_WORD = re.compile(r"[^\w%°/().+\[\] -]")
COPY, FEW = 0.98, 3
"""Correlation from which on a column is a copy of another one; fewest values that show it."""


@dataclass(frozen=True)
class Imported(Result):
    """The result of an import.

    Attributes:
        columns: columns of the measurement, (n,) each, `run` and `time_s` first.
        reader: name of the reader.
        rows_in, rows_out: number of rows of the file and of the measurement.
        notes: every step of the import, in words.
        unread: columns that nothing reads, kept for `rtec diagnose`: readings may follow one.
        measurement: the measurement, read back and checked, where a machine was given.
        table: path of the written table.
        map: path of the written map, where it was proposed.
    """

    page_maker: ClassVar[str] = "rtec.report.overview:imported_page"

    columns: dict[str, Values] = field(repr=False)
    reader: str
    rows_in: int
    rows_out: int
    notes: tuple[str, ...]
    unread: tuple[str, ...] = ()
    measurement: Measurement | None = None
    table: Path | None = None
    map: Path | None = None

    def facts(self) -> dict[str, Any]:
        """The result as plain data; keys as in the documented JSON."""
        read = self.measurement
        return {
            "table": str(self.table) if self.table else None,
            "map": str(self.map) if self.map else None,
            "reader": self.reader,
            "rows_in": self.rows_in,
            "rows_out": self.rows_out,
            "columns": list(self.columns),
            "notes": list(read.notes if read else self.notes),
            "checked": read is not None,
            "sha256": read.sha256 if read else "",
        }

    def to_frame(self, kind: Kind | None = None) -> Any:
        """The rows of the measurement; `kind` as for `rtec.result.Shown.to_frame`."""
        return frame(self.columns, kind)


@np.errstate(over="ignore", invalid="ignore")  # a number that becomes infinite is refused where it is written
def import_table(paths: Path | Sequence[Path], how: ImportMap) -> Imported:
    """Read a file of another program by a map, or several files of the same form as consecutive runs.

    If the files have dates, these give their order and the time between them; else the files are in the given order.

    Raises:
        MeasurementError: a file or the map is wrong; the message has line, column or key, and a remedy.
    """
    files = [paths] if isinstance(paths, Path) else list(paths)
    log = _log(how.temperatures, files[0]) if how.temperatures is not None else None
    parts = [_part(files[0], how, log), *(_next_part(path, files[0], how, log) for path in files[1:])]
    return parts[0].imported if len(parts) == 1 else _joined(parts, how)


@dataclass(frozen=True)
class _Part:
    """The rows of one file, and the time at which it begins."""

    path: Path
    imported: Imported
    began: datetime | None


def _next_part(path: Path, first: Path, how: ImportMap, log: LoggedTemperatures | None) -> _Part:
    try:
        return _part(path, how, log)
    except MeasurementError as e:
        if "there is no column" not in str(e):
            raise
        way = f"{path}: is read like {first.name}, as a further run of it; a log of temperatures goes to --temperatures"
        raise MeasurementError(f"{e}\n{way}") from e


def _log(how: TemperatureLog, beside: Path) -> LoggedTemperatures:
    """Read a log of temperatures; a relative path starts beside the imported file. A note names what is not used."""
    path = beside.parent / how.file
    _, tables = read_tables(path, how.source)
    table = chosen(tables, how.source.table, str(path))
    if how.events is not None:
        table = from_events(table, how.events.channel, how.events.value, how.events.unit, str(path))
    keep = _kept(table, how.rows, str(path), [])
    columns = {n: _column(table, n, c, keep, str(path))[0][keep] for n, c in how.column.items()}
    used = {how.time.column, how.time.date, *_sources(how.column)}
    unused = [n for n in table.columns if n not in used]
    notes = (f"columns of {path.name} not used: {_named(table, unused)}",) if unused else ()
    return LoggedTemperatures(str(path), seconds(table.rows(keep), how.time, str(path)), columns, notes)


def _part(path: Path, how: ImportMap, log: LoggedTemperatures | None) -> _Part:
    reader, tables = read_tables(path, how.source)
    table = chosen(tables, how.source.table, str(path))
    notes = [f"read as {reader}" + ("" if how.source.reader else ", as it looks"), *table.notes]
    rows_in = len(table)
    if how.events is not None:
        table = from_events(table, how.events.channel, how.events.value, how.events.unit, str(path))
        notes.append(table.notes[-1])
    if how.cycles is not None:
        table = from_cycles(table, **how.cycles.model_dump(), source=str(path))
        notes.append(table.notes[-1])
    keep = _kept(table, how.rows, str(path), notes)
    unused = _unused(table, how, notes)
    columns: dict[str, Floats] = {}
    faults = []
    for name, column in how.column.items():
        try:
            columns[name], remarks = _column(table, name, column, keep, str(path))
            notes += remarks
        except MeasurementError as e:
            faults.append(str(e))
    if faults:
        raise MeasurementError("\n".join(faults))
    keep = _after_first(columns, how, keep, str(path), notes)
    columns = {n: v[keep] for n, v in columns.items()}
    frame = of_frame(columns, how.setup, str(path)) if how.measurement.instrument == "tool_tip" else []
    notes = [*frame, *_doubts(columns, str(path)), *notes]
    table = table.rows(keep)
    clock = seconds(table, how.time, str(path))
    notes += clock.notes
    run, remarks = runs(table, how.run, clock, columns, str(path))
    notes += remarks
    if log is not None:
        more, remarks = matched(clock, str(path), log)
        columns |= more
        notes += remarks
    out: dict[str, Values] = {"run": run, "time_s": clock.time_s, **columns}
    of_circle = {"angle_deg"} if how.measurement.instrument == "ball_bar" else set()
    angles = {n: v for n, v in columns.items() if ROTARY.fullmatch(n) and n not in of_circle}
    unread = {n: v[keep] for n, v in unused.items()} | angles
    if said := not_read({n: v for n, v in unread.items() if varies(n, v)}):
        notes.append(said)
    kept = _kept_unread({n: v for n, v in unread.items() if n not in columns}, out)
    whole = Imported(out | kept, reader, rows_in, len(table), tuple(notes), tuple(kept))
    return _Part(path, whole, clock.began)


def _kept_unread(unread: Mapping[str, Floats], columns: Mapping[str, Values]) -> dict[str, Values]:
    """Columns that nothing reads, by plain names: complete ones that vary, and are no copy of what is read."""
    read = [np.asarray(v, dtype=np.float64) for v in columns.values()]
    out: dict[str, Values] = {}
    for name, values in unread.items():
        plain = NO_WORD.sub("_", name).strip("_ ") or "unread"
        if np.isfinite(values).all() and varies(name, values) and not any(_copies(values, v) for v in read):
            out |= {plain: values} if plain not in {*columns, *out} else {}
    return out


def _own_name(name: str, machine: Machine | None) -> str:
    """The name under which a column that nothing reads is kept, so that it is no name of rtec's; empty for none."""
    if machine is None:
        return ""
    return next((n for n in (name, f"column {name}") if is_own(n, machine)), "")


def _copies(one: Floats, other: Floats) -> bool:
    """Whether two columns are the same but for scale and zero, or nearly."""
    there = np.isfinite(other)
    if there.sum() < FEW or not np.ptp(one[there]) > 0.0 or not np.ptp(other[there]) > 0.0:
        return False
    return abs(float(np.corrcoef(one[there], other[there])[0, 1])) > COPY


def _joined(parts: Sequence[_Part], how: ImportMap) -> Imported:
    """Join files; the time between them is that of their dates, else `restart_gap_s`, with a note."""
    dates = [p.began for p in parts if p.began is not None]
    dated = len(dates) == len(parts)
    if dated:
        parts = sorted(parts, key=lambda p: p.began or dates[0])
    notes = [n for n in parts[0].imported.notes if all(n in p.imported.notes for p in parts)]
    columns: dict[str, list[Values]] = {n: [] for n in parts[0].imported.columns}
    end_s, runs_before = 0.0, 0
    kept = tuple(n for n in parts[0].imported.unread if all(n in p.imported.unread for p in parts))
    columns = {n: v for n, v in columns.items() if n in kept or n not in parts[0].imported.unread}
    for i, part in enumerate(parts):
        one = part.imported.columns
        time_s = np.asarray(one["time_s"], dtype=np.float64)
        start_s = end_s + how.time.restart_gap_s if i else 0.0
        if dated and part.began is not None:
            start_s = (part.began - min(dates)).total_seconds()
            if i and start_s < end_s:
                raise MeasurementError(
                    f"{part.path}: begins at {part.began:%Y-%m-%d %H:%M:%S}, before {parts[i - 1].path.name} ends; "
                    "files of one measurement follow one another"
                )
        own, run = np.unique(one["run"], return_inverse=True)
        for name, values in columns.items():
            values.append(one[name])
        columns["time_s"][-1] = time_s - time_s[0] + start_s
        columns["run"][-1] = run + 1 + runs_before
        when = f", from {part.began:%Y-%m-%d %H:%M:%S}" if part.began else ""
        number = (
            f"runs {runs_before + 1} to {runs_before + len(own)} are" if len(own) > 1 else f"run {runs_before + 1} is"
        )
        notes.append(f"{number} {part.path.name}{when}")
        notes += [f"{part.path.name}: {n}" for n in part.imported.notes if n not in notes]
        runs_before += len(own)
        end_s = float(columns["time_s"][-1][-1])
    if not dated:
        notes.append(
            f"the files have no dates: they follow as given, {how.time.restart_gap_s:g} s apart, which is made up"
        )
    joined: dict[str, Values] = {n: np.concatenate([x.astype(np.float64) for x in v]) for n, v in columns.items()}
    joined["run"] = joined["run"].astype(np.int64)
    rows_in, rows_out = (sum(getattr(p.imported, f) for p in parts) for f in ("rows_in", "rows_out"))
    return Imported(joined, parts[0].imported.reader, rows_in, rows_out, tuple(notes), kept)


def import_measurement(paths: Path | Sequence[Path], how: ImportMap, machine: Machine) -> Measurement:
    """Import as a measurement in memory, with all checks of a measurement file.

    Raises:
        MeasurementError: as `import_to_files`.
    """
    first = paths if isinstance(paths, Path) else paths[0]
    with TemporaryDirectory() as folder:
        try:
            done = import_to_files(paths, how, Path(folder) / f"{first.stem}.csv", machine)
        except MeasurementError as e:
            raise MeasurementError(str(e).replace(f"{folder}/", "")) from e
    assert done.measurement is not None  # noqa: S101 (a machine was given)
    return done.measurement


def import_to_files(
    paths: Path | Sequence[Path],
    how: ImportMap,
    out: Path,
    machine: Machine | None = None,
    *,
    reader: str | None = None,
    drop_bad_rows: bool = False,
    missing_codes: Sequence[str] = (),
    force: bool = False,
) -> Imported:
    """Import and write NAME.csv (or .parquet) and NAME.toml.

    Args:
        paths: file of the other program, or several as runs.
        how: the map.
        out: NAME, NAME.csv or NAME.parquet.
        machine: where given, the result is read back as a measurement of it, with all checks.
        reader: reader to use instead of the map's.
        drop_bad_rows, missing_codes: what the user accepts; written into `[table]` of NAME.toml.
        force: overwrite existing files.

    Returns:
        The result, with the measurement where a machine was given, and the path of the table.

    Raises:
        MeasurementError: as `import_table` and, for the result, as `load_measurement`.
    """
    from rtec.metrology.files.load import load_measurement

    check_named(out, MeasurementError)
    table = out if out.suffix in TABLES else out.with_name(out.name + ".csv")
    _may_write(table, [paths] if isinstance(paths, Path) else paths, force=force)
    if reader is not None:
        how = how.model_copy(update={"source": how.source.model_copy(update={"reader": reader})})
    words = tuple(code for code in missing_codes if _number(code) is None)
    if words:
        known = how.source.model_copy(update={"missing": (*how.source.missing, *words)})
        how = how.model_copy(update={"source": known})
    done = import_table(paths, how)
    head: dict[str, Any] = how.measurement.model_dump(mode="json")
    files = [paths] if isinstance(paths, Path) else paths
    head["notes"] = [*head["notes"], f"imported from {', '.join(p.name for p in files)}", *done.notes]
    numbers = [n for code in missing_codes if (n := _number(code)) is not None]
    accepted = {"drop_bad_rows": drop_bad_rows or None, "missing_codes": numbers or None}
    names = {n: _own_name(n, machine) for n in done.unread}
    done = replace(done, columns={names.get(n, n): v for n, v in done.columns.items() if names.get(n, n)})
    if machine is None:
        write_files(table, done.columns, head, how.setup, accepted)
        return replace(done, table=table)
    with _replacing(table) as new:
        write_files(new, done.columns, head, how.setup, accepted)
        try:
            read = load_measurement(new, machine)
        except MeasurementError as e:
            raise MeasurementError(str(e).replace(str(new.parent), str(table.parent))) from e
    return replace(done, measurement=read, table=table)


@contextmanager
def _replacing(table: Path) -> Iterator[Path]:
    """A place beside a table, from which it and its TOML move to their own places; after an error nothing is there."""
    try:
        table.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=".import-", dir=table.parent) as folder:
            new = Path(folder) / table.name
            yield new
            for file in (new, new.with_suffix(".toml")):
                file.replace(table.with_name(file.name))
    except OSError as e:
        raise MeasurementError(f"{table}: cannot be written: {e.strerror}") from e


def _number(text: str) -> float | None:
    """A finite number; None for a word, which NaN is, too."""
    try:
        number = float(text)
    except ValueError:
        return None
    return number if np.isfinite(number) else None


def _may_write(table: Path, inputs: Sequence[Path], *, force: bool) -> None:
    there = [p for p in (table, table.with_name(f"{table.stem}.toml")) if p.exists()]
    if own := [p for p in there if any(p.samefile(i) for i in inputs if i.exists())]:
        raise MeasurementError(f"{own[0]}: is imported here and must not be written over; give another name by -o")
    if there and not force:
        raise MeasurementError(f"{there[0]}: is there already; another name, or --force to write over it")


def chosen(tables: Sequence[ForeignTable], name: str | None, source: str) -> ForeignTable:
    """The table of that name; without a name, the only one.

    Raises:
        MeasurementError: there is no table of that name, or several where no name is given.
    """
    names = [t.name for t in tables]
    if name is None:
        if len(tables) > 1:
            raise MeasurementError(
                f"{source}: holds {len(tables)} tables; say [source] table = one of {', '.join(names)}"
            )
        return tables[0]
    if name not in names:
        raise MeasurementError(f"{source}: [source] table {name!r} is not there{nearest(name, names)}")
    return tables[names.index(name)]


def _kept(table: ForeignTable, rules: RowRules, source: str, notes: list[str]) -> Bools:
    """Rows that fulfil `[rows]`, (n,)."""
    keep = np.ones(len(table), dtype=np.bool_)
    for name in rules.require:
        values = table.column(name, source)
        keep &= values != "" if values.dtype == np.object_ else np.isfinite(values.astype(np.float64))
    if not keep.any():
        raise MeasurementError(f"{source}: no row has a value in all of {', '.join(rules.require)}; no row remains")
    if dropped := int((~keep).sum()):
        notes.append(f"{dropped} rows without {', '.join(rules.require)} left out")
    if rules.where is not None:
        before = int(keep.sum())
        keep &= condition(rules.where).holds(table, source)
        notes.append(f"{before - int(keep.sum())} rows left out where not {rules.where}")
        if not keep.any():
            raise MeasurementError(f"{source}: [rows] where = {rules.where!r} holds in no row; no row remains")
    return keep


def _after_first(columns: Mapping[str, Floats], how: ImportMap, keep: Bools, source: str, notes: list[str]) -> Bools:
    """The kept rows without those before the first value of any held column, (n,)."""
    for name, column in how.column.items():
        if column.fill is None:
            continue
        early = keep & np.isnan(columns[name])
        if early.any() and np.isfinite(columns[name]).any():
            notes.append(f"{int(early.sum())} rows before the first value of {name} left out")
            keep = keep & ~early
    if not keep.any():
        raise MeasurementError(f"{source}: no row comes after the first value of every held column; no row remains")
    return keep


def _held(values: Floats) -> Floats:
    last = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), 0))
    return values[last]


def _doubts(columns: Mapping[str, Floats], source: str) -> list[str]:
    """Notes on readings that vary with the travel by more than machines err.

    Raises:
        MeasurementError: they are the positions themselves, or the negative.
    """
    place = max((v for n, v in columns.items() if PLACE.fullmatch(n)), key=_spread, default=np.zeros(0))
    if (travel_mm := _spread(place)) < LEAST_TRAVEL_MM:
        return []
    out = []
    for name, values in columns.items():
        if not name.startswith("reading") or not name.endswith("_um"):
            continue
        read_mm = 1e-3 * values
        said = f"{name} varies by {_spread(read_mm):.4g} mm over a travel of {travel_mm:.4g} mm"
        if min(_spread(read_mm - place), _spread(read_mm + place)) < LIKE * travel_mm:
            raise MeasurementError(
                f"{source}: {said}: these are positions, no deviations; correct from, minus or unit of [column.{name}]"
            )
        if _spread(read_mm) > DOUBTFUL * travel_mm:
            out.append(f"doubtful: {said}; are these deviations, and in the right unit?")
    return out


def _spread(values: Floats) -> float:
    """Range between the quartiles, twice: outliers do not count."""
    known = values[np.isfinite(values)]
    return float(2.0 * np.subtract(*np.percentile(known, (75.0, 25.0)))) if len(known) else 0.0


def _unused(table: ForeignTable, how: ImportMap, notes: list[str]) -> dict[str, Floats]:
    """The columns of numbers that are not used, (n,) each; and a note on all that are not used."""
    used = {how.time.column, how.time.date, how.run.column, *_sources(how.column)}
    unused = [n for n in table.columns if n not in used]
    if unused:
        notes.append(f"columns of the file not used: {_named(table, unused)}")
    numbers = [n for n in unused if table.columns[n].dtype != np.object_]
    return {n: table.columns[n].astype(np.float64) for n in numbers}


def _sources(columns: Mapping[str, Column]) -> set[str | None]:
    """The columns of a file that the columns of a measurement come from."""
    return {n for c in columns.values() for n in (c.from_, c.minus)}


def _named(table: ForeignTable, unused: Sequence[str]) -> str:
    """The names of columns that are not used, the first ones of many."""
    some = ", ".join(n + _words_in(table.columns[n]) for n in unused[:MOST_NAMED])
    return some + (" …" if len(unused) > MOST_NAMED else "")


def _words_in(cells: Floats | Texts) -> str:
    """Why a column is none of numbers; empty for one that is."""
    first = next((str(c) for c in cells if str(c)), "") if cells.dtype == np.object_ else ""
    return f" (no numbers: {clean(first[:20])!r})" if first else ""


def _column(table: ForeignTable, name: str, column: Column, keep: Bools, source: str) -> tuple[Floats, list[str]]:
    """One column of the measurement, in all rows of the file, and notes on its conversion."""
    target = unit_of_column(name)
    if column.value is not None:
        return _constant(len(table), name, column.value, column.unit or target, source)
    values = _numbers(table, column, keep, source)
    unit = _unit(table, name, column, target, source)
    notes = []
    for code in column.missing_codes:
        hit = np.isclose(values, code, rtol=1e-9, atol=0.0)
        values = np.where(hit, np.nan, values)
        notes.append(f"{name}: {code:g} taken as missing in {int((hit & keep).sum())} rows")
    if column.fill == "hold":
        held = _held(values)
        gaps = int((np.isnan(values) & np.isfinite(held) & keep).sum())
        notes.append(f"column {column.from_!r}: last value held in {gaps} rows")
        values = held
    try:
        if column.minus is not None:
            less = _unit_of_minus(table, name, column, unit, source)
            values = values - convert(table.numbers(column.minus, source), less, unit)
        if column.take is not None:
            values = _taken(values, column, table, source)
        values = convert(values * (column.scale * column.sign), unit, target)
    except ValueError as e:
        raise MeasurementError(f"{source}: [column.{name}] {e}") from e
    done = f"{name} from {column.from_!r}"
    done += f" minus {column.minus!r}" if column.minus else ""
    done += {"sum": ", added up", "difference": ", each minus the one before"}.get(column.take or "", "")
    done += f" × {column.scale * column.sign:g}" if column.scale * column.sign != 1.0 else ""
    done += f", {unit} to {target}" if unit != target else ""
    done += f" {'+' if column.offset > 0.0 else '-'} {abs(column.offset):.10g}" if column.offset else ""
    return values + column.offset, [done, *notes]


def _constant(rows: int, name: str, value: float, unit: str, source: str) -> tuple[Floats, list[str]]:
    """A column that is the same in every row, and a note on it."""
    target = unit_of_column(name)
    try:
        values = convert(np.full(rows, value), unit, target)
    except ValueError as e:
        raise MeasurementError(f"{source}: [column.{name}] {e}") from e
    return values, [f"{name} is {value:.10g} in every row" + (f", {unit} to {target}" if unit != target else "")]


def _taken(values: Floats, column: Column, table: ForeignTable, source: str) -> Floats:
    """Cumulative sums or differences, as `take` requires; the first row has no difference."""
    if column.take == "difference":
        return np.concatenate([[np.nan], np.diff(values)])
    lost = np.flatnonzero(np.isnan(values))
    if len(lost):
        raise MeasurementError(
            f"{source}: line {table.lines[lost[0]]}: column {column.from_!r}: no step ({len(lost)} in all), so that no "
            "sum after it is known; fill in 0 where nothing moved, or take from a column without gaps"
        )
    return np.cumsum(values)


def _numbers(table: ForeignTable, column: Column, keep: Bools, source: str) -> Floats:
    values = table.column(column.from_, source)
    if not column.values or values.dtype != np.object_:
        return table.numbers(column.from_, source)
    out = np.empty(len(values))
    for i, text in enumerate(values):
        if text and text not in column.values and keep[i]:
            raise MeasurementError(
                f"{source}: line {table.lines[i]}: column {column.from_!r}: {text!r} has no meaning in values"
                f"{nearest(text, column.values)}"
            )
        out[i] = column.values.get(text, np.nan)
    return out


def _unit(table: ForeignTable, name: str, column: Column, target: str, source: str) -> str:
    """The unit of the file's numbers: the map's or the reader's, which must agree."""
    unit = _agreed(table.units.get(column.from_, ""), column.unit, name, "unit", column.from_, source)
    if not unit and target != "1":
        raise MeasurementError(f"{source}: [column.{name}] nobody tells the unit of {column.from_!r}; say unit = …")
    return unit or target


def _unit_of_minus(table: ForeignTable, name: str, column: Column, unit: str, source: str) -> str:
    """The unit of the subtracted numbers; of two columns without a unit it is the same."""
    minus = column.minus or ""
    less = _agreed(table.units.get(minus, ""), column.minus_unit, name, "minus_unit", minus, source)
    if not less and table.units.get(column.from_):
        raise MeasurementError(f"{source}: [column.{name}] nobody tells the unit of {minus!r}; say minus_unit = …")
    return less or unit


def _agreed(own: str, given: str | None, name: str, key: str, of: str, source: str) -> str:
    if given and own and own not in (given, "1"):
        raise MeasurementError(
            f"{source}: [column.{name}] {key} = {given!r}, but the file says that {of!r} is in {own}; "
            f"leave {key} out, or use scale"
        )
    return given or own

"""Applying a map: a table of another program becomes the columns of a measurement, and says what it did."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from rtec.errors import MeasurementError
from rtec.frames import Kind, frame
from rtec.machine import Machine
from rtec.metrology.files.save import Column as Values
from rtec.metrology.files.save import write_files
from rtec.metrology.files.table import Floats
from rtec.metrology.files.toml import TABLES
from rtec.metrology.importing.clock import runs, seconds
from rtec.metrology.importing.map import Column, ImportMap
from rtec.metrology.measurement import Measurement
from rtec.metrology.readers import read_tables
from rtec.metrology.readers.base import ForeignTable
from rtec.metrology.units import convert, unit_of_column
from rtec.result import Result
from rtec.tomlfile import nearest


@dataclass(frozen=True)
class Imported(Result):
    """What came out of a table.

    Attributes:
        columns: of the measurement, (n,) each, `run` and `time_s` first.
        reader: that read the file.
        rows_in, rows_out: rows of the file and of the measurement.
        notes: everything that was done, in words.
        measurement: what was read back and checked, where a machine was named.
        table: the file that was written.
    """

    page_maker: ClassVar[str] = "rtec.report.measurement:imported_page"

    columns: dict[str, Values]
    reader: str
    rows_in: int
    rows_out: int
    notes: tuple[str, ...]
    measurement: Measurement | None = None
    table: Path | None = None

    def facts(self) -> dict[str, Any]:
        """What was imported; keys as in the documented JSON."""
        read = self.measurement
        return {
            "table": str(self.table) if self.table else None,
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


def import_table(path: Path, how: ImportMap) -> Imported:
    """Read a file of another program by a map.

    Raises:
        MeasurementError: the file or the map is wrong; names line, column or key, and a way on.
    """
    reader, tables = read_tables(path, how.source)
    table = _chosen(tables, how.source.table, str(path))
    notes = [f"read as {reader}" + ("" if how.source.reader else ", as it looks"), *table.notes]
    rows_in = len(table)
    table, left_out = _required(table, how, str(path))
    notes += left_out
    _unused(table, how, notes)
    clock = seconds(table, how.time, str(path))
    notes += clock.notes
    columns: dict[str, Floats] = {}
    faults = []
    for name, column in how.column.items():
        try:
            columns[name], told = _column(table, name, column, str(path))
            notes += told
        except MeasurementError as e:
            faults.append(str(e))
    if faults:
        raise MeasurementError("\n".join(faults))
    run, told = runs(table, how.run, clock, columns, str(path))
    notes += told
    out: dict[str, Values] = {"run": run, "time_s": clock.time_s, **columns}
    return Imported(out, reader, rows_in, len(table), tuple(notes))


def import_to_files(
    path: Path,
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
        path: file of the other program.
        how: the map.
        out: NAME, NAME.csv or NAME.parquet.
        machine: where given, the result is read back as a measurement of it, with all checks.
        reader: takes the place of the map's.
        drop_bad_rows, missing_codes: what the user accepts; written into `[table]` of NAME.toml.
        force: write over files that are there.

    Returns:
        What was done, with the measurement where a machine was given, and the path of the table.

    Raises:
        MeasurementError: as `import_table` and, for the result, as `load_measurement`.
    """
    from rtec.metrology.files.load import load_measurement

    table = out if out.suffix in TABLES else out.with_name(out.name + ".csv")
    _may_write(table, force=force)
    if reader is not None:
        how = how.model_copy(update={"source": how.source.model_copy(update={"reader": reader})})
    words = tuple(code for code in missing_codes if _number(code) is None)
    if words:
        known = how.source.model_copy(update={"missing": (*how.source.missing, *words)})
        how = how.model_copy(update={"source": known})
    done = import_table(path, how)
    head: dict[str, Any] = how.measurement.model_dump(mode="json")
    head["notes"] = [*head["notes"], f"imported from {path.name}", *done.notes]
    numbers = [n for code in missing_codes if (n := _number(code)) is not None]
    accepted = {"drop_bad_rows": drop_bad_rows or None, "missing_codes": numbers or None}
    write_files(table, done.columns, head, how.setup, accepted)
    read = load_measurement(table, machine) if machine is not None else None
    return replace(done, measurement=read, table=table)


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _may_write(table: Path, *, force: bool) -> None:
    there = [p for p in (table, table.with_name(table.stem + ".toml")) if p.exists()]
    if there and not force:
        raise MeasurementError(f"{there[0]}: is there already; another name, or --force to write over it")


def _chosen(tables: list[ForeignTable], name: str | None, source: str) -> ForeignTable:
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


def _required(table: ForeignTable, how: ImportMap, source: str) -> tuple[ForeignTable, list[str]]:
    """Leave out rows that lack what `[rows] require` names; held values are carried over them first."""
    held = {c.from_ for c in how.column.values() if c.fill == "hold"}
    keep = np.ones(len(table), dtype=np.bool_)
    for name in how.rows.require:
        values = table.column(name, source)
        keep &= values != "" if values.dtype == np.object_ else np.isfinite(values.astype(np.float64))
    if not keep.any():
        raise MeasurementError(f"{source}: no row has a value in all of {', '.join(how.rows.require)}; no row remains")
    carried = {n: _held(table.numbers(n, source)) for n in held if n in table.columns}
    columns = {n: (carried.get(n, v))[keep] for n, v in table.columns.items()}
    dropped = int((~keep).sum())
    notes = [f"{dropped} rows without {', '.join(how.rows.require)} left out"] if dropped else []
    for name, values in carried.items():
        gaps = int((np.isnan(table.numbers(name, source)) & np.isfinite(values) & keep).sum())
        notes.append(f"column {name!r}: last value held in {gaps} rows")
    return ForeignTable(table.name, columns, table.units, table.lines[keep], table.notes, table.wrong), notes


def _held(values: Floats) -> Floats:
    last = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), 0))
    return values[last]


def _unused(table: ForeignTable, how: ImportMap, notes: list[str]) -> None:
    used = {how.time.column, how.run.column} | {n for c in how.column.values() for n in (c.from_, c.minus)}
    unused = [n for n in table.columns if n not in used]
    if unused:
        notes.append(f"columns of the file not used: {', '.join(unused[:20])}" + (" …" if len(unused) > 20 else ""))


def _column(table: ForeignTable, name: str, column: Column, source: str) -> tuple[Floats, list[str]]:
    """One column of the measurement and what was done for it."""
    values = _numbers(table, column, source)
    target = unit_of_column(name)
    unit = _unit(table, name, column, target, source)
    notes = []
    for code in column.missing_codes:
        hit = np.isclose(values, code, rtol=1e-9, atol=0.0)
        values = np.where(hit, np.nan, values)
        notes.append(f"{name}: {code:g} taken as missing in {int(hit.sum())} rows")
    if column.minus is not None:
        values = values - table.numbers(column.minus, source)
    try:
        values = convert(values * (column.scale * column.sign), unit, target)
    except ValueError as e:
        raise MeasurementError(f"{source}: [column.{name}] {e}") from e
    done = f"{name} from {column.from_!r}"
    done += f" minus {column.minus!r}" if column.minus else ""
    done += f" × {column.scale * column.sign:g}" if column.scale * column.sign != 1.0 else ""
    done += f", {unit} to {target}" if unit != target else ""
    done += f" + {column.offset:g}" if column.offset else ""
    return values + column.offset, [done, *notes]


def _numbers(table: ForeignTable, column: Column, source: str) -> Floats:
    values = table.column(column.from_, source)
    if not column.values or values.dtype != np.object_:
        return table.numbers(column.from_, source)
    out = np.empty(len(values))
    for i, text in enumerate(values):
        if text and text not in column.values:
            raise MeasurementError(
                f"{source}: line {table.lines[i]}: column {column.from_!r}: {text!r} has no meaning in values"
                f"{nearest(text, column.values)}"
            )
        out[i] = column.values.get(text, np.nan)
    return out


def _unit(table: ForeignTable, name: str, column: Column, target: str, source: str) -> str:
    """The unit of the file's numbers: the map's, or the reader's; they may not differ."""
    told = table.units.get(column.from_, "")
    if column.unit and told and told not in (column.unit, "1"):
        raise MeasurementError(
            f"{source}: [column.{name}] unit = {column.unit!r}, but the file says that {column.from_!r} is in {told}; "
            "leave unit out, or use scale"
        )
    if column.minus is not None and told and table.units.get(column.minus, told) != told:
        raise MeasurementError(f"{source}: [column.{name}] {column.from_!r} and {column.minus!r} differ in unit")
    unit = column.unit or told
    if not unit and target != "1":
        raise MeasurementError(f"{source}: [column.{name}] nobody tells the unit of {column.from_!r}; say unit = …")
    return unit or target

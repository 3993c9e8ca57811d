"""Text tables in general: perhaps a header, then rows of cells between delimiters or blanks, or with fixed widths."""

import csv
import itertools
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.errors import MeasurementError, first_line
from rtec.metrology.files.faults import Faults
from rtec.metrology.files.table import floats
from rtec.metrology.readers.base import WHERE, ForeignTable, SourceOptions, Texts, decoded, with_unit
from rtec.metrology.units import UNITS, canonical
from rtec.text import NUMBER

DELIMITERS = (";", "\t", ",", "|")
BEYOND_ASCII = 0x80
FEW = 1000
"""Number of rows that decide which columns are numbers; a shorter table is read cell by cell."""
NANS = ("nan", "NaN", "NAN")


def read(path: Path, source: SourceOptions, where: str = WHERE) -> list[ForeignTable]:
    """Read the only table of the file; `where` is how the user gives options, for messages.

    Raises:
        MeasurementError: the file is no text, has no rows, or rows of another length than the header; by line.
    """
    text, notes = decoded(path, source.encoding)
    return [table_of(path, text, source, notes, where)]


def table_of(
    path: Path, text: str, source: SourceOptions, notes: tuple[str, ...] = (), where: str = WHERE
) -> ForeignTable:
    """The table in a text; see `read`."""
    lines = _Lines.of(text, source)
    if not len(lines.at):
        raise MeasurementError(
            f"{path}: no rows" + (f" after the first {source.skip_rows}" if source.skip_rows else "")
        )
    if source.delimiter is None and source.widths is None:
        source = source.model_copy(update={"delimiter": _delimiter(lines.part(0, 20).texts())})
        notes = (*notes, f"cells are divided by {source.delimiter!r}, as it seems")
    names, units, first = _header(path, lines.part(0, 2).texts(), source, where)
    rows = lines.part(first)
    if not len(rows.at):
        raise MeasurementError(f"{path}: no rows under the header")
    columns: dict[str, Floats | Texts] = {}
    wrong = {}
    table = _quick(path, rows, names, source, where) or _cells(path, rows, names, source, where)
    for name in names:
        columns[name], bad = _numbers_or_texts(table.column(name), source)
        if bad is not None and (found := _less_units(columns[name], units.get(name), source)) is not None:
            columns[name], units[name] = found
            bad = None
        if bad is not None:
            wrong[name] = (int(rows.at[bad]), str(columns[name][bad]))
    return ForeignTable(path.stem, columns, units, rows.at, notes, wrong, where, source.decimal)


@dataclass(frozen=True)
class _Lines:
    """Lines of a text, without blank lines, comments and skipped ones.

    Attributes:
        data: the whole text.
        at: line numbers, from 1, rising, (n,).
        first, last: start and end of each line in the data, (n,).
    """

    data: bytes
    at: Ints
    first: Ints
    last: Ints

    @classmethod
    def of(cls, text: str, source: SourceOptions) -> "_Lines":
        """The lines of a text."""
        data = text.encode()
        there = np.frombuffer(data, dtype=np.uint8)
        ends = np.flatnonzero(there == ord("\n")).astype(np.int64)
        first, last = np.append(0, ends + 1), np.append(ends, len(data))
        keep = last > first
        keep[: source.skip_rows] = False
        head = there[np.minimum(first, len(data) - 1)] if len(data) else np.zeros(1, dtype=np.uint8)
        for i in np.flatnonzero(keep & ((head <= ord(" ")) | (head >= BEYOND_ASCII))):
            keep[i] = bool(data[first[i] : last[i]].decode().strip())
        if mark := (source.comment or "").encode():
            for i in np.flatnonzero(keep & (head == mark[0])):
                keep[i] = not data.startswith(mark, first[i])
        at = np.flatnonzero(keep).astype(np.int64)
        return cls(data, at + 1, first[at], last[at])

    def part(self, start: int, stop: int | None = None) -> "_Lines":
        """The lines from `start` to before `stop`."""
        here = slice(start, stop)
        return _Lines(self.data, self.at[here], self.first[here], self.last[here])

    def texts(self) -> list[str]:
        """Each line as a text."""
        return [self.data[a:b].decode() for a, b in zip(self.first.tolist(), self.last.tolist(), strict=True)]

    def content(self) -> memoryview | bytes:
        """All lines, joined."""
        gaps = np.flatnonzero(np.diff(self.at) != 1) + 1
        ends = [0, *gaps.tolist(), len(self.at)]
        parts = [memoryview(self.data)[self.first[a] : self.last[b - 1]] for a, b in itertools.pairwise(ends)]
        return parts[0] if len(parts) == 1 else b"\n".join(parts)


def split(line: str, source: SourceOptions) -> list[str]:
    """The cells of one line, without blanks around them.

    Raises:
        csv.Error: a quote in it is not closed, or the line is no text.
    """
    if source.widths is not None:
        ends = list(itertools.accumulate(source.widths))
        # The last column extends to the end of the line, so that a wider number is not cut off.
        ends[-1] = max(ends[-1], len(line))
        return [line[a:b].strip() for a, b in zip([0, *ends], ends, strict=False)]
    if source.delimiter == " ":
        return line.split()
    return [cell.strip() for cell in next(csv.reader([line], delimiter=source.delimiter or ","), [])]


def _delimiter(lines: list[str]) -> str:
    """The delimiter that divides the first lines into equally many cells; a comma where none does."""
    alike = [d for d in DELIMITERS if len({line.count(d) for line in lines}) == 1 and d in lines[0]]
    seen = [d for d in DELIMITERS if d in lines[0]]
    return (alike or seen or [","])[0]


def _header(path: Path, lines: list[str], source: SourceOptions, where: str) -> tuple[list[str], dict[str, str], int]:
    """Names, units, and the number of lines with them."""
    try:
        cells = [split(line, source) for line in lines]
    except csv.Error as e:
        raise MeasurementError(f"{path}: {e}; is this a text table?") from e
    if not source.header:
        names = list(source.names or (f"c{i + 1}" for i in range(len(cells[0]))))
        return names, {n: u for n in names if (u := bracketed(n))}, 0
    names = [n or f"c{i + 1}" for i, n in enumerate(cells[0])]
    for name in names:
        if names.count(name) > 1:
            other = f", or {where} header = false with skip_rows and names = [ … ]" if where else ""
            raise MeasurementError(
                f"{path}: column {name!r} is {names.count(name)} times in the header; rename one{other}"
            )
    units = {n: u for n in names if (u := bracketed(n))}
    if not source.unit_row:
        return names, units, 1
    if len(cells) < 2:
        raise MeasurementError(f"{path}: unit_row = true, and there is no line under the header")
    return (
        names,
        units | {n: u for n, c in zip(names, cells[1], strict=False) if (u := unit_named(c.strip("[]() ")))},
        2,
    )


def bracketed(name: str) -> str:
    """The unit in a name like `Pos X [mm]` or `T1 (°C)`."""
    found = re.search(r"[\[(]([^\])]+)[\])]\s*$", name)
    return unit_named(found.group(1)) if found else ""


def unit_named(text: str) -> str:
    """The unit that a word means; empty where it is no unit."""
    try:
        return canonical(text) if text and text not in UNITS.keys() - {"1"} else text
    except ValueError:
        return ""


def _cells(path: Path, rows: _Lines, names: list[str], source: SourceOptions, where: str) -> Any:
    """All cells as texts."""
    import pyarrow as pa

    if source.widths is not None or source.delimiter == " ":
        cells = [split(line, source) for line in rows.texts()]
        if any(len(row) != len(names) for row in cells):
            _tell_widths(path, rows, len(names), source, where)
        return pa.table(
            {n: pa.array(column, pa.string()) for n, column in zip(names, zip(*cells, strict=True), strict=True)}
        )
    try:
        table = _parsed(rows, names, source, dict.fromkeys(names, pa.string()))
    except (pa.ArrowException, ValueError) as e:
        _tell_widths(path, rows, len(names), source, where)
        raise MeasurementError(f"{path}: not a table divided by {source.delimiter!r}: {first_line(e)}") from e
    if table.num_rows != len(rows.at):
        raise MeasurementError(f"{path}: {len(rows.at)} lines and {table.num_rows} rows: a quote is not closed?")
    return table


def _parsed(rows: _Lines, names: list[str], source: SourceOptions, types: dict[str, Any]) -> Any:
    """The table from Arrow's reader, with a type for each column."""
    import pyarrow as pa
    from pyarrow import csv as arrow_csv

    file: Any = pa.BufferReader(pa.py_buffer(rows.content()))
    return arrow_csv.read_csv(
        file,
        read_options=arrow_csv.ReadOptions(column_names=names, block_size=64 << 20),
        parse_options=arrow_csv.ParseOptions(delimiter=source.delimiter or ","),
        convert_options=arrow_csv.ConvertOptions(
            column_types=types, null_values=["", *NANS, *source.missing], decimal_point=source.decimal
        ),
    )


def _quick(path: Path, rows: _Lines, names: list[str], source: SourceOptions, where: str) -> Any:
    """The table, with numeric columns as numbers; None where anything in one is unusual.

    The first rows decide which columns are numeric.
    """
    import pyarrow as pa

    if len(rows.at) <= FEW or source.widths is not None or source.delimiter == " " or source.thousands:
        return None
    try:
        head = _cells(path, rows.part(0, FEW), names, source, where)
        numbers = {name for name in names if _numbers_or_texts(head.column(name), source)[1] is None}
        types = {name: pa.float64() if name in numbers else pa.string() for name in names}
        table = _parsed(rows, names, source, types)
    except (pa.ArrowException, ValueError, MeasurementError):
        return None
    return table if table.num_rows == len(rows.at) and all(_is_plain(table.column(n)) for n in numbers) else None


def _is_plain(column: Any) -> bool:
    """Whether all cells of a numeric column match `NUMBER`: Arrow also accepts words for infinity and NaN."""
    values = floats(column)
    return not np.isinf(values).any() and int(np.isnan(values).sum()) == column.null_count


def _tell_widths(path: Path, rows: _Lines, width: int, source: SourceOptions, where: str) -> None:
    faults = Faults(str(path))
    for line, number in zip(rows.texts(), rows.at.tolist(), strict=True):
        try:
            n = len(split(line, source))
        except csv.Error as e:
            faults.row("csv", number, str(e), "is this a text table?")
            continue
        if n != width:
            faults.row("width", number, f"has {n} cells, the header has {width}", _width_way(source, where))
    faults.raise_if_any()


def _width_way(source: SourceOptions, where: str) -> str:
    if not where:
        return f"is the delimiter {source.delimiter!r}? decimal commas? write decimals with a point"
    if source.widths is not None:
        return f"{where} widths = [ … ] has as many numbers as there are names"
    empty = "empty cells? widths = [ … ] instead of a delimiter; " if source.delimiter == " " else ""
    before = f"lines before the header: {where} skip_rows = …; after it: comment = …"
    return f"is the delimiter {source.delimiter!r}? {empty}{before}"


def _less_units(texts: Floats | Texts, unit: str | None, source: SourceOptions) -> tuple[Floats, str] | None:
    """A column whose cells have a number and its unit: the same in all, and that of the header if that has one."""
    import pyarrow as pa

    plain: list[str | None] = []
    for text in texts.tolist():
        cell = with_unit(text) if text else ("", unit)
        if cell is None or (unit is not None and cell[1] != unit):
            return None
        plain.append(cell[0] or None)
        unit = cell[1]
    values, bad = _numbers_or_texts(pa.chunked_array([pa.array(plain, pa.string())]), source)
    return None if bad is not None or unit is None else (values.astype(np.float64), unit)


def _numbers_or_texts(column: Any, source: SourceOptions) -> tuple[Floats | Texts, int | None]:
    """A column as numbers if all its cells are numbers; else as texts, and the first cell that is none."""
    import pyarrow as pa
    from pyarrow import compute

    if pa.types.is_floating(column.type):
        return floats(column), None
    texts = compute.utf8_trim_whitespace(column)
    blank = compute.is_in(texts, value_set=pa.array(["", *NANS, *source.missing]))
    plain = texts
    if source.thousands:
        mark = re.escape(source.thousands)
        grouped = compute.match_substring_regex(plain, rf"^[+-]?[1-9]\d{{0,2}}({mark}\d{{3}})+([.,]\d*)?$")
        plain = compute.if_else(grouped, compute.replace_substring(plain, source.thousands, ""), plain)
    if source.decimal == ",":
        # A remaining point may be a decimal point or a thousands separator: such a column is not numeric.
        plain = compute.replace_substring(compute.replace_substring(plain, ".", "?"), ",", ".")
    plain = compute.if_else(blank, pa.scalar(None, pa.string()), compute.utf8_ltrim(plain, "+"))
    number = compute.fill_null(compute.match_substring_regex(plain, f"^{NUMBER}$"), True)
    first = compute.index(number, False).as_py()
    if first < 0:
        values = floats(plain.cast(pa.float64()))
        infinite = np.isinf(values)
        if not infinite.any():
            return values, None
        first = int(np.argmax(infinite))
    return np.asarray(compute.if_else(blank, "", texts).to_numpy(zero_copy_only=False), dtype=np.object_), first

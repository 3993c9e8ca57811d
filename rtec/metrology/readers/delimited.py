"""Any delimited text: a header, then rows."""

import csv
import io
import re
from pathlib import Path
from typing import Any

import numpy as np

from rtec.errors import MeasurementError
from rtec.metrology.files.faults import Faults
from rtec.metrology.readers.base import WHERE, Floats, ForeignTable, Ints, SourceOptions, Texts, decoded
from rtec.metrology.units import UNITS, canonical

DELIMITERS = (";", "\t", ",", "|")
NANS = ("nan", "NaN", "NAN")
NUMBER = r"^[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?$"


def read(path: Path, source: SourceOptions, where: str = WHERE) -> list[ForeignTable]:
    """Read the one table of the file; `where` is how the user tells more of it, for messages.

    Raises:
        MeasurementError: not text, no rows, or rows of another length than the header; by line.
    """
    text, notes = decoded(path, source.encoding)
    lines = text.split("\n")
    kept = [
        i
        for i in range(source.skip_rows, len(lines))
        if lines[i].strip() and not (source.comment and lines[i].startswith(source.comment))
    ]
    if not kept:
        raise MeasurementError(
            f"{path}: no rows" + (f" after the first {source.skip_rows}" if source.skip_rows else "")
        )
    delimiter = source.delimiter or _delimiter([lines[i] for i in kept[:20]])
    if source.delimiter is None:
        notes = (*notes, f"cells are divided by {delimiter!r}, as it seems")
    names, units, first = _header(path, [lines[i] for i in kept[:2]], delimiter, source, where)
    rows = kept[first:]
    if not rows:
        raise MeasurementError(f"{path}: no rows under the header")
    at = np.array(rows, dtype=np.int64) + 1
    table = _cells(path, [lines[i] for i in rows], at, names, delimiter, where)
    columns: dict[str, Floats | Texts] = {}
    wrong = {}
    for name in names:
        columns[name], bad = _numbers_or_texts(table.column(name), source)
        if bad is not None:
            wrong[name] = (int(at[bad]), str(columns[name][bad]))
    return [ForeignTable(path.stem, columns, units, at, notes, wrong, where)]


def _delimiter(lines: list[str]) -> str:
    """The mark that divides the first lines alike; the comma where none does."""
    alike = [d for d in DELIMITERS if len({line.count(d) for line in lines}) == 1 and d in lines[0]]
    seen = [d for d in DELIMITERS if d in lines[0]]
    return (alike or seen or [","])[0]


def _header(
    path: Path, lines: list[str], delimiter: str, source: SourceOptions, where: str
) -> tuple[list[str], dict[str, str], int]:
    """Names, units, and how many lines they took."""
    cells = [[c.strip() for c in row] for row in csv.reader(lines, delimiter=delimiter)]
    if not source.header:
        return [f"c{i + 1}" for i in range(len(cells[0]))], {}, 0
    names = [n or f"c{i + 1}" for i, n in enumerate(cells[0])]
    for name in names:
        if names.count(name) > 1:
            other = f", or {where} header = false with skip_rows, and use c1, c2, …" if where else ""
            raise MeasurementError(
                f"{path}: column {name!r} is {names.count(name)} times in the header; rename one{other}"
            )
    units = {n: u for n in names if (u := _bracketed(n))}
    if not source.unit_row:
        return names, units, 1
    if len(cells) < 2:
        raise MeasurementError(f"{path}: unit_row = true, and there is no line under the header")
    return names, units | {n: u for n, c in zip(names, cells[1], strict=False) if (u := _unit(c.strip("[]() ")))}, 2


def _bracketed(name: str) -> str:
    """The unit in a name like `Pos X [mm]` or `T1 (°C)`."""
    found = re.search(r"[\[(]([^\])]+)[\])]\s*$", name)
    return _unit(found.group(1)) if found else ""


def _unit(text: str) -> str:
    try:
        return canonical(text) if text and text not in UNITS.keys() - {"1"} else text
    except ValueError:
        return ""


def _cells(path: Path, lines: list[str], at: Ints, names: list[str], delimiter: str, where: str) -> Any:
    """All cells as texts."""
    import pyarrow as pa
    from pyarrow import csv as arrow_csv

    try:
        table = arrow_csv.read_csv(
            io.BytesIO("\n".join(lines).encode()),
            read_options=arrow_csv.ReadOptions(column_names=names, block_size=64 << 20),
            parse_options=arrow_csv.ParseOptions(delimiter=delimiter),
            convert_options=arrow_csv.ConvertOptions(column_types=dict.fromkeys(names, pa.string())),
        )
    except (pa.ArrowException, ValueError) as e:
        _tell_widths(path, lines, at, len(names), delimiter, where)
        raise MeasurementError(f"{path}: not a table divided by {delimiter!r}: {str(e).splitlines()[0]}") from e
    if table.num_rows != len(lines):
        raise MeasurementError(f"{path}: {len(lines)} lines and {table.num_rows} rows: a quote is not closed?")
    return table


def _tell_widths(path: Path, lines: list[str], at: Ints, width: int, delimiter: str, where: str) -> None:
    faults = Faults(str(path))
    for line, number in zip(lines, at.tolist(), strict=True):
        try:
            n = len(next(csv.reader([line], delimiter=delimiter)))
        except csv.Error as e:
            faults.row("csv", number, str(e), "is this a text table?")
            continue
        if n != width:
            way = f"is the delimiter {delimiter!r}?" + (
                f" lines before the header: {where} skip_rows = …; after it: comment = …"
                if where
                else " decimal commas? write decimals with a point"
            )
            faults.row("width", number, f"has {n} cells, the header has {width}", way)
    faults.raise_if_any()


def _numbers_or_texts(column: Any, source: SourceOptions) -> tuple[Floats | Texts, int | None]:
    """A column as numbers if all its cells are; else as texts, and which is the first that is no number."""
    import pyarrow as pa
    from pyarrow import compute

    texts = compute.utf8_trim_whitespace(column)
    blank = compute.is_in(texts, value_set=pa.array(["", *NANS, *source.missing]))
    plain = texts
    if source.thousands:
        mark = re.escape(source.thousands)
        grouped = compute.match_substring_regex(plain, rf"^[+-]?[1-9]\d{{0,2}}({mark}\d{{3}})+([.,]\d*)?$")
        plain = compute.if_else(grouped, compute.replace_substring(plain, source.thousands, ""), plain)
    if source.decimal == ",":
        # A point that is left may be a decimal point or a thousands separator: such a column is no numbers.
        plain = compute.replace_substring(compute.replace_substring(plain, ".", "?"), ",", ".")
    plain = compute.if_else(blank, pa.scalar(None, pa.string()), compute.utf8_ltrim(plain, "+"))
    number = compute.fill_null(compute.match_substring_regex(plain, NUMBER), True)
    first = compute.index(number, False).as_py()
    if first < 0:
        values = np.asarray(plain.cast(pa.float64()).to_numpy(), dtype=np.float64)
        infinite = np.isinf(values)
        if not infinite.any():
            return values, None
        first = int(np.argmax(infinite))
    return np.asarray(compute.if_else(blank, "", texts).to_numpy(zero_copy_only=False), dtype=np.object_), first

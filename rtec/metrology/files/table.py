"""Numbers from CSV and Parquet. The quick reader reads plain files; the exact one reports every fault with its place.

The text is checked first, in one pass: hash, encoding, byte order mark, length of its lines. No guess is made that
could be wrong.
"""

import codecs
import csv
import hashlib
import itertools
import math
import os
import re
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np

from rtec.arrays import Bools, Floats, Ints
from rtec.errors import MeasurementError, first_line
from rtec.files import check_size
from rtec.metrology.files.faults import Faults, places
from rtec.metrology.files.toml import Leniency
from rtec.text import NUMBER

NANS = ("nan", "NaN", "NAN", "-nan", "-NaN")
NO_VALUE = frozenset({"", *NANS})
# `float` reads texts of these letters only where `NUMBER` allows them.
PLAIN_ROW = re.compile(r"[0-9eE.+-]*", re.ASCII)
INFINITE = re.compile(r"[+-]?inf(inity)?", re.IGNORECASE)


class Cells:
    """Converts cells to numbers and reports those that are none."""

    def __init__(self, leniency: Leniency, faults: Faults, where: str) -> None:
        self.decimal = leniency.decimal
        self.delimiter = leniency.delimiter
        self.empty = {*NO_VALUE, *(str(w) for w in leniency.missing_codes if isinstance(w, str))}
        self.faults = faults
        self.where = where

    def row(
        self,
        row: Sequence[str],
        line: int,
        width: int,
        places_of: Sequence[tuple[str, int]],
        values: dict[str, "array[float]"],
    ) -> bool:
        """Append one row to `values`; give whether it has a fault."""
        if len(row) != width:
            for column in values.values():
                column.append(math.nan)
            self.faults.row("width", line, f"has {len(row)} cells, the header has {width}", self._width_way(row, width))
            return True
        if self.decimal == "." and PLAIN_ROW.fullmatch("".join(row)):
            try:
                found = [float(row[i]) for _, i in places_of]
            except ValueError:
                pass
            else:
                for (name, _), value in zip(places_of, found, strict=True):
                    values[name].append(value)
                return False
        bad = False
        for name, i in places_of:
            value, fault = self._number(row[i])
            values[name].append(value)
            if fault:
                bad = True
                kind, way = fault
                self.faults.row(f"{name} {kind}", line, f"{name}: {row[i]!r} {kind}", way)
        return bad

    def _number(self, cell: str) -> tuple[float, tuple[str, str] | None]:
        text = cell.strip()
        if text in self.empty:
            return math.nan, None
        # "1.234" among decimal commas is ambiguous, 1234 or 1.234: it is refused.
        dotted = text if self.decimal == "." else text.replace(".", "?").replace(",", ".")
        if re.fullmatch(NUMBER, dotted):
            return float(dotted), None
        if INFINITE.fullmatch(text):
            return math.inf, None
        return math.nan, self._wrong(text)

    def _wrong(self, text: str) -> tuple[str, str]:
        if self.decimal == "." and re.fullmatch(r"[+-]?\d*,\d+([eE][+-]?\d+)?", text):
            return (
                "has a decimal comma or a thousands separator",
                f'a decimal comma: {self.where} decimal = ","; a thousands separator: write numbers without',
            )
        if self.decimal == "," and re.fullmatch(NUMBER, text):
            return "has a decimal point where decimal = ',' was said", "make the table use one of the two"
        if re.fullmatch(r"[+-]?\d{1,3}([,.' \u00a0\u202f’]\d{3})+([.,]\d+)?", text):
            return "has thousands separators", "write numbers without, or convert with `rtec import` (thousands = …)"
        if re.fullmatch(r"\d{1,4}[-/.:]\d{1,2}[-/.:T ].*|\d{1,2}:\d{2}.*", text):
            return "is a date or time of day", "`rtec import` turns it into seconds (a map with [time] unit = …)"
        shown = text.replace('"', "'")
        return (
            "is no number",
            f'correct it, or if it stands for "no value": {self.where} missing_codes = ["{shown}"], '
            "or leave such rows out: drop_bad_rows = true",
        )

    def _width_way(self, row: Sequence[str], width: int) -> str:
        if self.delimiter == "," and len(row) > width:
            return 'decimal commas? write points, or divide cells by ";" and say so ' + (
                f'({self.where} delimiter = ";", decimal = ",")'
            )
        return f"complete it, or leave such rows out: {self.where} drop_bad_rows = true"


BLOCK = 1 << 20
LONGEST_LINE: Final = 1 << 20
EXPANSION: Final = 12
"""Bytes of memory per byte of a table while it is read."""
# The longer marks first: that of UTF-32 begins like that of UTF-16.
MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


@dataclass(frozen=True)
class Text:
    """A text file that has been checked.

    Attributes:
        encoding: Python's name; a byte order mark is part of it.
        digest: running SHA-256 over its bytes.
        notes: notes on the encoding.
    """

    encoding: str
    digest: "hashlib._Hash"
    notes: tuple[str, ...]


def look_over(path: Path, declared: str | None, where: str, *, text: bool = True) -> Text:
    """Hash a file and check that all of it can be decoded, in one pass.

    Args:
        path: the file.
        declared: encoding that the user gave.
        where: how the user gives one, for messages.
        text: whether it has lines; none of them may be longer than `LONGEST_LINE`.

    Raises:
        MeasurementError: the file cannot be read, is larger than the memory, or is not text in that encoding; the
            message has line and byte.
    """
    try:
        with path.open("rb") as file:
            check_size(path, os.fstat(file.fileno()).st_size, EXPANSION, MeasurementError)
            head = file.read(4096)
            encoding = declared or _by_mark(head, path, where)
            if declared == "utf-8" and head.startswith(codecs.BOM_UTF8):
                encoding = "utf-8-sig"
            file.seek(0)
            digest = _pass(file, encoding, path, where, LONGEST_LINE if text else None)
    except FileNotFoundError as e:
        raise MeasurementError(f"{path}: no such file") from e
    except OSError as e:
        raise MeasurementError(f"{path}: cannot be read: {e.strerror}") from e
    notes = () if encoding == "utf-8" else (f"text is {encoding}" + ("" if declared else ", by its byte order mark"),)
    return Text(encoding, digest, notes)


def _by_mark(head: bytes, path: Path, where: str) -> str:
    for mark, name in MARKS:
        if head.startswith(mark):
            return name
    if b"\0" in head:
        half = "utf-16-le" if head[1::2].count(0) >= head[::2].count(0) else "utf-16-be"
        raise MeasurementError(
            f"{path}: holds zero bytes and no byte order mark; if it is UTF-16 text, say so: "
            f"{where} encoding = {half!r}"
        )
    return "utf-8"


def _pass(file: BinaryIO, encoding: str, path: Path, where: str, longest: int | None) -> "hashlib._Hash":
    digest = hashlib.sha256()
    decoder = codecs.getincrementaldecoder(encoding)()
    plain = encoding in ("utf-8", "utf-8-sig", "latin-1", "cp1252")
    at, lines, begun = 0, 0, 0
    while block := file.read(BLOCK):
        digest.update(block)
        begun = len(block) - 1 - end if (end := block.rfind(b"\n")) >= 0 else begun + len(block)
        if longest is not None and begun > longest:
            number = lines + block.count(b"\n") + 1
            raise MeasurementError(f"{path}: line {number}: longer than {longest} bytes; is this a table?")
        pending = len(decoder.getstate()[0])
        if pending or not (plain and block.isascii()):
            try:
                decoder.decode(block)
            except UnicodeDecodeError as e:
                raise MeasurementError(_undecodable(e, at - pending, lines, path, encoding, where)) from e
        at += len(block)
        lines += block.count(b"\n")
    try:
        decoder.decode(b"", final=True)
    except UnicodeDecodeError as e:
        raise MeasurementError(f"{path}: ends in the middle of a {encoding} character; is it whole?") from e
    return digest


def _undecodable(e: UnicodeDecodeError, at: int, lines: int, path: Path, encoding: str, where: str) -> str:
    data = bytes(e.object)
    line = lines + data[: e.start].count(b"\n") + 1
    start = data.rfind(b"\n", 0, e.start) + 1
    text = data[start : e.start + 12].split(b"\n")[0].decode("latin-1")
    # Bytes that Windows programs write for ° and µ; the rest of that range is text in another alphabet.
    likely = "latin-1" if data[e.start] >= 0xA0 else "cp1252"
    other = f"; if it is {likely}, say so: {where} encoding = {likely!r}" if encoding.startswith("utf-8") else ""
    return (
        f"{path}: line {line}: byte 0x{data[e.start]:02X} (byte {at + e.start} of the file, in {text!r}) "
        f"is no {encoding} text{other}"
    )


@dataclass(frozen=True)
class Raw:
    """The used columns of a file as numbers.

    Attributes:
        columns: (n,) each; NaN where a cell is empty or wrong.
        numbers: line or row number of each row in the file, (n,).
        word: "line" or "row".
        bad: rows with a cell that was reported as a fault, (n,).
        notes: notes on the rows.
    """

    columns: dict[str, Floats]
    numbers: Ints
    word: str
    bad: Bools
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.numbers)

    def rows(self, keep: Bools) -> "Raw":
        """The columns with only these rows, (n,)."""
        if keep.all():
            return self
        columns = {n: v[keep] for n, v in self.columns.items()}
        return Raw(columns, self.numbers[keep], self.word, self.bad[keep], self.notes)


def header_of(path: Path, text: Text, leniency: Leniency, where: str) -> list[str]:
    """Give the names in the first line.

    Raises:
        MeasurementError: there is no header, or its delimiter is another one than stated.
    """
    with path.open(encoding=text.encoding, newline=None) as file:
        try:
            names = next(csv.reader(file, delimiter=leniency.delimiter), [])
        except csv.Error as e:
            raise MeasurementError(f"{path}: line 1: {e}") from e
    if not any(n.strip() for n in names):
        raise MeasurementError(f"{path}: line 1 is empty; it must hold the names of the columns")
    if len(names) == 1:
        other = next((c for c in (";", "\t", ",", "|") if c in names[0] and c != leniency.delimiter), "")
        if other:
            mark = ' and, where numbers have commas, decimal = ","' if other != "," else ""
            raise MeasurementError(
                f"{path}: line 1: cells are divided by {other!r}, not {leniency.delimiter!r}; "
                f"say so: {where} delimiter = {_toml(other)}{mark}"
            )
    return names


def _toml(text: str) -> str:
    return '"\\t"' if text == "\t" else f'"{text}"'


def read_csv(
    path: Path, text: Text, leniency: Leniency, names: Sequence[str], used: Sequence[str], faults: Faults, where: str
) -> Raw:
    """The used columns of a CSV file whose first line is `names`."""
    columns = _quick(path, text, leniency, names, used)
    if columns is None:
        return _exact(path, text, leniency, names, used, faults, where)
    n = len(next(iter(columns.values()))) if columns else 0
    return Raw(columns, np.arange(2, n + 2), "line", np.zeros(n, dtype=np.bool_))


def _quick(
    path: Path, text: Text, leniency: Leniency, names: Sequence[str], used: Sequence[str]
) -> dict[str, Floats] | None:
    """Arrow's reader, block by block; None where anything is unusual."""
    import pyarrow as pa
    from pyarrow import csv as arrow_csv

    if not used or len(leniency.delimiter.encode()) > 1 or any("\n" in n for n in names):
        return None
    words = [str(w) for w in leniency.missing_codes if isinstance(w, str)]
    keys = {name: str(names.index(name)) for name in used}
    encoding = "utf-8" if text.encoding == "utf-8-sig" else text.encoding
    read = arrow_csv.ReadOptions(
        column_names=[str(i) for i in range(len(names))], skip_rows=1, block_size=4 << 20, encoding=encoding
    )
    parse = arrow_csv.ParseOptions(delimiter=leniency.delimiter, ignore_empty_lines=False)
    cells = arrow_csv.ConvertOptions(
        include_columns=list(keys.values()),
        column_types={str(i): pa.float64() if str(i) in keys.values() else pa.string() for i in range(len(names))},
        null_values=["", *NANS, *words],
        decimal_point=leniency.decimal,
        check_utf8=False,
    )
    parts: dict[str, list[Floats]] = {name: [] for name in used}
    try:
        with arrow_csv.open_csv(str(path), read_options=read, parse_options=parse, convert_options=cells) as reader:
            for batch in reader:
                for name, key in keys.items():
                    parts[name].append(_of_chunk(batch.column(key)))
    except (pa.ArrowException, ValueError, OSError):
        return None
    columns = {name: np.concatenate([np.empty(0), *parts.pop(name)]) for name in used}
    # Arrow reads a blank line as an empty row; it does not count.
    return None if np.logical_and.reduce([np.isnan(v) for v in columns.values()]).any() else columns


def floats(column: Any) -> Floats:
    """The numbers of an Arrow column of float64, NaN where it has none.

    Its own `to_numpy` would import pandas, where it is installed: half a second.
    """
    return np.concatenate([np.empty(0), *map(_of_chunk, getattr(column, "chunks", [column]))])


def _of_chunk(column: Any) -> Floats:
    if not len(column):
        return np.empty(0)
    valid, content = column.buffers()
    here = slice(column.offset, column.offset + len(column))
    values = np.frombuffer(content, dtype=np.float64)[here]
    if not column.null_count:
        return values
    there = np.unpackbits(np.frombuffer(valid, dtype=np.uint8), bitorder="little")[here]
    return np.where(there == 1, values, np.nan)


def _exact(
    path: Path, text: Text, leniency: Leniency, names: Sequence[str], used: Sequence[str], faults: Faults, where: str
) -> Raw:
    """Reads cell by cell: slower, but reports each fault with its line."""
    places_of = [(name, names.index(name)) for name in used]
    values = {name: array("d") for name in used}
    numbers, bad, blank = array("q"), array("b"), array("q")
    reading = Cells(leniency, faults, where)
    with path.open(encoding=text.encoding, newline=None) as file:
        rows = csv.reader(file, delimiter=leniency.delimiter)
        try:
            next(rows)
            for row in rows:
                if not any(row):
                    blank.append(rows.line_num)
                    continue
                numbers.append(rows.line_num)
                bad.append(reading.row(row, rows.line_num, len(names), places_of, values))
        except csv.Error as e:
            faults.whole(f"line {rows.line_num}: {e}; is this a text table?")
    if blank and numbers:
        blank = array("q", itertools.takewhile(lambda n: n < numbers[-1], blank))
    notes = (f"blank {places('line', blank)} not read",) if blank and numbers else ()
    columns = {name: np.array(v, dtype=np.float64) for name, v in values.items()}
    return Raw(columns, np.array(numbers, dtype=np.int64), "line", np.array(bad, dtype=np.bool_), notes)


def read_own(path: Path, text: Text | None, leniency: Leniency, names: Sequence[str]) -> dict[str, Floats]:
    """Columns that need not be numbers: those that are, NaN where a cell has none, (n,); blank lines are no rows.

    Args:
        path: a CSV file, or a Parquet file where there is no text.
        text: as `look_over` gives it.
        leniency: how its numbers are written.
        names: of the columns.
    """
    if text is None:
        import pyarrow as pa
        from pyarrow import parquet, types

        with parquet.ParquetFile(path) as file:
            kinds = {n: file.schema_arrow.field(n).type for n in names}
            numbers = [n for n, k in kinds.items() if types.is_integer(k) or types.is_floating(k)]
            table = file.read(columns=numbers)
        return {n: floats(table.column(n).cast(pa.float64(), safe=False)) for n in numbers}
    out = {name: array("d") for name in names}
    with path.open(encoding=text.encoding, newline=None) as file:
        rows = csv.reader(file, delimiter=leniency.delimiter)
        header = next(rows)
        places_of = {name: header.index(name) for name in names}
        for row in rows:
            if not any(row):
                continue
            for name in list(out):
                cell = row[places_of[name]] if len(row) > places_of[name] else ""
                number = cell if leniency.decimal == "." else cell.replace(",", ".")
                if re.fullmatch(NUMBER, number):
                    out[name].append(float(number))
                elif cell in NO_VALUE or cell in leniency.missing_codes:
                    out[name].append(math.nan)
                else:
                    del out[name]
    return {name: np.array(v, dtype=np.float64) for name, v in out.items()}


def parquet_names(path: Path) -> list[str]:
    """Column names of a Parquet file; MeasurementError where the file is not Parquet."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        with parquet.ParquetFile(path) as file:
            return list(file.schema_arrow.names)
    except (pa.ArrowException, ValueError, OSError, KeyError) as e:
        raise MeasurementError(f"{path}: not a whole Parquet file: {first_line(e)}") from e


def read_parquet(path: Path, used: Sequence[str], faults: Faults) -> Raw:
    """The used columns of a Parquet file."""
    import pyarrow as pa
    from pyarrow import parquet

    columns: dict[str, Floats] = {}
    try:
        with parquet.ParquetFile(path) as file:
            check_size(path, file.metadata.num_rows * 8 * len(used), EXPANSION, MeasurementError)
            n = file.metadata.num_rows
            table = file.read(columns=_numeric(file.schema_arrow, used, faults))
        for name in table.column_names:
            columns[name] = floats(table.column(name).cast(pa.float64(), safe=False))
    except (pa.ArrowException, ValueError, OSError, KeyError) as e:
        raise MeasurementError(f"{path}: cannot be read: {first_line(e)}") from e
    return Raw(columns, np.arange(1, n + 1), "row", np.zeros(n, dtype=np.bool_))


def _numeric(schema: Any, used: Sequence[str], faults: Faults) -> list[str]:
    """The columns that hold numbers; others are reported as faults and not read."""
    from pyarrow import types

    out = []
    for name in used:
        kind = schema.field(name).type
        if types.is_integer(kind) or types.is_floating(kind) or types.is_decimal(kind):
            out.append(name)
        else:
            faults.whole(f"column {name!r} is of type {kind}; write it as numbers (float64)")
    return out

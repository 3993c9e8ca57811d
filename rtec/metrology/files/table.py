"""Numbers out of CSV and Parquet. The quick reader takes what is plain; the exact one says what is wrong and where."""

import csv
import itertools
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtec.errors import MeasurementError
from rtec.metrology.files.faults import Faults, places
from rtec.metrology.files.files_cells import NANS, Cells
from rtec.metrology.files.files_text import Text
from rtec.metrology.files.toml import Leniency

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Raw:
    """The used columns of a file as numbers.

    Attributes:
        columns: (n,) each; NaN where a cell is empty or wrong.
        numbers: where each row stands in the file, (n,).
        word: "line" or "row".
        bad: rows with a cell that was told as a fault, (n,).
        notes: what to tell about the rows.
    """

    columns: dict[str, Floats]
    numbers: Ints
    word: str
    bad: Bools
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.numbers)

    def rows(self, keep: Bools) -> "Raw":
        """Only these rows."""
        if keep.all():
            return self
        columns = {n: v[keep] for n, v in self.columns.items()}
        return Raw(columns, self.numbers[keep], self.word, self.bad[keep], self.notes)


def header_of(path: Path, text: Text, leniency: Leniency, where: str) -> list[str]:
    """Give the names in the first line.

    Raises:
        MeasurementError: there is none, or it is divided by something else than said.
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
    """Give the used columns of a CSV file whose first line is `names`."""
    columns = _quick(path, text, leniency, names, used)
    if columns is None:
        return _exact(path, text, leniency, names, used, faults, where)
    n = len(next(iter(columns.values()))) if columns else 0
    return Raw(columns, np.arange(2, n + 2), "line", np.zeros(n, dtype=np.bool_))


def _quick(
    path: Path, text: Text, leniency: Leniency, names: Sequence[str], used: Sequence[str]
) -> dict[str, Floats] | None:
    """Arrow's reader, block by block; None where anything at all is out of the ordinary."""
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
                    parts[name].append(batch.column(key).to_numpy(zero_copy_only=False))
    except (pa.ArrowException, ValueError, OSError):
        return None
    columns = {name: np.concatenate([np.empty(0), *parts.pop(name)]) for name in used}
    # A blank line comes out as a row without anything; it is none.
    return None if np.logical_and.reduce([np.isnan(v) for v in columns.values()]).any() else columns


def _exact(
    path: Path, text: Text, leniency: Leniency, names: Sequence[str], used: Sequence[str], faults: Faults, where: str
) -> Raw:
    """Cell by cell; slower, and knows the line of everything."""
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


def parquet_names(path: Path) -> list[str]:
    """Column names of a Parquet file; MeasurementError where it is none."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        with parquet.ParquetFile(path) as file:
            return list(file.schema_arrow.names)
    except (pa.ArrowException, ValueError, OSError, KeyError) as e:
        raise MeasurementError(f"{path}: not a whole Parquet file: {_first_line(e)}") from e


def read_parquet(path: Path, used: Sequence[str], faults: Faults) -> Raw:
    """Give the used columns of a Parquet file."""
    import pyarrow as pa
    from pyarrow import parquet

    columns: dict[str, Floats] = {}
    n = 0
    try:
        with parquet.ParquetFile(path) as file:
            table = file.read(columns=list(used))
        n = table.num_rows
        for name in used:
            kind = table.schema.field(name).type
            if pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind):
                columns[name] = table.column(name).cast(pa.float64(), safe=False).to_numpy().astype(np.float64)
            else:
                faults.whole(f"column {name!r} is of type {kind}; write it as numbers (float64)")
    except (pa.ArrowException, ValueError, OSError, KeyError) as e:
        raise MeasurementError(f"{path}: cannot be read: {_first_line(e)}") from e
    return Raw(columns, np.arange(1, n + 1), "row", np.zeros(n, dtype=np.bool_))


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]

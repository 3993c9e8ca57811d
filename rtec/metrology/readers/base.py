"""What a reader gives, and what it may be told about the file."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from rtec.errors import MeasurementError
from rtec.limits import check_size
from rtec.metrology.files.table import look_over
from rtec.quantities import Counts
from rtec.tomlfile import Strict, nearest

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Texts = NDArray[np.object_]
EXPANSION = 16
"""Bytes of memory that a byte of a text takes while it is read."""
WHERE = "in [source] of the map,"


class SourceOptions(Strict):
    """`[source]` of a map: how the file is written. What is not said is found out, and told.

    Attributes:
        reader: name of the reader.
        table: name of the table, in files that hold several.
        encoding, delimiter, decimal, thousands: of a delimited text; decimal and thousands are never guessed.
        skip_rows: lines before the header.
        comment: lines that begin with this are no rows.
        header: does the first line hold the names? Without it columns are `c1`, `c2`, …
        unit_row: does the line under the header hold units?
        missing: words that stand for "no value".
        swap_directions: ecmc only: what the file calls forward is backward.
    """

    reader: str | None = None
    table: str | None = None
    encoding: Literal["utf-8", "latin-1", "cp1252", "utf-16", "utf-16-le", "utf-16-be"] | None = None
    delimiter: Annotated[str, Field(min_length=1, max_length=1)] | None = None
    decimal: Literal[".", ","] = "."
    thousands: Literal[".", ",", " ", "'", "\u00a0", "\u202f"] | None = None
    skip_rows: Counts = 0
    comment: Annotated[str, Field(min_length=1)] | None = None
    header: bool = True
    unit_row: bool = False
    missing: tuple[str, ...] = ()
    swap_directions: bool = False


@dataclass(frozen=True)
class ForeignTable:
    """Named columns of one length, as they stand in the file.

    Attributes:
        name: of the table within its file.
        columns: (n,) each: numbers, NaN where there is none, or texts.
        units: unit of a column, where the file tells it.
        lines: line of each row in the file, (n,).
        notes: what the reader told.
        wrong: of a column of texts, line and text of the first cell that is no number, where the reader knows it.
        where: how the user tells the reader more, for messages; "" where nothing can be told.
    """

    name: str
    columns: Mapping[str, Floats | Texts]
    units: Mapping[str, str]
    lines: Ints
    notes: tuple[str, ...] = field(default=())
    wrong: Mapping[str, tuple[int, str]] = field(default_factory=dict)
    where: str = WHERE

    def __len__(self) -> int:
        return len(self.lines)

    def numbers(self, name: str, source: str) -> Floats:
        """Give a column of numbers.

        Raises:
            MeasurementError: there is no such column, or it holds a text; names the line.
        """
        values = self.column(name, source)
        if values.dtype != np.object_:
            return values.astype(np.float64)
        line, text = self.wrong.get(name) or self._first_text(values)
        raise MeasurementError(
            f"{source}: line {line}: column {name!r}: {text!r} is no number; {_way(text, self.where)}"
        )

    def _first_text(self, values: Floats | Texts) -> tuple[int, str]:
        i = next((i for i, v in enumerate(values) if not _is_number(str(v))), 0)
        return int(self.lines[i]), str(values[i])

    def column(self, name: str, source: str) -> Floats | Texts:
        """Give a column as it is; MeasurementError where there is none."""
        if name not in self.columns:
            raise MeasurementError(f"{source}: there is no column {name!r}{nearest(name, self.columns)}")
        return self.columns[name]


def _is_number(text: str) -> bool:
    try:
        float(text or "nan")
    except ValueError:
        return False
    return "_" not in text


def _way(text: str, where: str) -> str:
    if not where:
        return "write decimals with a point" if "," in text else "correct the file"
    digits = text.replace(",", "").replace(".", "").strip("+- ").isdigit()
    if digits and "," in text and "." in text:
        return f"thousands separators? {where} thousands = … and decimal = …"
    if digits and "," in text:
        return f'{where} decimal = "," if it is a decimal comma, or thousands = ","'
    if digits and "." in text:
        return f'a point among decimal commas? {where} thousands = "." if it divides thousands, else decimal = "."'
    if any(c in text for c in ":/-") and text[:1].isdigit():
        return 'is it a time? [time] takes unit = "iso" or a format'
    return f'{where} missing = ["{text}"] if it stands for "no value", else correct the file'


def decoded(path: Path, encoding: str | None) -> tuple[str, tuple[str, ...]]:
    """Give the whole text of a file and notes on its encoding.

    Raises:
        MeasurementError: no such file, too large, or not text in that encoding.
    """
    text = look_over(path, encoding, WHERE)
    check_size(path, path.stat().st_size, EXPANSION, MeasurementError)
    with path.open(encoding=text.encoding, newline=None) as file:
        return file.read(), text.notes

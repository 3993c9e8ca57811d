"""The result of a reader, the options that describe the file, and dates and times in the formats of other programs."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from rtec.arrays import Bools, Floats, Ints
from rtec.errors import MeasurementError
from rtec.files import check_size
from rtec.metrology.files.table import look_over
from rtec.metrology.units import canonical
from rtec.quantities import Counts
from rtec.tomlfile import Strict, nearest

Texts = NDArray[np.object_]
EXPANSION = 16
"""Bytes of memory per byte of a text while it is read."""
WITH_UNIT = re.compile(r"([+-]?[\d.,][\d.,'\u00a0\u202f]*(?:[eE][+-]?\d+)?)\s*([°\u00b5\u03bc\"a-zA-Z]\S*)")
MINUS = ("\u2212", "-")
"""The typographic minus sign, and that of numbers."""
WHERE = "in [source] of the map,"


class SourceOptions(Strict):
    """`[source]` of a map: the format of the file. Options that are not given are detected, with a note.

    Attributes:
        reader: name of the reader.
        table: name of the table, in files that hold several.
        encoding, delimiter, decimal, thousands: of a delimited text; the delimiter " " is any run of blanks.
        widths: characters of each column, where the cells have fixed places instead of a delimiter.
        skip_rows: lines before the header.
        comment: lines that begin with this are no rows.
        header: whether the first line has the names; without it columns are `c1`, `c2`, …
        names: names of the columns, where no line of the file has them.
        unit_row: whether the line below the header has units.
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
    widths: Annotated[tuple[Annotated[int, Field(ge=1, le=10_000)], ...], Field(min_length=1)] | None = None
    header: bool = True
    names: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    unit_row: bool = False
    missing: tuple[str, ...] = ()
    swap_directions: bool = False

    @model_validator(mode="after")
    def _one_way(self) -> "SourceOptions":
        if self.widths is not None and self.delimiter is not None:
            raise ValueError("give a delimiter or widths, not both")
        if self.names is not None and self.header:
            raise ValueError(
                "names are for a file without a header: header = false; else [column.NAME] from = … renames"
            )
        if self.names is not None and len(set(self.names)) < len(self.names):
            raise ValueError("a name is given twice")
        return self


@dataclass(frozen=True)
class ForeignTable:
    """Named columns of one length, unconverted.

    Attributes:
        name: name of the table within its file.
        columns: (n,) each: numbers, NaN where there is none, or texts.
        units: unit of a column, where the file has it.
        lines: line of each row in the file, (n,).
        notes: notes of the reader.
        wrong: line and text of the first cell without a number, by column of texts, where the reader knows it.
        where: how the user gives the reader options, for messages; "" where there are none.
        decimal: decimal mark in its columns of texts.
    """

    name: str
    columns: Mapping[str, Floats | Texts]
    units: Mapping[str, str]
    lines: Ints
    notes: tuple[str, ...] = field(default=())
    wrong: Mapping[str, tuple[int, str]] = field(default_factory=dict)
    where: str = WHERE
    decimal: str = "."

    def __len__(self) -> int:
        return len(self.lines)

    def numbers(self, name: str, source: str) -> Floats:
        """A column of numbers, (n,).

        Raises:
            MeasurementError: there is no such column, or it has a text; the message names the line.
        """
        values = self.column(name, source)
        if values.dtype != np.object_:
            return values.astype(np.float64)
        line, text = self.wrong.get(name) or self._first_text(values)
        raise MeasurementError(
            f"{source}: line {line}: column {name!r}: {text!r} is no number; {_way(text, self.where)}"
        )

    def rows(self, keep: Bools) -> "ForeignTable":
        """The table with only these rows, (n,)."""
        return replace(self, columns={n: v[keep] for n, v in self.columns.items()}, lines=self.lines[keep])

    def _first_text(self, values: Floats | Texts) -> tuple[int, str]:
        i = next((i for i, v in enumerate(values) if number_or_none(str(v), self.decimal) is None), 0)
        return int(self.lines[i]), str(values[i])

    def column(self, name: str, source: str) -> Floats | Texts:
        """A column, unconverted, (n,); MeasurementError where there is none."""
        if name not in self.columns:
            raise MeasurementError(f"{source}: there is no column {name!r}{nearest(name, self.columns)}")
        return self.columns[name]


def with_unit(cell: str) -> tuple[str, str] | None:
    """The number and the unit of a cell such as "20.05 °C", as texts, the unit by its name in `UNITS`; else None."""
    match = WITH_UNIT.fullmatch(cell.strip())
    unit = "" if match is None else _unit(match[2])
    return (match[1], unit) if match is not None and unit else None


@cache
def _unit(text: str) -> str:
    try:
        return canonical(text)
    except ValueError:
        return ""


def number_or_none(text: str, decimal: str = ".") -> float | None:
    """Number in a cell, NaN where it is empty; None where it is a word."""
    plain = text.strip() if decimal == "." else text.strip().replace(".", "?").replace(decimal, ".")
    try:
        return float(plain or "nan") if "_" not in plain else None
    except ValueError:
        return None


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
    """The whole text of a file and notes on its encoding.

    Raises:
        MeasurementError: the file is missing, too large, or no text in that encoding.
    """
    text = look_over(path, encoding, WHERE)
    check_size(path, path.stat().st_size, EXPANSION, MeasurementError)
    with path.open(encoding=text.encoding, newline=None) as file:
        return file.read().replace(*MINUS), text.notes


EPOCH_FILETIME = datetime(1601, 1, 1, tzinfo=UTC)
EPOCH_UNIX = datetime(1970, 1, 1, tzinfo=UTC)
EPOCH_EXCEL = datetime(1899, 12, 30, tzinfo=UTC)


def filetime_text(ticks: int) -> str:
    """A FILETIME (100 ns since 1601) as ISO text in UTC; the number itself where no calendar has it."""
    try:
        return (EPOCH_FILETIME + timedelta(microseconds=ticks // 10)).isoformat()
    except OverflowError:
        return f"FILETIME {ticks}"

"""Plain tables for the procedures: CSV with one line of names, numbers below, strictly read."""

import codecs
import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtec.errors import MeasurementError
from rtec.tomlfile import nearest

Floats = NDArray[np.float64]
Table = dict[str, Floats]
WAY_ON = "divide cells by ',' and write decimals with a point"
LENGTHS = ("nm", "mm", "m", "inch", "mil", "urad", "mrad", "deg")
"""Units that a column in µm is sometimes in by mistake, as its name then says."""


def read_table(path: Path) -> Table:
    """Columns by name, (n,) each; an empty cell is NaN.

    Raises:
        MeasurementError: not readable, not UTF-8, no rows, a name twice, a row too short or long, or a cell that is no
            number; the message names file, row (the first is 1: the names) and column.
    """
    names, rows = _rows(path)
    if not rows:
        raise MeasurementError(f"{path}: no rows below the names")
    return {n: np.array([_number(path, i, n, r[k]) for i, r in rows]) for k, n in enumerate(names)}


def need(path: Path, table: Table, names: Sequence[str]) -> list[Floats]:
    """Give some columns.

    Raises:
        MeasurementError: one is missing; the message names the nearest that is there.
    """
    for name in names:
        if name not in table:
            other = next((n for n in table if n.partition("_")[0] == name.partition("_")[0]), None)
            unit = name.rpartition("_")[2]
            hint = f"; there is {other!r}: convert its numbers to {unit}" if other else nearest(name, table)
            raise MeasurementError(f"{path}: column {name!r} is missing{hint}")
    return [table[n] for n in names]


def in_um(path: Path, names: Sequence[str]) -> None:
    """Refuse columns of probes whose names say that they are in another unit than µm.

    Raises:
        MeasurementError: the first of them.
    """
    for name in names:
        unit = name.rpartition("_")[2]
        if unit in LENGTHS:
            raise MeasurementError(f"{path}: column {name!r} is in {unit}; convert its numbers to µm, and call it …_um")


def position_of(path: Path, table: Table) -> tuple[str, Floats]:
    """The one column of positions, `x_mm` and so on: axis name and values.

    Raises:
        MeasurementError: none, more than one, or an empty cell in it; or a column of a probe that is not in µm.
    """
    in_um(path, [n for n in table if n.startswith("probe")])
    found = [n for n in table if n.endswith("_mm") and not n.startswith("probe")]
    if len(found) != 1:
        raise MeasurementError(
            f"{path}: needs one column of positions, named by its axis, such as x_mm; "
            f"found {', '.join(found) or 'none'}"
        )
    values = table[found[0]]
    if np.isnan(values).any():
        raise MeasurementError(f"{path}: row {int(np.argmax(np.isnan(values))) + 2}: {found[0]} is empty")
    return found[0].removesuffix("_mm").upper(), values


def _rows(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    try:
        with path.open(encoding=_encoding(path), newline="") as file:
            lines = [(i, [c.strip() for c in r]) for i, r in enumerate(csv.reader(file), 1)]
    except UnicodeError as e:
        raise MeasurementError(f"{path}: not UTF-8 text, nor UTF-16 with its mark; save it as UTF-8") from e
    except FileNotFoundError as e:
        raise MeasurementError(f"{path}: no such file") from e
    except OSError as e:
        raise MeasurementError(f"{path}: cannot be read: {e.strerror}") from e
    except csv.Error as e:
        raise MeasurementError(f"{path}: not a CSV table: {e}") from e
    lines = [(i, r) for i, r in lines if any(r) and not r[0].startswith("#")]
    if not lines:
        raise MeasurementError(f"{path}: empty")
    names = lines[0][1]
    if len(set(names)) < len(names) or "" in names:
        raise MeasurementError(
            f"{path}: row {lines[0][0]}: each column needs a name of its own, found {', '.join(names)}"
        )
    if len(names) == 1 and ";" in names[0]:
        raise MeasurementError(f"{path}: row {lines[0][0]}: cells are divided by ';'; {WAY_ON}")
    for i, row in lines[1:]:
        if len(row) != len(names):
            commas = f"; decimal commas? {WAY_ON}" if len(row) > len(names) else ""
            raise MeasurementError(f"{path}: row {i}: {len(row)} cells, but {len(names)} columns{commas}")
    return names, lines[1:]


def _encoding(path: Path) -> str:
    """UTF-16 where its byte order mark says so; else UTF-8, with a mark or without."""
    with path.open("rb") as file:
        return "utf-16" if file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else "utf-8-sig"


def _number(path: Path, row: int, name: str, text: str) -> float:
    if not text:
        return float("nan")
    try:
        value = float(text)
    except ValueError:
        value = float("inf")
    if not np.isfinite(value):
        hint = "; write decimals with a point" if "," in text else ""
        raise MeasurementError(f"{path}: row {row}, column {name}: expected a number, found {text!r}{hint}")
    return value

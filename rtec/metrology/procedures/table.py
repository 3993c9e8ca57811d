"""Plain tables for the procedures: CSV with one line of names, numbers below, strictly read."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtec.errors import MeasurementError
from rtec.tomlfile import nearest

Floats = NDArray[np.float64]
Table = dict[str, Floats]


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
            raise MeasurementError(f"{path}: column {name!r} is missing{nearest(name, table)}")
    return [table[n] for n in names]


def position_of(path: Path, table: Table) -> tuple[str, Floats]:
    """The one column of positions, `x_mm` and so on: axis name and values.

    Raises:
        MeasurementError: none, more than one, or an empty cell in it.
    """
    found = [n for n in table if n.endswith("_mm")]
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
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = [(i, [c.strip() for c in r]) for i, r in enumerate(csv.reader(file), 1)]
    except UnicodeDecodeError as e:
        raise MeasurementError(f"{path}: not UTF-8 text (byte {e.start}); save it as UTF-8") from e
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
    for i, row in lines[1:]:
        if len(row) != len(names):
            raise MeasurementError(f"{path}: row {i}: {len(row)} cells, but {len(names)} columns")
    return names, lines[1:]


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

"""JSON lines: one object a line. Nested keys are joined by points; a key that a line lacks is a missing value.

`{"ts": 1.5, "atherms": [{"id": "C", "temp": 26.6}]}` gives `ts` and `atherms.C.temp`: the key of a list's item is its
`id` or `name` where it has one, else its number.
"""

import json
import math
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rtec.arrays import Floats
from rtec.errors import MeasurementError
from rtec.metrology.files.faults import Faults
from rtec.metrology.readers.base import ForeignTable, SourceOptions, Texts, decoded

DEPTH = 8
MOST_COLUMNS = 1000


def read(path: Path, source: SourceOptions) -> list[ForeignTable]:
    """Read all lines as one table.

    Raises:
        MeasurementError: a line is no JSON object; by line.
    """
    text, notes = decoded(path, source.encoding)
    faults = Faults(str(path))
    cells: dict[str, tuple[array[int], list[Any]]] = {}
    lines: array[int] = array("q")
    for number, line in enumerate(text.split("\n"), start=1):
        if not line.strip():
            continue
        for key, value in _object(line, number, faults):
            where, values = cells.setdefault(key, (array("q"), []))
            where.append(len(lines))
            values.append(value)
        lines.append(number)
        if len(cells) > MOST_COLUMNS:
            raise MeasurementError(f"{path}: line {number}: more than {MOST_COLUMNS} different keys; not one table")
    if not lines:
        faults.whole("no lines")
    elif not cells and not len(faults):
        faults.whole("its objects hold nothing")
    faults.raise_if_any()
    columns = {key: _column(len(lines), where, values) for key, (where, values) in cells.items()}
    return [ForeignTable(path.stem, columns, {}, np.array(lines, dtype=np.int64), notes)]


def _object(line: str, number: int, faults: Faults) -> list[tuple[str, Any]]:
    """Keys and values of one line; each key once."""
    try:
        found = json.loads(line)
    except (ValueError, RecursionError) as e:
        faults.row("json", number, f"is no JSON: {e}", "was the file cut off, or written to at the same time?")
        return []
    if not isinstance(found, dict):
        faults.row("object", number, f"holds {type(found).__name__}, not an object", "one object {…} a line")
        return []
    try:
        return list(dict(_flat(found, "", 0)).items())
    except ValueError as e:
        faults.row("depth", number, str(e), "write it flatter")
        return []


def _flat(value: Any, name: str, depth: int) -> Iterator[tuple[str, Any]]:
    if depth > DEPTH:
        raise ValueError(f"nested more than {DEPTH} deep")
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _flat(inner, f"{name}.{key}" if name else str(key), depth + 1)
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            own = inner.get("id", inner.get("name", i)) if isinstance(inner, dict) else i
            yield from _flat(inner, f"{name}.{own}", depth + 1)
    elif value is not None:
        yield name, value


def _column(n: int, where: "array[int]", values: list[Any]) -> Floats | Texts:
    """A column of numbers if all its values are numbers, else of texts."""
    numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    if numbers and all(isinstance(v, float) or abs(v) < 2**1000 for v in values):
        column: Floats = np.full(n, math.nan)
        column[np.frombuffer(where, dtype=np.int64)] = values
        return column
    texts: Texts = np.full(n, "", dtype=np.object_)
    texts[np.frombuffer(where, dtype=np.int64)] = [v if isinstance(v, str) else json.dumps(v) for v in values]
    return texts

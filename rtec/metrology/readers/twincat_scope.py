"""TwinCAT Scope's export to CSV.

A block on the whole recording, then a block with one line for each property of the channels (Name, SymbolComment,
Data-Type, SampleTime, …, Unit, …), then the values; at the end maybe `EOF`. Public source: Beckhoff Information System,
TE13xx Scope View, "Export to csv" (time stamps in FILETIME, 100 ns since 1601, or in milliseconds since the first
sample; separator chosen by the user; one time column for all, for each channel or for each sample time) and TwinCAT 2
Scope settings. Where the label of a line is repeated among the names (`Name;a;Name;b`), a new time column begins there.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.errors import MeasurementError
from rtec.metrology.files.faults import Faults
from rtec.metrology.readers.base import WHERE, ForeignTable, SourceOptions, decoded, filetime_text
from rtec.metrology.units import canonical

FILETIME_LEAST = 10**16  # larger than any milliseconds since a start; FILETIME passed it in 1632
LABELS = ("Name", "SymbolComment", "Data-Type", "SampleTime", "SymbolName", "Unit")


@dataclass
class _Layout:
    """Places of the columns: `times[k]` is the time of the channels `groups[k]` (column, name, unit)."""

    times: list[int]
    groups: list[list[tuple[int, str, str]]]
    first: int
    decimal: str


def read(path: Path, source: SourceOptions) -> list[ForeignTable]:
    """Read one table for each time column: `time` in s from the first sample, and each channel by its name.

    Raises:
        MeasurementError: there is no header of channels or no value, or a value is no number; by line.
    """
    text, notes = decoded(path, source.encoding)
    lines = text.split("\n")
    delimiter = source.delimiter or next((d for d in "\t;,|" if d in lines[0]), "")
    if not delimiter:
        raise MeasurementError(f"{path}: line 1: {lines[0][:60]!r}: no separator; {WHERE} delimiter = …")
    layout = _layout(path, lines, delimiter, source.decimal)
    faults = Faults(str(path))
    cells, numbers = _values(lines, layout, delimiter, faults)
    faults.raise_if_any()
    if not numbers:
        raise MeasurementError(f"{path}: no values under the header")
    tables = [
        _table(path, layout, k, cells, np.array(numbers, dtype=np.int64), notes) for k in range(len(layout.times))
    ]
    if len(tables) == 1:
        return tables
    return [ForeignTable(f"group{k + 1}", t.columns, t.units, t.lines, t.notes) for k, t in enumerate(tables)]


def _layout(path: Path, lines: list[str], delimiter: str, decimal: str) -> _Layout:
    """Find the block of channels: the second line that begins with Name."""
    starts = [i for i, line in enumerate(lines[:500]) if line.split(delimiter)[0] == "Name"]
    start = next((i for i in starts if any(_label(x, delimiter) in LABELS[1:4] for x in lines[i + 1 : i + 4])), None)
    if start is None:
        raise MeasurementError(
            f"{path}: no block of channels (lines Name, SymbolComment, Data-Type, …); export with header"
        )
    properties: dict[str, list[str]] = {}
    end = start
    while end < len(lines) and lines[end].strip() and not re.match(r"[+-]?\d", lines[end]):
        cells = lines[end].split(delimiter)
        properties.setdefault(cells[0], cells)
        end += 1
    names, units = properties["Name"], properties.get("Unit", [])
    layout = _Layout([], [], end, decimal)
    for k, name in enumerate(names):
        if name == "Name":
            layout.times.append(k)
            layout.groups.append([])
        elif name.strip():
            layout.groups[-1].append((k, name.strip(), _unit(units[k] if k < len(units) else "")))
    if not any(layout.groups):
        raise MeasurementError(f"{path}: line {start + 1}: no channel has a name")
    return layout


def _label(line: str, delimiter: str) -> str:
    return line.split(delimiter, maxsplit=1)[0]


def _unit(text: str) -> str:
    try:
        return canonical(text) if text.strip() and text != "(None)" else ""
    except ValueError:
        return ""


def _values(lines: list[str], layout: _Layout, delimiter: str, faults: Faults) -> tuple[list[list[str]], list[int]]:
    """Cells of all rows, and their line numbers."""
    width = max([*layout.times, *(k for group in layout.groups for k, _, _ in group)]) + 1
    cells, numbers = [], []
    for i in range(layout.first, len(lines)):
        line = lines[i]
        if line.strip() == "EOF":
            break
        if not line.strip():
            continue
        row = line.split(delimiter)
        if len(row) < width:
            faults.row("width", i + 1, f"has {len(row)} values, its header {width}", "is the file whole?")
            continue
        cells.append(row)
        numbers.append(i + 1)
    return cells, numbers


def _table(
    path: Path,
    layout: _Layout,
    k: int,
    cells: list[list[str]],
    lines: Ints,
    notes: tuple[str, ...],
) -> ForeignTable:
    at = layout.times[k]
    there = [i for i, row in enumerate(cells) if row[at].strip()]
    time_s, start = _time_s(path, [cells[i][at] for i in there], lines[there], layout.decimal)
    columns: dict[str, Floats] = {"time": time_s}
    units = {"time": "s"}
    for place, name, unit in layout.groups[k]:
        own = name if name not in columns else f"{name} ({place})"
        columns[own] = _floats(path, own, [cells[i][place] for i in there], lines[there], layout.decimal)
        if unit:
            units[own] = unit
    remarks = (*notes, start, "channels: " + ", ".join(n for n in columns if n != "time"))
    return ForeignTable(path.stem, columns, units, lines[there], remarks)


def _time_s(path: Path, texts: list[str], lines: Ints, decimal: str) -> tuple[Floats, str]:
    """Seconds from the first sample, exact for FILETIME, and a note on the start."""
    if texts and re.fullmatch(r"\d{17,19}", texts[0].strip()):
        wrong = next((i for i, t in enumerate(texts) if not re.fullmatch(r"\d{17,19}", t.strip())), None)
        if wrong is not None:
            raise MeasurementError(
                f"{path}: line {lines[wrong]}: {texts[wrong][:40]!r} is no FILETIME as the rows above have"
            )
        ticks = [int(t) for t in texts]
        if min(ticks) < FILETIME_LEAST or max(ticks) >= 2**63:
            raise MeasurementError(f"{path}: line {lines[0]}: a time stamp is out of range")
        whole = np.array(ticks, dtype=np.int64)
        return (whole - whole[0]) * 1e-7, f"time 0 is {filetime_text(ticks[0])}"
    values = _floats(path, "time", texts, lines, decimal) * 1e-3
    return (values - values[0] if len(values) else values), "time stamps are milliseconds; the first is 0"


def _floats(path: Path, name: str, texts: list[str], lines: Ints, decimal: str) -> Floats:
    out = np.empty(len(texts))
    for i, text in enumerate(texts):
        try:
            out[i] = float(_pointed(text, decimal)) if text.strip() else np.nan
        except ValueError:
            if text.strip() in ("True", "False", "TRUE", "FALSE"):
                out[i] = float(text.strip().lower() == "true")
                continue
            way = f'; {WHERE} decimal = ","' if "," in text else ""
            raise MeasurementError(f"{path}: line {lines[i]}: {name}: {text[:40]!r} is no number{way}") from None
    return out


def _pointed(text: str, decimal: str) -> str:
    """The text with a decimal point; a point among decimal commas is ambiguous, so that the text is no number."""
    text = text.replace("_", "?")
    return text.replace(".", "?").replace(",", ".") if decimal == "," else text

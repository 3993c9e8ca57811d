"""Volumetric compensation tables of the ISG kernel and of Beckhoff's TwinCAT CNC ("ISG CSV format"), in and out.

    // comment to the end of the line
    X  EXX  EYX  EZX  EAX  EBX  ECX
    0.0   0.02  0.01  0.07  0.00  0.0042  0.003
    #
    ...the next block, with a header of its own

Units are fixed: parameters mm and rad, arguments mm (linear axes) and degrees (rotary axes). `X0A`, `C0Y` and so on
are the position errors, which ISO 230-1 writes `EX0A`, `EC0Y`. Public sources: Beckhoff Information System, TF5280
Volumetric Compensation, "ISG CSV format", "Units of measure" and "List of parameters supported"; the same pages at ISG
Stuttgart. Signs are those of the machine's errors; the controller computes the compensation, and inverts the sign with
`negate`. No sign is inverted here.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rtec.arrays import Floats
from rtec.errors import MeasurementError
from rtec.metrology.files.faults import Faults
from rtec.metrology.readers.base import ForeignTable, SourceOptions, decoded
from rtec.text import NUMBER

ARGUMENTS = {"X": "mm", "Y": "mm", "Z": "mm", "A": "deg", "B": "deg", "C": "deg"}
COMPONENT = re.compile(r"E([XYZABC])[XYZABC]")
POSITION = re.compile(r"([XYZABC])0[XYZABC]")
OTHER = re.compile(r"P0[XYZ]|P[XYZ][ABC]|N0[XYZ]|V[XYZ][XYZABC]")


def read(path: Path, source: SourceOptions) -> list[ForeignTable]:
    """Read every block as a table, in the file's own units; position errors get their ISO names (`EC0Y`).

    Raises:
        MeasurementError: a name is unknown, or a row does not fit its header; by line.
    """
    text, notes = decoded(path, source.encoding)
    faults = Faults(str(path))
    tables = []
    for i, block in enumerate(_blocks(text)):
        header_line, header = block[0]
        names = [_iso_name(n) for n in header]
        for name, iso in zip(header, names, strict=True):
            if not iso:
                faults.whole(f"line {header_line}: {name!r} is no argument and no error parameter of this format")
            elif names.count(iso) > 1:
                faults.whole(f"line {header_line}: {name!r} is given twice")
        values = _rows(block[1:], len(names), faults)
        if not len(values):
            faults.whole(f"line {header_line}: no rows under this header")
        lines = np.array([line for line, cells in block[1:] if len(cells) == len(names)], dtype=np.int64)
        columns: dict[str, Floats] = {n: values[:, k] for k, n in enumerate(names)}
        tables.append(ForeignTable(f"block{i + 1}", columns, {n: unit(n) for n in names if n}, lines, notes))
    if not tables:
        faults.whole("no header and no rows")
    faults.raise_if_any()
    return tables


def write(tables: Sequence[ForeignTable], path: Path) -> None:
    """Write tables as blocks; `read` gives the same numbers, bit for bit.

    Args:
        tables: columns in the units of `unit`; ISO names (`EC0Y`) are written in the format's own way (`C0Y`).
        path: file to write.

    Raises:
        MeasurementError: the format does not have a column, a unit is wrong, or a value is not finite.
    """
    blocks = [_block(table, path) for table in tables]
    try:
        path.write_text("#\n".join(blocks), encoding="ascii")
    except OSError as e:
        raise MeasurementError(f"{path}: cannot be written: {e.strerror}") from e


def unit(name: str) -> str:
    """Unit of a column of this format, by its ISO name."""
    if name in ARGUMENTS:
        return ARGUMENTS[name]
    if name.startswith(("N", "V")):
        return "1"
    return "rad" if re.fullmatch(r"E[ABC]\w+", name) else "mm"


def _iso_name(name: str) -> str:
    """Name as in ISO 230-1; empty for a name that the format does not have."""
    if POSITION.fullmatch(name):
        return f"E{name}"
    known = name in ARGUMENTS or COMPONENT.fullmatch(name) or OTHER.fullmatch(name)
    return name if known else ""


def _own_name(name: str) -> str:
    return name[1:] if name.startswith("E") and POSITION.fullmatch(name[1:]) else name


def _blocks(text: str) -> list[list[tuple[int, list[str]]]]:
    """Blocks of (line, cells), without comments and blank lines."""
    out: list[list[tuple[int, list[str]]]] = [[]]
    for i, line in enumerate(text.split("\n")):
        content = line.split("//")[0].strip()
        if content.startswith("#"):
            out.append([])
        elif cells := [c for c in re.split(r"\s*[;\t]\s*|\s+", content) if c]:
            out[-1].append((i + 1, cells))
    return [block for block in out if block]


def _rows(block: Sequence[tuple[int, list[str]]], width: int, faults: Faults) -> Floats:
    rows = []
    for line, cells in block:
        if len(cells) != width:
            faults.row("width", line, f"has {len(cells)} values, its header {width}", "complete the row")
            continue
        row = []
        for cell in cells:
            if not re.fullmatch(NUMBER, cell):
                faults.row("number", line, f"{cell!r} is no number", "numbers have decimal points here")
                row.append(np.nan)
            else:
                row.append(float(cell))
        rows.append(row)
    return np.array(rows, dtype=np.float64).reshape(-1, width)


def _block(table: ForeignTable, path: Path) -> str:
    columns = {}
    for name in table.columns:
        if _iso_name(_own_name(name)) != name:
            raise MeasurementError(f"{path}: {name!r} is no argument and no error parameter of this format")
        if table.units.get(name) != unit(name):
            raise MeasurementError(f"{path}: {name} is in {table.units.get(name)!r}, this format wants {unit(name)}")
        columns[_own_name(name)] = table.numbers(name, str(path))
        if not np.isfinite(columns[_own_name(name)]).all():
            raise MeasurementError(f"{path}: {name} has a value that is not finite; a controller cannot use it")
    rows = zip(*(v.tolist() for v in columns.values()), strict=True)
    return "\n".join(["\t".join(columns), *("\t".join(map(repr, row)) for row in rows)]) + "\n"

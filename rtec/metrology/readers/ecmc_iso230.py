"""Bidirectional positioning data of ecmc's ISO 230-2 scripts: `TGT_DATA[i]`, `REF_DATA_FWD[i,j]`, `REF_DATA_BWD[i,j]`.

i numbers target positions, j cycles. The files have no time, so that rows get the order of ISO 230-2: every cycle
forward through all targets, then back.

Trap: published reports of such files call "forward" what the file calls BWD, and vice versa. The file's own words are
kept; `swap_directions = true` exchanges them. The sign of B and the means of each direction depend on it; the
magnitudes of B, M, A, E and R do not.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rtec.arrays import Floats
from rtec.metrology.files.faults import Faults
from rtec.metrology.readers.base import ForeignTable, SourceOptions, Texts, decoded
from rtec.metrology.units import canonical
from rtec.text import NUMBER

VALUE = re.compile(rf"(TGT_DATA|REF_DATA_FWD|REF_DATA_BWD)\[(\d{{1,6}})(?:,(\d{{1,6}}))?\]=\s*({NUMBER})\s*", re.ASCII)
KEY = re.compile(r"(UNIT|CYCLES|POSITIONS|DEC|REF_PV|TEST_PV|TGT_SET_PV|TEST_DATA)=(.*)")
MOST = 10_000_000


@dataclass
class _File:
    targets: dict[int, float] = field(default_factory=dict)
    readings: dict[tuple[str, int, int], tuple[float, int]] = field(default_factory=dict)
    keys: dict[str, str] = field(default_factory=dict)


def read(path: Path, source: SourceOptions) -> list[ForeignTable]:
    """Read the only table of the file: order, cycle, position, direction (-1, +1), target, reference, deviation.

    Raises:
        MeasurementError: a line is not of the format, a value is repeated, a target or reading is missing; by line.
    """
    text, notes = decoded(path, source.encoding)
    faults = Faults(str(path))
    file = _parse(text, faults)
    unit = _unit(file, faults)
    positions, cycles = _sizes(file, faults)
    faults.raise_if_any()
    table = _table(file, positions, cycles, swap=source.swap_directions)
    said = "turned round" if source.swap_directions else "as the file says"
    about = (
        f"forward and backward are {said}; reports published from such files have them the other way round",
        "the file records no time: rows are in the order of ISO 230-2",
    )
    lost = int(np.isnan(np.asarray(table["reference"], dtype=np.float64)).sum())
    missing = (f"{lost} of {positions * cycles * 2} readings are not in the file",) if lost else ()
    lines = np.array(table.pop("line"), dtype=np.int64)
    units = dict.fromkeys(("target", "reference", "deviation"), unit)
    return [ForeignTable(path.stem, table, units, lines, (*notes, *about, *missing))]


def _parse(text: str, faults: Faults) -> _File:
    file = _File()
    for number, raw in enumerate(text.split("\n"), start=1):
        line = raw.strip()
        if not line or line.startswith("#"):
            continue
        if found := VALUE.fullmatch(line):
            name, i, j, value = found.group(1), int(found.group(2)), int(found.group(3) or 0), float(found.group(4))
            known = (i in file.targets) if name == "TGT_DATA" else ((name, i, j) in file.readings)
            if known:
                faults.row("twice", number, f"{line.split('=')[0]} is given twice", "keep one")
            elif (name == "TGT_DATA") == (j > 0) or i < 1:
                faults.row("index", number, f"{line!r}: wrong index", "TGT_DATA[i], REF_DATA_FWD[i,j], from 1")
            elif name == "TGT_DATA":
                file.targets[i] = value
            else:
                file.readings[name, i, j] = (value, number)
        elif found := KEY.fullmatch(line):
            file.keys[found.group(1)] = found.group(2).strip()
        else:
            faults.row(
                "line", number, f"{line[:60]!r} is no line of this format", "expected KEY=value or NAME[i,j]=number"
            )
    return file


def _unit(file: _File, faults: Faults) -> str:
    try:
        return canonical(file.keys.get("UNIT", "mm"))
    except ValueError as e:
        faults.whole(f"UNIT: {e}")
        return "mm"


def _sizes(file: _File, faults: Faults) -> tuple[int, int]:
    """Numbers of positions and cycles; the data must agree with POSITIONS and CYCLES."""
    if not file.targets or not file.readings:
        faults.whole("no TGT_DATA[i] or no REF_DATA_FWD[i,j], REF_DATA_BWD[i,j]")
        return 0, 0
    found = {"POSITIONS": max(file.targets), "CYCLES": max(j for _, _, j in file.readings)}
    for key, n in found.items():
        said = file.keys.get(key)
        if said is not None and said != str(n):
            faults.whole(f"{key}={said}, and {n} are there; correct one of them")
    for i in range(1, min(found["POSITIONS"], MOST) + 1):
        if i not in file.targets:
            faults.whole(f"TGT_DATA[{i}] is missing")
    extra = sorted({i for _, i, _ in file.readings} - set(file.targets))
    for i in extra:
        faults.whole(f"readings for position {i}, which has no TGT_DATA[{i}]")
    if found["POSITIONS"] * found["CYCLES"] > MOST:
        faults.whole(f"{found['POSITIONS']} positions × {found['CYCLES']} cycles are more than this format ever holds")
    return found["POSITIONS"], found["CYCLES"]


def _table(file: _File, positions: int, cycles: int, *, swap: bool) -> dict[str, Floats | Texts]:
    up = ("REF_DATA_BWD", "REF_DATA_FWD") if swap else ("REF_DATA_FWD", "REF_DATA_BWD")
    there = range(1, positions + 1)
    rows = []
    for j in range(1, cycles + 1):
        for way, name, order in ((1, up[0], there), (-1, up[1], reversed(there))):
            for i in order:
                value, line = file.readings.get((name, i, j), (np.nan, 0))
                rows.append((j, i, way, file.targets[i], value, line))
    cycle, position, way_, target, reference, line_ = np.array(rows, dtype=np.float64).T
    rising = 1.0 if file.targets[positions] >= file.targets[1] else -1.0
    return {
        "order": np.arange(len(rows), dtype=np.float64),
        "cycle": cycle,
        "position": position,
        "direction": way_ * rising,
        "target": target,
        "reference": reference,
        "deviation": reference - target,
        "line": line_,
    }

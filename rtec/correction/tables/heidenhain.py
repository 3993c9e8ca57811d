"""HEIDENHAIN: nonlinear axis error compensation, as tables to type in.

`.COM` and `.CMA`: technical manual MANUALplus 620, pages 716 and 718; 256 lines: technical manual TNC 407, 4.7.3.
Older controls, 64 points at a power of two: technical manual TNC 406 / TNC 306, 3/97, page 4-21 (the printed table),
and TNC 360, 8/95, page 4-24. Sign: TNC 407, 01.98, page 4-26: the error is positive where the travel is too long; page
4-28 draws the table as "Error in Z". Not tried on a control.
"""

import re
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from rtec.correction.tables.table import (
    UNTRIED,
    CompensationTable,
    TableAxes,
    TableFormat,
    TableLimits,
    end,
    number,
    rising,
    same_axis,
    whole,
)
from rtec.errors import ConfigError

MOST_LINES: Final = 256
MOST_OLD: Final = 64
STEEPEST: Final = 64
"""The older controls accept a difference of 1/64 of the distance between two neighbours."""
LEAST_MM: Final = 1e-3
"""Distance of an exponent of 0: 2⁰ µm."""
LARGEST_EXPONENT: Final = 23
QUANTUM_UM: Final = 0.1
QUANTUM_OLD_UM: Final = 1.0
SIGN: Final = "error, actual minus nominal, mm; positive where the axis travels too far"


@dataclass(frozen=True)
class ComTable(TableFormat):
    """`.COM` with the columns AXISPOS, BACKLASH and the corrected axis."""

    title: str = "HEIDENHAIN .COM"
    sign: str = SIGN + "; BACKLASH: arriving in negative direction"
    use: str = "config.cma: enter FILE in the column of the axis that moves, and * in ACTIVE"

    @property
    def limits(self) -> TableLimits:
        """Both directions, any distances."""
        return TableLimits(MOST_LINES, True, "either", False, QUANTUM_UM, typed=True)

    def text(self, table: CompensationTable) -> str:
        """Write one line a point."""
        columns = zip(table.positions_mm, table.backward_um, table.forward_um, strict=True)
        rows = [
            f"{n:<4d} {p:>+12.4f} {1e-3 * b + 0.0:>+10.4f} {1e-3 * f + 0.0:>+10.4f}"
            for n, (p, b, f) in enumerate(columns)
        ]
        head = f"{'NR':<4} {'AXISPOS':>12} {'BACKLASH':>10} {table.corrects:>10}"
        cma = f"; config.cma: column {table.axis}: the name of this table; ACTIVE: *"
        return "\n".join([*_head(self, table), cma, head, *rows, "[END]", end(";")]) + "\n"

    def read(self, text: str, source: str, axes: TableAxes) -> CompensationTable:
        """Read a table with the columns in any order, with or without BACKLASH."""
        whole(text, source, ";")
        lines = [(n, c.split()) for n, c in _contents(text) if c != "[END]" and not c.startswith("BEGIN")]
        if not lines or "AXISPOS" not in lines[0][1]:
            raise ConfigError(f"{source}: without the line of columns: NR AXISPOS BACKLASH {axes.corrects}")
        if not any(c == "[END]" for _, c in _contents(text)):
            raise ConfigError(f"{source}: without [END]: is the file cut off?")
        head = lines[0][1]
        if axes.corrects not in head:
            raise ConfigError(f"{source}: no column {axes.corrects} among {', '.join(head)[:80]}")
        rows = []
        for n, words in lines[1:]:
            if len(words) != len(head):
                raise ConfigError(f"{source}: line {n}: {len(words)} values under {len(head)} columns")
            values = dict(zip(head, words, strict=True))
            chosen = (values["AXISPOS"], values[axes.corrects], values.get("BACKLASH", values[axes.corrects]))
            rows.append([number(word, source, n) for word in chosen])
        if len(rows) > MOST_LINES:
            raise ConfigError(f"{source}: {len(rows)} points; a .COM has {MOST_LINES}")
        columns = np.array(rows).reshape(-1, 3)
        return CompensationTable(
            axes.moves, axes.corrects, rising(columns[:, 0], source), 1e3 * columns[:, 1], 1e3 * columns[:, 2]
        )


@dataclass(frozen=True)
class OldTable(TableFormat):
    """`Y = F(Z)`, datum point, exponent of the distance, 64 lines; the value at the datum point is 0."""

    title: str = "HEIDENHAIN TNC 306, 360, 406, code number 105296"
    sign: str = SIGN
    use: str = "code number 105 296, COMPENSATION VALUE LIST; one table for each corrected axis"

    @property
    def limits(self) -> TableLimits:
        """One value for both directions, at a power of two."""
        return TableLimits(MOST_OLD, False, "either", True, QUANTUM_OLD_UM, grid="powers", zero="first", typed=True)

    def refuses(self, table: CompensationTable) -> str:
        """Beside the limits: the table may not be steeper than the control accepts."""
        if why := self.limits.refuses(table):
            return why
        step_um = 1e3 * (table.positions_mm[1] - table.positions_mm[0])
        if exponent(1e-3 * step_um) > LARGEST_EXPONENT:
            return f"takes a distance up to 2^{LARGEST_EXPONENT} µm"
        steepest = max(abs(b - a) for a, b in pairwise(table.forward_um.tolist()))
        if steepest > step_um / STEEPEST:
            return f"takes {step_um / STEEPEST:.1f} µm between two points, the table has {steepest:.1f} µm"
        return ""

    def text(self, table: CompensationTable) -> str:
        """Write it as the manual prints it."""
        positions = table.positions_mm
        rows = [
            f"{n} {table.axis}{_plain(p)} {table.corrects}{1e-3 * v + 0.0:+.3f}"
            for n, (p, v) in enumerate(zip(positions, table.forward_um, strict=True))
        ]
        head = [
            *_head(self, table),
            f"{table.corrects} = F({table.axis})",
            f"DATUM POINT {_plain(positions[0])}",
            f"SETUP {exponent(float(positions[1] - positions[0]))}",
        ]
        return "\n".join([*head, *rows, end(";")]) + "\n"

    def read(self, text: str, source: str, axes: TableAxes) -> CompensationTable:
        """Read the lines; a point without a value is interpolated between its neighbours."""
        whole(text, source, ";")
        datum, setup, values = None, None, dict[int, float | None]()
        for n, content in _contents(text):
            line = content.replace("\N{EN DASH}", "-")
            if match := re.match(r"(\w+)\s*=\s*F\((\w+)\)$", line):
                same_axis(match[1], axes.corrects, source, n)
                same_axis(match[2], axes.moves, source, n)
            elif match := re.match(r"DATUM POINT\s*([-+]?[\d.]+)$", line):
                datum = number(match[1], source, n)
            elif match := re.match(r"SETUP\s*(\d{1,2})$", line):
                setup = int(match[1])
            elif match := re.match(r"(\d{1,3})\s+[A-Z]+([-+]?[\d.]+)(?:\s+[A-Z]+([-+]?[\d.]+))?$", line):
                values[int(match[1])] = None if match[3] is None else number(match[3], source, n)
            else:
                raise ConfigError(f"{source}: line {n}: {content[:60]!r} is no line of this table")
        if datum is None or setup is None or setup > LARGEST_EXPONENT:
            raise ConfigError(f"{source}: without DATUM POINT or SETUP (0 to {LARGEST_EXPONENT})")
        if sorted(values) != list(range(len(values))) or not 2 <= len(values) <= MOST_OLD:
            raise ConfigError(f"{source}: {len(values)} lines; needed are the lines 0, 1, 2, …, {MOST_OLD} at most")
        known = [k for k, v in sorted(values.items()) if v is not None]
        if not known:
            raise ConfigError(f"{source}: no line has a value")
        points = np.arange(len(values), dtype=np.float64)
        errors = 1e3 * np.interp(points, known, [v for _, v in sorted(values.items()) if v is not None])
        return CompensationTable(axes.moves, axes.corrects, datum + LEAST_MM * 2**setup * points, errors, errors)


def exponent(step_mm: float) -> int:
    """Exponent, 0 or more, of the largest power of two in µm that is at most the distance."""
    return max(0, int(np.floor(np.log2(step_mm / LEAST_MM) + 1e-9)))


def _head(form: TableFormat, table: CompensationTable) -> list[str]:
    lines = [f"; {form.title}, {table.what}: a table to type in; {UNTRIED}", f"; {form.sign}"]
    return lines + ([f"; made for: {table.made_for}"] if table.at else [])


def _contents(text: str) -> list[tuple[int, str]]:
    lines = ((n, line.partition(";")[0].strip()) for n, line in enumerate(text.splitlines(), 1))
    return [(n, content) for n, content in lines if content]


def _plain(value_mm: float) -> str:
    """Number without trailing zeros."""
    return f"{value_mm:+.4f}".rstrip("0").rstrip(".")

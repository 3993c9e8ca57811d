"""LinuxCNC's `COMP_FILE`: nominal position, then one column for each direction.

LinuxCNC reads lines of three numbers up to the first other line, so the file's explanation is below its points. It
reads the file at its start only. Type 0 holds actual positions, `nominal + error`; type 1 holds the offset added to
the command, `nominal - actual = -error`. `tests/correction/test_tables_linuxcnc.py` has LinuxCNC itself check both.
"""

import math
import re
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtec.correction.tables.table import CompensationTable, TableAxes, TableFormat, TableLimits, rising, same_axis
from rtec.errors import ConfigError

MOST_POINTS: Final = 256
QUANTUM_UM: Final = 0.001
LARGEST_UM: Final = 10_000.0
"""A screw never has an error of a centimetre: such a file has the other type, or other units."""
_OURS = re.compile(r"; LinuxCNC COMP_FILE, .*, axis (\w+)(?:, (\d+) points)?")


@dataclass(frozen=True)
class CompFile(TableFormat):
    """The file of `COMP_FILE_TYPE` 0 or 1; positions in mm."""

    kind: int

    @property
    def title(self) -> str:
        """Controller and file, for people."""
        return f"LinuxCNC COMP_FILE, COMP_FILE_TYPE = {self.kind}"

    @property
    def sign(self) -> str:
        """The sign of the values, in words."""
        if self.kind == 0:
            return "nominal position, actual position arriving forward, actual position arriving in reverse, mm"
        return "nominal position, nominal minus actual arriving forward, nominal minus actual arriving in reverse, mm"

    @property
    def use(self) -> str:
        """The INI file's key that names the file."""
        return (
            f"[JOINT_n] COMP_FILE = FILE, COMP_FILE_TYPE = {self.kind}; LINEAR_UNITS = mm; no BACKLASH; "
            "start LinuxCNC again"
        )

    @property
    def limits(self) -> TableLimits:
        """256 points, both directions, any distances."""
        return TableLimits(MOST_POINTS, True, "own", False, QUANTUM_UM)

    def text(self, table: CompensationTable) -> str:
        """Write the points first: LinuxCNC stops reading at the first line that is not a point."""
        nominal = table.positions_mm
        columns = [1e-3 * table.forward_um, 1e-3 * table.backward_um]
        columns = [nominal + e for e in columns] if self.kind == 0 else [-e + 0.0 for e in columns]
        rows = np.column_stack([nominal, *columns])
        lines = ["".join(f"{v:>14.6f}" for v in row) for row in rows]
        lines += [
            f"; {self.title}, axis {table.axis}, {len(rows)} points",
            f"; columns: {self.sign}",
            *([f"; made for: {table.made_for}"] if table.at else []),
        ]
        return "\n".join(lines) + "\n"

    def read(self, text: str, source: str, axes: TableAxes) -> CompensationTable:
        """Read as LinuxCNC does; refuse a line with part of a point."""
        rows: list[tuple[float, float, float]] = []
        for n, line in enumerate(text.splitlines(), 1):
            row = _three(line)
            if row is None:
                _ends(line, source, n, axes.moves, len(rows))
                break
            if not all(math.isfinite(v) for v in row):
                raise ConfigError(f"{source}: line {n}: a value that is no finite number")
            rows.append(row)
        if len(rows) < 2:
            raise ConfigError(
                f"{source}: fewer than two lines of three numbers at its beginning: LinuxCNC would take no points"
            )
        if len(rows) > MOST_POINTS:
            raise ConfigError(f"{source}: {len(rows)} points; LinuxCNC takes {MOST_POINTS}")
        values = np.array(rows)
        nominal = rising(values[:, 0], source)
        errors = values[:, 1:] - nominal[:, None] if self.kind == 0 else -values[:, 1:]
        if np.abs(errors).max() * 1e3 > LARGEST_UM:
            other = "linuxcnc-type-1" if self.kind == 0 else "linuxcnc"
            raise ConfigError(
                f"{source}: an error of {np.abs(errors).max():g} mm, which is no screw's; is it of --format {other}?"
            )
        return CompensationTable(axes.moves, axes.corrects, nominal, 1e3 * errors[:, 0], 1e3 * errors[:, 1])


def _three(line: str) -> tuple[float, float, float] | None:
    try:
        a, b, c = (float(word) for word in line.split()[:3])
    except ValueError:
        return None
    return a, b, c


def _ends(line: str, source: str, n: int, axis: str, points: int) -> None:
    """Check the first line that is not a point: it is not part of one, and rtec's statements in it are true."""
    words = line.split()
    try:
        float(words[0] if words else "none")
    except ValueError:
        pass
    else:
        raise ConfigError(f"{source}: line {n}: {line[:60]!r} is half a point: is the file cut off?")
    if ours := _OURS.match(line):
        same_axis(ours[1], axis, source, n)
        if ours[2] and int(ours[2]) != points:
            raise ConfigError(f"{source}: line {n}: written with {ours[2]} points, and {points} are there")

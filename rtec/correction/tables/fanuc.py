"""FANUC stored pitch error compensation: parameters 3620 to 3627 and the values of the points, as a list to type in.

Parameter manual Series 0i-PB, B-63980EN/01, pages 99 and 100 (the printed example). The control adds a point's value
over the section that ends at the point; the value of point 3620 is that of the section that ends at the reference
position, where the sum is 0. Both directions: A-77810E/02, table of parameters 3605#0, 3626, 3627. A value is -7 to 7,
times 3623, in detection units of 1 µm. The pages that we have read do not state the sign. Not tried on a control.
"""

import re
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtec.arrays import Floats
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

MOST_POINTS: Final = 128
UNIT_UM: Final = 1.0
LARGEST_VALUE: Final = 7
LARGEST_MAGNIFICATION: Final = 100
_FIRST_OF: Final = {"X": 0, "Y": 256, "Z": 512}
"""Our choice, so that the points of three axes in both directions do not overlap."""


@dataclass(frozen=True)
class PitchErrorList(TableFormat):
    """The list for one axis; with `both` the second set of points for the negative direction.

    Attributes:
        both: bidirectional pitch error compensation, 3605#0.
    """

    both: bool

    @property
    def title(self) -> str:
        """Controller and file, for people."""
        return f"FANUC stored pitch error compensation{', both directions' if self.both else ''}"

    @property
    def sign(self) -> str:
        """The sign of the values, in words."""
        return "nominal minus actual, what is added over each section, 1 µm times 3623; the sum is 0 at position 0"

    @property
    def use(self) -> str:
        """The parameters to type in."""
        way = ", in positive direction" if self.both else ""
        return f"type the parameters and points in, switch off and on, approach the reference position (machine 0{way})"

    @property
    def limits(self) -> TableLimits:
        """128 sections, at multiples of the distance, so one position more."""
        most = MOST_POINTS + 1
        return TableLimits(most, self.both, "own", True, UNIT_UM, grid="origin", zero="origin", typed=True)

    def refuses(self, table: CompensationTable) -> str:
        """Beside the limits: no section may need more than the largest magnification."""
        why = self.limits.refuses(table)
        return why or ("" if magnification(self._plain(table)) else "takes 700 µm in a section at most")

    def held(self, table: CompensationTable) -> CompensationTable:
        """As `TableLimits.held`, in steps of the magnification that the steepest section needs."""
        return self.limits.held(table, UNIT_UM * magnification(self._plain(table)))

    def text(self, table: CompensationTable) -> str:
        """Write the parameters, then the points."""
        by = magnification(table, exact=True)
        positions = table.positions_mm
        step = float(positions[1] - positions[0])
        first, low = _FIRST_OF.get(table.axis, 0), round(float(positions[0]) / step)
        count = len(positions) - 1
        forward, backward = (_sections(v, by) for v in (table.forward_um, table.backward_um))
        lines = [
            f"; {self.title}, axis {table.axis}: a list to type in; {UNTRIED}",
            f"; {self.sign}",
            *([f"; made for: {table.made_for}"] if table.at else []),
            "; the numbers of the points must not be those of another axis: shift them all where they are taken",
            f"3605#0 = {int(self.both)}",
            f"3620 = {first - low}",
            f"3621 = {first + 1}",
            f"3622 = {first + count}",
            f"3623 = {by}",
            f"3624 = {step:.3f}",
        ]
        if self.both:
            at_reference = -round(float(np.interp(0.0, positions, table.backward_um)) / UNIT_UM)
            lines += [f"3626 = {first + MOST_POINTS + 1}", f"3627 = {at_reference}"]
        lines += [f"point {first + 1 + k} = {v:+d}" for k, v in enumerate(forward)]
        if self.both:
            lines += [f"point {first + MOST_POINTS + 1 + k} = {v:+d}" for k, v in enumerate(backward)]
        return "\n".join([*lines, end(";")]) + "\n"

    def read(self, text: str, source: str, axes: TableAxes) -> CompensationTable:
        """Read a list that `text` has written."""
        whole(text, source, ";")
        keys: dict[str, float] = {}
        points: dict[int, int] = {}
        for n, line in enumerate(text.splitlines(), 1):
            if ours := re.match(r"; FANUC .*, axis (\w+):", line):
                same_axis(ours[1], axes.moves, source, n)
            content = line.partition(";")[0].strip()
            if not content:
                continue
            if match := re.match(r"(3605#0|362[0-7])\s*=\s*(\S+)$", content):
                keys[match[1]] = number(match[2], source, n)
            elif match := re.match(r"point\s+(\d{1,4})\s*=\s*([-+]?\d{1,2})$", content):
                points[int(match[1])] = int(match[2])
            else:
                raise ConfigError(f"{source}: line {n}: {content[:60]!r} is no parameter 3620 to 3627 and no point")
        required = ["3620", "3621", "3622", "3623", "3624", *(["3626", "3627"] if self.both else [])]
        if missing := [key for key in required if key not in keys]:
            raise ConfigError(f"{source}: without parameter {', '.join(missing)}")
        if keys.get("3625"):
            raise ConfigError(f"{source}: 3625 is {keys['3625']:g}: a rotary axis")
        if bool(keys.get("3605#0")) != self.both:
            other = "fanuc" if self.both else "fanuc-both"
            raise ConfigError(f"{source}: 3605#0 is {keys.get('3605#0', 0):g}: is it of --format {other}?")
        reference, low, high = (round(keys[key]) for key in ("3620", "3621", "3622"))
        step, by = keys["3624"], round(keys["3623"])
        if not (0 < high - low + 1 <= MOST_POINTS and step > 0 and 0 < by <= LARGEST_MAGNIFICATION):
            raise ConfigError(
                f"{source}: 3621 to 3622 are {high - low + 1} points (1 to {MOST_POINTS}), 3623 is {by} (1 to "
                f"{LARGEST_MAGNIFICATION}), 3624 is {step:g} mm (above 0)"
            )
        if not low - 1 <= reference <= high:
            raise ConfigError(f"{source}: 3620 is {reference}, which is not among the points {low} to {high}")
        positions = step * (np.arange(low - 1, high + 1, dtype=np.float64) - reference)

        def errors(start: int, at_reference: float) -> Floats:
            numbers = range(start, start + high - low + 1)
            if gone := [k for k in numbers if k not in points]:
                raise ConfigError(f"{source}: point {gone[0]} is missing: is the list cut off?")
            added = np.r_[0.0, np.cumsum([points[k] for k in numbers])] * UNIT_UM * by
            errors_um: Floats = np.interp(0.0, positions, added) - at_reference - added
            return errors_um

        forward = errors(low, 0.0)
        backward = errors(round(keys["3626"]), keys["3627"] * UNIT_UM) if self.both else forward
        return CompensationTable(axes.moves, axes.corrects, rising(positions, source), forward + 0.0, backward + 0.0)

    def _plain(self, table: CompensationTable) -> CompensationTable:
        """The table with its zero, not rounded."""
        return self.limits.held(table, 1e-9)


def magnification(table: CompensationTable, exact: bool = False) -> int:
    """Smallest 3623 with no section above 7 and, if `exact`, with every value unchanged; 0: there is none."""
    columns = np.array([table.forward_um, table.backward_um])
    for by in range(1, LARGEST_MAGNIFICATION + 1):
        rounded = np.rint(columns / (UNIT_UM * by))
        if np.abs(np.diff(rounded)).max() <= LARGEST_VALUE and not (
            exact and np.any(rounded * UNIT_UM * by != columns)
        ):
            return by
    return 0


def _sections(values_um: Floats, by: int) -> list[int]:
    """Sum added over each section: differences of the rounded values, so that roundings do not add up."""
    return [int(-d) for d in np.diff(np.rint(values_um / (UNIT_UM * by))).tolist()]

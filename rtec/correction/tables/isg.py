"""ISG kernel and Beckhoff TwinCAT CNC: compensation value lists, `achskw*.lis`.

Beckhoff TF5200, axis compensation. Leadscrew, `kw.ssfk`: "Example: non-equidistant bilateral SSFK"; P-COMP-00017 to 25.
Cross, `kw.crosscomp`: "Example of a compensation value list" (113391499); P-COMP-00003 to 7, 60. Plane,
`kw.crosscomp2`: "Example of a compensation value list" (113417611); P-COMP-00008 to 16, 61. Not tried on a control.
"""

import re
from collections.abc import Iterator
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
    rising,
    same_axis,
    whole,
)
from rtec.errors import ConfigError

MOST_POINTS: Final = 1500
MOST_CROSS: Final = 1000
MOST_PLANE: Final = 10201
"""P-COMP-00059, "maximum 1000 values", P-COMP-00061: the control's default where max_points is not set."""
QUANTUM_UM: Final = 0.1
LARGEST_UM: Final = 3276.7
LARGEST_CROSS_UM: Final = 10_000.0
"""Our own limit: an axis never has an error of a centimetre; the control accepts 32 bits."""
CROSS_SIGN: Final = "actual minus setpoint of the corrected axis, 0.1 µm, as in kw.ssfk; TF5200 does not state it"

_LINE = re.compile(r"(\w+)\.(?:(\w+)\.)?(?:table((?:\[\s*\d{1,6}\s*\])+)\.)?(\w+)\s+(\S+.*)$")


@dataclass(frozen=True)
class LeadscrewList(TableFormat):
    """`kw.ssfk`: positions of every point and both directions."""

    title: str = "ISG and Beckhoff TwinCAT CNC, kw.ssfk"
    sign: str = "actual minus setpoint, 0.1 µm; pos: arriving in positive direction, neg: in negative direction"
    use: str = "lr_param.ssfk 1 in the axis' list (P-AXIS-00175); kopf.achs_nr must be the axis' number"

    @property
    def limits(self) -> TableLimits:
        """Both directions, any distances."""
        return TableLimits(MOST_POINTS, True, "own", False, QUANTUM_UM, LARGEST_UM, adds_heat=True)

    def text(self, table: CompensationTable) -> str:
        """Write the list; its line with the axis' logical number, unknown here, is for the user to complete."""
        places, forward, backward = (_tenths(v, 1e4 if i == 0 else 10.0) for i, v in enumerate(_columns(table)))
        lines = [
            *_head(self, table),
            "kw.ssfk.interval 0",
            f"kw.ssfk.kw_startpos {places[0]}",
            f"kw.ssfk.kw_nr_max {len(places)}",
            "kw.ssfk.unit 1",
            "kw.ssfk.bilateral 1",
            *(f"kw.ssfk.table[{i}].setpoint {p}" for i, p in enumerate(places)),
            *(f"kw.ssfk.table[{i}].pos {f}" for i, f in enumerate(forward)),
            *(f"kw.ssfk.table[{i}].neg {b}" for i, b in enumerate(backward)),
        ]
        return "\n".join([*lines, end("#")]) + "\n"

    def read(self, text: str, source: str, axes: TableAxes) -> CompensationTable:
        """Read one- or two-sided lists, with points at even distances or each with its position."""
        listing = _read(text, source, "ssfk", axes.moves, ("setpoint", "pos", "neg"))
        keys, columns = listing.keys, listing.columns
        if keys.get("modulo"):
            raise ConfigError(f"{source}: kw.ssfk.modulo: a rotary axis")
        if not keys.get("bilateral"):
            columns["neg"] = columns["pos"]
        n, step = keys.get("kw_nr_max", 0), keys.get("interval", 0)
        if step:
            columns["setpoint"] = {(i,): keys.get("kw_startpos", 0) + step * i for i in range(min(n, MOST_POINTS))}
        if not 0 < n <= MOST_POINTS or any(sorted(of) != [(i,) for i in range(n)] for of in columns.values()):
            raise ConfigError(
                f"{source}: kw.ssfk.kw_nr_max is {n}, with {len(columns['setpoint'])} positions, {len(columns['pos'])} "
                f"values pos and {len(columns['neg'])} neg; each point needs its own, {MOST_POINTS} at most"
            )
        positions = rising(1e-3 * listing.column_um("setpoint", n), source)
        return CompensationTable(
            axes.moves, axes.corrects, positions, listing.column_um("pos", n), listing.column_um("neg", n)
        )


@dataclass(frozen=True)
class CrossList(TableFormat):
    """`kw.crosscomp`: along the master axis for the slave axis; one value for both directions."""

    title: str = "ISG and Beckhoff TwinCAT CNC, kw.crosscomp"
    sign: str = CROSS_SIGN
    use: str = (
        "lr_param.crosscomp 1 in the corrected axis' list (P-AXIS-00047); kopf.achs_nr is its number, master_ax_nr "
        "that of the axis that moves"
    )

    @property
    def limits(self) -> TableLimits:
        """One value for both directions, any distances."""
        return TableLimits(MOST_CROSS, False, "between", False, QUANTUM_UM, LARGEST_CROSS_UM)

    def text(self, table: CompensationTable) -> str:
        """Write the list; its lines with the axes' logical numbers, unknown here, are for the user to complete."""
        places, values = _tenths(table.positions_mm, 1e4), _tenths(table.forward_um, 10.0)
        lines = [
            *_head(self, table),
            f"# kw.crosscomp.master_ax_nr: write the logical number of axis {table.axis} here",
            f"kw.crosscomp.last_index {len(places) - 1}",
            "kw.crosscomp.unit 1",
        ]
        for i, (place, value) in enumerate(zip(places, values, strict=True)):
            lines += [f"kw.crosscomp.table[{i}].setpoint {place}", f"kw.crosscomp.table[{i}].correction {value}"]
        return "\n".join([*lines, end("#")]) + "\n"

    def read(self, text: str, source: str, axes: TableAxes) -> CompensationTable:
        """Read a list of one slave axis."""
        listing = _read(text, source, "crosscomp", axes.corrects, ("setpoint", "correction"))
        n = listing.keys.get("last_index", -1) + 1
        if not 0 < n <= MOST_CROSS or any(sorted(of) != [(i,) for i in range(n)] for of in listing.columns.values()):
            raise ConfigError(
                f"{source}: kw.crosscomp.last_index is {n - 1}, with {len(listing.columns['setpoint'])} positions and "
                f"{len(listing.columns['correction'])} corrections; each point needs its own, {MOST_CROSS} at most"
            )
        positions, errors = rising(1e-3 * listing.column_um("setpoint", n), source), listing.column_um("correction", n)
        return CompensationTable(axes.moves, axes.corrects, positions, errors, errors)


@dataclass(frozen=True)
class PlaneList(TableFormat):
    """`kw.crosscomp2`: over the plane of two master axes for the slave axis; `table[j][i]`, j counts the second one."""

    title: str = "ISG and Beckhoff TwinCAT CNC, kw.crosscomp2"
    sign: str = CROSS_SIGN
    use: str = (
        "lr_param.crosscomp2 1 in the corrected axis' list (P-AXIS-00174); kopf.achs_nr is its number, master1_ax_nr "
        "and master2_ax_nr those of the axes that move"
    )

    @property
    def limits(self) -> TableLimits:
        """One value for both directions, squares of one distance."""
        return TableLimits(MOST_PLANE, False, "plane", True, QUANTUM_UM, LARGEST_CROSS_UM, grid="steps")

    def refuses(self, table: CompensationTable) -> str:
        """Beside the limits: the squares must have the same distance in both axes."""
        first, other = (float(v[1] - v[0]) if len(v) > 1 else 0.0 for v in (table.positions_mm, table.second_mm))
        why = self.limits.refuses(table)
        return why or ("takes the same distance in both axes" if abs(first - other) > 1e-6 * first else "")

    def text(self, table: CompensationTable) -> str:
        """Write the list; its lines with the axes' logical numbers, unknown here, are for the user to complete."""
        first, other = _tenths(table.positions_mm, 1e4), _tenths(table.second_mm, 1e4)
        lines = [
            *_head(self, table),
            f"# kw.crosscomp2.master1_ax_nr: write the logical number of axis {table.axis} here",
            f"# kw.crosscomp2.master2_ax_nr: write the logical number of axis {table.second} here",
            f"kw.crosscomp2.interval {first[1] - first[0]}",
            f"kw.crosscomp2.last_index_master1 {len(first) - 1}",
            f"kw.crosscomp2.last_index_master2 {len(other) - 1}",
            f"kw.crosscomp2.start_position_master1 {first[0]}",
            f"kw.crosscomp2.start_position_master2 {other[0]}",
            "kw.crosscomp2.unit 1",
        ]
        for j, row in enumerate(table.forward_um):
            lines += [f"kw.crosscomp2.table[{j}][{i}].correction {v}" for i, v in enumerate(_tenths(row, 10.0))]
        return "\n".join([*lines, end("#")]) + "\n"

    def read(self, text: str, source: str, axes: TableAxes) -> CompensationTable:
        """Read a list of one slave axis."""
        listing = _read(text, source, "crosscomp2", axes.corrects, ("correction",))
        keys, values = listing.keys, listing.columns["correction"]
        n, m = (keys.get(f"last_index_master{k}", -1) + 1 for k in (1, 2))
        step = keys.get("interval", 0)
        if not (n > 1 and m > 1 and n * m <= MOST_PLANE and step > 0):
            raise ConfigError(
                f"{source}: kw.crosscomp2: {n} x {m} points at a distance of {1e-4 * step:g} mm; needed are 2 x 2 to "
                f"{MOST_PLANE} points at a distance above 0"
            )
        if sorted(values) != [(j, i) for j in range(m) for i in range(n)]:
            raise ConfigError(
                f"{source}: kw.crosscomp2: {len(values)} corrections for {n} x {m} points: is it cut off?"
            )
        errors = 0.1 * np.array([[values[j, i] for i in range(n)] for j in range(m)], dtype=np.float64)
        places = [
            1e-4 * (keys.get(f"start_position_master{k}", 0) + step * np.arange(count, dtype=np.float64))
            for k, count in ((1, n), (2, m))
        ]
        return CompensationTable(axes.moves, axes.corrects, places[0], errors, errors, {}, axes.second, places[1])


@dataclass
class _List:
    """Content of a list on one kind of compensation."""

    keys: dict[str, int]
    columns: dict[str, dict[tuple[int, ...], float]]

    def column_um(self, name: str, n: int) -> Floats:
        """Values of the points 0 to n - 1; positions in µm, too."""
        return 0.1 * np.array([self.columns[name][i,] for i in range(n)], dtype=np.float64)


def _read(text: str, source: str, kind: str, axis: str, columns: tuple[str, ...]) -> _List:
    whole(text, source, "#")
    listing = _List({}, {name: {} for name in columns})
    for line, content in _contents(text):
        entry = _LINE.match(content)
        if entry and entry[1] == "kopf":
            if entry[4] == "log_achs_name":
                same_axis(entry[5], axis, source, line)
            continue
        try:
            if not entry or (entry[1], entry[2]) != ("kw", kind):
                raise ValueError
            word = entry[5].replace("\N{EN DASH}", "-")
            value = float(word) if entry[4] == "correction" else int(word)
            if not abs(value) < 2**31:
                raise ValueError
            if entry[3]:
                listing.columns[entry[4]][tuple(int(k) for k in re.findall(r"\d+", entry[3]))] = value
            else:
                listing.keys[entry[4]] = int(value)
        except (ValueError, KeyError):
            raise ConfigError(f"{source}: line {line}: {content[:60]!r} is no entry of kw.{kind}") from None
    if listing.keys.get("unit") != 1:
        raise ConfigError(f"{source}: kw.{kind}.unit is not 1: in encoder increments, which rtec does not know")
    return listing


def _contents(text: str) -> Iterator[tuple[int, str]]:
    """Lines without their comments, `# …` and `/* … */`."""
    for number, line in enumerate(text.splitlines(), 1):
        if content := re.sub(r"/\*.*?\*/", "", line.partition("#")[0]).strip():
            yield number, content


def _columns(table: CompensationTable) -> tuple[Floats, Floats, Floats]:
    return table.positions_mm, table.forward_um, table.backward_um


def _tenths(values: Floats, scale: float) -> list[int]:
    """Values in 0.1 µm."""
    return [round(scale * v) for v in values.tolist()]


def _head(form: TableFormat, table: CompensationTable) -> list[str]:
    lines = [f"# {form.title}, {table.what}; {UNTRIED}", f"# {form.sign}"]
    lines += [f"# made for: {table.made_for}"] if table.at else []
    for heat in table.heat:
        lines.append(
            f"# each degC of {heat.sensor} above that: lr_param.temp_comp_offset_0 {10 * heat.offset_um:+.3f} (0.1 µm),"
            f" lr_param.temp_comp_coefficient {heat.slope_um_per_m:+.3f} (µm/m), "
            f"lr_param.temp_comp_position_0 = {round(1e4 * heat.reference_mm)} (0.1 µm)"
        )
    lines.append(f"# kopf.achs_nr: write the logical number of axis {table.corrects} here")
    return [*lines, f"kopf.log_achs_name {table.corrects}"]

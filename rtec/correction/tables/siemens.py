"""Siemens SINUMERIK: leadscrew error compensation (LEC) of one axis, and sag compensation (CEC) between axes.

Function manual Extended Functions, 03/2013, 6FC5397-1BP40-3BA1, K3. LEC: page 238 (a positive value moves the machine
axis in the negative direction), page 242 (the printed example). CEC: pages 245, 248, 249; its printed example is in the
802D sl function manual, 11/2012, 6FC5397-1CP10-5BA0, page 222. Temperature: page 225. No control has read our files.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from rtec.arrays import Floats
from rtec.correction.tables.table import (
    UNTRIED,
    CompensationTable,
    TableAxes,
    TableFormat,
    TableLimits,
    number,
    rising,
    same_axis,
)
from rtec.errors import ConfigError

MOST_POINTS: Final = 5000
"""Our own limit; a control has MD38000 (LEC) or MD18342 (CEC): 200 on an 808D, 200 in each CEC table on an 828D."""
QUANTUM_UM: Final = 0.001
SIGN: Final = "error, actual minus nominal, mm; a positive value moves the axis in the negative direction"
USE: Final = "MD32700 $MA_ENC_COMP_ENABLE[0] = 0, load the file, then 1; the axis must be referenced"
USE_CEC: Final = (
    "MD32710 $MA_CEC_ENABLE of the corrected axis = 0, load the file, then 1, SD41300 $SN_CEC_TABLE_ENABLE[t] = 1; "
    "both axes must be referenced"
)

_END = re.compile(r"(M17|M30|M0?2)$", re.IGNORECASE)
_FRAME = re.compile(r"(%\w+|CHANDATA\(\d+\)|M17|M30|M0?2)$", re.IGNORECASE)
_LINE = re.compile(r"\$(AA_ENC_COMP|AN_CEC)(?:_([A-Z_]+))?\s*\[([^\]]*)\]\s*=\s*(\S+)$")
_CEC_KEYS: Final = ("INPUT_AXIS", "OUTPUT_AXIS", "STEP", "MIN", "MAX", "DIRECTION", "MULT_BY_TABLE", "IS_MODULO")
_LEC_KEYS: Final = ("STEP", "MIN", "MAX", "IS_MODULO")


@dataclass(frozen=True)
class EncoderCompensation(TableFormat):
    """LEC: one table of one axis, of its first measuring system; mm."""

    title: str = "Siemens SINUMERIK LEC, $AA_ENC_COMP"
    sign: str = SIGN
    use: str = USE

    @property
    def limits(self) -> TableLimits:
        """One value for both directions, at even distances."""
        return TableLimits(MOST_POINTS, False, "own", True, QUANTUM_UM, grid="steps", adds_heat=True)

    def text(self, table: CompensationTable) -> str:
        """Write the table; the channel's name of axis X is taken to be X1."""
        axis = f"{table.axis}1"
        lines = [
            "%_N_AX_EEC_INI",
            "CHANDATA(1)",
            *_head(self, table, f"axis {axis}"),
            *(f"$AA_ENC_COMP[0,{n},{axis}]={_mm(v)}" for n, v in enumerate(table.forward_um.tolist())),
            *(f"$AA_ENC_COMP_{key}[0,{axis}]={value}" for key, value in _range(table).items()),
            f"$AA_ENC_COMP_IS_MODULO[0,{axis}]=0",
            "M17",
        ]
        return "\n".join(lines) + "\n"

    def read(self, text: str, source: str, axes: TableAxes) -> CompensationTable:
        """Read the first measuring system's table of the file's one axis."""
        values = _Values()
        names: set[str] = set()
        for line, what, key, words, value in _lines(text, source, "AA_ENC_COMP"):
            if (key and key not in _LEC_KEYS) or len(words) != (2 if key else 3):
                raise _no_entry(source, line, what, "$AA_ENC_COMP")
            names.add(words[-1])
            same_axis(words[-1], axes.moves, source, line)
            values.put(source, line, key, words[1], value)
        if len(names) != 1:
            raise ConfigError(f"{source}: tables of {len(names)} axes ({', '.join(sorted(names))}); one is needed")
        positions, errors = values.table(source, "$AA_ENC_COMP")
        return CompensationTable(axes.moves, axes.corrects, positions, errors, errors)


@dataclass(frozen=True)
class CrossErrorCompensation(TableFormat):
    """CEC: along one axis for another axis, or for itself; two tables where the directions differ; mm."""

    title: str = "Siemens SINUMERIK CEC, $AN_CEC"
    sign: str = SIGN
    use: str = USE_CEC

    @property
    def limits(self) -> TableLimits:
        """A table for each direction, at even distances."""
        return TableLimits(MOST_POINTS, True, "either", True, QUANTUM_UM, grid="steps", adds_heat=True)

    def text(self, table: CompensationTable) -> str:
        """Write table 0 for both directions, or tables 0 and 1; the names of X and Y are taken to be X1 and Y1."""
        same = np.array_equal(table.forward_um, table.backward_um)
        columns = [(0, table.forward_um)] if same else [(1, table.forward_um), (-1, table.backward_um)]
        lines = ["%_N_NC_CEC_INI", "CHANDATA(1)", *_head(self, table, f"{table.corrects}1 along {table.axis}1")]
        for t, (direction, values) in enumerate(columns):
            keys = {
                "INPUT_AXIS": f"({table.axis}1)",
                "OUTPUT_AXIS": f"({table.corrects}1)",
                **_range(table),
                "DIRECTION": f"{direction}",
                "MULT_BY_TABLE": "0",
                "IS_MODULO": "0",
            }
            lines += [f"$AN_CEC[{t},{n}]={_mm(v)}" for n, v in enumerate(values.tolist())]
            lines += [f"$AN_CEC_{key}[{t}]={value}" for key, value in keys.items()]
        return "\n".join([*lines, "M17"]) + "\n"

    def read(self, text: str, source: str, axes: TableAxes) -> CompensationTable:
        """Read the tables from this axis to that one, of any number, in a file that may hold others."""
        tables: dict[str, _Values] = {}
        for line, what, key, words, value in _lines(text, source, "AN_CEC"):
            places = words if key or len(words) == 2 else words[0].split(".")  # the manual also prints [0.1]
            if (key and key not in _CEC_KEYS) or len(places) != (1 if key else 2):
                raise _no_entry(source, line, what, "$AN_CEC")
            tables.setdefault(places[0], _Values()).put(source, line, key, places[-1], value)
        what = f"{axes.corrects} along {axes.moves}"
        of = {
            t: v for t, v in tables.items() if _is(v, "INPUT_AXIS", axes.moves) and _is(v, "OUTPUT_AXIS", axes.corrects)
        }
        if not of:
            raise ConfigError(f"{source}: no table of {what} among {len(tables)} of $AN_CEC")
        by_direction: dict[float, tuple[Floats, Floats]] = {}
        for t, values in of.items():
            if values.keys.get("MULT_BY_TABLE"):
                raise ConfigError(f"{source}: $AN_CEC_MULT_BY_TABLE[{t}]: multiplied by another table")
            direction = values.keys.get("DIRECTION", 0.0)
            if direction in by_direction:
                raise ConfigError(f"{source}: two tables of {what} for direction {direction:g}")
            by_direction[direction] = values.table(source, f"$AN_CEC[{t}]")
        if set(by_direction) not in ({0.0}, {1.0, -1.0}):
            raise ConfigError(
                f"{source}: $AN_CEC_DIRECTION of {what}: {', '.join(f'{d:g}' for d in by_direction)}; needed is 0, or "
                "1 and -1"
            )
        positions, forward = by_direction.get(0.0) or by_direction[1.0]
        other, backward = by_direction.get(0.0) or by_direction[-1.0]
        if not np.array_equal(positions, other):
            backward = np.interp(positions, other, backward)
        others = len(tables) - len(of)
        return CompensationTable(axes.moves, axes.corrects, positions, forward, backward, others=others)


@dataclass
class _Values:
    """Points and keys of one table, as far as it is read."""

    points: dict[int, float] = field(default_factory=dict)
    keys: dict[str, float] = field(default_factory=dict)
    names: dict[str, str] = field(default_factory=dict)

    def put(self, source: str, line: int, key: str, place: str, value: str) -> None:
        """Store the value of one line."""
        if key.endswith("_AXIS"):
            self.names[key] = value.strip("()")
        elif key:
            self.keys[key] = number(value, source, line)
        elif place.strip().isdecimal() and len(place) < 9:
            self.points[int(place)] = number(value, source, line)
        else:
            raise ConfigError(f"{source}: line {line}: {place[:30]!r} is no number of a point")

    def table(self, source: str, what: str) -> tuple[Floats, Floats]:
        """Positions and errors, µm: (n,) each."""
        keys, points = self.keys, self.points
        if missing := {"STEP", "MIN"} - keys.keys():
            raise ConfigError(f"{source}: without {what.partition('[')[0]}_{min(missing)}")
        if keys.get("IS_MODULO"):
            raise ConfigError(f"{source}: {what}: a table with modulo function, of a rotary axis")
        if keys["STEP"] <= 0 or sorted(points) != list(range(len(points))) or len(points) > MOST_POINTS:
            raise ConfigError(
                f"{source}: {what}: {len(points)} points at a distance of {keys['STEP']:g} mm; needed are points "
                f"0, 1, 2, … at a distance above 0, {MOST_POINTS} at most"
            )
        used = len(points)
        if "MAX" in keys:
            used = int(np.floor((keys["MAX"] - keys["MIN"]) / keys["STEP"] + 1e-6)) + 1
            if used > len(points):
                raise ConfigError(
                    f"{source}: {what}: {len(points)} points, and up to MAX = {keys['MAX']:g} mm there are {used}: is "
                    "the file cut off?"
                )
        positions = rising(keys["MIN"] + keys["STEP"] * np.arange(used, dtype=np.float64), source)
        return positions, 1e3 * np.array([points[k] for k in range(used)])


def _head(form: TableFormat, table: CompensationTable, what: str) -> list[str]:
    lines = [f"; {form.title}, {what}; {UNTRIED}", f"; {form.sign}"]
    lines += [f"; made for: {table.made_for}"] if table.at else []
    axis = f"{table.axis}1"
    for heat in table.heat:
        lines.append(
            f"; each degC of {heat.sensor} above that: "
            f"SD43900 $SA_TEMP_COMP_ABS_VALUE[{axis}] {1e-3 * heat.offset_um:+.6f}, "
            f"SD43910 $SA_TEMP_COMP_SLOPE[{axis}] {1e-6 * heat.slope_um_per_m:+.9f}, "
            f"SD43920 $SA_TEMP_COMP_REF_POSITION[{axis}] = {heat.reference_mm:g}"
        )
    return lines


def _range(table: CompensationTable) -> dict[str, str]:
    positions = table.positions_mm
    step = (positions[-1] - positions[0]) / (len(positions) - 1)
    return {"STEP": f"{step:.9g}", "MIN": f"{positions[0]:.9g}", "MAX": f"{positions[-1]:.9g}"}


def _mm(error_um: float) -> str:
    return f"{1e-3 * error_um + 0.0:.6f}"


def _lines(text: str, source: str, what: str) -> Iterator[tuple[int, str, str, list[str], str]]:
    """Line, content, key ("" of a value), indices and value of each entry."""
    contents = [(n, line.partition(";")[0].strip()) for n, line in enumerate(text.splitlines(), 1)]
    used = [content for _, content in contents if content]
    if used and used[0].startswith("%") and not _END.match(used[-1]):
        raise ConfigError(f"{source}: begins with {used[0][:30]} and does not end with M17: is the file cut off?")
    for n, content in contents:
        if not content or _FRAME.match(content):
            continue
        match = _LINE.match(content)
        if not match or match[1] != what:
            raise _no_entry(source, n, content, f"${what}")
        yield n, content, match[2] or "", [word.strip() for word in match[3].split(",")], match[4]


def _no_entry(source: str, line: int, content: str, what: str) -> ConfigError:
    return ConfigError(f"{source}: line {line}: {content[:60]!r} is no value of {what}")


def _is(values: _Values, key: str, axis: str) -> bool:
    """Can the name be that of the axis? AX1 and the like can name any axis."""
    try:
        same_axis(values.names.get(key, ""), axis, "", 0)
    except ConfigError:
        return False
    return key in values.names

"""Roles of the columns of a foreign table: time, runs, positions, readings, temperatures; asks about unclear ones."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from rtec.arrays import Bools, Floats
from rtec.effects.derived import direction_track
from rtec.errors import MeasurementError
from rtec.machine import Machine
from rtec.metrology.diagonal import diagonal
from rtec.metrology.importing.map import WHOLE
from rtec.metrology.importing.words import (
    axis_letter,
    bare_unit,
    difference,
    direction_meant,
    has,
    in_diameter,
    is_nominal,
    is_part,
    is_place,
    sensor_called,
    sensor_name,
    sensors_like,
    sign_said,
    turns_other,
    unknown_unit,
    words_of,
)
from rtec.metrology.instruments.registry import INSTRUMENTS
from rtec.metrology.readers.base import ForeignTable, number_or_none
from rtec.metrology.readers.delimited import unit_named
from rtec.metrology.readers.layout import Guess
from rtec.metrology.units import UNITS, convert
from rtec.metrology.unread import is_rotary
from rtec.wording import counted

DATES = (
    "%d.%m.%Y", "%d.%m.%y", "%Y-%m-%d", "%Y/%m/%d", "%Y.%m.%d", "%d/%m/%Y", "%m/%d/%Y", "%d-%m-%Y", "%m-%d-%Y",
    "%d/%m/%y", "%m/%d/%y", "%d-%b-%Y", "%d %b %Y", "%Y%m%d",
)  # fmt: skip
MINUTES: Final = "%M:%S"
ELAPSED: Final = frozenset({"elapsed", "duration", "dauer", "laufzeit", "verstrichen"})
"""Words for a time since the begin, of which 0:12 is twelve seconds."""
CORRECTS: Final = frozenset({"correction", "compensation", "comp", "korrektur", "korrekturwert", "kompensation"})
"""Words for a value that is added to a position, so that its sign is that of nominal minus actual."""
CLOCKS = ("%H:%M:%S", "%H:%M:%S.%f", "%H:%M:%S,%f", "%H:%M", "%I:%M:%S %p", "%I:%M %p")
JOINS = (" ", "T", "-", "_", ", ")
TRIED = 400
"""Number of cells on which a format of time is tried."""
FEW_LINES = 2
"""Up to this many lines without a time count as remarks above or below the rows."""
SMALL = 0.1
"""Deviations are below this share of the travel; an actual position differs from its nominal one by less."""
SAME: Final = 0.05
"""Distances that differ by a smaller share are the same, but for rounding."""
BY_LETTER = ("tool_tip", "grid_encoder", "squareness")
"""Instruments with a reading in each of several directions."""
BAR_MM, BAR_VARIES = 10.0, 0.01
"""A column is the length of a ball bar if it is above the first, and varies by less than the second share."""
TURNED_DEG = 1.0
"""An angle that varies by more is that of a rotary axis: errors of machines are far smaller."""
CLEAR = 0.9
"""Share of the motions that must agree with the meaning of a number."""
MEANS = {1: "actual minus nominal", -1: "nominal minus actual, turned round"}
LEAVE = "leave out"
LENGTH_HINT = "um, mm, inch; for counts the size of one, such as 2.5 um"
HOT, ROOM = 60.0, 45.0
"""Medians: from the first on, a temperature without a unit may be in °F or K. Where one is below the second, a room is
not in °F, and °C is assumed of the others, too."""
UNIX = (1e8, 5e9)
UNIX_MS = (1e11, 5e12)
EXCEL = (20000.0, 80000.0)


class Asks(Protocol):
    """Asks a question given by its fields; gives the answer, the default, or None."""

    def __call__(
        self, key: str, text: str, choices: tuple[str, ...] = (), default: str | None = None, hint: str = ""
    ) -> str | None:
        """Ask one question; arguments as the fields of `ImportQuestion`."""


@dataclass(frozen=True)
class _When:
    """A format of time that fits all cells."""

    column: str
    keys: dict[str, Any]
    reason: str


def sensors_of(columns: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """The questions about sensors that the columns of a map answer."""
    named = {n: c["from"] for n, c in columns.items() if n.endswith("_degc") and "from" in c}
    return {f"sensor of {name}": target.removesuffix("_degc") for target, name in named.items()}


class ColumnRoles:
    """Assigns roles to the columns of a table.

    Args:
        table: table of the file; an event log as columns.
        machine: the measured machine, or None.
        preset: known tables of a map.
        ask: asks the user.
        is_log: whether each channel has times of its own.
        remarks: line numbers and texts of the lines of the file that are no rows.

    Attributes:
        use: column of the measurement and the reason, by column of the file.
        units: units of the columns of the file, as far as known.
        guesses: further conclusions.
        settled: questions that the file answers itself, with the answer.
        bar_mm: median of the reading where it is the length of a ball bar, else None.
        line: direction in X, Y and Z in which several axes move together; None where they do not.
        of_parts: whether the runs are parts, by the name of their column.
        coordinates: actual and nominal position in each direction, by letter, where the file has several.
    """

    def __init__(
        self,
        table: ForeignTable,
        machine: Machine | None,
        preset: Mapping[str, Any],
        ask: Asks,
        *,
        is_log: bool,
        remarks: Sequence[tuple[int, str]] = (),
    ) -> None:
        self.remarks = remarks
        self.table, self.machine, self.preset, self.ask, self.is_log = table, machine, preset, ask, is_log
        self.use: dict[str, tuple[str, str]] = {}
        self.units = {n: u for n in table.columns if (u := table.units.get(n) or bare_unit(n))}
        self.guesses: list[Guess] = []
        self.settled = {f"unit of {n}": u for n, u in self.units.items()}
        self.bar_mm: float | None = None
        self.line: tuple[float, ...] | None = None
        self.coordinates: dict[str, tuple[str, str]] = {}
        self.of_parts = False
        self.columns: dict[str, dict[str, Any]] = {n: dict(c) for n, c in preset.get("column", {}).items()}
        for target, column in self.columns.items():
            if "from" in column:
                self.use[str(column["from"])] = (target, "given")
        self.settled |= sensors_of(self.columns)

    def content(self) -> dict[str, Any]:
        """The map without `[source]`, `[events]` and `[setup]`."""
        time = dict(self.preset.get("time", {})) or self._time()
        run = self._run_column()
        self._temperatures()
        self._motion()
        measurement = self._measured(dict(self.preset.get("measurement", {})))
        if not run:
            run = self._runs(measurement)
        self._directions(measurement)
        kind = INSTRUMENTS.get(measurement.get("instrument", ""))
        if kind is not None and kind.axis_use == "none" and "axis" not in self.preset.get("measurement", {}):
            measurement.pop("axis", None)
        out: dict[str, Any] = {"measurement": measurement, "time": time, "run": dict(self.preset.get("run", run))}
        if rows := dict(self.preset.get("rows", {})) or self._rows(time.get("column")):
            out["rows"] = rows
        return out | {"column": self.columns}

    def log(self) -> dict[str, Any]:
        """`[temperatures]` without the file: the time, and columns of temperatures, spindle speed, feed and load."""
        time = dict(self.preset.get("time", {})) or self._time()
        self._temperatures()
        self._motion()
        out: dict[str, Any] = {"time": time, "column": self.columns}
        if rows := dict(self.preset.get("rows", {})) or self._rows(time.get("column")):
            out["rows"] = rows
        return out

    def _free(self, *, texts: bool = False) -> list[str]:
        return [n for n, v in self.table.columns.items() if n not in self.use and (v.dtype == np.object_) == texts]

    def _values(self, name: str) -> Floats:
        return self.table.columns[name].astype(np.float64)

    def _finite(self, name: str) -> Floats:
        values = self._values(name)
        return values[np.isfinite(values)]

    def _take(self, name: str, target: str, reason: str, **keys: Any) -> None:
        unit = (
            {} if "unit" in keys or self.table.units.get(name) or name not in self.units else {"unit": self.units[name]}
        )
        hold = {"fill": "hold"} if self.is_log and not target.startswith("reading") else {}
        self.columns[target] = {"from": name, **unit, **keys, **hold}
        self.use[name] = (target, reason)

    # --- time

    def _time(self) -> dict[str, Any]:
        """`[time]`."""
        found = self._moment() or self._number_of_time()
        if found is None:
            self.guesses.append(Guess("time", None, "made up: the file has no time, its rows are taken as 1 s apart"))
            return {"step_s": 1.0}
        self.use[found.column] = ("time_s", found.reason)
        keys = {"column": found.column, **found.keys}
        if found.column in self._numbers_all() and not keys.get("format"):
            values = self._finite(found.column)
            if len(values) > 1 and (np.diff(values) < 0).any():
                keys["restarts"] = True
                self.guesses.append(
                    Guess("time.restarts", True, f"{found.column!r} falls: every run has its own clock")
                )
        return keys

    def _numbers_all(self) -> list[str]:
        return [n for n, v in self.table.columns.items() if v.dtype != np.object_]

    def _moment(self) -> _When | None:
        """Texts that are date and time; date and time of day in two columns; time of day alone."""
        clock = None
        dates: list[tuple[str, tuple[str, ...]]] = []
        texts = self._free(texts=True)
        whole = self._is_row() if texts else np.zeros(0, dtype=np.bool_)
        for name in texts:
            cells = [str(v) for v, row in zip(self.table.columns[name], whole, strict=True) if v and row]
            cells = cells[:TRIED]
            if not cells:
                continue
            if "T" in cells[0] and (forms := ["iso"] if _iso(cells) else []):
                return _When(name, {"unit": "iso"}, "date and time as in ISO 8601")
            forms = [d + j + c for d in DATES for j in JOINS for c in CLOCKS if _fit(cells, d + j + c)]
            if forms:
                form = self._which(name, forms)
                return _When(name, {"format": form}, f"date and time, {form}")
            days = tuple(d for d in DATES if _fit(cells, d))
            if days:
                dates.append((name, days))
            forms = [c for c in CLOCKS if _fit(cells, c)]
            if forms[:1] == ["%H:%M"] and ELAPSED & set(words_of(name)) and _fit(cells, MINUTES):
                forms = [MINUTES]
            clock = clock or ((name, forms[0]) if forms else None)
        if clock is None:
            return None
        if dates:
            name, days = dates[0]
            day = self._which(name, list(days))
            self.use[name] = ("time_s", f"date, {day}")
            return _When(clock[0], {"date": name, "format": f"{day} {clock[1]}"}, f"time of day, {clock[1]}")
        of = "minutes and seconds" if clock[1] == MINUTES else "time of day"
        return _When(clock[0], {"format": clock[1]}, f"{of}, {clock[1]}; no date in the file")

    def _is_row(self) -> Bools:
        """Whether each line has more than one cell; `End of test;;;` does not."""
        if len(self.table.columns) <= 2:
            return np.ones(len(self.table), dtype=np.bool_)
        filled = np.zeros(len(self.table), dtype=np.int64)
        for column in self.table.columns.values():
            filled += _filled(column)
        return np.asarray(filled > 1)

    def _which(self, name: str, forms: list[str]) -> str:
        """Day before month, or month before day; asks where the cells allow both."""
        shortest = [f for f in forms if len(f) == min(map(len, forms))]
        if len({f[:5] for f in shortest}) == 1 or not {"%d/%m", "%m/%d", "%d-%m", "%m-%d"} & {f[:5] for f in shortest}:
            return shortest[0]
        choices = tuple(shortest)
        return self.ask(f"date of {name}", "Is the day or the month first?", choices, choices[0]) or choices[0]

    def _number_of_time(self) -> _When | None:
        """A column of numbers that is a time by its name, its unit or its size."""
        for name in sorted(self._free(), key=lambda n: not has(n, "time")):
            unit, values = self.units.get(name, ""), self._finite(name)
            is_unit = bool(unit) and UNITS[unit].kind == "time"
            if not (has(name, "time") or is_unit) or not len(values) or (unit and not is_unit):
                continue
            if is_unit:
                given = {} if self.table.units.get(name) else {"unit": unit}
                return _When(name, given, f"time in {unit}, as its name says")
            return self._epoch(name, values)
        return None

    def _epoch(self, name: str, values: Floats) -> _When | None:
        low, high = float(values.min()), float(values.max())
        if low > 1e16:
            return _When(name, {"unit": "filetime"}, "numbers of this size are FILETIME, 100 ns since 1601")
        if UNIX[0] < low and high < UNIX[1]:
            return _When(name, {"unit": "unix"}, "numbers of this size are seconds since 1970")
        if UNIX_MS[0] < low and high < UNIX_MS[1]:
            return _When(name, {"unit": "ms"}, "numbers of this size are milliseconds since 1970")
        if EXCEL[0] < low and high < EXCEL[1] and (values % 1).any() and high - low < 400:
            return _When(name, {"unit": "excel"}, "numbers of this size are days since 1900")
        if (np.diff(values) < 0).sum() > len(values) // 3:
            return None
        unit = self.ask(f"unit of {name}", f"Unit of the time {name!r}?", ("s", "ms", "min", "h"), "s")
        return _When(name, {"unit": unit}, "time by its name")

    # --- runs, temperatures and motion

    def _run_column(self) -> dict[str, Any]:
        for name in self._free():
            values = self._values(name)
            if not np.array_equal(values, np.round(values)) or self._is_direction(name):
                continue
            self.of_parts = self._is_part(name, values)
            if has(name, "run") or self.of_parts:
                self.use[name] = ("run", f"numbers of {'parts' if self.of_parts else 'runs'}, by its name")
                return {"column": name}
        return {}

    def _is_part(self, name: str, values: Floats) -> bool:
        """Whether a column has the numbers of parts by its name, and the rows of each part are together."""
        together = np.count_nonzero(np.diff(values)) == len(np.unique(values)) - 1
        return is_part(name) and together and not self.units.get(name) and not self._warm(name)

    @property
    def reads_diameter(self) -> bool:
        """Whether the reading is the diameter of a part: by its name, which has no axis."""
        name = self.columns.get("reading_um", {}).get("from", "")
        return in_diameter(name) and not axis_letter(name)

    def _temperatures(self) -> None:
        sensors = self.machine.sensor_names if self.machine else ()
        medians = [np.median(self._finite(n)) for n in self._free() if not self.units.get(n) and self._warm(n)]
        usual = "°C" if min(medians, default=HOT) < ROOM else None
        for name in self._free():
            unit = self.units.get(name, "")
            like = bool(unit) and UNITS[unit].kind == "temperature"
            if not (like or (not unit and self._warm(name))):
                continue
            reason = f"a temperature in {unit}" if like else "a temperature, by its name and its values"
            median = float(np.median(self._finite(name)))
            if not like:
                unit = "degf" if words_of(name)[1:] and words_of(name)[-1] == "f" else "degc" if median < HOT else ""
                unit = "" if unknown_unit(name) else unit
                self.settled |= {f"unit of {name}": unit} if unit else {}
            target = self._sensor(name, sensors) if sensors else sensor_name(name)
            if not target or f"{target}_degc" in self.columns:
                why = {None: "of no sensor known yet", "": "left out"}.get(target, f"a second one for {target}")
                self.use[name] = ("", f"{reason}, {why}")
                continue
            if not unit:
                text = f"Unit of the temperature {name!r}? Half of its values are above {median:g}."
                unit = self.ask(f"unit of {name}", text, ("°C", "°F", "K"), usual) or ""
            if not unit:
                self.use[name] = ("", f"{reason}, in a unit not known yet")
                continue
            unit_key = {} if self.table.units.get(name) else {"unit": unit}
            self._take(name, f"{target}_degc", reason, **unit_key)

    def _warm(self, name: str) -> bool:
        """Whether a column without a unit is a temperature: by its name, its values, and if it is no setting."""
        values = self._finite(name)
        named = has(name, "temperature") or re.fullmatch(r"(?i)t(_.*|\d+)|.*_t\d*|.*temp", name.strip()) is not None
        named = named or any(map(is_place, words_of(name)))
        known = self.machine is not None and sensor_called(name, self.machine.sensor_names) != ""
        if not (named or known) or has(name, "setting") or not len(values):
            return False
        return bool(-60.0 < np.median(values) < 500.0)

    def _sensor(self, name: str, sensors: tuple[str, ...]) -> str | None:
        """The machine's sensor; "" where the column is not used, None where the question is not answered."""
        fitting = sensors_like(name, sensors)
        if len(fitting) == 1:
            self.settled[f"sensor of {name}"] = fitting[0]
            return fitting[0]
        choices = (*(fitting or sensors), LEAVE)
        usual = LEAVE if self.preset.keys() >= WHOLE else None
        answer = self.ask(f"sensor of {name}", f"Which sensor of the machine is {name!r}?", choices, usual)
        return "" if answer == LEAVE else answer

    def _motion(self) -> None:
        """Spindle speed, feed and load; of two the one that is no setting, else the first."""
        for name in sorted(self._free(), key=lambda n: has(n, "setting") or has(n, "nominal")):
            unit = self.units.get(name, "")
            kind = UNITS[unit].kind if unit else ""
            keys = {}
            if (kind == "turning" or (not unit and has(name, "spindle"))) and not turns_other(name):
                target, what, keys = "spindle_rpm", "the spindle's speed", {} if unit else {"unit": "rpm"}
            elif kind == "speed" and (has(name, "feed") or words_of(name)[:1] == ["f"]):
                target, what = "feed_mm_min", "feed"
            elif kind == "mass":
                target, what = "load_kg", "load"
            else:
                continue
            if target in self.columns:
                self.use[name] = ("", f"a second column of {target}")
            else:
                self._take(name, target, what, **keys)

    # --- positions and readings

    def _measured(self, head: dict[str, Any]) -> dict[str, Any]:
        """`[measurement]`, with the columns of positions and readings."""
        if head.get("instrument") == "ball_bar":
            self._angle()
        else:
            self._rotary()
        free = [n for n in self._free() if len(self._finite(n)) and not self._is_direction(n)]
        readings = [n for n in self.columns if n.startswith("reading")]
        deviations = [n for n in free if self._is_reading(n)]
        if head.get("instrument") == "ball_bar" and not deviations:
            deviations = self._bars(free)
        rest = [n for n in free if n not in deviations]
        actual = [n for n in rest if has(n, "actual")]
        nominal = [n for n in rest if n not in actual and self._is_position(n)]
        nominal.sort(key=lambda n: (n not in self.units, not has(n, "nominal"), words_of(n)[0] in ("position", "pos")))
        if not readings:
            self.coordinates = self._coordinates(actual, nominal)
            deviations = [n for n in deviations if not self._is_length_of_deviation(n)]
        if not deviations and not readings and not (actual and nominal):
            deviations, nominal = self._by_size(rest, nominal)
            actual = []
        by_axis = self._positions(nominal, head)
        if not readings:
            self._reading(deviations, actual, nominal, head)
        self._head(head, by_axis, nominal)
        return head

    def _angle(self) -> None:
        """The angle on a ball bar's circle."""
        for name in self._free():
            unit = self.units.get(name, "")
            if "angle_deg" in self.columns or not (UNITS[unit].kind == "angle" if unit else has(name, "angle")):
                continue
            keys = {}
            if not unit:
                answer = self.ask(f"unit of {name}", f"Unit of the angle {name!r}?", (), "deg", "deg, rad, mrad")
                keys = self._in_unit(answer, name, "angle")
            self._take(name, "angle_deg", "the angle on the circle", **keys)

    def _rotary(self) -> None:
        """The angles of rotary axes, which nothing reads; `diagnose` asks whether the readings depend on them."""
        for name in self._free():
            unit, letters = self.units.get(name, ""), [w for w in words_of(name) if w in ("a", "b", "c")]
            target = f"{letters[0] if len(letters) == 1 else 'angle'}_deg"
            if unit not in ("deg", "rad") or target in self.columns or not is_rotary(name):
                continue
            values = self._finite(name)
            if len(values) and float(np.ptp(convert(values, unit, "deg"))) > TURNED_DEG:
                self._take(name, target, "the angle of a rotary axis, which rtec does not read")

    def _bars(self, free: Sequence[str]) -> list[str]:
        """The columns of a ball bar's length: by their names, else by their sizes."""
        lengths = [n for n in free if UNITS[self.units.get(n, "mm")].kind == "length" and not axis_letter(n)]
        return [n for n in lengths if has(n, "bar")] or [n for n in lengths if n in self.units and self._of_bar(n)]

    def _of_bar(self, name: str) -> float | None:
        """Median of a column that has the size of a ball bar's length throughout, in its unit; None where it has not.

        Errors of machines are far smaller; a radius without a unit is in mm.
        """
        values = self._finite(name)
        median = float(np.median(values))
        low = BAR_MM / UNITS[self.units.get(name, "mm")].factor
        return median if median > low and 0.0 < _spread(values) < BAR_VARIES * median else None

    def _bar(self, name: str) -> bool:
        """Take the length of a ball bar as the reading, without its offset; whether the column is a length."""
        if (median := self._of_bar(name)) is None:
            return False
        keys = self._length(name, "um" if median > BAR_MM / UNITS["um"].factor else "mm", "length")
        self.settled["sign"] = "+1"
        self.bar_mm = median * keys.get("scale", 1.0) * UNITS[self.units.get(name) or keys["unit"]].factor
        self._take(name, "reading_um", "the length of the bar, less its nominal length", **keys)
        return True

    def _is_reading(self, name: str) -> bool:
        unit = self.units.get(name, "")
        kind = UNITS[unit].kind if unit else ""
        if kind not in ("", "length", "angle") or self._is_actual_place(name):
            return False
        if difference(name) is not None or (has(name, "actual") and self._is_small(name)):
            return True
        if unit in ("um", "nm", "mil", "uinch") or kind == "angle":
            return not has(name, "nominal")
        return has(name, "deviation")

    def _is_actual_place(self, name: str) -> bool:
        """Whether a column is an actual position, not a deviation: it follows a nominal position."""
        if not has(name, "actual") or has(name, "deviation"):
            return False
        return any(self._follows(name, n) for n in self._nominal_places(name))

    def _is_small(self, name: str) -> bool:
        """Whether the values are far below the travel of the nominal positions that it may belong to."""
        pairs = [pair for n in self._nominal_places(name) for pair in self._pairs(name, n) if _spread(pair[1]) > 0.0]
        return bool(pairs) and all(np.abs(v).max() < SMALL * _spread(w) for v, w in pairs)

    def _nominal_places(self, name: str) -> list[str]:
        """The nominal positions that a column may belong to, by the letter of the axis."""
        others = [n for n in self._free() if n != name and not has(n, "actual") and not has(n, "deviation")]
        letters = ("", axis_letter(name)) if axis_letter(name) else ("", *"XYZUVW")
        return [n for n in others if self._is_position(n) and axis_letter(n) in letters and len(self._finite(n))]

    def _pairs(self, name: str, place: str) -> list[tuple[Floats, Floats]]:
        """The values of two columns where both have one: in mm, and as they are where the unit of one is unknown."""
        raw = np.stack([self._values(name), self._values(place)])
        raw = raw[:, np.isfinite(raw).all(axis=0)]
        units = [self.units.get(n, "") for n in (name, place)]
        mm = raw * np.array([[UNITS[u].factor if u else 1.0] for u in units])
        both = [mm] if all(units) or units == ["", ""] else [mm, raw]
        return [(v[0], v[1]) for v in both if v.shape[1]]

    def _follows(self, name: str, place: str) -> bool:
        """Whether a column has the values of a position, but for a constant and what is small beside its travel."""
        return any(_is_like(v, w) for v, w in self._pairs(name, place))

    def _is_position(self, name: str) -> bool:
        unit = self.units.get(name, "")
        if (unit and UNITS[unit].kind != "length") or self._is_direction(name):
            return False
        return bool(axis_letter(name)) or is_nominal(name) or unit in ("mm", "m", "inch", "cm")

    def _by_size(self, rest: list[str], nominal: list[str]) -> tuple[list[str], list[str]]:
        """Where no name means a reading: the only column that is no position; asks where there are several."""
        lengths = [n for n in rest if not self.units.get(n) or UNITS[self.units[n]].kind in ("length", "angle")]
        lengths = [n for n in lengths if not has(n, "index") and not has(n, "setting")] or lengths
        others = [n for n in lengths if n not in nominal]
        choices = tuple(dict.fromkeys([*others, *nominal]))
        if not choices:
            return [], nominal
        whole = len(others) == 1 and np.array_equal(self._finite(others[0]), np.round(self._finite(others[0])))
        usual = others[0] if len(others) == 1 and nominal and not whole else None
        name = self.ask("reading", "Which column is the reading?", choices, usual)
        return ([name], [n for n in nominal if n != name]) if name else ([], [])

    def _positions(self, nominal: Sequence[str], head: dict[str, Any]) -> dict[str, str]:
        """Assign the positions; gives the axis of each. A name without a letter belongs to the axis of the answer."""
        axes = self.machine.axis_names if self.machine else ()
        out: dict[str, str] = {}
        for name in nominal:
            letter = axis_letter(name)
            if letter and axes and letter not in axes:
                self.use[name] = ("", f"the machine has no axis {letter}")
                continue
            if not letter and head.get("axis") is None:
                choices = tuple(axes) or ("X", "Y", "Z")
                head["axis"] = self.ask("axis", "Which axis moved?", choices, axes[0] if len(axes) == 1 else None)
            letter = letter or head["axis"] or ""
            if not letter or letter in out.values():
                why = "a second position" if letter else "a position, of an axis not known yet"
                self.use.setdefault(name, ("", why))
                continue
            self._take(name, f"{letter.lower()}_mm", f"position of {letter}", **self._length(name))
            out[name] = letter
        return out

    def _length(self, name: str, usual: str | None = "mm", what: str = "position") -> dict[str, Any]:
        """`unit` of a position or another length where the file lacks it, and `scale` where the numbers are counts."""
        if self.units.get(name):
            return {}
        answer = self.ask(f"unit of {name}", f"Unit of the {what} {name!r}?", (), usual, LENGTH_HINT)
        return self._in_unit(answer, name, "length")

    def _in_unit(self, answer: str | None, name: str, *kinds: str) -> dict[str, Any]:
        """`unit` and `scale` of an answer such as "um" or "2.5 um"; empty where there is none."""
        if answer is None:
            return {}
        size, _, word = answer.strip().rpartition(" ")
        unit, scale = unit_named(word), number_or_none(size) if size else 1.0
        if unit not in UNITS or UNITS[unit].kind not in kinds or not scale or not np.isfinite(scale):
            allowed = ", ".join(u for u, x in UNITS.items() if x.kind in kinds)
            raise MeasurementError(
                f"unit of {name}: {answer!r} is none; allowed: {allowed}, or a number and one of these"
            )
        return {"unit": unit} | ({"scale": scale} if scale != 1.0 else {})

    def _reading(
        self,
        deviations: Sequence[str],
        actual: Sequence[str],
        nominal: Sequence[str],
        head: dict[str, Any],
    ) -> None:
        """The reading: a deviation, or actual minus nominal; its unit and its sign."""
        if deviations:
            name = deviations[0]
            if len(deviations) > 1:
                if self._several(deviations, head):
                    return
                picked = self.ask("reading", "Which column is the reading?", tuple(deviations), None)
                for other in deviations:
                    if other != picked:
                        self.use[other] = (
                            "",
                            "could be the reading" if picked is None else "another reading than that asked for",
                        )
                if picked is None:
                    return
                name = picked
            if head.get("instrument") == "ball_bar" and self._bar(name):
                return
            if len(deviations) > 1 or not axis_letter(name) or not self._several([name], head):
                self._deviation(name, actual, nominal, head)
            return
        pairs = self._tool_tip(head)
        if not pairs and actual and nominal and (pair := self._pair(actual, nominal)):
            pairs = {self._coordinate(pair[0], head): pair}
        for target, (name, of) in pairs.items():
            self.settled["sign"] = "+1"
            self._take(name, target, f"actual minus nominal: less {of!r}", minus=of, **self._two_units(name, of))

    def _coordinates(self, actual: Sequence[str], nominal: Sequence[str]) -> dict[str, tuple[str, str]]:
        """The actual and the nominal position in X, Y and Z, by letter; empty where fewer than two were measured."""
        lengths = [n for n in actual if UNITS[self.units.get(n) or "mm"].kind == "length"]
        measured = [n for n in lengths if axis_letter(n) and np.ptp(self._finite(n)) > 0.0]
        letters = [axis_letter(n) for n in measured]
        first = {axis_letter(n): n for n in reversed(nominal)}
        pairs = {
            c: (n, first[c]) for c, n in zip(letters, measured, strict=True) if c in first and c in ("X", "Y", "Z")
        }
        alone = len(pairs) > 1 and len(set(letters)) == len(letters) and all(c == self._direction(c) for c in pairs)
        return dict(sorted(pairs.items())) if alone else {}

    def _is_length_of_deviation(self, name: str) -> bool:
        """Whether a column is the distance of the actual from the nominal positions, as trackers write it."""
        if not self.coordinates or axis_letter(name):
            return False
        off = [self._in_mm(a) - self._in_mm(n) for a, n in self.coordinates.values()]
        far = np.abs(self._in_mm(name) - np.linalg.norm(off, axis=0))
        is_length = bool(np.nanmedian(far) < SAME * np.nanmedian(np.linalg.norm(off, axis=0)))
        if is_length:
            self.use[name] = ("", "the length of the deviation, whose coordinates are the readings")
        return is_length

    def _in_mm(self, name: str) -> Floats:
        """The values of a column of lengths, in mm; one without a unit is taken as in mm."""
        return self._values(name) * UNITS[self.units.get(name) or "mm"].factor

    def _tool_tip(self, head: dict[str, Any]) -> dict[str, tuple[str, str]]:
        """The positions whose difference is a reading, by the reading; empty where the instrument reads no coordinates.

        Without another answer they are of a point beside the tool, as a tracker reads them.
        """
        if not self.coordinates:
            return {}
        if head.get("instrument") is None:
            text = "Which instrument took the readings?"
            head["instrument"] = self.ask("instrument", text, tuple(INSTRUMENTS), "tool_tip")
        of_letters = {f"reading_{c.lower()}_um": pair for c, pair in self.coordinates.items()}
        return of_letters if head["instrument"] in BY_LETTER else {}

    def _pair(self, actual: Sequence[str], nominal: Sequence[str]) -> tuple[str, str] | None:
        """An actual position and the nominal one that it belongs to; asks where several move."""
        letters = [(a, n) for a in actual for n in nominal if axis_letter(a) == axis_letter(n)]
        pairs = [(a, n) for a, n in letters if self._follows(a, n)]
        pairs = pairs or [(a, n) for a in actual for n in nominal if self._follows(a, n)]
        if len({a for a, _ in pairs}) > 1:
            name = self.ask("reading", "Which column is the reading?", tuple(dict.fromkeys(a for a, _ in pairs)), None)
            return next(((a, n) for a, n in pairs if a == name), None)
        return (pairs or letters or [(actual[0], nominal[0])])[0]

    def _two_units(self, name: str, of: str) -> dict[str, Any]:
        """`unit`, `scale` and `minus_unit` of an actual position less a nominal one, where the file lacks them."""
        less = {"unit": self.units[of]} if self.units.get(of) else self._length(of)
        alike = any(_is_like(v, w) for v, w in self._pairs(name, of)[-1:])
        usual = f"{less['scale']} {less['unit']}" if "scale" in less else less.get("unit")
        own = {"unit": self.units[name]} if self.units.get(name) else self._length(name, usual if alike else None)
        if not (own and less):
            return {}
        if own.get("scale") != less.get("scale"):
            raise MeasurementError(f"{name!r} and {of!r} are counts of different size: convert one of them in the file")
        unit = {} if self.table.units.get(name) else own
        known = self.table.units.get(of) or (unit and unit["unit"] == less["unit"])
        return unit | ({} if known else {"minus_unit": less["unit"]})

    def _coordinate(self, name: str, head: Mapping[str, Any]) -> str:
        """The column of a length that is read: of a tool tip with its direction, which is asked if no name tells it."""
        if head.get("instrument") != "tool_tip" or head.get("component"):
            return "reading_um"
        text = f"In which direction of the machine is {name!r} a reading?"
        letter = axis_letter(name) or self.ask("coordinate", text, ("X", "Y", "Z"), None)
        return f"reading_{letter.lower()}_um" if letter else "reading_um"

    def _deviation(self, name: str, actual: Sequence[str], nominal: Sequence[str], head: Mapping[str, Any]) -> None:
        keys = {} if self.units.get(name) else self._unit_of_reading(name)
        unit = self.units.get(name) or keys.get("unit", "")
        if not unit:
            self.use[name] = ("", "the reading, in a unit not known yet")
            return
        target = "reading_urad" if UNITS[unit].kind == "angle" else self._coordinate(name, head)
        sign, why = self._sign(name, actual, nominal, unit, keys.get("scale", 1.0))
        if sign is None:
            sign, why = self._named_sign(name, "the reading")
        else:
            self.settled["sign"] = f"{sign:+d}"
        self._take(name, target, why, **keys, **({"sign": -1} if sign < 0 else {}))

    def _named_sign(self, name: str, what: str) -> tuple[int, str]:
        """The sign by the name, else asked; and what the column is."""
        if sign := difference(name):
            self.settled["sign"] = f"{sign:+d}"
            return sign, f"{what}: {MEANS[sign]}, as its name says"
        if said := sign_said(self.remarks):
            self.settled["sign"] = f"{said[0]:+d}"
            return said[0], f"{what}: {MEANS[said[0]]}, as line {said[1]} says"
        text = "Is the reading actual minus nominal (+1) or nominal minus actual (-1)?"
        corrects = bool(CORRECTS & set(words_of(name)))
        text += f" {name!r} may be what a control adds (-1)." if corrects else ""
        usual = None if corrects else "+1"
        return int(self.ask("sign", text, ("+1", "-1"), usual) or "+1"), what

    def _unit_of_reading(self, name: str) -> dict[str, Any]:
        """By size, where only one unit is plausible: deviations of machines are below a few tenths of a millimetre."""
        values = self._finite(name)
        usual = "um" if np.abs(values - np.median(values)).max() >= 1.0 else None
        answer = self.ask(
            f"unit of {name}", f"Unit of the reading {name!r}?", (), usual, f"urad, arcsec, {LENGTH_HINT}"
        )
        return self._in_unit(answer, name, "length", "angle")

    def _sign(
        self, name: str, actual: Sequence[str], nominal: Sequence[str], unit: str, scale: float
    ) -> tuple[int | None, str]:
        """From columns of actual and nominal values, where the file has them beside the deviation."""
        if not (actual and nominal):
            return None, ""
        difference = (self._in_mm(actual[0]) - self._in_mm(nominal[0])) * 1e3
        reading = convert(self._values(name) * scale, unit, "um") if UNITS[unit].kind == "length" else np.zeros(0)
        if reading.shape != difference.shape:
            return None, ""
        for sign in (1, -1):
            off = np.abs(sign * reading - difference)
            if np.nanmax(off, initial=0.0) <= 1.0 and np.nanmax(np.abs(reading), initial=0.0) > 3.0:
                return sign, f"the reading: {MEANS[sign]}, as the other columns show"
        return None, ""

    def _several(self, deviations: Sequence[str], head: dict[str, Any]) -> bool:
        """Readings of an instrument that has several: by the letters in their names; those of drift probes in order.

        Three in X, Y and Z are of a point beside the tool unless another instrument is known.
        """
        letters = [axis_letter(n) for n in deviations]
        if head.get("instrument") is None and sorted(letters) == ["X", "Y", "Z"]:
            head["instrument"] = "tool_tip"
        if head.get("instrument") == "spindle_drift":
            letters = [f"p{i + 1}" for i in range(len(deviations))]
        elif head.get("instrument") not in BY_LETTER or not all(letters) or len(set(letters)) < len(letters):
            return False
        for name, letter in zip(deviations, letters, strict=True):
            given = {} if self.units.get(name) else self._unit_of_reading(name)
            if self.units.get(name) or given:
                unit, of = self.units.get(name) or given["unit"], self.coordinates.get(letter, ())
                sign, why = self._sign(name, of[:1], of[1:], unit, given.get("scale", 1.0))
                if sign is None:
                    sign, why = self._named_sign(name, f"reading in {letter}")
                self._take(name, f"reading_{letter.lower()}_um", why, **given, **({"sign": -1} if sign < 0 else {}))
        return True

    def _direction(self, axis: str) -> str:
        """Direction of an axis in the machine; its letter where the machine is not known."""
        return self.machine.axis(axis).direction if self.machine else axis

    def _head(self, head: dict[str, Any], by_axis: Mapping[str, str], nominal: Sequence[str]) -> None:
        """Instrument, axis and machine."""
        angle = "reading_urad" in self.columns
        has_reading = any(n.startswith("reading") for n in self.columns)
        if not head.get("instrument"):
            usual = "laser_linear" if has_reading and nominal and not angle else None
            if usual and by_axis:
                places = np.column_stack([self._values(n) for n in by_axis])
                self.line = diagonal(places, [self._direction(letter) for letter in by_axis.values()])
                usual = usual if self.line is None else "laser_diagonal"
            if usual and (self.of_parts or (self.reads_diameter and "minus" in self.columns["reading_um"])):
                usual = "work_piece"
            answer = self.ask("instrument", "Which instrument took the readings?", tuple(INSTRUMENTS), usual)
            if answer:
                head["instrument"] = answer
        kind = INSTRUMENTS.get(head.get("instrument", ""))
        if head.get("axis") is None and kind is not None and kind.axis_use == "required":
            moving = [a for n, a in by_axis.items() if np.ptp(self._finite(n)) > 0]
            axes = tuple(self.machine.axis_names) if self.machine else tuple(sorted({"X", "Y", "Z", *by_axis.values()}))
            if len(moving) == 1:
                head["axis"] = moving[0]
                self.guesses.append(Guess("axis", moving[0], "it is the one that moves"))
            else:
                head["axis"] = self.ask("axis", "Which axis moved?", axes, None)
        if head.get("axis") is None:
            head.pop("axis", None)
        if not head.get("machine"):
            machine = self.machine.name if self.machine else self.ask("machine", "Which machine?", (), None)
            if machine:
                head["machine"] = machine

    # --- rows

    def _is_direction(self, name: str) -> bool:
        """Whether a column of numbers is a direction: by its name, and -1 and +1 or two whole numbers."""
        values = np.unique(self._finite(name))
        known = set(values) <= {-1.0, 0.0, 1.0} or (len(values) == 2 and np.array_equal(values, np.round(values)))
        return has(name, "direction") and bool(len(values)) and known and not self.units.get(name)

    def _directions(self, head: Mapping[str, Any]) -> None:
        """Directions of the axes that their names say, else of the measured axis."""
        axes = self.machine.axis_names if self.machine else ()
        for name in [*self._free(texts=True), *self._free()]:
            axis = axis_letter(name) or head.get("axis")
            target = f"dir_{str(axis).lower()}"
            if not axis or not has(name, "direction") or (axes and axis not in axes):
                continue
            numbers = self.table.columns[name].dtype != np.object_
            keys, why = self._coded(name, target) if numbers else (self._worded(name), "direction, by its words")
            if target in self.columns and keys is not None:
                self.use[name] = ("", f"a second direction of {axis}")
            elif keys is not None:
                self._take(name, target, why, unit="1", **keys)

    def _worded(self, name: str) -> dict[str, Any] | None:
        words = {str(v) for v in self.table.columns[name] if v}
        meaning = {w: sign for w in sorted(words) if (sign := direction_meant(w))}
        return {"values": meaning} if words and len(meaning) == len(words) else None

    def _coded(self, name: str, target: str) -> tuple[dict[str, Any] | None, str]:
        """Numbers other than -1 and +1: which of the two is forward is as the positions show, else asked."""
        if not self._is_direction(name):
            return None, ""
        values = self._values(name)
        place = str(self.columns.get(f"{target.removeprefix('dir_')}_mm", {}).get("from"))
        at = self._values(place) if place in self.table.columns else np.zeros(len(values))
        codes = np.unique(values[np.isfinite(values)])
        if not codes.any():
            self.use[name] = ("", "a direction that is 0 in every row")
            return None, ""
        first = np.isfinite(values) & (np.cumsum(np.nan_to_num(values) != 0.0) == 0)
        before = not np.any((values == 0.0) & ~first) and not np.ptp(at[first]) if first.any() else 0.0 not in codes
        if set(codes) <= {-1.0, 0.0, 1.0} and (-1.0 in codes or before):
            return {}, "direction, -1 or +1"
        low, high = codes.tolist()
        forward, why = _is_forward(values == high, at), f"direction: {high:g} or {low:g}, as the positions show"
        if forward is not None:
            self.settled[f"direction of {name}"] = f"{high if forward else low:g}"
        else:
            text = f"Which number in {name!r} is the motion in the positive direction?"
            choices = (f"{high:g}", f"{low:g}")
            answer = self.ask(f"direction of {name}", text, choices, None)
            if answer is None:
                return None, ""
            forward, why = answer == choices[0], "direction"
        sign = 1 if forward else -1
        return {"scale": 2.0 / (high - low), "sign": sign, "offset": -sign * (high + low) / (high - low)}, why

    def _runs(self, head: Mapping[str, Any]) -> dict[str, Any]:
        """Every reversal of the axis begins a run, where it reverses."""
        target = f"{str(head.get('axis') or '').lower()}_mm"
        column = self.columns.get(target)
        if column is None or column.get("from") not in self.table.columns or column.get("take"):
            return {}
        values = self._finite(column["from"])
        if len(values) < 3:
            return {}
        track = direction_track(np.ascontiguousarray(values), 0.01)
        turns = int((np.diff(track[track != 0]) != 0).sum())
        if not 0 < turns <= len(values) // 3:
            return {}
        self.guesses.append(Guess("run", target, f"{target} goes to and fro: each way is a run"))
        return {"direction_of": target}

    def _rows(self, clock: str | None) -> dict[str, Any]:
        """`[rows]`: of a log the rows with a reading; of a table the rows with a time, if a line or two has none."""
        if self.is_log:
            readings = [c["from"] for n, c in self.columns.items() if n.startswith("reading")]
            return {"require": readings} if readings else {}
        if clock is None:
            return {}
        without = int((~_filled(self.table.columns[clock])).sum())
        if not 0 < without <= FEW_LINES:
            return {}
        self.guesses.append(Guess("rows.require", [clock], f"{counted(without, 'line')} without a time: no row"))
        return {"require": [clock]}


def _is_like(values: Floats, place: Floats) -> bool:
    return _spread(values - place) < SMALL * _spread(place)


def _spread(values: Floats) -> float:
    """Range of the values without the extreme twentieth at either end."""
    low, high = np.percentile(values, (5.0, 95.0)) if len(values) else (0.0, 0.0)
    return float(high - low)


def _is_forward(marked: Bools, at_mm: Floats) -> bool | None:
    """Whether an axis mostly moves forward to the marked rows and back to the others; None where it does not show."""
    way = np.sign(np.diff(at_mm))
    same = np.where(marked[1:], way, -way)
    forward, back = int((same > 0).sum()), int((same < 0).sum())
    return forward > back if max(forward, back) > CLEAR * (forward + back) else None


def _filled(values: NDArray[Any]) -> Bools:
    """Whether each cell of a column has a value, (n,)."""
    if values.dtype != np.object_:
        return np.asarray(~np.isnan(values))
    # NaN is not equal to itself.
    return np.array([v is not None and v != "" and v == v for v in values], dtype=np.bool_)  # noqa: PLR0124


def _fit(cells: Sequence[str], form: str) -> bool:
    """Whether a format fits all cells; tries the first and last ones first, which exclude most formats."""
    for text in (cells[0], cells[-1], *cells):
        try:
            datetime.strptime(text.strip(), form)
        except ValueError:
            return False
    return True


def _iso(cells: Sequence[str]) -> bool:
    try:
        for text in cells:
            datetime.fromisoformat(text.strip())
    except ValueError:
        return False
    return True

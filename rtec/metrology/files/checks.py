"""Checks of a table's numbers; reports every fault by row, and notes everything that the user accepts."""

import itertools
from collections.abc import Mapping

import numpy as np

from rtec.arrays import Bools, Floats
from rtec.machine import Machine
from rtec.metrology.contradicted import MOVED_MM, contradicted
from rtec.metrology.diagonal import diagonal
from rtec.metrology.files.faults import Faults, places
from rtec.metrology.files.table import Raw
from rtec.metrology.files.toml import Leniency
from rtec.metrology.instruments.base import Instrument
from rtec.metrology.instruments.laser import LaserDiagonal
from rtec.wording import listed

# Values that loggers write for a broken sensor. They are faults only outside the sensor's own range.
TEMPERATURE_CODES: Mapping[float, str] = {
    -9999.0: "no value",
    -999.0: "no value",
    -999.9: "no value",
    -3276.8: "the lowest 16-bit number",
    -32768.0: "the lowest 16-bit number",
    -273.15: "nothing measured (0 K)",
    -270.0: "the bottom of a thermocouple's range",
    -242.0: "an open or shorted Pt100",
    -200.0: "the bottom of a Pt100's or thermocouple's range",
    -180.0: "an open thermocouple",
    -127.0: "a DS18B20 that does not answer",
    85.0: "a DS18B20 that has not measured yet",
    400.0: "an open type T thermocouple",
    760.0: "an open type J thermocouple",
    850.0: "an open Pt100",
    988.0: "an open or shorted Pt100",
    999.0: "no value",
    999.9: "no value",
    1000.0: "an open type E thermocouple",
    1200.0: "an open type J thermocouple",
    1300.0: "an open type N thermocouple",
    1370.0: "an open type K thermocouple",
    1372.0: "an open type K thermocouple",
    1768.0: "an open type R or S thermocouple",
    1820.0: "an open type B thermocouple",
    2000.0: "an open thermocouple",
    3276.7: "the highest 16-bit number",
    6553.5: "the highest 16-bit number",
    9999.0: "no value",
    9999.9: "no value",
    32767.0: "the highest 16-bit number",
    65535.0: "the highest 16-bit number",
}
WARMEST_DEGC = 50.0
"""No machine is warmer than this at every sensor; 68 °F is 20 °C."""
# Values that measuring programs write for a lost reading; no machine tool has an error of 10 mm or 10 mrad.
READING_CODES = (9999.0, 9999.9, 99999.0, 99999.9, 999999.0, 9999999.0, -9999.0, -99999.0, -999999.0, -9999999.0)

ALONG = 0.999
"""Least cosine of the line along which the axes move with that of a diagonal's TOML: 2.6 degrees."""


class CheckedRows:
    """The rows of one table under examination.

    Args:
        raw: its numbers.
        readings: names of the reading columns; NaN is allowed in these alone.
        machine: its sensors have ranges.
        leniency: what the user accepts.
        where: how the user accepts it, for messages.
    """

    def __init__(
        self, raw: Raw, readings: tuple[str, ...], machine: Machine, leniency: Leniency, faults: Faults, where: str
    ) -> None:
        self.raw, self.readings, self.machine = raw, readings, machine
        self.leniency, self.faults, self.where = leniency, faults, where
        self.bad = raw.bad.copy()
        self.notes: list[str] = list(raw.notes)
        self.drop_way = f"leave such rows out: {where} drop_bad_rows = true"

    def checked(self) -> Raw:
        """Check all cells; report faults, or drop the bad rows where the user accepts that."""
        self._missing_codes()
        ranges = {f"{s.name}_degc": s.range_degc for s in self.machine.sensors}
        for name in self.raw.columns:
            self._infinite(name)
            if name in ranges:
                self._temperature(name, *ranges[name])
            elif name in self.readings:
                self._lost_reading(name)
            if name not in self.readings:
                self._empty(name)
            if name == "run" or name.startswith("dir_"):
                self._whole_number(name)
        if not self.leniency.drop_bad_rows:
            return self.raw
        self.notes += self.faults.drop()
        if self.bad.any():
            self.notes.append(f"{int(self.bad.sum())} of {len(self.raw)} rows left out in all")
        return self.raw.rows(~self.bad)

    def _tell(self, name: str, kind: str, rows: Bools, text: str, way: str) -> None:
        """Report rows where `name` has an impossible value; `{}` in the text is the value."""
        index = np.flatnonzero(rows & ~self.bad)
        values = self.raw.columns[name]
        self.bad |= rows
        self.faults.rows(
            f"{name} {kind}",
            self.raw.numbers[index],
            lambda i: f"{name} is {text.format(f'{values[index[i]]:.10g}')}",
            way,
        )

    def _missing_codes(self) -> None:
        """Refuse missing-value codes, in readings and temperatures only: 850 is a valid position in mm."""
        coded = [n for n in self.raw.columns if n in self.readings or n.endswith("_degc")]
        for code in self.leniency.missing_codes:
            if isinstance(code, str):
                continue
            for name in coded:
                values = self.raw.columns[name]
                hit = np.isclose(values, code, rtol=1e-9, atol=0.0)
                if hit.any():
                    self.raw.columns[name] = np.where(hit, np.nan, values)
                    self.notes.append(f"{name}: {code:.10g} taken as missing ({self._at(hit)})")

    def _at(self, rows: Bools) -> str:
        return places(self.raw.word, self.raw.numbers[rows].tolist())

    def _infinite(self, name: str) -> None:
        values = self.raw.columns[name]
        self._tell(name, "infinite", np.isinf(values), "{}, which is no value", f"correct it, or {self.drop_way}")

    def _temperature(self, name: str, low: float, high: float) -> None:
        values = self.raw.columns[name]
        outside = ((values < low) | (values > high)) & ~np.isinf(values)
        if outside.any():
            rounded = np.round(values, 2)
            for code, meaning in TEMPERATURE_CODES.items():
                hit = outside & (rounded == code)
                way = (
                    f"mend the sensor, or take it as missing: {self.where} missing_codes = [{code:.10g}] with "
                    f"hold_temperature_s = 120 or drop_bad_rows = true"
                )
                self._tell(name, f"code {code}", hit, f"{{}}: {meaning}, not a temperature", way)
                outside &= ~hit
            sensor = name.removesuffix("_degc")
            way = f"correct it, widen range_degc of [temperature.{sensor}] in the machine file, or {self.drop_way}"
            if self._fahrenheit(name, low, high):
                way = f"if it is in °F, convert all to (T - 32) / 1.8, which lies in the range; else {way}"
            self._tell(name, "range", outside, f"{{}} °C, outside the sensor's range {low:g} to {high:g} °C", way)
        self._hold(name)

    def _fahrenheit(self, name: str, low: float, high: float) -> bool:
        """Whether all temperatures are above 50 °C, and those of a sensor are in its range if they are in °F."""
        known = {n: v[np.isfinite(v)] for n, v in self.raw.columns.items() if n.endswith("_degc")}
        if any(len(v) and float(np.median(v)) < WARMEST_DEGC for v in known.values()):
            return False
        celsius = (known[name] - 32.0) / 1.8
        return bool(np.all((celsius >= low) & (celsius <= high)))

    def _hold(self, name: str) -> None:
        """Fill gaps of a temperature with its last good value, where the user accepts that."""
        limit, time_s = self.leniency.hold_temperature_s, self.raw.columns.get("time_s")
        values = self.raw.columns[name]
        gaps = np.isnan(values) & ~self.bad
        if limit is None or time_s is None or not gaps.any():
            return
        good = np.maximum.accumulate(np.where(np.isfinite(values) & ~self.bad, np.arange(len(values)), -1))
        age_s = time_s - time_s[np.maximum(good, 0)]
        fill = gaps & (good >= 0) & (age_s >= 0) & (age_s <= limit)
        if fill.any():
            filled = values.copy()
            filled[fill] = values[good[fill]]
            self.raw.columns[name] = filled
            self.notes.append(f"{name}: last good value held ({self._at(fill)})")

    def _lost_reading(self, name: str) -> None:
        values = self.raw.columns[name]
        lost = (np.isin(values, READING_CODES) | (np.abs(values) >= 1e30)) & ~np.isinf(values)
        lost &= ~np.isin(values, self.leniency.accept_values)
        if lost.any():
            shown = f"{values[lost][0]:.10g}"
            way = f"{self.where} missing_codes = [{shown}], or accept_values = [{shown}] if it is genuine"
            self._tell(name, "lost", lost, "{}: what programs write for a lost reading", way)

    def _empty(self, name: str) -> None:
        hold = ", or keep the last good one: hold_temperature_s = 120" if name.endswith("_degc") else ""
        column = f", or leave the column unread: ignore_columns = ['{name}']" if name.endswith("_degc") else ""
        way = f"only readings may be missing; fill it in, or {self.drop_way}{hold}{column}"
        empty = np.isnan(self.raw.columns[name])
        index = np.flatnonzero(empty & ~self.bad)
        self.faults.rows(f"{name} empty", self.raw.numbers[index], lambda _: f"{name} is empty", way)
        self.bad |= empty

    def _whole_number(self, name: str) -> None:
        values = self.raw.columns[name]
        if name == "run":
            wrong = (values != np.round(values)) | (np.abs(values) > 2.0**53)
            text, way = "{}, which is no integer", "runs are numbered 1, 2, 3, …"
        else:
            wrong = ~np.isin(values, (-1.0, 0.0, 1.0))
            text, way = "{}; a direction is -1 or +1", "or leave the column out: it follows from the positions"
        self._tell(name, "whole", wrong & np.isfinite(values), text, way)


def check_order(raw: Raw, faults: Faults) -> None:
    """Report time that falls, and runs that are interrupted by another one."""
    raw = raw.rows(np.isfinite(raw.columns["run"]) & np.isfinite(raw.columns["time_s"]))
    run, time_s = raw.columns["run"], raw.columns["time_s"]
    starts = np.flatnonzero(np.diff(run, prepend=np.nan) != 0)
    falls = np.flatnonzero(time_s[1:] < time_s[:-1]) + 1  # no difference: it may overflow
    at_starts = bool(len(falls)) and bool(np.isin(falls, starts).all())
    faults.rows(
        "time falls",
        raw.numbers[falls],
        lambda i: f"time_s falls from {time_s[falls[i] - 1]:.10g} to {time_s[falls[i]]:.10g}",
        "every run starts its clock again: `rtec import` puts them one after another ([time] restarts = true)"
        if at_starts
        else "rows must be in order of time; sort them, or correct the clock",
        droppable=False,
    )
    _, first = np.unique(run[starts], return_index=True)
    again = np.setdiff1d(np.arange(len(starts)), first)
    where = {value: int(raw.numbers[starts[i]]) for i, value in zip(first, run[starts][first], strict=True)}
    back = starts[again]
    faults.rows(
        "run again",
        raw.numbers[back],
        lambda i: f"run {run[back[i]]:.0f} comes back (it began at {raw.word} {where[run[back[i]]]})",
        "a run is one uninterrupted traverse or cycle; give it a number of its own",
        droppable=False,
    )


def check_motion(raw: Raw, instrument: Instrument, machine: Machine, faults: Faults) -> None:
    """Report axes that move otherwise than the TOML says.

    Of a laser or straightness, the axis never moves while another one does, or several move together; of a laser along
    a diagonal, they move along another line. Where a component is read directly, somebody has reduced the numbers.
    """
    places = np.column_stack([raw.columns.get(f"{a.channel}_mm", np.zeros(len(raw))) for a in machine.axes])
    line = diagonal(places, [a.direction for a in machine.axes])
    if isinstance(instrument, LaserDiagonal):
        if line is None or np.dot(line, instrument.line) < ALONG:
            so = "do not move together along a line" if line is None else f"move along {list(line)}"
            faults.whole(f"direction = {list(instrument.setup.direction)} in its TOML, but the axes {so}")
        return
    if not instrument.along or instrument.component is not None or instrument.axis not in machine.axis_names:
        return
    with np.errstate(over="ignore"):  # a span beyond all numbers is infinite
        spans = np.ptp(places, axis=0).tolist()
    moving = [a.name for a, span in zip(machine.axes, spans, strict=True) if span > MOVED_MM]
    if moving and instrument.axis not in moving:
        said = f'axis = "{instrument.axis}" in its TOML, but {instrument.axis} never moves here and {listed(moving)} '
        faults.whole(f"{said}{'does' if len(moving) == 1 else 'do'}: name the axis along which it reads")
    elif line is not None:
        said = f'axis = "{instrument.axis}" in its TOML, but {listed(moving)} move together'
        faults.whole(f'{said}: instrument = "laser_diagonal" reads along such a line, with direction = {list(line)}')


def remarks(raw: Raw, readings: tuple[str, ...], machine: Machine) -> list[str]:
    """Notes on properties of the table that are allowed but unusual."""
    out = []
    for name in readings:
        lost = np.isnan(raw.columns[name])
        if lost.any():
            at = places(raw.word, raw.numbers[lost].tolist())
            out.append(f"{name}: {int(lost.sum())} of {len(raw)} readings missing ({at})")
    for axis in machine.axes:
        position = raw.columns.get(f"{axis.channel}_mm")
        if position is None:
            said = f"no column {axis.channel}_mm: axis {axis.name} is taken as fixed at 0 mm"
            out.append(f"{said}; add the column if it stood elsewhere")
        elif position.min() < axis.travel_mm[0] or position.max() > axis.travel_mm[1]:
            low, high = axis.travel_mm
            span = f"{position.min():g} to {position.max():g} mm"
            out.append(f"{axis.channel}_mm goes from {span}, axis {axis.name} from {low:g} to {high:g}: right unit?")
        ways = raw.columns.get(f"dir_{axis.channel}")
        if position is not None and ways is not None:
            wrong = contradicted(raw.columns["run"], position, ways)
            if wrong is not None:
                said = (
                    f"dir_{axis.channel} contradicts the order of {axis.channel}_mm in {wrong[0]} of {wrong[1]} moves"
                )
                out.append(f"{said}: right sign?")
    return out + _same_runs(raw, readings)


def _same_runs(raw: Raw, readings: tuple[str, ...]) -> list[str]:
    """Notes on runs that repeat another one to the last digit, as if recorded twice."""
    run = raw.columns["run"]
    bounds = [*np.flatnonzero(np.diff(run, prepend=np.nan) != 0), len(run)]
    seen: dict[bytes, float] = {}
    out = []
    for low, high in itertools.pairwise(bounds):
        values: list[Floats] = [raw.columns[name][low:high] for name in readings]
        content = b"".join(v.tobytes() for v in values)
        # A few equal readings are normal for a good instrument with a coarse resolution.
        if high - low >= 5 and any(np.ptp(v) > 0 for v in values):
            if content in seen:
                out.append(f"run {run[low]:.0f} has the readings of run {seen[content]:.0f} to the last digit")
            seen.setdefault(content, float(run[low]))
    return out

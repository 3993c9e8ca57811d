"""The map of `rtec import`: the source column and the unit of each column of a measurement."""

import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from rtec.errors import MeasurementError
from rtec.metrology.files.toml import MeasurementTable
from rtec.metrology.importing.rows import condition
from rtec.metrology.importing.zones import zone_of
from rtec.metrology.readers.base import SourceOptions
from rtec.metrology.units import UNITS, canonical
from rtec.quantities import (
    BUT_NAN,
    Code,
    Coefficient,
    Factor,
    MillimetresNotNegative,
    MillimetresPositive,
    SecondsPositive,
)
from rtec.tomlfile import Strict, read_toml, validated

FORMS = ("iso", "filetime", "excel", "unix")
TARGET = re.compile(
    r"[a-z][a-z0-9_]*_mm|dir_\w+|v\w+_mm_s|a\w+_mm_s2|\w+_degc|spindle_rpm|feed_mm_min|load_kg|angle_deg|[abc]_deg"
    r"|reading(_[A-Za-z0-9]+)*_(um|urad)",
    re.ASCII,
)


WHOLE = frozenset({"measurement", "time", "column"})
"""A map with these tables has all that an import needs; the missing parts of another one are proposed."""
LOGGED = re.compile(r"\w+_degc|spindle_rpm|feed_mm_min|load_kg", re.ASCII)
"""Columns that may come from a log in a file of its own: what is still the same a moment later."""


class Column(Strict):
    """`[column.NAME]`: where a column of the measurement comes from.

    value = sign · scale · (from - minus), then converted from `unit`; `offset` is added in the measurement's own unit.

    Attributes:
        from_: column of the file.
        value: instead of a column: the same number in every row, in `unit`; for what the file lacks, such as the place
            of another axis.
        minus: column of the file that is subtracted: actual minus nominal.
        minus_unit: unit of that column, where the reader does not know it and it differs from `unit`.
        take: "sum": the file has steps, and the value is the sum of all so far; "difference": the file has running
            totals, and the value is each one minus the one before. Rows that are not used count, too.
        unit: unit of the file's numbers, where the reader does not know it; by default the measurement's own.
        scale, sign, offset: see above.
        fill: "hold" repeats the last value where one is missing.
        values: numbers for words: {"fwd" = 1, "bwd" = -1}.
        missing_codes: numbers that stand for "no value".
    """

    from_: str = Field("", alias="from")
    value: Coefficient | None = None
    minus: str | None = None
    minus_unit: str | None = None
    take: Literal["sum", "difference"] | None = None
    unit: str | None = None
    scale: Factor = 1.0
    sign: Literal[1, -1] = 1
    offset: Coefficient = 0.0
    fill: Literal["hold"] | None = None
    values: dict[str, Coefficient] = Field(default_factory=dict)
    missing_codes: Annotated[tuple[Code, ...], BUT_NAN] = ()

    @field_validator("unit", "minus_unit")
    @classmethod
    def _known(cls, unit: str | None) -> str | None:
        return unit if unit is None else canonical(unit)

    @model_validator(mode="after")
    def _one_source(self) -> "Column":
        if ("from_" in self.model_fields_set) == (self.value is not None):
            raise ValueError("give either from, a column of the file, or value, the same number in every row")
        if self.value is not None and (more := self.model_fields_set - {"value", "unit"}):
            raise ValueError(f"value stands alone, or with unit; {', '.join(sorted(more))} belongs to from")
        return self

    @model_validator(mode="after")
    def _minus_first(self) -> "Column":
        if self.minus_unit and not self.minus:
            raise ValueError("minus_unit belongs to minus, which is missing")
        return self

    @field_validator("scale")
    @classmethod
    def _not_nothing(cls, scale: float) -> float:
        if scale == 0.0:
            raise ValueError("scale is 0, which loses every value")
        return scale


class Time(Strict):
    """`[time]`: a column and its unit or form, or a step where the file has no time.

    Attributes:
        column: of the file.
        date: column of the date, where the time of day has a column of its own; `format` reads "DATE TIME".
        unit: a unit of time, or "iso", "filetime" (100 ns since 1601), "excel" (days since 1900), "unix" (seconds
            since 1970).
        format: strptime pattern of a time of day.
        zone: of local times: a place such as "Europe/Berlin", "UTC", or "+02:00".
        from_zero: whether the first row becomes 0; times of day always begin at 0.
        restarts: a time that falls begins a new run, `restart_gap_s` after the one before.
        restart_gap_s: see `restarts`.
        step_s: without a column: time from one row to the next.
    """

    column: str | None = None
    date: str | None = None
    unit: str | None = None
    format: str | None = None
    zone: str | None = None
    from_zero: bool = True
    restarts: bool = False
    restart_gap_s: SecondsPositive = 1.0
    step_s: SecondsPositive | None = None

    @model_validator(mode="after")
    def _one_way(self) -> "Time":
        if (self.column is None) == (self.step_s is None):
            raise ValueError("give either column or step_s")
        if self.column is None and (self.unit or self.format or self.restarts or self.date or self.zone):
            raise ValueError("step_s stands alone; date, unit, format, zone and restarts belong to a column")
        if self.zone is not None:
            zone_of(self.zone)
        if self.date and self.unit != "iso" and not self.format:
            raise ValueError('date needs a format for "DATE TIME", such as "%d.%m.%Y %H:%M:%S", or unit = "iso"')
        if self.unit and self.format:
            raise ValueError("give unit or format, not both")
        if self.unit and self.unit not in FORMS and UNITS[canonical(self.unit)].kind != "time":
            raise ValueError(f"unit {self.unit!r} is no unit of time; allowed: s, ms, min, h, … or {', '.join(FORMS)}")
        return self


class Run(Strict):
    """`[run]`: a column of run numbers, or rules for the start of a run; without any all rows are one run.

    Attributes:
        column: of the file.
        direction_of: position column of the measurement: every reversal begins a run.
        dead_band_mm: motion back by at most this much is no reversal.
        gap_s: a longer pause between rows begins a run.
        jump_mm: a longer motion of any axis between rows begins a run.
    """

    column: str | None = None
    direction_of: str | None = None
    dead_band_mm: MillimetresNotNegative = 0.01
    gap_s: SecondsPositive | None = None
    jump_mm: MillimetresPositive | None = None

    @model_validator(mode="after")
    def _one_way(self) -> "Run":
        if self.column is not None and (self.direction_of or self.gap_s or self.jump_mm):
            raise ValueError("give a column of run numbers, or what begins a new run, not both")
        return self


class RowRules(Strict):
    """`[rows]`: which rows of the file are used; the others are dropped and counted.

    Attributes:
        require: columns of the file in which a row needs a value.
        where: condition on columns of the file, such as `bed_target == 105 and status != "warm-up"`.
    """

    require: tuple[str, ...] = ()
    where: str | None = None

    @field_validator("where")
    @classmethod
    def _readable(cls, where: str | None) -> str | None:
        return where if where is None else condition(where).text


class EventLog(Strict):
    """`[events]`: a log with one value a line; each channel becomes a column, events of one instant become one row.

    Attributes:
        channel: column of the file with the names of channels.
        value: column of the file with their values.
        unit: column of the file with their units.
    """

    channel: str
    value: str
    unit: str | None = None


class Cycles(Strict):
    """`[cycles]`: a protocol with one row a target, one column a run and direction; each becomes rows of its own.

    Attributes:
        position: column of the file with the targets.
        forward: columns of the runs in which the targets were approached in the positive direction, in order.
        backward: those in the negative direction.
        reading: what the runs hold: deviations, or actual positions; the column that they become has this name.
    """

    position: str
    forward: tuple[str, ...] = ()
    backward: tuple[str, ...] = ()
    reading: Literal["deviation", "actual"] = "deviation"


class TemperatureLog(Strict):
    """`[temperatures]`: a log of temperatures in a file of its own; it is matched by date or time of day.

    Temperatures are interpolated between its rows; a spindle speed, feed or load is that of the row before.

    Attributes:
        file: path of the log; a relative one starts at the folder of the imported file.
        source, events, rows, time: as in the map.
        column: where each SENSOR_degc comes from, and spindle_rpm, feed_mm_min and load_kg.
    """

    file: str
    source: SourceOptions = SourceOptions()
    events: EventLog | None = None
    rows: RowRules = RowRules()
    time: Time
    column: dict[str, Column]

    @field_validator("column")
    @classmethod
    def _logged(cls, column: dict[str, Column]) -> dict[str, Column]:
        if wrong := [n for n in column if not LOGGED.fullmatch(n)]:
            raise ValueError(
                f"{wrong[0]!r} does not come from a log; it gives SENSOR_degc, spindle_rpm, feed_mm_min, load_kg"
            )
        return column


class ImportMap(Strict):
    """A whole map.

    Attributes:
        source: how the file is read.
        events: for a log with one value a line.
        cycles: for a protocol with one column a run.
        measurement: what was measured.
        setup: how the instrument was set up; its keys are the instrument's own.
        time: where the time comes from.
        run: what begins a new run.
        rows: which rows are used.
        column: where each column of the measurement comes from, by its name there.
        temperatures: log of temperatures in a file of its own.
    """

    source: SourceOptions = SourceOptions()
    events: EventLog | None = None
    cycles: Cycles | None = None
    measurement: MeasurementTable
    setup: dict[str, Any] = Field(default_factory=dict)
    time: Time
    run: Run = Run()
    rows: RowRules = RowRules()
    column: dict[str, Column]
    temperatures: TemperatureLog | None = None

    @field_validator("column")
    @classmethod
    def _targets(cls, column: dict[str, Column]) -> dict[str, Column]:
        for name in column:
            if name in ("time_s", "run"):
                raise ValueError(f"{name} has a table of its own, [{name.removesuffix('_s')}]")
            if not TARGET.fullmatch(name):
                raise ValueError(
                    f"{name!r} is no column of a measurement; these are x_mm, dir_x, vx_mm_s, ax_mm_s2, SENSOR_degc, "
                    "spindle_rpm, feed_mm_min, load_kg, angle_deg, c_deg, reading_um, reading_urad, reading_x_um"
                )
        for name in (n for n, c in column.items() if c.minus is not None and n.endswith("_degc")):
            raise ValueError(f"{name}: minus is for readings and positions; a difference of temperatures is none")
        for name in (n for n, c in column.items() if c.value is not None and n.startswith("reading")):
            raise ValueError(f"{name}: a reading comes from a column of the file; value is for what stays the same")
        if not any(name.startswith("reading") for name in column):
            raise ValueError("no reading: one of reading_um, reading_urad, reading_x_um … must come from somewhere")
        return column


def load_map(path: Path) -> ImportMap:
    """Read a map.

    Raises:
        MeasurementError: the map is wrong; the message has file, section, key and what is allowed.
    """
    return validated(ImportMap, read_toml(path, MeasurementError), str(path), MeasurementError)

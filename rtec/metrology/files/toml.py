"""The TOML beside a table: what was measured, with what, and what the user accepts about the table."""

import shlex
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from rtec.errors import MeasurementError
from rtec.quantities import BUT_NAN, Code, SecondsPositive
from rtec.tomlfile import Strict, read_kind, validated

TABLES = (".csv", ".parquet")


class Leniency(Strict):
    """What the user accepts about a table, on purpose; the measurement's notes list all of it.

    Attributes:
        encoding: of the text, where it is not UTF-8.
        delimiter: between cells.
        decimal: mark in numbers.
        missing_codes: words, or numbers of readings and temperatures, that stand for "no value".
        accept_values: readings that look like such a code and are genuine.
        drop_bad_rows: leave out rows with a cell that cannot be used.
        ignore_columns: columns that are not read.
        hold_temperature_s: a missing temperature is the last good one, at most so old.
        moves_at_feed: the axis was read in motion: its velocity, where it has no column, is the feed in the direction
            of motion, also where the times do not show it.
    """

    encoding: Literal["utf-8", "latin-1", "cp1252", "utf-16", "utf-16-le", "utf-16-be"] | None = None
    delimiter: Annotated[str, Field(min_length=1, max_length=1)] = ","
    decimal: Literal[".", ","] = "."
    missing_codes: Annotated[tuple[Code | str, ...], BUT_NAN] = ()
    accept_values: tuple[Code, ...] = ()
    drop_bad_rows: bool = False
    ignore_columns: tuple[str, ...] = ()
    hold_temperature_s: SecondsPositive | None = None
    moves_at_feed: bool = False

    @model_validator(mode="after")
    def _marks_differ(self) -> "Leniency":
        if self.delimiter == self.decimal:
            raise ValueError(f"delimiter and decimal are both {self.decimal!r}; such a table cannot be read")
        if self.delimiter in '\r\n"':
            raise ValueError("delimiter may not be a quote or the end of a line")
        return self

    def with_(self, other: "Leniency | None") -> "Leniency":
        """These settings, overridden by what `other` sets."""
        given = other.model_dump(exclude_unset=True) if other else {}
        return validated(Leniency, self.model_dump(exclude_unset=True) | given, "options", MeasurementError)


class MeasurementTable(Strict):
    """`[measurement]`: what was measured.

    Attributes:
        instrument: name of the instrument.
        machine: name of the machine.
        axis: axis that it follows, where it follows one.
        component: component error that it reads, where it reads one.
        notes: for people.
    """

    instrument: str
    machine: str
    axis: str | None = None
    component: str | None = None
    notes: tuple[str, ...] = ()


class MeasurementFile(Strict):
    """The whole TOML.

    Attributes:
        measurement: what was measured.
        setup: how the instrument was set up; its keys are the instrument's own.
        table: what you accept about the table of readings.
    """

    measurement: MeasurementTable
    setup: dict[str, Any] = Field(default_factory=dict)
    table: Leniency = Leniency()


SPREADSHEETS = (".xlsx", ".xlsm", ".xls", ".ods")
MISSING = """{toml}: no such file. A measurement is a table and a TOML of the same stem that says what was measured:
    [measurement]
    instrument = "laser_linear"
    axis = "X"
    machine = "{machine}"
    [setup]
Or make both at once: rtec import {name} -o NAME"""


def read_measurement_toml(path: Path, machine: str, table: Path) -> MeasurementFile:
    """Read the TOML beside `table`.

    Raises:
        MeasurementError: the file is missing or wrong; the message says how to write one.
    """
    if not path.exists():
        raise MeasurementError(MISSING.format(toml=path, machine=machine, name=shlex.quote(str(table))))
    file = validated(MeasurementFile, read_kind(path, "a measurement", MeasurementError), str(path), MeasurementError)
    if file.measurement.machine != machine:
        raise MeasurementError(
            f"{path}: [measurement] machine is {file.measurement.machine!r}, the machine given is {machine!r}; "
            "measurements hold for the machine that they were made on"
        )
    return file


def find_files(path: Path) -> tuple[Path, Path]:
    """Table and TOML of a measurement from the path of either, or from their common stem.

    Raises:
        MeasurementError: there is no table, or there are two.
    """
    # `with_suffix` would remove the end of a stem like `laser-1.5`.
    stem = path.with_suffix("") if path.suffix in (*TABLES, ".toml") else path
    tables = [found for s in TABLES if (found := stem.with_name(stem.name + s)).is_file()] if stem.name else []
    if path.suffix in TABLES:
        tables = [path] if path.is_file() else []
    if not tables:
        if path.suffix.lower() in SPREADSHEETS and path.is_file():
            way = f"rtec import {shlex.quote(path.with_suffix('.csv').name)} -o NAME"
            raise MeasurementError(f"{path}: is no measurement yet; save it as CSV, then: {way}")
        if path.suffix == ".toml" and path.is_file():
            read_kind(path, "a measurement", MeasurementError)
        what = f"{path}: no such file" if path.suffix in TABLES else f"{path}: no {stem.name}.csv or .parquet there"
        what = f"{path}: is a folder" if path.is_dir() else what
        raise MeasurementError(f"{what}; a measurement is a CSV or Parquet table and a TOML of the same stem")
    if len(tables) > 1:
        raise MeasurementError(f"{path}: both {tables[0].name} and {tables[1].name} are there; name the one you mean")
    return tables[0], stem.with_name(stem.name + ".toml")

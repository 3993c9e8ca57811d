"""Settings of a simulated measurement: targets, protocol, temperatures, noise; the set-up of its instrument.

They come from a TOML file and from options. Every table is optional; defaults follow from machine and instrument.
"""

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from rtec.errors import ConfigError, MeasurementError
from rtec.files import check_named
from rtec.machine import Machine
from rtec.metrology.instruments.base import Instrument
from rtec.metrology.instruments.registry import make_instrument
from rtec.quantities import (
    Coefficient,
    DegreesCelsius,
    DegreesDifference,
    DegreesSpread,
    MicrometresNotNegative,
    Millimetres,
    MillimetresPerMinute,
    MillimetresPositive,
    RevolutionsPerMinute,
    SecondsNotNegative,
    SecondsPositive,
    Share,
    ZeroOrMore,
)
from rtec.tomlfile import Strict, read_toml, validated


class Targets(Strict):
    """Targets of the readings.

    Attributes:
        axes: axes that travel, one after another; by default the instrument's axis, or all for an instrument without
            one.
        range_mm: first and last target; by default the travel without 2 % at each end.
        step_mm: distance between targets; by default a twentieth of the range.
        keep_step: use the step even if it is a multiple of the pitch, which hides the error that repeats with it.
        dwell_s: time at rest at each target until it is read.
        readings: number of readings at each target during the dwell.
        feed_mm_min: feed between targets.
        both_directions: approach from both directions; by default yes, except for a work piece.
        at_mm: positions of the other axes, by name; with several positions every line is measured at each. By default
            the middle of the travel.
    """

    axes: tuple[str, ...] | None = None
    range_mm: tuple[Millimetres, Millimetres] | None = None
    step_mm: MillimetresPositive | None = None
    keep_step: bool = False
    dwell_s: SecondsPositive = 3.0
    readings: Annotated[int, Field(ge=1, le=100_000)] = 1
    feed_mm_min: MillimetresPerMinute = 3000.0
    both_directions: bool | None = None
    at_mm: dict[str, Annotated[tuple[Millimetres, ...], Field(min_length=1)]] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _range_rises(self) -> "Targets":
        if self.range_mm is not None and self.range_mm[0] >= self.range_mm[1]:
            raise ValueError(f"range_mm {list(self.range_mm)}: the first must be below the second")
        return self


class DrivenPath(Strict):
    """Paths of the instruments that read in motion: ball bar and grid encoder.

    Attributes:
        step_deg: angle between readings on a circle.
        kinds: paths on a grid, one after another: the square in both senses; straight lines through the middle in both
            directions; L, to the corner from both sides and then along the other axis.
        travel_mm: side of the square, length of the lines.
        feeds_mm_min: feeds on a grid, each path at each of them; a ball bar has its feed in its set-up.
        step_mm: distance between readings on a grid.
    """

    step_deg: Annotated[float, Field(ge=1e-3, le=360)] = 0.25
    kinds: Annotated[tuple[Literal["square", "straight", "l_shaped"], ...], Field(min_length=1)] = (
        "square", "straight", "l_shaped",
    )  # fmt: skip
    travel_mm: MillimetresPositive = 160.0
    feeds_mm_min: Annotated[tuple[MillimetresPerMinute, ...], Field(min_length=1)] = (1000.0,)
    step_mm: MillimetresPositive = 0.5


class DayPhase(Strict):
    """A part of the day, with or without measuring cycles.

    Attributes:
        name: for people.
        cycles: number of measuring cycles; 0: none.
        hours: duration of a phase without cycles.
        on: whether the machine is switched on.
        rpm: spindle speed.
        moving: share of the time in which the axes move to and fro at the feed.
        read_every_s: interval of readings at rest, as by drift probes; None: no readings.
    """

    name: str
    cycles: Annotated[int, Field(ge=0, le=100_000)] = 0
    hours: Annotated[float, Field(ge=0, le=1e5), ZeroOrMore] = 0.0
    on: bool = True
    rpm: RevolutionsPerMinute = 0.0
    moving: Share = 0.0
    read_every_s: SecondsPositive | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> "DayPhase":
        if bool(self.cycles) == bool(self.hours):
            raise ValueError("a phase has either cycles or hours")
        if self.cycles and (self.moving or self.read_every_s):
            raise ValueError("moving and read_every_s are for phases with hours; cycles move and read by themselves")
        return self


class SensorBody(Strict):
    """First-order body under one temperature sensor: it approaches the air's temperature plus these steady-state rises.

    Attributes:
        tau_s: time constant.
        on_degc: rise with the machine on and at rest.
        axis_degc: rise with an axis moving at 100 mm/s, by axis name.
        spindle_degc: rise at 1000 1/min; grows with the power 1.2 of the speed.
        follows: another sensor on the same body (collinear); excludes all other keys but `share`.
        share: share of that body's rise above the air.
    """

    tau_s: SecondsPositive = 3600.0
    on_degc: DegreesDifference = 0.0
    axis_degc: dict[str, DegreesDifference] = Field(default_factory=dict)
    spindle_degc: DegreesDifference = 0.0
    follows: str | None = None
    share: Coefficient = 1.0


class Sensors(Strict):
    """Errors of all temperature sensors: offset (drawn once for each), noise, lag, resolution."""

    offset_degc: DegreesSpread = 0.1
    noise_degc: DegreesSpread = 0.02
    lag_s: SecondsNotNegative = 10.0
    resolution_degc: DegreesSpread = 0.01


class Thermal(Strict):
    """Air and bodies; a sensor that has no body here gets one by its name (axis, spindle, air, else structure)."""

    air_degc: DegreesCelsius = 20.0
    swing_degc: DegreesSpread = 1.0
    walk_degc: DegreesSpread = 0.3
    walk_tau_s: SecondsPositive = 7200.0
    body: dict[str, SensorBody] = Field(default_factory=dict)
    sensors: Sensors = Sensors()


class ReadingNoise(Strict):
    """Errors of the readings, µm (µrad where a reading is an angle).

    Attributes:
        white_um: standard deviation of independent noise.
        drift_um: standard deviation of noise that is correlated from reading to reading (Ornstein-Uhlenbeck).
        drift_tau_s: its correlation time.
        run_offset_um: standard deviation of the offset of each run.
        resolution_um: steps of the display.
        outliers: share of readings that are wrong by about `outlier_um`, either way.
        lost: share of readings that are missing.
    """

    white_um: MicrometresNotNegative = 0.3
    drift_um: MicrometresNotNegative = 0.0
    drift_tau_s: SecondsPositive = 1800.0
    run_offset_um: MicrometresNotNegative = 0.0
    resolution_um: MicrometresNotNegative = 0.0
    outliers: Share = 0.0
    outlier_um: MicrometresNotNegative = 20.0
    lost: Annotated[float, Field(ge=0, lt=1)] = 0.0


Preset = Literal["warm_up", "cold", "drift", "parts"]


class Settings(Strict):
    """A whole campaign.

    Attributes:
        protocol: name of a built-in protocol.
        phase: the user's own phases; they override `protocol`.
        log_every_s: interval of rows without a reading between the cycles, so that slow channels are recorded.
        nuisance: standard deviation of each nuisance parameter (zero, slope, …), by name, in its unit; by default 5 µm,
            20 µrad, 10 µm/m. 0: none.
    """

    targets: Targets = Targets()
    path: DrivenPath = DrivenPath()
    protocol: Preset | None = None
    phase: tuple[DayPhase, ...] = ()
    cycles: Annotated[int, Field(ge=1, le=100_000)] = 5
    thermal: Thermal = Thermal()
    noise: ReadingNoise = ReadingNoise()
    nuisance: dict[str, MicrometresNotNegative] = Field(default_factory=dict)
    log_every_s: SecondsPositive | None = None


DRIFT_PROBES: Mapping[str, Any] = {
    "radial1": {"direction": "X"},
    "radial2": {"direction": "X", "offset_mm": [0.0, 0.0, -60.0]},
    "axial": {"direction": "Z"},
}
"""Default probes of a spindle along Z: two radial ones 60 mm apart, and an axial one."""


def instrument_of(
    machine: Machine, instrument: str, axis: str | None, component: str | None, setup: Mapping[str, Any]
) -> Instrument:
    """Make an instrument with its set-up; drift probes without a set-up are the default ones.

    Raises:
        MeasurementError: the instrument or a key is unknown, or the machine lacks something.
    """
    table = dict(setup)
    if instrument == "spindle_drift" and "probe" not in table:
        table["probe"] = dict(DRIFT_PROBES)
    return make_instrument(instrument, table, axis, component, machine, "simulate")


def setup_table(items: Sequence[str]) -> dict[str, Any]:
    """The `[setup]` table from `key=value` texts; values as in TOML, or plain words.

    Raises:
        MeasurementError: a text is no key=value, or a key is repeated.
    """
    lines = []
    for item in items:
        key, mark, value = (part.strip() for part in item.partition("="))
        if not mark or not key:
            raise MeasurementError(f"--set {item!r} is no key=value, for example beam_offset_mm=[0,150,80]")
        try:
            tomllib.loads(f"value = {value}")
        except tomllib.TOMLDecodeError:
            value = "'" + value.replace("'", "") + "'"
        lines.append(f"{key} = {value}")
    try:
        return tomllib.loads("\n".join(lines))
    except tomllib.TOMLDecodeError as e:
        raise MeasurementError(f"--set {' '.join(items)}: {e}") from e


def settings_of(file: Path | None, options: Mapping[str, Mapping[str, Any]], heads: Mapping[str, Any]) -> Settings:
    """Settings of a file, overridden by the options that are not None.

    Args:
        file: TOML with the tables of `Settings`.
        options: values by key, by table.
        heads: values of the keys outside of tables.

    Raises:
        ConfigError: the file or an option is invalid.
    """
    content = dict(read_toml(file)) if file is not None else {}
    if file is not None:
        validated(Settings, content, str(file))
    for name, table in options.items():
        typed = {k: v for k, v in table.items() if v is not None}
        if typed:
            content[name] = {**content.get(name, {}), **typed}
    content |= {k: v for k, v in heads.items() if v is not None}
    if heads.get("protocol") is not None and content.get("phase"):
        raise ConfigError(f"{file}: [[phase]] and the option --protocol both say what the day is; leave one out")
    return validated(Settings, content, "simulate")


def table_path(out: Path) -> Path:
    """Path of the table: NAME.csv unless the name ends in .csv or .parquet.

    Raises:
        ConfigError: the name is that of a folder, as ".".
    """
    check_named(out, ConfigError)
    return out if out.suffix in (".csv", ".parquet") else out.with_name(f"{out.name}.csv")

"""Set-up of the instrument and settings of a campaign, from a file and from options."""

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rtec.errors import ConfigError, MeasurementError
from rtec.machine import Machine
from rtec.metrology.instruments.base import Instrument
from rtec.metrology.instruments.registry import make_instrument
from rtec.sim.campaign.settings import Settings
from rtec.tomlfile import read_toml, validated

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
    """Path of the table: NAME.csv unless the name ends in .csv or .parquet."""
    return out if out.suffix in (".csv", ".parquet") else out.with_name(f"{out.name}.csv")

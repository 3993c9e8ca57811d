"""All keys of machine, run, model, measurement, map and truth files, of answers for `rtec init`, of every driver.

Derived from the pydantic models that check the files: every key that is checked is also explained, on a terminal or as
a page of the documentation.
"""

import difflib
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import groupby
from textwrap import fill
from typing import Any, Final

import tomli_w
from pydantic import BaseModel

from rtec.commission.answers import Answers
from rtec.commission.example import SHIPPED
from rtec.correction.sinks import FollowingErrorSink, OriginOffsetSink, PhaseSink, PulseSink
from rtec.errors import ConfigError, DriverUnavailable
from rtec.hil import load_bench
from rtec.loop.driver_info import Option, installed, options_of
from rtec.loop.run_file import RunFile
from rtec.machine.machine import MachineFile
from rtec.metrology.files.toml import MeasurementFile
from rtec.metrology.importing.map import ImportMap
from rtec.metrology.instruments.registry import INSTRUMENTS
from rtec.model.file import ModelFile
from rtec.sim.truth import Truth
from rtec.tomlfile import read_toml

FILES: Final[Mapping[str, type[BaseModel]]] = {
    "machine": MachineFile,
    "run": RunFile,
    "model": ModelFile,
    "measurement": MeasurementFile,
    "map": ImportMap,
    "answers": Answers,
    "truth": Truth,
}
SINKS: Final = (PulseSink, FollowingErrorSink, OriginOffsetSink, PhaseSink)
SEVERAL: Final = ("device", "output", "setup")
"""Tables of run file and measurement whose keys depend on one key: the driver, the kind of output, the instrument."""
UNITS: Final = {
    "um_per_m_degc": "µm/(m·°C)",
    "degc_per_sqrt_h": "°C/√h",
    "bend_per_degc": "1/°C",
    "w_at_1000_rpm": "W",
    "j_per_mm": "J/mm",
    "j_per_k": "J/K",
    "w_per_k": "W/K",
    "rpm_per_s": "1/(min·s)",
    "kv_per_s": "1/s",
    "at_h": "h",
    "period_h": "h",
    "return_h": "h",
    "phase_rad": "rad",
    "counts_per_mm": "counts/mm",
    "counts_per_s": "counts/s",
    "um_s2": "µm/s²",
    "mm_s2": "mm/s²",
    "mm_min": "mm/min",
    "um_s": "µm/s",
    "mm_s": "mm/s",
    "um": "µm",
    "mm": "mm",
    "degc": "°C",
    "urad": "µrad",
    "deg": "°",
    "rpm": "1/min",
    "kg": "kg",
    "force_n": "N",
    "hz": "Hz",
    "ms": "ms",
    "us": "µs",
    "s": "s",
    "mb": "MB",
    "counts": "counts",
    "baud": "bit/s",
    "bitrate": "bit/s",
}
NEAR: Final = 0.6


@dataclass(frozen=True)
class Key:
    """One key of one file.

    Attributes:
        file: kind of file.
        table: path of its table, with dots; NAME is a name of the user's choice. "" for the top of the file.
        when: condition in its table for the key to exist, such as `driver = "modbus"`; or "".
        option: name, value, default, meaning.
        unit: unit of its number; "" without one.
        example: a line of TOML.
    """

    file: str
    table: str
    when: str
    option: Option
    unit: str
    example: str

    @property
    def name(self) -> str:
        """Name without its table."""
        return self.option.name.rpartition(".")[2]

    @property
    def path(self) -> str:
        """Table and name."""
        return f"{self.table}.{self.name}" if self.table else self.name


@cache
def all_keys() -> tuple[Key, ...]:
    """Every key, file by file, table by table."""
    return tuple(key for file, model in FILES.items() for key in _sorted(list(_keys_of(file, model))))


def _sorted(keys: Sequence[Key]) -> list[Key]:
    """Tables in the order of their model, each before the tables within it."""
    tops = list(dict.fromkeys((key.table.split(".")[0], key.when) for key in keys))
    return sorted(keys, key=lambda key: (tops.index((key.table.split(".")[0], key.when)), key.table))


def matching(path: str) -> list[Key]:
    """The keys that a text matches: a whole path, a table or a driver with all its keys, or the end of a path.

    Raises:
        ConfigError: none matches; the message names the nearest.
    """
    keys = [*all_keys(), *_device_keys(own=False)]
    parts = _parts(path)
    whole = [key for key in keys if _is(_parts(key.path), parts)]
    tables = [key for key in keys if _is(_parts(key.table), parts) or (path in FILES and key.file == path)]
    kinds = [key.when.split('"')[-2:-1][0] if key.when else "" for key in keys]
    by_driver = [
        key for kind, key in zip(kinds, keys, strict=True) if kind and (kind == path or _is([kind, key.name], parts))
    ]
    ends = [key for key in keys if _is(_parts(key.path)[-len(parts) :], parts)]
    matches = [*whole, *tables] or by_driver or ends
    if not matches:
        names = sorted({key.name for key in keys} | {key.path for key in keys})
        close = difflib.get_close_matches(path, names, n=1, cutoff=NEAR)
        way = f"did you mean {close[0]!r}?" if close else "`rtec explain` lists the tables"
        raise ConfigError(f"rtec explain: no key {path!r}; {way}")
    return matches


def tables() -> list[tuple[str, str, str, int]]:
    """File, table, its condition, and its number of keys."""
    out: dict[tuple[str, str, str], int] = {}
    for key in all_keys():
        place = (key.file, key.table, key.when)
        out[place] = out.get(place, 0) + 1
    return [(*place, n) for place, n in out.items()]


def _keys_of(file: str, model: type[BaseModel]) -> Iterator[Key]:
    for option in options_of(model):
        several = file in ("run", "measurement") and option.name.split(".")[0] in SEVERAL
        if not several and not _has_keys(option):
            yield _key(file, option, "")
    if file == "run":
        yield from _hil_keys()
        yield from _output_keys()
        yield from _device_keys(own=True)
    if file == "measurement":
        for name, kind in INSTRUMENTS.items():
            options = (o for o in options_of(kind.setup_model, "setup.") if not _has_keys(o))
            yield from (_key(file, o, f'instrument = "{name}"') for o in options)


def _hil_keys() -> Iterator[Key]:
    """The keys of the bench that is installed."""
    try:
        options = load_bench().options_model
    except DriverUnavailable:
        return
    example = read_toml(SHIPPED / "hil.toml")["hil"]
    yield from (_key("run", o, "", example) for o in options_of(options, "hil.") if not _has_keys(o))


def _output_keys() -> Iterator[Key]:
    for sink in SINKS:
        when = f'kind = "{sink.model_fields["kind"].default}"'
        yield from (_key("run", o, when) for o in options_of(sink, "output.NAME."))


def _device_keys(*, own: bool) -> Iterator[Key]:
    """The keys of rtec's own drivers, or of those of other packages, which no page of rtec has."""
    for name, driver in installed().items():
        if (driver.package == "rtec") is own and not driver.trouble:
            kind = driver.load()
            example = _first_table(str(getattr(kind, "EXAMPLE", "")))
            options = (o for o in options_of(kind.options_model, "device.NAME.") if not _has_keys(o))
            yield from (_key("run", o, f'driver = "{name}"', example) for o in options)


def _has_keys(option: Option) -> bool:
    """Is it a table whose own keys are listed after it?"""
    return option.kind in ("table", "tables by name")


def _key(file: str, option: Option, when: str, example: Mapping[str, Any] | None = None) -> Key:
    table, _, name = option.name.rpartition(".")
    return Key(file, table, when, option, unit_of(name, option), _example(file, option, when, example or {}))


def unit_of(name: str, option: Option) -> str:
    """The unit at the end of a key's name."""
    if "number" not in option.kind:
        return ""
    return next((unit for end, unit in UNITS.items() if name == end or name.endswith(f"_{end}")), "")


def _example(file: str, option: Option, when: str, table: Mapping[str, Any]) -> str:
    """A line of TOML, from the first of: written examples, the driver's own, a shipped file, the default, a choice."""
    name = option.name.rpartition(".")[2]
    kind = when.partition('"')[2].rstrip('"')
    whole = f"{file}.{option.name}"
    as_in_the_map = whole.replace("map.temperatures.", "map.")
    for written in (f"{kind}.{name}", whole, as_in_the_map, ".".join(option.name.split(".")[-2:]), name):
        if written in EXAMPLES:
            return f"{name} = {EXAMPLES[written]}"
    path = option.name.removeprefix("device.NAME.").removeprefix("hil.").split(".")
    value = _at(table, path) if table else _at(_shipped(file), path)
    if value is not None:
        return _line(name, value)
    if option.default:
        return f"{name} = {option.default}"
    if choice := re.match(r"one of ([^,]+)", option.kind):
        return f"{name} = {choice[1]}"
    return ""


def _line(name: str, value: Any) -> str:
    """One line of TOML."""
    text = tomli_w.dumps({name: value})
    return re.sub(r"\s+", " ", re.sub(r",\s*\]", "]", re.sub(r"\[\s+", "[", text))).strip()


@cache
def _shipped(file: str) -> dict[str, Any]:
    """A shipped file of this kind."""
    names = {"machine": "machines/turning-centre.toml", "run": "turning-centre-sim.toml"}
    names |= {"model": "models/turning-centre.toml", "map": "maps/laser-decimal-comma.toml"}
    names |= {"truth": "sim/turning-centre.toml"}
    return read_toml(SHIPPED / names[file]) if file in names else {}


def _first_table(text: str) -> dict[str, Any]:
    devices = tomllib.loads(text).get("device", {})
    return next(iter(devices.values()), {})


def _at(value: Any, path: Sequence[str]) -> Any:
    """The value at a place; for NAME, the first one that has the rest of the path."""
    if not path:
        return None if isinstance(value, Mapping) else value
    if not isinstance(value, Mapping):
        return None
    names = list(value) if path[0] == "NAME" else [path[0]]
    return next((x for n in names if n in value and (x := _at(value[n], path[1:])) is not None), None)


def _parts(path: str) -> list[str]:
    return [part.strip("[] \"'") for part in path.split(".") if part.strip("[] ")]


def _is(parts: Sequence[str], path: Sequence[str]) -> bool:
    """Does this place match? NAME matches any name, except at the end of `path`."""
    return len(parts) == len(path) > 0 and all(a in (b, "NAME") for a, b in zip(parts, path, strict=True))


TITLES = {
    "machine": "Machine file",
    "run": "Run file",
    "model": "Model file",
    "measurement": "Measurement, the TOML beside its table",
    "map": "Map of `rtec import`",
    "answers": "Answers of `rtec init`",
    "truth": "Truth of a simulated machine, of driver `sim`",
}
HEAD = """\
# Every key of every file

Written by `rtec explain --all` from the models that check the files; `make reference` writes it again. On the command
line, `rtec explain stop_um` explains one key. How the files work together: [files](../files.md).

NAME is a name of your choice: of an axis, a link, a sensor, a device. A key without a default, not required, may
be left out. Numbers outside their limits are refused.
"""


def explained(key: Key, width: int = 79) -> str:
    """One key on a terminal."""
    place = f"[{key.table}] {key.name}" if key.table else key.name
    lines = [f"{place}   ({key.file} file{f', where {key.when}' if key.when else ''})"]
    meaning = key.option.meaning.replace("`", "")
    if meaning:
        lines.append(fill(meaning[0].upper() + meaning[1:], width, initial_indent="  ", subsequent_indent="  "))
    facts = (("unit", key.unit), ("value", key.option.kind), ("default", _default(key)), ("example", key.example))
    lines += [f"  {name:<8} {text}" for name, text in facts if text]
    return "\n".join(lines)


def overview(tables: Sequence[tuple[str, str, str, int]]) -> str:
    """The tables, a line each."""
    lines = ["rtec explain KEY, or a table or a file with all its keys. The tables:", ""]
    for file, rows in groupby(tables, key=lambda row: row[0]):
        lines.append(f"{file} file")
        lines += [f"  {f'[{table}]' if table else '(top)':<44} {when} ({n})" for _, table, when, n in rows]
    return "\n".join(lines)


def reference(keys: Sequence[Key]) -> str:
    """All keys as Markdown."""
    return HEAD + "".join(_file_part(file, list(part)) for file, part in groupby(keys, key=lambda k: k.file))


def _file_part(file: str, keys: Sequence[Key]) -> str:
    parts = groupby(keys, key=lambda k: (k.table, k.when))
    return f"\n## {TITLES[file]}\n" + "".join("\n".join(_table(t, w, list(part))) for (t, w), part in parts)


def _table(table: str, when: str, keys: Sequence[Key]) -> Iterator[str]:
    yield f"\n### `[{table}]`{f', {when}' if when else ''}\n" if table else ""
    yield "| key | unit | value | default | example | meaning |"
    yield "|---|---|---|---|---|---|"
    for key in keys:
        cells = (key.unit, key.option.kind, _default(key), f"`{key.example}`", key.option.meaning)
        yield f"| `{key.name}` | {' | '.join(_cell(cell) for cell in cells)} |"
    yield ""


def _cell(text: str) -> str:
    return text.replace("|", "\\|") or "-"


def _default(key: Key) -> str:
    return "required" if key.option.required else key.option.default


EXAMPLES: Final[Mapping[str, str]] = {
    # machine, run, model
    "run.run.model": '"model.toml"',
    "model.correlation.numbers": '["1 scale(EXX, X) k", "2 backlash(EXX, X) B"]',
    "model.correlation.rows": '["", "-0.25"]',
    "run.run.log_folder": '"logs"',
    "run.run.state_folder": '"/var/lib/rtec/mill"',
    "run.role.spindle": '"machine"',
    "run.role.actuator": '"machine"',
    "run.table": '{files = {X = "x.comp"}}',
    "run.table.files": '{X = "x.comp"}',
    "run.table.change_um": "1.0",
    "run.guard.fade_after_s": "600.0",
    "run.realtime.cpu": "3",
    "run.control.prometheus": '"127.0.0.1:9105"',
    "run.control.compared": '"compared.json"',
    "run.telemetry.opcua.certificate_file": '"mill.pem"',
    "run.telemetry.opcua.key_file": '"mill.key"',
    "run.telemetry.opcua.trusted_folder": '"opcua-clients"',
    "run.telemetry.mqtt.broker": '"192.168.10.9:8883"',
    "run.telemetry.mqtt.topic": '"shop/mill"',
    "run.telemetry.mqtt.ca_file": '"shop-ca.pem"',
    "run.telemetry.mqtt.certificate_file": '"mill.pem"',
    "run.telemetry.mqtt.key_file": '"mill.key"',
    "run.telemetry.mqtt.user": '"mill"',
    "run.telemetry.mqtt.password_file": '"mqtt.password"',
    "run.capture.axis.NAME.a": '"MODE/XA"',
    "run.capture.axis.NAME.b": '"RB/XB"',
    "run.capture.degc": "{T_spindle_front = 33.0}",
    "run.hil": '{truth = "sim/turning-centre.toml", seed = 1}',
    "run.output.NAME.resolution_um": "0.1",
    "model.model.machine_file": '"machine.toml"',
    "model.model.effects": "6",
    "model.model.noise_um": "0.4",
    "model.effect": '[{effect = "scale", component = "EXX", axis = "X"}]',
    "model.valid_range": "{T_air = [17.5, 25.7]}",
    "model.measurement": '{laser-x = "8a567585fa94baa3"}',
    "model.history": '[{change = "fitted"}]',
    # measurement and map
    "measurement.measurement.instrument": '"laser_linear"',
    "measurement.measurement.machine": '"turning-centre"',
    "measurement.measurement.axis": '"X"',
    "measurement.measurement.component": '"EXX"',
    "measurement.measurement.notes": '["oil at 21 °C"]',
    "measurement.table.encoding": '"cp1252"',
    "measurement.table.missing_codes": '[-9999.0, "n/a"]',
    "measurement.table.ignore_columns": '["operator"]',
    "measurement.table.hold_temperature_s": "60.0",
    "map.source.reader": '"delimited"',
    "map.source.table": '"Sheet1"',
    "map.source.encoding": '"cp1252"',
    "map.source.delimiter": '";"',
    "map.source.thousands": '"."',
    "map.source.comment": '"#"',
    "map.source.widths": "[10, 8, 8]",
    "map.source.names": '["time", "position", "error"]',
    "map.source.missing": '["n/a"]',
    "map.cycles.position": '"Target [mm]"',
    "map.cycles.forward": '["Run 1 +", "Run 2 +"]',
    "map.cycles.backward": '["Run 1 -", "Run 2 -"]',
    "map.events.channel": '"channel"',
    "map.events.value": '"value"',
    "map.events.unit": '"unit"',
    "map.measurement.component": '"EXX"',
    "map.measurement.axis": '"X"',
    "map.measurement.notes": '["second day"]',
    "map.setup": '{zero = "run"}',
    "map.time.column": '"Zeit"',
    "map.time.date": '"Datum"',
    "map.time.unit": '"s"',
    "map.time.format": '"%H:%M:%S"',
    "map.time.zone": '"Europe/Berlin"',
    "map.time.step_s": "5.0",
    "map.run.column": '"run"',
    "map.run.direction_of": '"x_mm"',
    "map.run.gap_s": "120.0",
    "map.run.jump_mm": "50.0",
    "map.temperatures.file": '"logger.csv"',
    "map.rows.require": '["error"]',
    "map.rows.where": '"bed_target == 105"',
    "map.column.NAME.from": '"Abweichung"',
    "map.column.NAME.value": "180.0",
    "map.column.NAME.minus": '"Soll"',
    "map.column.NAME.minus_unit": '"um"',
    "map.column.NAME.unit": '"µm"',
    "map.column.NAME.values": "{fwd = 1.0, bwd = -1.0}",
    "map.column.NAME.missing_codes": "[-9999.0]",
    # truth
    "truth.conductance": '[{between = ["headstock", "bed"], w_per_k = 14.0}]',
    "truth.growth_um": '[{link = "spindle", motion = "Z", body = "headstock", per_degc = 0.7, per_degc2 = 0.003}]',
    "truth.growth_urad": '[{link = "Z", motion = "B0", body = "headstock", minus = "bed", per_degc = 0.9}]',
    "truth.drift_um": '[{link = "workpiece", motion = "X", amplitude = 0.6, period_h = 31.0}]',
    "truth.spindle.shares": "{spindle_front = 0.6, spindle_rear = 0.4}",
    "truth.axis.NAME.squareness_urad": "{B = 12.0}",
    "truth.axis.NAME.drive.shares": "{x_nut = 0.7, carriage = 0.3}",
    "truth.axis.NAME.motion_urad.NAME.bumps": "[[2.0, 140.0, 14.0]]",
    # answers
    "answers.name": '"lathe-3"',
    "answers.tool_chain": '["Z", "X", "turret", "tool"]',
    "answers.work_chain": '["spindle", "workpiece"]',
    "answers.axis.NAME.travel_mm": "[0.0, 200.0]",
    "answers.axis.NAME.resolution_um": "0.5",
    "answers.axis.NAME.counts_per_mm": "2000.0",
    "answers.axis.NAME.pitch_mm": "5.0",
    "answers.link": "{tool = [120.0, 0.0, 80.0]}",
    "answers.sensors": '["T_bed", "T_air"]',
    "answers.role.counts": '"encoders"',
    "answers.role.temperatures": '["thermocouples"]',
    "answers.role.spindle": '"encoders"',
    "answers.role.actuator": '"offsets"',
    "answers.device": '{encoders = {driver = "serial_box", port = "/dev/ttyUSB0"}}',
    "answers.limits.warning_um": "40.0",
    "answers.output": '{kind = "origin_offset", resolution_um = 0.1}',
    "answers.rate_hz": "1000.0",
    "answers.counts_max_age_s": "0.005",
    # instruments
    "air_sensor": '"T_air"',
    "interferometer_mm": "-250.0",
    "artefact_degree": "3",
    "reference_axis": '"Y"',
    "centre_mm": "[250.0, 200.0, 150.0]",
    "radius_mm": "100.0",
    "setup.feed_mm_min": "1000.0",
    "laser_diagonal.direction": "[500.0, 400.0, 300.0]",
    "origin_mm": "[250.0, 200.0, 0.0]",
    "reversed_runs": "[3, 4]",
    # drivers
    "truth": '"sim/turning-centre.toml"',
    "program": '"G1 X40 F720"',
    "program_file": '"part.nc"',
    "port": '"/dev/ttyUSB0"',
    "usb_serial": '"A5069RR4"',
    "axes": '["X", "Z"]',
    "box_serial": "42",
    "max_speed_mm_s": "{X = 400.0, Z = 400.0}",
    "patterns": "['T1=(?P<T_bed>\\S+)']",
    "request": '"READ?\\r"',
    "timeout_ms": "5.0",
    "host": '"192.168.1.60"',
    "restarted": '"READY.*"',
    "thermocouple": '"K"',
    "cold_junction": '"terminals"',
    "interface": '"socketcan"',
    "channel": '"can0"',
    "bitrate": "500000",
    "id": "5",
    "dbc": '"machine.dbc"',
    "message": '"Temperatures"',
    "signal": '"Bed"',
    "node": "5",
    "cob_id": "389",
    "state": '"tcp://127.0.0.1:5555"',
    "command": '"tcp://127.0.0.1:5556"',
    "ascii_offset.command": '["OFS X={X:.4f} Z={Z:.4f}"]',
    "server_key_file": '"cell.key"',
    "own_key_file": '"rtec.key_secret"',
    "can_encoders.max_speed_mm_s": "400.0",
    "tcp.port": "502",
}
"""TOML by driver, instrument or kind and key, by file and place, or by key alone; the first of these counts."""

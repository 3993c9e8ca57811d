"""All keys of machine, run, model, measurement and map files, of answers for `rtec init`, and of every driver.

Derived from the pydantic models that check the files: every key that is checked is also explained.
"""

import difflib
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import tomli_w
from pydantic import BaseModel

from rtec.commission.answers import Answers
from rtec.commission.example import SHIPPED
from rtec.correction.sinks import FollowingErrorSink, OriginOffsetSink, PhaseSink, PulseSink
from rtec.errors import ConfigError
from rtec.loop.driver_info import Option, installed, options_of
from rtec.loop.run_file import RunFile
from rtec.machine.load import MachineFile
from rtec.metrology.files.toml import MeasurementFile
from rtec.metrology.importing.map import ImportMap
from rtec.metrology.instruments.registry import INSTRUMENTS
from rtec.model.file import ModelFile
from rtec.reference.examples import EXAMPLES
from rtec.tomlfile import read_toml

FILES: Final[Mapping[str, type[BaseModel]]] = {
    "machine": MachineFile,
    "run": RunFile,
    "model": ModelFile,
    "measurement": MeasurementFile,
    "map": ImportMap,
    "answers": Answers,
}
SINKS: Final = (PulseSink, FollowingErrorSink, OriginOffsetSink, PhaseSink)
SEVERAL: Final = ("device", "output", "setup")
"""Tables of run file and measurement whose keys depend on one key: the driver, the kind of output, the instrument."""
UNITS: Final = {
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
    """The keys that a text matches: a whole path, a table with all its keys, or the end of a path.

    Raises:
        ConfigError: none matches; the message names the nearest.
    """
    keys = all_keys()
    parts = _parts(path)
    whole = [key for key in keys if _is(_parts(key.path), parts)]
    tables = [key for key in keys if _is(_parts(key.table), parts) or (path in FILES and key.file == path)]
    by_driver = [key for key in keys if _is([key.when.split('"')[-2:-1][0], key.name] if key.when else [], parts)]
    ends = [key for key in keys if _is(_parts(key.path)[-len(parts) :], parts)]
    matches = whole or tables or by_driver or ends
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
        yield from _output_keys()
        yield from _device_keys()
    if file == "measurement":
        for name, kind in INSTRUMENTS.items():
            options = (o for o in options_of(kind.setup_model, "setup.") if not _has_keys(o))
            yield from (_key(file, o, f'instrument = "{name}"') for o in options)


def _output_keys() -> Iterator[Key]:
    for sink in SINKS:
        when = f'kind = "{sink.model_fields["kind"].default}"'
        yield from (_key("run", o, when) for o in options_of(sink, "output.NAME."))


def _device_keys() -> Iterator[Key]:
    """The keys of rtec's own drivers; `rtec drivers NAME` shows those of other packages."""
    for name, driver in installed().items():
        if driver.package == "rtec" and not driver.trouble:
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
    for written in (f"{kind}.{name}", f"{file}.{option.name}", ".".join(option.name.split(".")[-2:]), name):
        if written in EXAMPLES:
            return f"{name} = {EXAMPLES[written]}"
    path = option.name.removeprefix("device.NAME.").split(".")
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

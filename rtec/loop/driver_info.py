"""The installed drivers: rtec's own, and those that other packages register at the entry point `rtec.drivers`.

An entry point gives either a driver's class (the entry point's name is then the driver's) or a table
`name -> (module, class)`, as rtec's own registry does. A module of a table is imported only when its driver is used.
A package that fails to load hides no other.

The description of a driver (`driver_facts`, `options_of`) is derived from its class: its ports, and each option's name,
type, default and meaning from the pydantic model that checks it. The meaning is the field's description; a field
without one takes it from "Attributes:" in the class' docstring.
"""

import functools
import importlib
import inspect
import json
import re
import sys
import types
import typing
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import Distribution, EntryPoint, entry_points
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from rtec.errors import ConfigError, DriverUnavailable
from rtec.loop.ports import Actuator, CountSource, SpindleSource, TemperatureSource
from rtec.tomlfile import nearest

GROUP = "rtec.drivers"
OWN = "rtec"


@dataclass(frozen=True)
class Installed:
    """Where a driver is.

    Attributes:
        name: its name in a run file.
        module, kind: its module and the name of its class.
        package: installed package that it belongs to.
        trouble: why it cannot be used, as known before its module is imported; or "".
    """

    name: str
    module: str
    kind: str
    package: str
    trouble: str = ""

    def load(self) -> Any:
        """Import its module and give the driver's class.

        Raises:
            DriverUnavailable: it cannot be used; the message says what to install, where that helps.
        """
        if self.trouble:
            raise DriverUnavailable(f"driver {self.name!r} {self.trouble}")
        try:
            driver_type = getattr(importlib.import_module(self.module), self.kind, None)
        except ImportError as e:
            raise DriverUnavailable(f"driver {self.name!r} {_cannot(e, self.package)}") from e
        except Exception as e:  # a package's own code may raise anything while it is imported
            raise DriverUnavailable(f"driver {self.name!r} cannot be imported: {type(e).__name__}: {e}") from e
        if driver_type is None:
            raise DriverUnavailable(f"driver {self.name!r}: module {self.module} has no {self.kind}")
        return driver_type


def installed() -> dict[str, Installed]:
    """All drivers by name, rtec's own first.

    Where two have one name, the first keeps it. The other is listed with its fault under "NAME (PACKAGE)", which no run
    file can use.
    """
    out: dict[str, Installed] = {}
    for entry in _registered(tuple(_changed(place) for place in sys.path)):
        for driver in _of(entry):
            first = out.get(driver.name)
            if first is None:
                out[driver.name] = driver
                continue
            name = f"{driver.name} ({driver.package})"
            fault = f"is hidden: package {first.package} has a driver of the same name"
            out[name] = Installed(name, driver.module, driver.kind, driver.package, fault)
    return out


def _changed(place: str) -> tuple[str, int]:
    """A place where packages are, and when one last came or went there; 0 where there is no such place."""
    whole = Path(place).absolute()
    try:
        return str(whole), whole.stat().st_mtime_ns
    except OSError:
        return str(whole), 0


@functools.lru_cache(maxsize=4)
def _registered(places: tuple[tuple[str, int], ...]) -> tuple[EntryPoint, ...]:
    """Entry points of all packages, rtec's own first; read again once a package came or went."""
    del places
    return tuple(sorted(entry_points(group=GROUP), key=lambda e: (_package(e) != OWN, e.name)))


def find(name: str, where: str) -> Installed:
    """The driver of that name.

    Raises:
        ConfigError: no driver has that name.
    """
    table = installed()
    if name not in table:
        raise ConfigError(f"{where}: no driver {name!r}{nearest(name, table)}")
    return table[name]


def _of(entry: EntryPoint) -> list[Installed]:
    """The drivers that one entry point registers."""
    package = _package(entry)
    try:
        value: Any = entry.load()
    except ImportError as e:
        return [Installed(entry.name, entry.module, entry.attr, package, _cannot(e, package))]
    except (Exception, SystemExit) as e:  # noqa: BLE001 - a package's own code may raise anything while it is imported
        fault = f"cannot be imported: {type(e).__name__}: {e}"
        return [Installed(entry.name, entry.module, entry.attr, package, fault)]
    if isinstance(value, type):
        return [Installed(entry.name, entry.module, entry.attr, package)]
    if isinstance(value, Mapping) and all(isinstance(p, tuple) and len(p) == 2 for p in value.values()):
        return [Installed(str(name), str(place[0]), str(place[1]), package) for name, place in value.items()]
    fault = f"cannot be used: its entry point {entry.value!r} is neither a class nor a table of (module, class)"
    return [Installed(entry.name, entry.module, entry.attr, package, fault)]


def _package(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist is not None else "?"


def _cannot(error: ImportError, package: str) -> str:
    """Why an import failed, and what to install."""
    missing = (error.name or "").partition(".")[0]
    if not isinstance(error, ModuleNotFoundError) or not missing:
        return f"cannot be imported: {error}"
    return f"needs the Python package {missing!r}, which is not installed: {_how(missing, package)}"


def _how(missing: str, package: str) -> str:
    """The command that installs a missing module: with the extra of the driver's package, if one names that module."""
    try:
        requires = Distribution.from_name(package).requires or []
    except (ModuleNotFoundError, ValueError):  # the package does not exist, or has no name
        requires = []
    for requirement in requires:
        name = re.match(r"[A-Za-z0-9._-]+", requirement)
        if name is None or _plain(name[0]) != _plain(missing):
            continue
        extra = re.search(r"""extra\s*==\s*['"]([^'"]+)""", requirement)
        return f"pip install '{package}[{extra[1]}]'" if extra else f"pip install {name[0]}"
    return f"pip install the package that holds the module {missing!r} (often of the same name)"


def _plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


WORDS: dict[Any, str] = {
    bool: "true or false",
    int: "whole number",
    float: "number",
    str: "text",
    Path: "file",
}
LOW, HIGH = {"ge": "from {}", "gt": "above {}"}, {"le": "to {}", "lt": "below {}"}


@dataclass(frozen=True)
class Option:
    """One key that a device's table may have.

    Attributes:
        name: the key; a key within a table follows its table's name and a dot. `NAME` is a name that the user chooses.
        kind: type and allowed values, in words.
        default: value of a key that is not given, as TOML; "" where there is none.
        required: must it be given?
        meaning: one or two sentences; "" where the driver's author wrote none.
    """

    name: str
    kind: str
    default: str
    required: bool
    meaning: str


def options_of(model: type[BaseModel], prefix: str = "") -> list[Option]:
    """All options of a model; the options within a table follow it."""
    documented = _attributes(model)
    out = []
    for key, field in model.model_fields.items():
        name = prefix + (field.alias or key)
        kind, inner, below = _kind(field.annotation, field.metadata)
        meaning = field.description or documented.get(key) or documented.get(field.alias or key, "")
        out.append(Option(name, kind, _default(field), field.is_required(), _flat(meaning)))
        if inner is not None:
            out += options_of(inner, f"{name}.{below}")
    return out


def summary_of(kind: type) -> str:
    """First paragraph of a class' docstring, on one line."""
    return _flat((inspect.getdoc(kind) or "").split("\n\n", maxsplit=1)[0])


def _kind(annotation: Any, metadata: typing.Sequence[Any] = ()) -> tuple[str, type[BaseModel] | None, str]:
    """A type in words; the model of a table within; and the part of a key between the table's name and its own keys."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is typing.Annotated:
        parts = [part.metadata if isinstance(part, FieldInfo) else [part] for part in arguments[1:]]
        return _kind(arguments[0], [item for part in parts for item in part])
    if origin in (typing.Union, types.UnionType):
        kinds = [_kind(a, metadata) for a in arguments if a is not type(None)]
        inner = next((k for k in kinds if k[1] is not None), (None, None, ""))
        return " or ".join(k[0] for k in kinds), inner[1], inner[2]
    if origin is Literal:
        return "one of " + ", ".join(_toml(a) for a in arguments), None, ""
    if origin is dict:
        words, inner_model, below = _kind(arguments[1])
        return ("tables by name" if inner_model else f"table: name = {words}"), inner_model, f"NAME.{below}"
    if origin in (tuple, list):
        return _sequence(arguments), None, ""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "table", annotation, ""
    return WORDS.get(annotation, "value") + _bounds(metadata), None, ""


def _sequence(arguments: tuple[Any, ...]) -> str:
    kinds = list(dict.fromkeys(_kind(a)[0] for a in arguments if a is not Ellipsis))
    if Ellipsis in arguments or len(arguments) < 2:
        return f"list: {kinds[0] if kinds else 'value'}, …"
    return f"list of {len(arguments)}: {', '.join(kinds)}"


def _bounds(metadata: typing.Sequence[Any]) -> str:
    """Limits in words, such as " from 1 to 247"."""
    return "".join(
        f" {words.format(_short(getattr(item, key)))}"
        for side in (LOW, HIGH)
        for key, words in side.items()
        for item in metadata
        if getattr(item, key, None) is not None
    )


def _short(number: float) -> str:
    return str(int(number)) if float(number).is_integer() else f"{number:.9f}".rstrip("0")


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return ""
    value = field.get_default(call_default_factory=True, validated_data={})
    return "" if value is None else _toml(value)


def _toml(value: Any) -> str:
    if isinstance(value, BaseModel):
        return ""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return json.dumps(value, ensure_ascii=False, default=str)


def _attributes(model: type) -> dict[str, str]:
    """Descriptions of the attributes, from the docstrings of a class and of its bases; the class' own come first."""
    out: dict[str, str] = {}
    for base in model.__mro__:
        text = inspect.cleandoc(base.__doc__ or "")
        part = re.search(r"^Attributes:\n((?:[ \t]+.*\n?|\n)*)", text, re.MULTILINE)
        for names, words in _entries(inspect.cleandoc(part[1]) if part else ""):
            for name in names:
                out.setdefault(name, words)
    return out


def _entries(text: str) -> list[tuple[list[str], str]]:
    """Split `name, name: words` with indented lines below into names and words."""
    out = []
    for entry in re.split(r"\n(?=\S)", text):
        names, colon, words = entry.partition(":")
        if colon and all(name.strip().isidentifier() for name in names.split(",")):
            out.append(([name.strip() for name in names.split(",")], words))
    return out


def _flat(text: str) -> str:
    return re.sub(r"\s+", " ", text).strip()


CAN_BE: dict[str, type] = {
    "counts": CountSource,
    "temperatures": TemperatureSource,
    "spindle": SpindleSource,
    "actuator": Actuator,
}
"""The keys of a run file's `[role]`, each with the port that a driver must have for it."""


@dataclass(frozen=True)
class DriverFacts:
    """Description of one driver.

    Attributes:
        name: its name in a run file.
        module, package: where it is defined.
        summary: one sentence.
        roles: the keys of `[role]` that it can serve.
        takes: kinds of output that it accepts as an actuator; empty where it does not declare them.
        takes_by: the option that selects the kind of output, or "".
        resumes: does it stop after a fault until it is ordered to resume?
        scans: can it scan its port or bus for numbers?
        options: the keys of its device's table.
        example: text of a device's table, or "".
        trouble: why it cannot be used, and what to do; or "".
    """

    name: str
    module: str
    package: str
    summary: str = ""
    roles: tuple[str, ...] = ()
    takes: tuple[str, ...] = ()
    takes_by: str = ""
    resumes: bool = False
    scans: bool = False
    options: tuple[Option, ...] = ()
    example: str = ""
    trouble: str = ""

    def plain(self) -> dict[str, Any]:
        """As data for JSON."""
        return asdict(self)


def all_drivers() -> list[DriverFacts]:
    """Every driver that is installed; those that cannot be used say why."""
    return [_facts(driver) for driver in installed().values()]


def driver_facts(name: str) -> DriverFacts:
    """Description of one driver.

    Raises:
        ConfigError: no driver has that name.
    """
    return _facts(find(name, "rtec drivers"))


def _facts(driver: Installed) -> DriverFacts:
    try:
        kind = driver.load()
    except DriverUnavailable as e:
        return DriverFacts(driver.name, driver.module, driver.package, trouble=str(e))
    model = getattr(kind, "options_model", None)
    if model is None:
        trouble = f"driver {driver.name!r}: class {driver.kind} has no options_model; see docs/write-a-driver.md"
        return DriverFacts(driver.name, driver.module, driver.package, trouble=trouble)
    takes, by = _takes(kind)
    return DriverFacts(
        driver.name,
        driver.module,
        driver.package,
        summary_of(kind),
        tuple(role for role, port in CAN_BE.items() if issubclass(kind, port)),
        takes,
        by,
        hasattr(kind, "resume"),
        hasattr(kind, "scanner"),
        tuple(options_of(model)),
        str(getattr(kind, "EXAMPLE", "")),
    )


def _takes(kind: Any) -> tuple[tuple[str, ...], str]:
    """Kinds of output that the class declares, else those of its option `actuator`, with that option's name."""
    if not issubclass(kind, Actuator):
        return (), ""
    declared = getattr(kind, "TAKES", None)
    if declared is not None:
        return tuple(declared), ""
    option = kind.options_model.model_fields.get("actuator")
    return (tuple(map(str, get_args(option.annotation))), "actuator") if option is not None else ((), "")

"""`rtec drivers`. Oracles: docs/drivers.md, written by hand; pydantic's own schema; what real drivers refuse."""

import importlib
import json
import re
import sys
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from pydantic import Field, TypeAdapter

from rtec.cli.main import status
from rtec.correction.sinks import Sink
from rtec.errors import ConfigError, DriverUnavailable
from rtec.loop.clock import VirtualClock
from rtec.loop.driver_info import all_drivers, driver_facts, find, installed, options_of
from rtec.report.devices import driver_row
from rtec.tomlfile import Strict, validated
from rtec_drivers.registry import DRIVERS
from tests.support.conformance import CONFIGS, MACHINE

PAGE = (Path(__file__).parents[2] / "docs" / "drivers.md").read_text(encoding="utf-8")
SINKS: list[Sink] = [
    TypeAdapter(Sink).validate_python({"kind": kind, **more})
    for kind, more in (
        ("pulse", {}),
        ("following_error", {"resolution_um": 1.0}),
        ("origin_offset", {"resolution_um": 1.0}),
        ("phase", {"bits": 8, "range_mm": 0.128}),  # steps of 1 µm
    )
]
SPEED = {"max_speed_mm_s": {"X": 400.0, "Z": 400.0}}
ACTUATORS: dict[str, dict[str, Any]] = {
    "sim": {"truth": "sim/turning-centre.toml"},
    "serial_box": {"port": "/dev/none", **SPEED},
    "ascii_offset": {
        "tcp": {"host": "none", "port": 1},
        "command": ["{X} {Z}"],
        "unit": "um",
        "resolution_um": 1.0,
    },
    "can_box": {"interface": "virtual", "channel": "none", **SPEED},
    "linuxcnc": {"socket": "none.sock", "unit_um": 1.0},
    "zmq_link": {"state": "ipc://none", "command": "ipc://nothing"},
}


def package(folder: Path, name: str, points: dict[str, str], requires: str = "", **modules: str) -> None:
    """A package as `pip install` leaves it; it must be put on the path."""
    info = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    info.mkdir()
    head = f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n{requires}"
    (info / "METADATA").write_text(head, encoding="utf-8")
    lines = "".join(f"{key} = {value}\n" for key, value in points.items())
    (info / "entry_points.txt").write_text(f"[rtec.drivers]\n{lines}", encoding="utf-8")
    for module, text in modules.items():
        (folder / f"{module}.py").write_text(text, encoding="utf-8")


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that packages can be put into."""
    monkeypatch.syspath_prepend(str(tmp_path))
    importlib.invalidate_caches()
    return tmp_path


def test_the_table_of_the_page_is_that_of_the_program() -> None:
    rows = re.findall(r"^\| \[?`(\w+)`\S* \| (.*?) \| (.*?) \| (.*?) \|$", PAGE, re.MULTILINE)
    assert [tuple(row) for row in rows] == [driver_row(d) for d in all_drivers() if d.package == "rtec"]
    assert [row[0] for row in rows] == list(DRIVERS)


@pytest.mark.parametrize("name", ACTUATORS)
def test_what_a_driver_is_said_to_take_it_does_not_refuse(name: str) -> None:
    facts = driver_facts(name)
    taken = set()
    for kind in facts.takes if facts.takes_by else ("",):
        chosen = {facts.takes_by: kind} if kind else {}
        driver = find(name, "test").load()
        options = validated(driver.options_model, {**ACTUATORS[name], **chosen}, "test")
        made = driver(options, MACHINE, VirtualClock(), CONFIGS)
        taken |= {sink.kind for sink in SINKS if not made.refuses(sink)}
    assert taken == set(facts.takes)
    assert set(ACTUATORS) == {d.name for d in all_drivers() if "actuator" in d.roles}


@pytest.mark.parametrize("name", DRIVERS)
def test_every_option_is_told_and_explained(name: str) -> None:
    """Names, and which must be given, against pydantic's own schema, table by table."""
    facts = driver_facts(name)
    schema = find(name, "test").load().options_model.model_json_schema(by_alias=True)
    wanted = set(_paths(schema, schema, ""))
    assert {(o.name, o.required) for o in facts.options} == wanted
    assert [o.name for o in facts.options if not o.meaning] == []
    assert "value" not in {o.kind for o in facts.options}
    assert tomllib.loads(facts.example)["device"]


def _paths(schema: dict[str, Any], whole: dict[str, Any], prefix: str) -> list[tuple[str, bool]]:
    out = []
    for key, value in schema.get("properties", {}).items():
        out.append((prefix + key, key in schema.get("required", [])))
        for item in [value, *value.get("anyOf", [])]:
            table, between = (item["additionalProperties"], "NAME.") if _is_table(item) else (item, "")
            reference = table.get("$ref", "") if isinstance(table, dict) else ""
            if reference:
                inner = whole["$defs"][reference.rpartition("/")[2]]
                out += _paths(inner, whole, f"{prefix}{key}.{between}")
    return out


def _is_table(item: dict[str, Any]) -> bool:
    return isinstance(item.get("additionalProperties"), dict)


class _Base(Strict):
    """Words of the base.

    Attributes:
        speed: of the base.
        first, second: two at once,
            on two lines.
    """

    speed: Annotated[int, Field(ge=1, le=247)] = 10
    first: float | None = None
    second: tuple[float, float] = (0.0, 1.5)


class _Own(_Base):
    """Words of its own.

    Attributes:
        speed: of its own.
    """

    kind: Literal["a", "b"] = Field("a", description="From the field.")
    names: tuple[str, ...] = ()
    limits: dict[str, Annotated[float, Field(gt=0)]]
    on: bool = True


def test_words_for_options() -> None:
    """Oracle: the classes above, read by eye."""
    told = {o.name: (o.kind, o.default, o.required, o.meaning) for o in options_of(_Own)}
    assert told == {
        "speed": ("whole number from 1 to 247", "10", False, "of its own."),
        "first": ("number", "", False, "two at once, on two lines."),
        "second": ("list of 2: number", "[0.0, 1.5]", False, "two at once, on two lines."),
        "kind": ('one of "a", "b"', '"a"', False, "From the field."),
        "names": ("list: text, …", "[]", False, ""),
        "limits": ("table: name = number above 0", "", True, ""),
        "on": ("true or false", "true", False, ""),
    }


def test_a_driver_that_lacks_a_package_says_what_to_install(site: Path) -> None:
    """A class and a table; the extra of the package that names what lacks, in another spelling."""
    lacks = "import some_bus_library\n"
    requires = "Requires-Dist: Some-Bus.Library>=2; extra == 'bus'\n"
    package(site, "rtec-far", {"far": "far_driver:Far"}, requires, far_driver=lacks)
    package(
        site, "rtec-near", {"x": "near:DRIVERS"}, near='DRIVERS = {"near": ("near_driver", "N")}', near_driver=lacks
    )
    facts = {d.name: d for d in all_drivers()}
    assert set(facts) == {*DRIVERS, "far", "near"}
    assert facts["far"].trouble == (
        "driver 'far' needs the Python package 'some_bus_library', which is not installed: pip install 'rtec-far[bus]'"
    )
    assert "pip install the package that holds the module 'some_bus_library'" in facts["near"].trouble
    assert status(["drivers"]) == 0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1 / 0\n", "cannot be imported: ZeroDivisionError"),
        ("raise SystemExit(3)\n", "cannot be imported: SystemExit: 3"),
        ("odd = 5\n", "neither a class nor a table"),
        ("odd = {'odd': 'module:Class'}\n", "neither a class nor a table"),
        ("class odd: pass\n", "has no options_model"),
        ("odd = {'odd': ('odd_driver', 'Absent')}\n", "module odd_driver has no Absent"),
    ],
)
def test_a_package_that_is_broken_hides_no_other(site: Path, text: str, said: str) -> None:
    package(site, "odd", {"odd": "odd_driver:odd"}, odd_driver=text)
    sys.modules.pop("odd_driver", None)
    facts = {d.name: d for d in all_drivers()}
    assert said in facts["odd"].trouble
    assert [n for n in facts if not facts[n].trouble] == list(DRIVERS)


def test_rtecs_own_driver_is_not_replaced(site: Path) -> None:
    package(site, "a-thief", {"a": "thief:TABLE"}, thief='TABLE = {"sim": ("thief", "Sim")}\n')
    table = installed()
    assert table["sim"].package == "rtec"
    assert table["sim (a-thief)"].trouble == "is hidden: package rtec has a driver of the same name"
    with pytest.raises(DriverUnavailable, match="hidden"):
        table["sim (a-thief)"].load()


def test_an_unknown_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert status(["drivers", "modbuss"]) == 2
    assert "did you mean 'modbus'?" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="allowed"):
        find("q", "test")


def test_one_driver_printed_and_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    """The example is printed as it stands, so that it can be copied."""
    assert status(["drivers", "modbus"]) == 0
    text = capsys.readouterr().out
    assert text.rstrip().endswith(driver_facts("modbus").example.rstrip())
    assert "Options in its table slave.NAME.register.NAME" in text
    assert status(["drivers", "modbus", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["roles"] == ["temperatures"]
    assert status(["drivers", "--json"]) == 0
    assert [d["name"] for d in json.loads(capsys.readouterr().out)] == list(DRIVERS)

"""Every key is explained. Oracles: pydantic's own schema of the models, its validation of each example, the page."""

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from rtec.cli.main import status
from rtec.correction.sinks import Sink
from rtec.loop.driver_info import find
from rtec.metrology.instruments.registry import INSTRUMENTS
from rtec.reference import FILES, SEVERAL, Key, all_keys, matching, reference
from rtec_drivers.hil.wiring import HilOptions

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "keys.md"


def leaves(schema: dict[str, Any], whole: dict[str, Any], prefix: str = "") -> Iterator[str]:
    """Places of keys in a JSON schema; NAME stands for any name; tables themselves are no keys."""
    schema = resolved(schema, whole)
    for key, inner in schema.get("properties", {}).items():
        yield from below(inner, whole, prefix + key)


def below(schema: dict[str, Any], whole: dict[str, Any], path: str) -> Iterator[str]:
    schema = resolved(schema, whole)
    named = schema.get("additionalProperties")
    if "properties" in schema:
        yield from leaves(schema, whole, f"{path}.")
    elif isinstance(named, dict) and "properties" in resolved(named, whole):
        yield from leaves(named, whole, f"{path}.NAME.")
    else:
        yield path


def resolved(schema: dict[str, Any], whole: dict[str, Any]) -> dict[str, Any]:
    for part in (schema, *schema.get("anyOf", ())):
        if "$ref" in part:
            return dict(whole["$defs"][part["$ref"].rpartition("/")[2]])
    return next((p for p in schema.get("anyOf", ()) if p.get("type") == "object"), schema)


@pytest.mark.parametrize("file", FILES)
def test_every_key_of_a_file_is_there(file: str) -> None:
    schema = FILES[file].model_json_schema(by_alias=True)
    several = SEVERAL if file in ("run", "measurement") else ()
    wanted = {path for path in leaves(schema, schema) if path.split(".")[0] not in several}
    wanted |= {f"hil.{name}" for name in HilOptions.model_fields} if file == "run" else set()
    assert {key.path for key in all_keys() if key.file == file and not key.when} == wanted


def model_of(key: Key) -> Any:
    """What checks a key's table, and where it is in it."""
    name = key.when.partition('"')[2].rstrip('"')
    if key.when.startswith("driver"):
        return find(name, "test").load().options_model, ["device", "NAME"]
    if key.when.startswith("instrument"):
        return INSTRUMENTS[name].setup_model, ["setup"]
    if key.when.startswith("kind"):
        return Sink, ["output", "NAME"]
    return FILES[key.file], []


@pytest.mark.parametrize("file", FILES)
def test_a_key_says_what_it_is_and_its_example_is_valid(file: str) -> None:
    """Oracle: pydantic, which is given the example alone at its place, and finds no fault at that place."""
    keys = [key for key in all_keys() if key.file == file]
    assert keys
    assert {where: found for where, found in ((f"{k.path} {k.when}", wrong(k)) for k in keys) if found} == {}


def wrong(key: Key) -> list[str]:
    """What is wrong with a key's explanation or its example."""
    if len(key.option.meaning) <= 4:
        return ["no meaning"]
    (name, value), *more = tomllib.loads(key.example).items()
    if (name, more) != (key.name, []):
        return [f"the example is not of it alone: {key.example}"]
    model, before = model_of(key)
    path = key.path.split(".")[len(before) :]
    table: Any = {name: value}
    for part in reversed(path[:-1]):
        table = {part: table}
    if model is Sink:
        table["kind"] = key.when.partition('"')[2].rstrip('"')
    return [place for place in faults(model, table) if name in place.split(".")]


def faults(model: Any, table: dict[str, Any]) -> list[str]:
    """Places of what pydantic finds wrong with a table, other than what is missing."""
    try:
        TypeAdapter(model).validate_python(table)
    except ValidationError as e:
        return [".".join(map(str, fault["loc"])) for fault in e.errors() if fault["type"] != "missing"]
    return []


def test_a_number_whose_name_has_a_unit_has_that_unit() -> None:
    ends = {"um": "µm", "mm": "mm", "degc": "°C", "um_s": "µm/s", "um_s2": "µm/s²", "mm_s": "mm/s", "hz": "Hz"}
    seen = set()
    for key in all_keys():
        match = re.search(r"_(um_s2|um_s|mm_s|um|mm|degc|hz|s)$", key.name)
        if match and "_per_" not in key.name and "number" in key.option.kind:
            assert key.unit == ends.get(match[1], match[1])
            seen.add(key.unit)
    assert len(seen) >= 7


def test_the_page_is_what_the_program_prints() -> None:
    """`make reference` writes it."""
    assert PAGE.read_text(encoding="utf-8") == reference(all_keys())


@pytest.mark.parametrize(
    ("wanted", "paths"),
    [
        ("run.rate_hz", {"run.rate_hz"}),
        ("[limits.X] stop_um".replace("] ", "]."), {"limits.NAME.stop_um"}),
        ("stop_um", {"limits.NAME.stop_um", "limits.stop_um"}),
        ("modbus.timeout_s", {"device.NAME.slave.NAME.timeout_s"}),
        ("device.box.slave.bed.timeout_s", {"device.NAME.slave.NAME.timeout_s"}),
        ("guard", {"guard.counts_max_age_s", "guard.temperature_max_age_s", "guard.fade_after_s"}),
    ],
)
def test_a_key_is_found_as_people_name_it(wanted: str, paths: set[str]) -> None:
    assert {key.path for key in matching(wanted)} == paths


def test_on_the_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert status(["explain", "temperature_max_age_s"]) == 0
    out = capsys.readouterr().out
    assert "default  30.0" in out
    assert "unit     s" in out
    assert max(map(len, out.splitlines())) <= 80
    assert status(["explain", "stop_umm"]) == 2
    assert "did you mean 'stop_um'?" in capsys.readouterr().err
    assert status(["explain"]) == 0
    assert "[device.NAME.slave.NAME.register.NAME]" in capsys.readouterr().out


def test_the_keys_of_the_bench_are_explained() -> None:
    """Oracle: the model that checks `[hil]`."""
    (key,) = matching("off_s")
    assert (key.path, key.unit, key.example) == ("hil.off_s", "s", "off_s = 30")
    assert {k.name for k in matching("hil")} == {"hil", *HilOptions.model_fields}

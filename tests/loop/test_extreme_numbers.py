"""Numbers beyond reason in files. Oracles: the bounds in each model's own JSON schema; errors of rtec alone."""

import importlib
import pkgutil
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from pydantic import BaseModel

import rtec
import rtec_drivers
from rtec.cli.main import status
from rtec.errors import ConfigError
from rtec.tomlfile import read_toml
from tests.extremes import attack, kinds, put, trials

SAMPLE = 40
OTHER_PYTHON = "rtec_drivers.linuxcnc.bridge"
"""Runs under LinuxCNC's Python and has no model."""
NAMES = (
    "run file", "run file, following_error", "run file, origin_offset", "run file, phase", "machine file", "truth",
    "import map", "campaign", "model", "measurement, laser_linear", "measurement, laser_angular", "measurement, level",
    "measurement, laser_diagonal", "measurement, straightness", "measurement, squareness",
    "measurement, spindle_drift", "measurement, tool_tip",
    "measurement, work_piece", "measurement, ball_bar", "measurement, grid_encoder", "driver sim", "driver serial_box",
    "driver ascii_lines", "driver ascii_offset", "driver modbus", "driver can", "driver can_encoders", "driver can_box",
    "driver linuxcnc", "driver zmq_link",
)  # fmt: skip


def _models() -> list[type[BaseModel]]:
    """Every pydantic model of rtec and of its drivers."""
    for package in (rtec, rtec_drivers):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not module.name.endswith("__main__") and module.name != OTHER_PYTHON:
                importlib.import_module(module.name)

    def below(kind: type[BaseModel]) -> Iterator[type[BaseModel]]:
        for k in kind.__subclasses__():
            yield k
            yield from below(k)

    return sorted({k for k in below(BaseModel) if k.__module__.startswith("rtec")}, key=lambda k: k.__qualname__)


def _unbounded(node: Any, where: str) -> Iterator[str]:
    """Numbers of a JSON schema without two bounds, or with 0 as an excluded one: 1e-300 is above 0, and divides."""
    if isinstance(node, dict):
        if node.get("type") in ("number", "integer") and not {"enum", "const"} & set(node):
            low = "minimum" in node or node.get("exclusiveMinimum", 0) != 0
            if not low or not {"maximum", "exclusiveMaximum"} & set(node):
                yield where
        for key, item in node.items():
            yield from _unbounded(item, f"{where}.{key}")
    elif isinstance(node, list):
        for i, item in enumerate(node):
            yield from _unbounded(item, f"{where}[{i}]")


def test_every_number_of_every_model_has_two_bounds() -> None:
    """Oracle: the schema that pydantic derives from the very types that check the files."""
    models = _models()
    assert len(models) > 80
    found = [x for k in models for x in _unbounded(k.model_json_schema().get("properties", {}), k.__qualname__)]
    assert not found


def test_the_kinds_are_all_there(tmp_path: Path) -> None:
    assert set(NAMES) == set(kinds(tmp_path))


@pytest.mark.parametrize("name", NAMES)
def test_a_file_with_an_extreme_number_is_used_or_refused(name: str, tmp_path: Path) -> None:
    """A sample of all places and extremes; `python -m tests.extremes` tries them all."""
    kind = kinds(tmp_path)[name]
    every = trials(kind)
    found = attack(kind, tmp_path, random.Random(name).sample(every, min(SAMPLE, len(every))))
    assert not found.faults
    assert found.refused > 0 or not every


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        (("guard", "temperature_max_age_s"), 1e12, "[guard] temperature_max_age_s: must be from 1e-06 to 1e+07, found"),
        (("output", "X", "max_counts_per_s"), 1e22, "max_counts_per_s: must be from 0.001 to 1e+09, found 1e+22"),
        (("run", "rate_hz"), 10**400, "[run] rate_hz: TOML's integers have 64 bits; this one has more"),
        (("run", "rate_hz"), True, "[run] rate_hz: Input should be a valid number, found True"),
    ],
)
def test_a_command_refuses_it_in_one_line(
    place: tuple[str, ...], value: object, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.toml"
    path.write_text(tomli_w.dumps(put(kinds(tmp_path)["run file"].tables, place, value)), encoding="utf-8")
    assert status(["run", str(path), "--dry-run"]) == 2
    error = capsys.readouterr().err
    assert f"{path}: " in error
    assert said in " ".join(error.split())


def test_a_model_with_a_pitch_of_zero_is_refused(tmp_path: Path) -> None:
    """As a reload would meet it: `pitch = 0` divides by zero in the kernel."""
    kind = kinds(tmp_path)["model"]
    tables = kind.tables
    at = next(i for i, e in enumerate(tables["effect"]) if "pitch" in e.get("nonlinear", {}))
    found = attack(kind, tmp_path, [(("effect", at, "nonlinear", "pitch", "value"), 0)])
    assert (found.refused, found.faults) == (1, [])


@pytest.mark.parametrize(
    "text", ["a = " + "[" * 100_000, "a = " + "{b = " * 50_000, "a." * 50_000 + "a = 1", f"a = {'9' * 10_000}"]
)
def test_deep_and_endless_toml_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "deep.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=str(path)):
        read_toml(path)

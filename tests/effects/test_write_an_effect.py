"""docs/write-an-effect.md: its code and its tables are taken out of the page, installed, fitted, saved, loaded, run.

Oracles: the page's own equations in numpy, written here once more; `Model.predict` for the kernel and the step.
"""

import dataclasses
import importlib
import re
import shlex
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import tomli_w
from numpy.typing import NDArray

from rtec.correction.flags import MODE_ON, Limits
from rtec.effects import Effect, State, effect_class
from rtec.effects.base import DRIVES, Kind, Surroundings
from rtec.effects.derived import since_reversal_track
from rtec.effects.expression import expression_from_text
from rtec.errors import ModelError
from rtec.loop.records import Samples
from rtec.loop.step import Inputs, Step, StepSettings
from rtec.model import Model, load_model, save_model
from rtec.model.file import tables
from tests.diagnosis.test_waves import found_in
from tests.support.compiled_model import compile_model
from tests.support.machines import turning_centre
from tests.support.tip_fit import fit_model

Floats = NDArray[np.float64]
PAGE = (Path(__file__).parents[2] / "docs" / "write-an-effect.md").read_text(encoding="utf-8")
MACHINE = turning_centre()
LIMITS = Limits(warning_um=500, stop_um=1000, slew_um_s=1e6, acceleration_um_s2=1e10)


def blocks(language: str) -> list[str]:
    """Fenced blocks of a language, indentation of a list taken off."""
    found = re.findall(rf"^( *)```{language}\n(.*?)^ *```$", PAGE, re.MULTILINE | re.DOTALL)
    return ["\n".join(line.removeprefix(indent) for line in text.splitlines()) + "\n" for indent, text in found]


INPUTS, IN_FILE, PYPROJECT = blocks("toml")
(COMMAND,) = blocks("sh")
(MODULE,) = blocks("python")


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The page's package as `pip install` leaves it: a module, and a dist-info folder with the entry point."""
    project = tomllib.loads(PYPROJECT)["project"]
    info = tmp_path / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir()
    head = f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    (info / "METADATA").write_text(head, encoding="utf-8")
    points = project["entry-points"]
    text = "".join(f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in points[group].items()) for group in points)
    (info / "entry_points.txt").write_text(text, encoding="utf-8")
    (tmp_path / "worn_patch.py").write_text(MODULE, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    importlib.invalidate_caches()
    yield
    sys.modules.pop("worn_patch", None)


def course() -> State:
    """X goes to and fro, never twice over the same stretch, Z stands."""
    phase = np.arange(600) / 40.0
    x = 100.0 + 80.0 * np.sin(phase) * np.sin(phase / 9.0 + 1.0)
    return State(MACHINE, np.arange(600.0), {"x": np.round(x, 3), "z": np.full(600, 300.0)})


def readings(error_um: Floats) -> Floats:
    """Tip error where EXX is all there is: along X, one to one; Y and Z not read."""
    tip = np.full((len(error_um), 3), np.nan)
    tip[:, 0] = error_um + 0.02 * np.random.default_rng(5).standard_normal(len(error_um))
    return tip


def through_everything(effect: Effect, error_um: Floats, folder: Path) -> Model:
    """Fit, save, load; then kernel over arrays and one step of the loop against `Model.predict`."""
    s = course()
    model = fit_model([effect], s, readings(error_um))
    save_model(model, folder / "model.toml")
    loaded = load_model(folder / "model.toml", MACHINE)
    assert loaded.hash == model.hash
    wanted = loaded.predict(s)
    np.testing.assert_allclose(wanted[:, 0], error_um, atol=0.05)
    np.testing.assert_allclose(compile_model(loaded).predict(s)[0], wanted, rtol=1e-9, atol=1e-9)
    step = Step(StepSettings(loaded, {"X": LIMITS, "Z": LIMITS}))
    sample = Samples.empty(step.layout, len(s))
    sample.time_ns[:] = 10**9 + np.arange(len(s)) * 10**6
    sample.counts_time_ns[:] = sample.time_ns
    sample.mode[:] = MODE_ON
    sample.counts[:] = np.round(s.positions_mm() * 1000.0)
    same = State(MACHINE, s.time_s, s.channels, dead_band_mm=loaded.dead_bands_mm)
    requested = step.run(sample).requested_um
    np.testing.assert_allclose(requested[:, 0], -loaded.predict(same)[:, 0], rtol=1e-9, atol=1e-9)
    assert np.ptp(requested[:, 0]) > 1.0
    return loaded


@pytest.mark.usefixtures("installed")
def test_the_plug_in(tmp_path: Path) -> None:
    """Oracle: the worn patch that the readings were made with."""
    kind = effect_class("worn_patch", "test")
    effect = kind.model_validate({"effect": "worn_patch", "component": "EXX", "axis": "X"})
    error = 4.0 * np.exp(-(((course().channels["x"] - 130.0) / 22.0) ** 2))
    (fitted,) = through_everything(effect, error, tmp_path).effects
    assert fitted.values["A"] == pytest.approx(4.0, abs=0.02)
    assert dict(fitted.theta) == pytest.approx({"q0": 130.0, "w": 22.0}, abs=0.2)
    assert len(MODULE.split("class ")[1].splitlines()) <= 25


def test_without_the_package_its_models_are_refused(tmp_path: Path) -> None:
    """The message names the effect; nothing of the file is run."""
    content = tables(Model(MACHINE))
    content["effect"] = [{"effect": "worn_patch", "component": "EXX", "axis": "X", "coefficient": {}}]
    (tmp_path / "m.toml").write_text(tomli_w.dumps(content), encoding="utf-8")
    with pytest.raises(ModelError, match=r"no effect 'worn_patch' \(if it is of a plug-in, install its package here\)"):
        load_model(tmp_path / "m.toml", MACHINE)


def test_the_expression_of_the_command(tmp_path: Path) -> None:
    """Oracle: the sine that the readings were made with."""
    words = shlex.split(COMMAND)
    given: dict[str, Any] = {w: words[i + 1] for i, w in enumerate(words[:-1]) if w.startswith("--")}
    effect = expression_from_text(given["--expr"], [given["--param"]], given["--component"], MACHINE)
    error = 1.5 * np.sin(2 * np.pi * course().channels["x"] / 36.0 + 2.0)
    (fitted,) = through_everything(effect, error, tmp_path).effects
    assert np.hypot(fitted.values["A_sin"], fitted.values["A_cos"]) == pytest.approx(1.5, abs=0.02)
    assert np.arctan2(fitted.values["A_cos"], fitted.values["A_sin"]) == pytest.approx(2.0, abs=0.05)


def test_the_expression_of_the_model_file(tmp_path: Path) -> None:
    """Oracle: the numbers in the page's table; then fitted anew to readings made by its equation."""
    content = tables(Model(MACHINE))
    content["effect"] = tomllib.loads(IN_FILE)["effect"]
    (tmp_path / "m.toml").write_text(tomli_w.dumps(content), encoding="utf-8")
    model = load_model(tmp_path / "m.toml", MACHINE)
    (fitted,) = model.effects
    s = course()
    away = since_reversal_track(s.channels["x"], MACHINE.axis("X").dead_band_mm)
    error = 1.8 * s.value("d_x") * np.exp(-away / 2.5)
    np.testing.assert_allclose(model.predict(s)[:, 0], error, atol=1e-9)
    (again,) = through_everything(fitted.effect, error, tmp_path).effects
    assert again.theta["s0"] == pytest.approx(2.5, rel=0.05)


def test_what_else_the_page_says() -> None:
    """The run file's table is read; the channels and what `suggest` is given are those of the code."""
    assert Inputs.model_validate(tomllib.loads(INPUTS)["inputs"]).load_kg == 250.0
    table = PAGE.split("## What an effect may read")[1].split("## ")[0]
    named = set(re.findall(r"^\| (.*?) \|", table, re.MULTILINE))
    channels = {c for cell in named for c in re.findall(r"`(\w+)`", cell)}
    assert channels == {c for c in MACHINE.channel_names if c.split("_")[-1] != "z"} - {
        "T_spindle",
        "T_column",
        "T_air",
    }
    given = PAGE.split("### What the diagnosis tries")[1].split("Rules:")[0]
    told = {a for cell in re.findall(r"^\| (`.*?) \|", given, re.MULTILINE) for a in re.findall(r"`(\w+)`", cell)}
    assert told == {f.name for f in dataclasses.fields(Surroundings)}
    words = set(re.findall(r"`([a-z_ ]+)`", given.split("Kinds for")[1]))
    assert words == {*get_args(Kind), *DRIVES, "feeds", "driven_by"}


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("place_mm", [170.0, 214.0, 300.0])
def test_diagnose_names_it_wherever_the_patch_is(place_mm: float) -> None:
    """Oracle: the patch that the readings were made with; the screen tries six places only, and 214 and 300 between."""
    x = np.arange(12.5, 600.0, 25.0)
    d = found_in(-8.0 * np.exp(-(((x - place_mm) / 60.0) ** 2)), x, 4)
    assert d.findings[0].effect.effect == "worn_patch"
    assert d.verdict in ("missing_effect", "ambiguous")
    found = d.findings[0].parameters
    assert found["q0"].value == pytest.approx(place_mm, abs=1.0)
    assert found["w"].value == pytest.approx(60.0, abs=1.0)

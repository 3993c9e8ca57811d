"""`rtec diagnose`, `add`, `improve`, `history` on simulated files; oracle: the effects that were made true."""

import json
import os
from pathlib import Path
from typing import Any

import pytest

from rtec.cli import model as commands
from rtec.cli.main import status
from rtec.diagnosis.extend import improve as improving
from rtec.machine import load_machine
from rtec.model import Model, load_model, save_model
from tests.support.diagnosis_examples import effects, small_machine, write_laser, write_machine

SCALE = "scale,component=EXX,axis=X,k=12"
BACKLASH = "backlash,component=EXX,axis=X,B=3"
WAVE = "cyclic_pole,component=EXX,axis=X,s=2,c=-1,period=37.3"
NAMES = "scale,backlash,servo_lag,backlash_position,axis_expansion,mount_expansion,cyclic_pole,straightness"
"""Looked for where a test is not about the whole catalogue, so that it is quick."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Machine, a model that knows the scale only, and lasers: with play, with play and a wave, with nothing more."""
    folder = tmp_path_factory.mktemp("diagnosis")
    write_machine(folder)
    save_model(Model(small_machine(), effects(SCALE), name="first"), folder / "model.toml")
    write_laser(folder, [SCALE, BACKLASH], 3)
    write_laser(folder, [SCALE, BACKLASH], 4)
    # Steps below half of the shortest period looked for: the same targets in every run do not tell aliases apart.
    write_laser(folder, [SCALE, BACKLASH, WAVE], 5, targets={"step_mm": 1.17}, protocol="cold", cycles=4)
    write_laser(folder, [SCALE], 6)
    return folder


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """`improve` looks for `NAMES` only, for tests of what goes on around the diagnosis."""
    real: Any = vars(improving)["diagnose"]
    monkeypatch.setattr(improving, "diagnose", lambda *given, **more: real(*given, **more, only=NAMES.split(",")))


def ran(words: list[str], capsys: pytest.CaptureFixture[str], expected: int = 0) -> dict[str, Any]:
    """Run a command with --json; give what it printed."""
    capsys.readouterr()
    assert status([*words, "--json"]) == expected
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_diagnose_names_what_is_missing(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the play that was made true; the keys are those that other programs rely on."""
    found = ran(["diagnose", str(folder / "model.toml"), str(folder / "laser-x-3.csv")], capsys)
    assert {"verdict", "rms_residual_um", "noise_floor_um", "candidates", "unknown", "not_testable"} <= set(found)
    first = found["candidates"][0]
    assert {"rank", "effect", "component", "channels", "parameters", "heldout_drop", "confidence"} <= set(first)
    assert set(first["parameters"]["B"]) == {"value", "se", "unit"}
    assert (first["rank"], first["effect"], first["component"]) == (1, "backlash", "EXX")
    size = first["parameters"]["B"]
    assert size["value"] == pytest.approx(3.0, abs=4.0 * size["se"])
    # A single straight line of light: play of the slide and a turn of it at each reversal look alike.
    assert found["verdict"] == "ambiguous"
    assert "angular_reversal" in {a["effect"] for a in first["confused_with"]}
    assert all(a["separating_test"] for a in first["confused_with"])
    assert found["rms_residual_um"] == pytest.approx(1.53, rel=0.05)
    assert found["noise_floor_um"] == pytest.approx(0.3, rel=0.1)
    assert "spindle_growth" in {n["effect"] for n in found["not_testable"]}


def test_diagnose_says_when_nothing_is_missing(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: a machine of which the model knows everything."""
    words = ["diagnose", str(folder / "model.toml"), str(folder / "laser-x-6.csv"), "--only", NAMES]
    found = ran(words, capsys)
    assert found["verdict"] == "nothing_missing"
    assert not any(c["accepted"] for c in found["candidates"])
    assert {a["effect"] for a in found["absent"]} <= set(NAMES.split(","))
    assert all(a["smallest"] > 0.0 for a in found["absent"])


def test_diagnose_report(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the JSON beside the page; the terminal says the same sentence."""
    words = ["diagnose", str(folder / "model.toml"), str(folder / "laser-x-3.csv"), "--only", NAMES]
    assert status([*words, "--report", str(tmp_path / "out")]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    facts = json.loads((tmp_path / "out" / "result.json").read_text())
    assert facts["sentence"][1:] in shown
    assert (tmp_path / "out" / "evidence.png").read_bytes().startswith(b"\x89PNG")
    assert "<script" not in (tmp_path / "out" / "report.html").read_text()


def test_wrong_names_have_a_way_on(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model, data = str(folder / "model.toml"), str(folder / "laser-x-3.csv")
    assert status(["diagnose", model, data, "--only", "baklash"]) == 2
    assert "backlash" in capsys.readouterr().err
    assert status(["add", model, "baklash", "--component", "EXX", "--data", data, "-o", str(folder / "n.toml")]) == 2
    assert "backlash" in capsys.readouterr().err
    assert status(["add", model, "backlash", "--data", data, "-o", str(folder / "n.toml")]) == 2
    assert "--component" in capsys.readouterr().err
    assert status(["add", model, "mount_expansion", "--component", "EXX", "--data", data, "-o", "n.toml"]) == 2
    assert "T_bed, T_air" in capsys.readouterr().err
    assert not (folder / "n.toml").exists()


def test_a_model_of_another_machine(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "model.toml").write_bytes((folder / "model.toml").read_bytes())
    data = str(folder / "laser-x-3.csv")
    assert status(["diagnose", str(tmp_path / "model.toml"), data]) == 2
    assert "--machine" in capsys.readouterr().err


def test_add_shows_what_it_bought(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the true play; half of it either way is the error before, noise is the error after."""
    out = tmp_path / "better.toml"
    words = ["add", str(folder / "model.toml"), "backlash", "--component", "EXX", "-o", str(out)]
    found = ran([*words, "--data", str(folder / "laser-x-3.csv"), str(folder / "laser-x-4.csv")], capsys)
    assert found["before"]["held_out"] == pytest.approx(1.53, rel=0.05)
    assert found["after"]["held_out"] == pytest.approx(0.3, rel=0.1)
    assert found["better"]
    machine = load_machine(folder / "machine.toml")
    saved = load_model(out, machine)
    assert saved.effects[-1].values["B"] == pytest.approx(3.0, abs=4.0 * saved.effects[-1].errors["B"])
    assert set(saved.measurements) >= {"laser-x-3", "laser-x-4"}
    again = tmp_path / "again.toml"
    words = ["add", str(folder / "model.toml"), "backlash", "--component", "EXX", "-o", str(again)]
    ran([*words, "--data", str(folder / "laser-x-3.csv"), "--data", str(folder / "laser-x-4.csv")], capsys)
    assert load_model(again, machine).hash == saved.hash


def test_add_refuses_what_makes_it_worse(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: a machine on which nothing more is true, and seven shapes more fitted to its noise."""
    out = tmp_path / "worse.toml"
    words = ["add", str(folder / "model.toml"), "polynomial_position", "--component", "EXX", "-o", str(out)]
    words += ["--set", "degrees=[2,3,4,5,6,7,8]", "--data", str(folder / "laser-x-6.csv")]
    found = ran(words, capsys, expected=1)
    assert found["after"]["held_out"] > found["before"]["held_out"]
    assert found["model_file"] is None
    assert status(words) == 1
    assert "Not written" in capsys.readouterr().err
    assert not out.exists()
    assert status([*words, "--force"]) == 0
    assert len(load_model(out, load_machine(folder / "machine.toml")).effects) == 2


def test_an_effect_of_ones_own(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the wave that was made true, found from a start 3 mm off, and play found before it."""
    first, out = tmp_path / "first.toml", tmp_path / "own.toml"
    save_model(Model(small_machine(), effects(SCALE, BACKLASH), name="first"), first)
    words = ["add", str(first), "--expr", "A*sin(2*pi*x/p + phi)", "--param", "p=40:20..90", "--component", "EXX"]
    words += ["--machine", str(folder / "machine.toml"), "--data", str(folder / "laser-x-5.csv"), "-o", str(out)]
    found = ran(words, capsys)
    assert found["before"]["held_out"] > 1.2
    assert found["after"]["held_out"] < 0.4
    own = load_model(out, load_machine(folder / "machine.toml")).effects[-1]
    assert own.effect.effect == "expression"
    assert own.theta["p"] == pytest.approx(37.3, abs=4.0 * own.errors["p"])


def test_improve_goes_on_to_the_floor(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: two effects were made true and the model knows neither; then `history` tells both steps."""
    out = tmp_path / "improved.toml"
    found = ran(["improve", str(folder / "model.toml"), str(folder / "laser-x-5.csv"), "-y", "-o", str(out)], capsys)
    assert {label for s in found["steps"] for label in s["added"]} == {"backlash(EXX, X)", "cyclic_pole(EXX, X)"}
    assert found["steps"][-1]["after"]["held_out"] == pytest.approx(0.3, rel=0.15)
    machine = str(folder / "machine.toml")
    told = ran(["history", str(out), "--machine", machine], capsys)
    assert [s["name"] for s in told["steps"]] == [s["added"][0] for s in found["steps"]]
    errors = [told["steps"][0]["before"], *(s["error"] for s in told["steps"])]
    bought = [found["steps"][0]["before"]["held_out"], *(s["after"]["held_out"] for s in found["steps"])]
    assert errors == pytest.approx(bought)
    assert errors == sorted(errors, reverse=True)
    assert told["steps"][-1]["floor"] == pytest.approx(0.3, rel=0.1)
    assert status(["history", str(out), "--machine", machine, "--report", str(tmp_path / "history")]) == 0
    assert (tmp_path / "history" / "history.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.usefixtures("few")
def test_improve_asks(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: what a person types on a terminal, here one end of a pseudo-terminal."""
    for typed, written in (("what?\nn\n", False), ("y\nn\n", True)):
        out = tmp_path / f"{written}.toml"
        ours, theirs = os.openpty()
        os.write(ours, typed.encode())
        with os.fdopen(theirs, "r") as terminal, monkeypatch.context() as m:
            m.setattr("sys.stdin", terminal)
            assert status(["improve", str(folder / "model.toml"), str(folder / "laser-x-5.csv"), "-o", str(out)]) == 0
        os.close(ours)
        assert out.exists() == written


def test_improve_needs_somebody_to_ask(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Path(os.devnull).open() as nobody, pytest.MonkeyPatch.context() as m:
        m.setattr("sys.stdin", nobody)
        assert status(["improve", str(folder / "model.toml"), str(folder / "laser-x-5.csv")]) == 2
    assert "--yes" in capsys.readouterr().err
    assert not (folder / "model-improved.toml").exists()


@pytest.mark.usefixtures("few")
def test_improve_loses_nothing(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: the file after Ctrl-C in the second diagnosis: the first step is in it."""
    real: Any = vars(improving)["diagnose"]
    calls: list[int] = []

    def interrupted(*given: Any, **more: Any) -> Any:
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(*given, **more)

    monkeypatch.setattr(improving, "diagnose", interrupted)
    out = tmp_path / "kept.toml"
    assert status(["improve", str(folder / "model.toml"), str(folder / "laser-x-5.csv"), "-y", "-o", str(out)]) == 130
    kept = load_model(out, load_machine(folder / "machine.toml"))
    assert len(kept.effects) == 2
    assert len(kept.history) == 1


def test_every_command_says_how_it_is_used(capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("diagnose", "add", "improve", "history", "plan"):
        assert status([name, "--help"]) == 0
        assert "Example" in capsys.readouterr().out
    assert commands.__doc__

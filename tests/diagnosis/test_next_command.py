"""The commands that are printed as the next step; oracle: the command line itself, which runs them as they are."""

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from rtec.cli.main import status
from rtec.diagnosis.search.diagnose import diagnose
from rtec.machine import load_machine
from rtec.metrology.files.load import save_measurement
from rtec.model import Model, save_model
from rtec.report.diagnosis import diagnosis_page
from tests.support.diagnosis_examples import QUICK, TABLE, effects, laser, small_machine

SCALE = "scale,component=EXX,axis=X,k=12"
COLD: Mapping[str, Any] = {"protocol": "cold", "cycles": 3}


def made(
    folder: Path, truth: Sequence[str], instrument: str, setup: Sequence[str] = (), **more: Any
) -> tuple[Path, Path]:
    """A model that knows the scale of X, and a measurement of a machine that has more, in a folder with a blank."""
    place = folder / "a machine"
    place.mkdir()
    machine, model, table = place / "the machine.toml", place / "model.toml", place / "day 1.csv"
    machine.write_text(tomli_w.dumps(TABLE), encoding="utf-8")
    save_model(Model(load_machine(machine), effects(SCALE), name="first"), model)
    settings = folder / "settings.toml"
    settings.write_text(tomli_w.dumps({**QUICK, **more}), encoding="utf-8")
    words = ["simulate", str(machine), "--instrument", instrument, "--settings", str(settings), "--seed", "3"]
    words += [w for text in (SCALE, *truth) for w in ("--effect", text)]
    assert status([*words, *setup, "-o", str(table.with_suffix(""))]) == 0
    return model, table


def next_commands(out: str) -> list[list[str]]:
    """The printed commands, as a shell splits them."""
    return [shlex.split(line.removeprefix("Next: "))[1:] for line in out.splitlines() if line.startswith("Next: ")]


X = ("--axis", "X")
DIAGNOSES: Mapping[str, tuple[tuple[str, ...], str, tuple[str, ...], dict[str, Any], str]] = {
    "play of the slide or a turn of it": (
        ("backlash,component=EXX,axis=X,B=3",), "laser_linear", X, dict(COLD), "scale,backlash,angular_reversal"),
    "a wave of the screw or of a pole that equal targets fold onto it": (
        ("cyclic_screw,component=EXX,axis=X,harmonics=1,s1=4,c1=-2,pitch=5",), "laser_linear", X,
        {**COLD, "targets": {"step_mm": 6.3}}, "cyclic_screw,cyclic_pole,interpolation_error"),
    "a body that grows, by its sensor": (
        ("mount_expansion,component=EX0workpiece,sensor=T_bed,k=2.5",), "laser_linear", X, {},
        "mount_expansion,column_tilt,spindle_growth"),
    "a column between two sensors": (
        ("column_tilt,component=EB0workpiece,front=T_bed,back=T_air,k=30",), "spindle_drift",
        ("--set", 'probe={x={direction="X"}}'), {"protocol": "drift"}, "mount_expansion,column_tilt,spindle_tilt"),
    "sub-divisions of a scale": (
        ("interpolation_error,component=EXX,axis=X,lambda_mm=0.02,s=1.5,c=0.7",), "laser_linear", X,
        {**COLD, "targets": {"step_mm": 0.0033, "range_mm": [50.0, 50.5]}},
        "cyclic_screw,cyclic_pole,interpolation_error"),
}  # fmt: skip


@pytest.mark.parametrize("case", DIAGNOSES)
def test_the_next_command_of_a_diagnosis_runs(case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: its status; a plan has the rivals of the diagnosis, and separates none that the diagnosis could not."""
    truth, instrument, setup, more, only = DIAGNOSES[case]
    model, table = made(tmp_path, truth, instrument, setup, **more)
    words = ["diagnose", str(model), str(table), "--only", only]
    capsys.readouterr()
    assert status([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["verdict"] == "ambiguous") == found["sentence"].lower().startswith("one of ")
    assert status(words) == 0
    commands = next_commands(capsys.readouterr().out)
    assert [c[0] for c in commands] == ["add" if case.startswith("sub-") else "plan"]
    for command in commands:
        assert status([*command, *(["--yes"] if command[0] == "improve" else []), "--json"]) == 0, command
        facts = json.loads(capsys.readouterr().out)
        if command[0] == "plan":
            first = found["candidates"][0]
            names = {n.split("(")[0] for p in facts["rivals"] for n in (p["one"], p["other"])}
            assert names <= {first["effect"], *(a["effect"] for a in first["confused_with"])}
            with_first = [p for p in facts["rivals"] if p["one"].startswith(first["effect"])]
            assert with_first
            assert not any(p["clear"] for p in with_first)
            assert status(command) == 0
            shown = " ".join(capsys.readouterr().out.split())
            assert "do not separate" in shown
            assert "These tests separate all" not in shown


def test_a_machine_elsewhere_is_named_in_the_next_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the model beside no machine file; without the option the commands do not find it."""
    model, table = made(tmp_path, ["backlash,component=EXX,axis=X,B=3"], "laser_linear", X, **COLD)
    machine = model.with_name("the machine.toml")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    text = "".join(line for line in model.read_text().splitlines(True) if not line.startswith("machine_file"))
    (elsewhere / "model.toml").write_text(text)
    words = [str(elsewhere / "model.toml"), str(table)]
    assert status(["compare", *words]) == 2
    capsys.readouterr()
    assert status(["compare", *words, "--machine", str(machine)]) == 0
    (diagnose,) = next_commands(capsys.readouterr().out)
    assert diagnose == ["diagnose", *words, "--machine", str(machine)]
    assert status([*diagnose, "--only", "backlash"]) == 0
    (add,) = next_commands(capsys.readouterr().out)
    assert add[0] == "add"
    assert status(add) == 0
    capsys.readouterr()
    assert status(["compare", str(model), str(table), "--machine", str(machine)]) == 0
    assert next_commands(capsys.readouterr().out) == [["diagnose", str(model), str(table)]]


def test_a_fault_of_a_rival_names_its_option(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model, table = made(tmp_path, [], "laser_linear", X, **COLD)
    words = ["plan", str(model.with_name("the machine.toml")), str(table)]
    for option in ("--rivals", "--effects"):
        capsys.readouterr()
        assert status([*words, option, "mount_expansion:EXX,scale:EXX"]) == 2
        assert f"rtec: {option} mount_expansion:EXX: key 'sensor' is missing" in capsys.readouterr().err
    assert status([*words, "--rivals", "scale:EXX"]) == 2
    assert "--rivals names one effect; name two or more" in capsys.readouterr().err


def test_a_plan_has_the_rivals_that_the_sentence_names() -> None:
    """Oracle: the candidates in the order of the table; the second is made a rival that is alike in these readings."""
    m = laser([SCALE, "backlash,component=EXX,axis=X,B=9"], 3)
    found = diagnose(Model(small_machine(), effects(SCALE), name="m"), [m], draws=50, explain=True)
    others = {a.effect for a in found.findings[0].confused_with} | {found.findings[0].effect.effect}
    second = next(f for f in found.findings if f.effect.effect not in others)
    findings = (found.findings[0], replace(second, rank=2, group=True))
    files = (Path("m.toml"), Path("m.csv"))
    with_second = replace(found, findings=findings, files=files, machine_file=Path("machine.toml"))
    (command,) = diagnosis_page(with_second, figures=False).next
    asked = shlex.split(command)[shlex.split(command).index("--rivals") + 1].split(",")
    assert [text.split(":")[0] for text in asked[:2]] == ["backlash", second.effect.effect]
    tilts = [text for text in asked[2:] if text.startswith("angular_reversal:")]
    assert tilts
    assert all(":theta=" in text for text in tilts), "a rival has the size that it was fitted with"


def test_a_name_that_the_sentence_asserts_is_asserted_in_the_json() -> None:
    """Oracle: the law that was made true; with a delay and without it the readings are alike, the name is not open."""
    growth = "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=2,fixed_mm=0"
    found = diagnose(Model(small_machine(), effects(SCALE), name="m"), [laser([SCALE, growth], 3)], draws=50)
    assert found.sentence.startswith("axis_expansion(EXX, X, T_bed) is missing: it explains ")
    assert "its form cannot be determined" in found.sentence
    assert found.verdict == "missing_effect"
    assert [a.label for a in found.findings[0].confused_with] == ["axis_expansion(EXX, X, T_bed), lag"]


def saturating(folder: Path) -> tuple[Path, Path]:
    """A model with an expansion of 12 µm/m/K, and a day of a machine whose growth ends 2 K above the reference."""
    place = folder / "a machine"
    place.mkdir()
    machine, model, table = place / "machine.toml", place / "model.toml", place / "day.csv"
    machine.write_text(tomli_w.dumps(TABLE), encoding="utf-8")
    growth = "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=12"
    read = load_machine(machine)
    save_model(Model(read, effects(growth), name="first"), model)
    m = laser([growth], 5)
    x, warm = m.channels["x"], m.channels["T_bed"] - 20.0
    ends = 60e-3 * x * (np.tanh(warm / 2.0) - 0.2 * warm)
    save_measurement(replace(m, machine=read, readings={"reading_um": m.readings["reading_um"] + ends}), table)
    return model, table


def test_what_has_no_name_is_added_by_the_printed_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From `improve`, which adds nothing that follows a temperature, and prints the command. Oracle: the noise."""
    model, table = saturating(tmp_path)
    assert status(["improve", str(model), str(table), "--yes"]) == 0
    told = capsys.readouterr().out
    assert "not in the catalogue" in told
    (command,) = next_commands(told)
    assert command[:3] == ["add", str(model), "--expr"], told
    assert status([*command, "--json"]) == 0
    added = json.loads(capsys.readouterr().out)
    assert added["after"]["held_out"] < 1.3 * added["noise_floor"] < 0.5 * added["before"]["held_out"]

"""A machine file in place of a model: the model without effects.

Oracle: a model file without effects, written by hand; what was hidden.
"""

from pathlib import Path

import pytest

from rtec.cli.main import status
from rtec.model import Model, load_model, save_model
from tests.support.diagnosis_examples import small_machine, write_laser, write_machine

HIDDEN = ("scale,component=EXX,axis=X,k=25",)


def answers(*words: str, capsys: pytest.CaptureFixture[str]) -> str:
    assert status([*words, "--json"]) == 0
    return capsys.readouterr().out


@pytest.fixture
def table(tmp_path: Path) -> Path:
    write_machine(tmp_path)
    save_model(Model(small_machine(), name=small_machine().name), tmp_path / "empty.toml")
    return write_laser(tmp_path, HIDDEN, 3)


def test_it_is_compared_and_diagnosed_as_a_model_without_effects(
    table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    machine, empty = str(tmp_path / "machine.toml"), str(tmp_path / "empty.toml")
    for command in ("compare", "diagnose"):
        capsys.readouterr()
        mine = answers(command, machine, str(table), capsys=capsys)
        theirs = answers(command, empty, str(table), "--machine", machine, capsys=capsys)
        assert mine.replace("machine.toml", "M") == theirs.replace("empty.toml", "M").replace("machine.toml", "M")


def test_it_is_improved_into_a_model_and_stays_as_it_was(table: Path, tmp_path: Path) -> None:
    machine = tmp_path / "machine.toml"
    before = machine.read_bytes()
    assert status(["improve", str(machine), str(table), "--yes", "-o", str(tmp_path / "model.toml")]) == 0
    (scale,) = load_model(tmp_path / "model.toml", small_machine()).effects
    assert scale.effect.effect == "scale"
    assert scale.values["k"] == pytest.approx(25.0, abs=1.0)
    assert machine.read_bytes() == before


def test_one_of_another_machine_is_refused(table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (tmp_path / "machine.toml").read_text(encoding="utf-8")
    (tmp_path / "other.toml").write_text(text.replace('name = "', 'name = "other '), encoding="utf-8")
    words = ["compare", str(tmp_path / "other.toml"), str(table), "--machine", str(tmp_path / "machine.toml")]
    assert status(words) == 2
    assert "is a machine file, not a model, and of another machine than" in " ".join(capsys.readouterr().err.split())

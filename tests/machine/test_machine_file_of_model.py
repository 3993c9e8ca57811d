"""Which machine a model is for: its hash, an empty one, and the file that it remembers.

Oracle: the machine file itself, moved, changed and absent.
"""

from pathlib import Path
from typing import Any

import pytest
import tomli_w

from rtec.cli.main import status
from rtec.daemon.dry_run import dry_run
from rtec.daemon.sign_check import load_stepped
from rtec.diagnosis.machine_file import load_with_machine, machine_file
from rtec.errors import ConfigError, ModelError
from rtec.loop.run_file import load_setup
from rtec.machine import load_machine
from rtec.model import Model, load_model, save_model
from rtec.tomlfile import read_toml

CONFIGS = Path(__file__).parents[2] / "configs"
MACHINE = CONFIGS / "machines" / "turning-centre.toml"
MODEL = CONFIGS / "models" / "turning-centre.toml"


def written(path: Path, tables: dict[str, Any]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(tomli_w.dumps(tables), encoding="utf-8")
    return path


def with_hash(path: Path, machine_hash: str, **more: str) -> Path:
    tables = read_toml(MODEL)
    return written(path, {**tables, "model": {**tables["model"], "machine_hash": machine_hash, **more}})


def copied(file: Path, to: Path) -> Path:
    to.parent.mkdir(parents=True, exist_ok=True)
    to.write_bytes(file.read_bytes())
    return to


def test_an_empty_hash_is_this_machine_and_is_written_out_when_saved(tmp_path: Path) -> None:
    machine = load_machine(MACHINE)
    model = load_model(with_hash(tmp_path / "m.toml", ""), machine)
    assert model.hash == load_model(MODEL, machine).hash
    save_model(model, tmp_path / "saved.toml")
    assert read_toml(tmp_path / "saved.toml")["model"]["machine_hash"] == machine.hash
    with pytest.raises(ModelError, match="made for machine"):
        load_model(with_hash(tmp_path / "other.toml", "0" * 64), machine)


def test_a_saved_model_finds_its_machine_from_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Far from the machine's file, in no folder that is searched; and after both were moved together."""
    file = copied(MACHINE, tmp_path / "one" / "shop" / "lathe.toml")
    model = tmp_path / "one" / "deep" / "down" / "model.toml"
    model.parent.mkdir(parents=True)
    save_model(Model(load_machine(file)), model)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert machine_file(model) == file
    (tmp_path / "one").rename(tmp_path / "two")
    moved = tmp_path / "two" / "deep" / "down" / "model.toml"
    assert machine_file(moved) == tmp_path / "two" / "shop" / "lathe.toml"
    assert load_with_machine(moved).machine.name == "turning-centre"


def test_a_remembered_file_that_changed_is_not_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    file = copied(MACHINE, tmp_path / "shop" / "lathe.toml")
    model = tmp_path / "models" / "deep" / "model.toml"
    model.parent.mkdir(parents=True)
    save_model(Model(load_machine(file)), model)
    file.write_text(file.read_text().replace("counts_per_mm = 2000", "counts_per_mm = 1000", 1))
    with pytest.raises(ModelError, match=r"machine_file = '\.\./\.\./shop/lathe\.toml'"):
        machine_file(model)


@pytest.mark.parametrize("named", [True, False])
def test_an_empty_hash_takes_the_file_that_is_named_else_the_machine_of_the_name(tmp_path: Path, named: bool) -> None:
    """Beside it is another machine's file, whose name comes first."""
    copied(CONFIGS / "machines" / "vertical-mill.toml", tmp_path / "a-mill.toml")
    file = copied(MACHINE, tmp_path / "shop" / "z.toml" if named else tmp_path / "z.toml")
    model = with_hash(tmp_path / "model.toml", "", **({"machine_file": "shop/z.toml"} if named else {}))
    assert machine_file(model).resolve() == file


def run_tables(**run: str) -> dict[str, Any]:
    tables = read_toml(CONFIGS / "turning-centre-sim.toml")
    device = {**tables["device"]["machine"], "truth": str(CONFIGS / "sim" / "turning-centre.toml"), "warm_up_s": 0}
    return {**tables, "device": {"machine": device}, "run": {"machine": str(MACHINE), "rate_hz": 1000, **run}}


def test_a_held_run_needs_no_model_and_corrects_nothing(tmp_path: Path) -> None:
    """Oracle: a model without effects asks for zero."""
    setup = load_setup(written(tmp_path / "run.toml", run_tables(mode="hold")))
    assert setup.model.effects == ()
    assert dry_run(setup)["requested_um"] == {"X": 0.0, "Z": 0.0}
    with pytest.raises(ConfigError, match=r'mode = "hold"'):
        load_setup(written(tmp_path / "on.toml", run_tables()))


def test_a_sign_check_reads_no_model(tmp_path: Path) -> None:
    """With a model file that is not there yet, or none named at all."""
    for run in ({"model": "not-there-yet.toml"}, {}):
        path = written(tmp_path / "run.toml", run_tables(**run))
        assert load_stepped(path, {"X": 20.0}).step_um == {"X": 20.0}
        with pytest.raises(ConfigError):
            load_stepped(path, {})


def test_machine_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the hash in the shipped model; a file with a key that is not there."""
    assert status(["machine", "hash", str(MACHINE)]) == 0
    assert capsys.readouterr().out.strip() == read_toml(MODEL)["model"]["machine_hash"]
    assert status(["machine", "check", str(MACHINE), str(MODEL)]) == 0
    assert "of this machine" in capsys.readouterr().out
    assert status(["machine", "show", str(MACHINE)]) == 0
    out = capsys.readouterr().out
    assert "Z > X > turret > tool" in out
    assert "EXX" in out
    wrong = tmp_path / "wrong.toml"
    wrong.write_text(MACHINE.read_text().replace("pitch_mm", "pich_mm", 1))
    assert status(["machine", "check", str(wrong)]) == 2
    assert "did you mean 'pitch_mm'" in capsys.readouterr().err
    assert status(["machine", "check", str(CONFIGS / "machines" / "vertical-mill.toml"), str(MODEL)]) == 2
    assert "made for machine" in capsys.readouterr().err

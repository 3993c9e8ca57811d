"""A file of another kind, or saved in another encoding: one sentence says what it is and what is expected.

Oracle: the files themselves, of the kinds that the product ships or writes.
"""

import shutil
from pathlib import Path

import pytest

from rtec.cli.main import status
from rtec.errors import ConfigError
from rtec.machine import load_machine
from rtec.metrology.files.toml import find_files
from rtec.tomlfile import read_toml

CONFIGS = Path(__file__).parents[2] / "configs"
MACHINE = CONFIGS / "machines" / "turning-centre.toml"


@pytest.fixture
def shop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine, a model, a run file and a measurement in one folder."""
    shutil.copy(MACHINE, tmp_path / "machine.toml")
    shutil.copy(CONFIGS / "models" / "turning-centre.toml", tmp_path / "model.toml")
    shutil.copy(CONFIGS / "turning-centre-sim.toml", tmp_path / "run.toml")
    (tmp_path / "laser.csv").write_text("run,time_s,x_mm,reading_um\n1,0,0,0\n", encoding="utf-8")
    (tmp_path / "laser.toml").write_text(
        '[measurement]\ninstrument = "laser_linear"\naxis = "X"\nmachine = "turning-centre"\n', encoding="utf-8"
    )
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("fit laser.csv machine.toml -o m.toml", "laser.csv: is a table of readings; a TOML file is expected here"),
        ("fit model.toml laser.csv -o m.toml", "model.toml: is a model file; a machine file is expected here"),
        ("fit run.toml laser.csv -o m.toml", "run.toml: is a run file; a machine file is expected here"),
        ("compare run.toml laser.csv", "run.toml: is a run file; a model file is expected here"),
        ("compare laser.toml model.toml", "laser.toml: is a measurement; a model file is expected here"),
        ("compare model.toml machine.toml", "machine.toml: is a machine file; a measurement is expected here"),
        ("plan machine.toml model.toml", "model.toml: is a model file; a measurement is expected here"),
        ("run model.toml", "model.toml: is a model file; a run file is expected here"),
        ("run machine.toml --dry-run", "machine.toml: is a machine file; a run file is expected here"),
        ("doctor machine.toml", "machine.toml: is a machine file; a run file is expected here"),
        ("replay laser.csv x.arrows", "laser.csv: is a table of readings; a TOML file is expected here"),
    ],
)
@pytest.mark.usefixtures("shop")
def test_a_file_of_another_kind_is_named(command: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert status(command.split()) == 2
    assert capsys.readouterr().err.splitlines() == [f"rtec: {said}"]


def test_a_byte_order_mark_does_no_harm(tmp_path: Path) -> None:
    """As an editor of Windows writes it, with its line ends."""
    text = MACHINE.read_text(encoding="utf-8")
    path = tmp_path / "machine.toml"
    path.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    assert load_machine(path).hash == load_machine(MACHINE).hash


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be"])
def test_utf_16_is_named_with_the_way_out(encoding: str, tmp_path: Path) -> None:
    path = tmp_path / "machine.toml"
    mark = "" if encoding == "utf-16" else "\ufeff"
    path.write_bytes((mark + MACHINE.read_text(encoding="utf-8")).encode(encoding))
    with pytest.raises(ConfigError, match=r"machine\.toml: is UTF-16 text; save it as UTF-8$"):
        read_toml(path)


def test_a_spreadsheet_leads_to_the_import(shop: Path) -> None:
    (shop / "Laser X.xlsx").write_bytes(b"PK\x03\x04")
    with pytest.raises(Exception, match=r"Laser X\.xlsx: is no measurement yet.*save it as CSV.*rtec import"):
        find_files(shop / "Laser X.xlsx")


def test_the_import_that_is_proposed_can_be_typed(shop: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the shell's rules for a name with a blank."""
    shutil.copy(shop / "laser.csv", shop / "Laser X.csv")
    assert status(["compare", "model.toml", "Laser X.csv", "-m", "machine.toml"]) == 2
    assert "rtec import 'Laser X.csv' -o NAME" in capsys.readouterr().err

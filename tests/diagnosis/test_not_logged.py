"""Files of which one logged a temperature and another did not.

Oracle: the machine's screw warms, by a known law; a ball bar beside the laser has no temperatures, so that the law is
no candidate. The verdict must say so, as what it names instead is not the cause.
"""

from pathlib import Path

import pytest

import rtec
from rtec.cli.main import status

MACHINE = Path(__file__).parents[2] / "configs" / "machines" / "vertical-mill.toml"
TRUTH = ("axis_expansion,component=EXX,axis=X,sensor=T_x_nut,k=12", "backlash,component=EXX,axis=X,B=6")
CIRCLE = {"plane": "XY", "centre_mm": [250.0, 200.0, 200.0], "radius_mm": 150.0, "direction": "ccw"}

FEW = {"cycles": 2, "targets": {"step_mm": 23.0}, "path": {"step_deg": 2.0}}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A laser with temperatures, a circle without, one with a constant temperature, and a model of the scale."""
    folder = tmp_path_factory.mktemp("files")
    machine = rtec.load_machine(MACHINE)
    rtec.simulate(machine, "laser_linear", axis="X", effects=TRUTH, seed=1, changes=FEW, out=folder / "laser")
    circle = CIRCLE | {"feed_mm_min": 1000.0}
    rtec.simulate(machine, "ball_bar", setup=circle, effects=TRUTH, seed=2, changes=FEW, out=folder / "circle")
    _without_temperatures(folder / "circle.csv")
    assert (
        status(["fit", str(MACHINE), str(folder / "laser.csv"), "--effects", "scale", "-o", str(folder / "m.toml")])
        == 0
    )
    return folder


def _without_temperatures(path: Path) -> None:
    rows = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
    kept = [i for i, name in enumerate(rows[0]) if not name.endswith("_degc")]
    path.write_text("".join(",".join(row[i] for i in kept) + "\n" for row in rows), encoding="utf-8")


@pytest.mark.parametrize("command", [["diagnose"], ["improve", "--yes", "-o", "better.toml"]])
def test_the_verdict_says_which_temperatures_were_not_tested(
    command: list[str], files: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(files)
    assert status([command[0], "m.toml", "laser", "circle", "--machine", str(MACHINE), *command[1:]]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "Not tested: effects of " in said
    assert "T_x_nut" in said.split("Not tested: effects of ")[1].split(" on what circle reads")[0]
    assert "Leave circle out, or write the temperature into the file: rtec import --answer " in said


def test_nothing_is_said_where_all_files_logged_all(files: Path) -> None:
    found = rtec.diagnose(files / "m.toml", files / "laser.csv", machine=MACHINE)
    assert "Not tested: effects" not in found.page(figures=False).lead

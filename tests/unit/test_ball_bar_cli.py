"""`rtec simulate` to `rtec ballbar`: files, numbers, report; the oracle is what was made true on the command line."""

import json
from pathlib import Path

import pytest
import tomli_w

from rtec.cli.main import status

TESTS = (("a", 0.0, 150.0, "ccw"), ("b", 100.0, 120.0, "cw"), ("c", 100.0, 120.0, "ccw"))
EFFECTS = (
    "scale,component=EXX,axis=X,k=-12", "squareness,component=EC0X,alpha=35", "backlash,component=EYY,axis=Y,B=-4",
    "servo_lag,component=EXX,axis=X,tau=0.3",
)  # fmt: skip


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    """A gantry: X rides on Y."""
    axes = {k: {"direction": k, "travel_mm": [-400.0, 400.0], "counts_per_mm": 1000} for k in "XYZ"}
    path = tmp_path / "gantry.toml"
    path.write_text(tomli_w.dumps({"machine": {"name": "gantry", "tool_chain": ["Y", "X", "Z"]}, "axis": axes}))
    return path


@pytest.fixture
def circles(machine: Path) -> list[str]:
    """Three tests as files; the servo makes X lag, so the phase depends on feed over radius."""
    out = []
    for name, height, radius, direction in TESTS:
        # The same angular speed in all three: then a lag in time is one angle, as [BB] has it.
        setup = {"plane": "XY", "centre_mm": "[0,0,0]", "radius_mm": radius, "height_mm": height,
                 "direction": direction, "feed_mm_min": radius * 6.0, "overshoot_deg": 10.0}  # fmt: skip
        line = ["simulate", str(machine), "-i", "ball_bar", "--cycles", "1", "--noise", "0.1", "-o"]
        line.append(str(machine.parent / name))
        line += [part for k, v in setup.items() for part in ("--set", f"{k}={v}")]
        line += [part for e in EFFECTS for part in ("--effect", e)]
        line += ["--settings", str(quiet(machine.parent))]
        assert status(line) == 0
        out.append(str(machine.parent / f"{name}.csv"))
    return out


def quiet(folder: Path) -> Path:
    """The ball stays where it is in all three."""
    path = folder / "settings.toml"
    path.write_text(tomli_w.dumps({"nuisance": {"centre": 0.0}}))
    return path


def test_what_was_made_true_is_found(
    machine: Path, circles: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    line = ["ballbar", *circles, "-m", str(machine), "--json", "--report", str(tmp_path / "out"), "--model", "linear"]
    assert status(line) == 0
    found = json.loads(capsys.readouterr().out)
    values = {k: v["value"] for k, v in found["parameters"].items()}
    expected = {"scale_x": -12.0, "scale_y": 0.0, "squareness": 35.0, "clearance_y": 4.0, "clearance_x": 0.0}
    # A lag of 0.3 µm per mm/s at 0.1 rad/s is 30 µrad: e_x = 0.3 v_x = -0.3 s ω r sin ζ.
    for name, value in {**expected, "phase": 30.0}.items():
        v = found["parameters"][name]
        assert values[name] == pytest.approx(value, abs=4.5 * v["se"] + 0.02), name
    assert found["rank"]["rank"] == 10
    assert found["model"] == "linear"
    assert found["explained"] > 0.99
    assert [t["left_out"] for t in found["tests"]] == [80, 80, 80]
    assert found["both_senses"][0]["names"] == ["c", "b"]
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        "polar.png", "linear.png", "harmonics.png", "report.html", "result.json",
    }  # fmt: skip
    assert json.loads((tmp_path / "out" / "result.json").read_text())["model"] == "linear"


def test_the_terminal_says_what_one_test_cannot_tell(
    machine: Path, circles: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert status(["ballbar", circles[0], "-m", str(machine)]) == 0
    said = capsys.readouterr().out
    assert "do not separate squareness and phase" in said
    assert "never see: perpendicularity_x, perpendicularity_y" in said
    assert "Model: linear, because" in said


def test_what_is_wrong_is_told(machine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert status(["ballbar", "nothing.csv", "-m", str(machine)]) == 2
    assert "nothing.csv" in capsys.readouterr().err
    assert status(["ballbar", "--help"]) == 0
    assert "Example" in capsys.readouterr().out

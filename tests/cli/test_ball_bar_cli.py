"""`rtec simulate` to `rtec ballbar`: files, numbers, report; the oracle is what was made true on the command line."""

import json
from collections.abc import Sequence
from pathlib import Path

import pytest
import tomli_w

from rtec.cli.main import status

TESTS = (("a", 0.0, 150.0, "ccw"), ("b", 100.0, 120.0, "cw"), ("c", 100.0, 120.0, "ccw"))
EFFECTS = (
    "scale,component=EXX,axis=X,k=-12", "squareness,component=EC0X,alpha=35", "backlash,component=EYY,axis=Y,B=-4",
    "servo_lag,component=EXX,axis=X,tau=0.3",
)  # fmt: skip


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A gantry: X rides on Y."""
    axes = {k: {"direction": k, "travel_mm": [-400.0, 400.0], "counts_per_mm": 1000} for k in "XYZ"}
    path = tmp_path_factory.mktemp("gantry") / "gantry.toml"
    path.write_text(tomli_w.dumps({"machine": {"name": "gantry", "tool_chain": ["Y", "X", "Z"]}, "axis": axes}))
    return path


@pytest.fixture(scope="module")
def circles(machine: Path) -> list[str]:
    """Three tests as files; the servo makes X lag, so the phase depends on feed over radius."""
    # The same angular speed in all three: then a lag in time is one angle, as [BB] has it.
    return [
        simulated(machine, name, EFFECTS, radius_mm=radius, height_mm=height, direction=direction,
                  feed_mm_min=radius * 6.0)
        for name, height, radius, direction in TESTS
    ]  # fmt: skip


def simulated(machine: Path, name: str, effects: Sequence[str], **setup: float | str) -> str:
    """A test as `rtec simulate` writes it."""
    given = {"plane": "XY", "centre_mm": "[0,0,0]", "overshoot_deg": 10.0, **setup}
    line = ["simulate", str(machine), "-i", "ball_bar", "--cycles", "1", "--noise", "0.1", "-o"]
    line.append(str(machine.parent / name))
    line += [part for k, v in given.items() for part in ("--set", f"{k}={v}")]
    line += [part for e in effects for part in ("--effect", e)]
    line += ["--settings", str(quiet(machine.parent))]
    assert status(line) == 0
    return str(machine.parent / f"{name}.csv")


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
        "polar.png", "linear.png", "causes.png", "harmonics.png", "report.html", "result.json",
    }  # fmt: skip
    assert json.loads((tmp_path / "out" / "result.json").read_text())["model"] == "linear"


def test_the_terminal_says_what_one_test_cannot_tell(
    machine: Path, circles: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert status(["ballbar", circles[0], "-m", str(machine), "--full"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "do not separate squareness X-Y and servo phase mismatch X-Y" in said
    assert "do not determine: perpendicularity of X to Z, perpendicularity of Y to Z" in said
    assert "Model: linear, because" in said


DYNAMIC = (
    "backlash,component=EYY,axis=Y,B=-3", "inertia,component=EXX,axis=X,k=500",
    "reversal_spike,component=EXX,axis=X,A=-9,s0=0.25", "change_over,component=EXX,axis=X,other=Y,tau=-0.2",
    "change_over,component=EYY,axis=Y,other=X,tau=-0.2",
)  # fmt: skip


def test_dynamic_effects_and_two_feeds(machine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: what was made true: X 500 µm short for each m/s², its spike ½ of 9 µm, 0.2 ms late while slower."""
    files = [
        simulated(machine, f"{feed}{direction}", DYNAMIC, radius_mm=150.0, direction=direction, feed_mm_min=feed)
        for feed, direction in ((1000, "ccw"), (1000, "cw"), (3000, "ccw"))
    ]
    capsys.readouterr()
    assert status(["ballbar", *files[:2], "-m", str(machine), "--full"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "All tests were run at one feed, 1000 mm/min, which cannot separate" in said
    assert status(["ballbar", *files, "-m", str(machine), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {f["name"] for f in found["beyond"]["found"]} == {"spike_x_f1000", "spike_x_f3000", "gain_x", "change_over"}
    wanted = {"gain_x": 500.0, "spike_x_plus_f1000": 4.5, "spike_x_minus_f3000": 4.5, "change_over": 0.2,
              "scale_x": 0.0, "clearance_y": 3.0}  # fmt: skip
    for name, value in wanted.items():
        v = found["parameters"][name]
        assert v["value"] == pytest.approx(value, abs=4.5 * v["se"]), name
    assert found["explained"] > 0.98
    assert status(["ballbar", *files, "-m", str(machine), "--json", "--no-dynamic"]) == 0
    plain = json.loads(capsys.readouterr().out)
    assert plain["beyond"] is None
    assert plain["explained"] < 0.9


def test_what_is_wrong_is_told(machine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert status(["ballbar", "nothing.csv", "-m", str(machine)]) == 2
    assert "nothing.csv" in capsys.readouterr().err
    assert status(["ballbar", "--help"]) == 0
    assert "Example" in capsys.readouterr().out

"""The evaluations of `import rtec`: ball bar, grid encoder, procedures, a model's history; the commands call them.

Oracles: the JSON that the commands print; the numbers that the tables were made of.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rtec
from rtec.cli.main import status
from rtec.result import Result
from tests.cli.test_grid_cli import machine as bridge
from tests.cli.test_grid_cli import simulated as plate
from tests.cli.test_procedures_cli import SLIDE, arbor, circles, dat, spindle
from tests.support.diagnosis_examples import write_laser, write_machine

SCALE = "scale,component=EXX,axis=X,k=40"
machine = bridge


def printed(capsys: pytest.CaptureFixture[str], *words: str | Path) -> dict[str, Any]:
    """What a command prints with `--json`."""
    capsys.readouterr()
    assert status([*map(str, words), "--json"]) == 0
    out: dict[str, Any] = json.loads(capsys.readouterr().out)
    return out


def same(result: Result, facts: dict[str, Any]) -> None:
    """A result is the command's, and shows itself in a notebook and as a figure."""
    assert json.loads(json.dumps(result.to_dict())) == facts
    assert "<table>" in result._repr_html_()
    assert result.plot().axes


PROCEDURES: dict[str, tuple[Callable[[Path], str], dict[str, Any], list[str]]] = {
    "iso230": (dat, {"pitch_mm": 5.0}, ["--pitch", "5"]),
    "straightness": (arbor, {}, []),
    "parallelism": (circles, {}, []),
    "drift": (spindle, {"distance_mm": 50.0}, ["--distance", "50"]),
}


@pytest.mark.parametrize("name", PROCEDURES)
def test_a_procedure_is_the_command(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the command's JSON; the report's files."""
    make, arguments, options = PROCEDURES[name]
    table = make(tmp_path / ("x.dat" if name == "iso230" else "x.csv"))
    same(getattr(rtec, name)(table, **arguments), printed(capsys, name, table, *options))
    result = getattr(rtec, name)(Path(table), **arguments, report=tmp_path / "out")
    assert result.written["report"] == tmp_path / "out" / "report.html"


def test_frames_have_a_row_a_place_a_circle_a_target_a_phase(tmp_path: Path) -> None:
    """Oracle: what the tables were made of."""
    places = rtec.straightness(arbor(tmp_path / "a.csv")).to_frame("pandas")
    np.testing.assert_allclose(places["straightness_um"], SLIDE - SLIDE.mean(), atol=1e-9)
    around = rtec.parallelism(circles(tmp_path / "c.csv")).to_frame("pandas")
    assert list(around["radius_um"]) == pytest.approx([0.0, 4.5, 0.0, -4.5])
    targets = rtec.iso230(dat(tmp_path / "x.dat")).to_frame("pandas")
    assert list(targets["target_mm"]) == [10.0, 20.0, 30.0]
    assert list(targets["B_um"]) == pytest.approx([4.0, 4.0, 4.0])
    phases = rtec.drift(spindle(tmp_path / "s.csv"), columns={"axial": "axial_um"}).to_frame("pandas")
    assert list(phases["rpm"]) == [2000.0, 0.0]
    assert phases["tau_s"][0] == pytest.approx(3600.0, rel=0.1)


def test_a_measurement_needs_its_machine_unless_it_is_loaded(tmp_path: Path) -> None:
    """Oracle: the reversal that was simulated, 3 µm; the message names the way out."""
    described = write_machine(tmp_path)
    table = write_laser(tmp_path, [SCALE, "backlash,component=EXX,axis=X,B=3"], 4)
    with pytest.raises(rtec.RtecError, match="name the machine that it was made on"):
        rtec.iso230(table)
    both = rtec.iso230(rtec.load_measurement(table, described)).tests[0].both
    assert both is not None
    assert both.B_mean_um == pytest.approx(3.0, abs=0.5)
    assert rtec.iso230(table, machine=described).tests[0].both is not None


def test_ballbar_is_the_command(machine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the command's JSON; the scale that was simulated; the next command names the files."""
    setup = {"plane": "XY", "centre_mm": [0, 0, 0], "radius_mm": 150.0, "direction": "ccw", "feed_mm_min": 900.0}
    table = tmp_path / "ball.csv"
    rtec.simulate(machine, "ball_bar", setup=setup, effects=[SCALE], changes={"cycles": 1}, out=table)
    stages: list[tuple[str, int, int]] = []
    result = rtec.ballbar(machine, table, model="linear", dynamic=False, progress=lambda *stage: stages.append(stage))
    same(result, printed(capsys, "ballbar", table, "--machine", machine, "--model", "linear", "--no-dynamic"))
    assert stages == [("diagnosing 1 test", 0, 1)]
    scale = result.to_frame("pandas").set_index("name").loc["scale_x"]
    assert scale["low"] < 40.0 < scale["high"]
    assert result.page(figures=False).next == [f"rtec plan {machine} {table} --ball-bar non-linear"]


def test_grid_is_the_command(machine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the command's JSON; the squareness that was simulated, -25 µrad."""
    table = plate(machine, "plate", "[0,0,300]")
    result = rtec.grid(machine, table)
    same(result, printed(capsys, "grid", table, "--machine", machine))
    errors = result.to_frame("pandas").set_index("name")
    assert errors.loc["EB0Z"]["value"] == pytest.approx(-25.0, abs=2 * errors.loc["EB0Z"]["u"] + 0.02)


def test_history_is_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the command's JSON; a fit is one step."""
    described = write_machine(tmp_path)
    table = write_laser(tmp_path, [SCALE], 4)
    rtec.fit(described, table, effects="scale:EXX:axis=X", out=tmp_path / "model.toml")
    result = rtec.history(tmp_path / "model.toml", machine=described)
    same(result, printed(capsys, "history", tmp_path / "model.toml", "--machine", described))
    assert [s["name"] for s in result.steps] == list(result.to_frame("pandas")["name"]) == ["fit"]

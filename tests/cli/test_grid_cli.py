"""`rtec simulate` to `rtec grid`: files, numbers, report; the oracle is what was made true on the command line."""

import json
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from rtec.cli.main import status
from rtec.report.grid import Piece, contour, usual_magnification


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    """[XT]'s bridge."""
    axes = {k: {"direction": k, "travel_mm": [-2000.0, 2000.0], "counts_per_mm": 1000} for k in "XYZ"}
    path = tmp_path / "bridge.toml"
    tables = {"machine": {"name": "bridge", "tool_chain": ["Y", "Z"], "work_chain": ["X"]}, "axis": axes}
    path.write_text(tomli_w.dumps(tables))
    (tmp_path / "settings.toml").write_text(tomli_w.dumps({"path": {"feeds_mm_min": [500.0, 8000.0]}}))
    return path


def simulated(machine: Path, name: str, origin: str) -> str:
    truth = ("squareness,component=EB0Z,alpha=-25", "polynomial_position,component=EBY,axis=Y,degrees=[1],c1=40",
             "backlash,component=EXX,axis=X,B=3")  # fmt: skip
    line = ["simulate", str(machine), "-i", "grid_encoder", "--set", "plane=XZ", "--set", f"origin_mm={origin}"]
    line += ["--noise", "0.1", "--cycles", "1", "--settings", str(machine.parent / "settings.toml")]
    line += [part for e in truth for part in ("--effect", e)]
    assert status([*line, "-o", str(machine.parent / name)]) == 0
    return str(machine.parent / f"{name}.csv")


def test_what_was_made_true_is_found(machine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """EBY is 40 µrad times y over half the travel, so 30 at y = 1500 and -30 at -1500."""
    files = [simulated(machine, n, f"[0,{y},300]") for n, y in (("near", -1500), ("far", 1500))]
    capsys.readouterr()
    assert status(["grid", *files, "-m", str(machine), "--json", "--report", str(tmp_path / "out")]) == 0
    found = json.loads(capsys.readouterr().out)
    for setup, expected in zip(found["setups"], (-25.0 - 30.0, -25.0 + 30.0), strict=True):
        items = {i["name"]: i for i in setup["items"]}
        assert items["EB0Z"]["value"] == pytest.approx(expected, abs=2 * items["EB0Z"]["u"] + 0.02)
    items = {i["name"]: i for c in found["comparisons"] for i in c["items"]}
    assert items["EBY"]["value"] == pytest.approx(-60.0, abs=2 * items["EBY"]["u"] + 0.02)
    assert items["EXX(+) - (-)"]["value"] == pytest.approx(3.0, abs=0.1)
    certain = {n for c in found["comparisons"] for n in c["certain"]}
    assert {"EBY", "EXX(+) - (-)"} <= certain
    names = {p.name for p in (tmp_path / "out").iterdir()}
    assert {"contour-1.png", "contour-2.png", "places-1.png", "report.html", "result.json"} <= names
    assert any(n.startswith("feeds-") for n in names)


def test_the_terminal_says_it_in_words(machine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = simulated(machine, "one", "[0,0,300]")
    capsys.readouterr()
    assert status(["grid", file, "-m", str(machine)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "squareness of Z to X" in said
    assert "EXX(+) - (-) = " in said
    assert status(["grid", file, "-m", str(machine), "--corner", "5", "5"]) == 2
    assert "no edges meet at 5, 5 mm" in capsys.readouterr().err
    assert status(["grid", "--help"]) == 0
    assert "Example" in capsys.readouterr().out


def test_magnification_is_round_and_the_figure_is_drawn() -> None:
    """Oracle: an eighth of 160 mm for 2 µm is 10 000 times, [XT]'s own."""
    place = np.linspace(-80.0, 80.0, 50)
    pieces = [Piece(0, 1, place, -80.0, 2.0 * place / 80.0, 0), Piece(1, -1, place, 80.0, 0.0 * place, 1)]
    assert usual_magnification(pieces) == 10000.0
    assert contour("test", ("X", "Z"), pieces, ["one", "two"], 10000.0).startswith(b"\x89PNG")

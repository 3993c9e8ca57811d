"""The commands of the procedures: tables in, terminal, JSON, report out. Oracle: what the tables are made of."""

import csv
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from numpy.typing import NDArray

from rtec.cli.main import status

Floats = NDArray[np.float64]
MACHINE = str(Path(__file__).parents[2] / "configs" / "machines" / "turning-centre.toml")
Z = np.arange(0.0, 301.0, 25.0)
SLIDE = 2 * ((Z - 150) / 150) ** 2
ARBOR = 0.8 * np.sin(Z / 40)


def table(path: Path, head: Sequence[str], rows: Iterable[Sequence[float | str]]) -> str:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([head, *rows])
    return str(path)


def arbor(path: Path) -> str:
    rows: list[Sequence[float | str]] = []
    for run in (1, 2):
        rows += [(run, z, 0, a - s, "") for z, a, s in zip(Z, ARBOR, SLIDE, strict=True)]
        rows += [(run, z, 180, "", a + s) for z, a, s in zip(Z, ARBOR, SLIDE, strict=True)]
    return table(path, ["run", "z_mm", "spindle_deg", "probe1_um", "probe2_um"], rows)


def faces(path: Path) -> str:
    rows = [(x, deg, -0.02 * x + e * x) for deg, e in ((0, 0.1), (180, -0.1)) for x in (40.0, 60.0, 80.0, 100.0)]
    return table(path, ["x_mm", "spindle_deg", "probe1_um"], rows)


def circles(path: Path) -> str:
    rows = [
        (z, a, 0.015 * z + 4 * np.cos(np.radians(a)), -0.015 * z - 4 * np.cos(np.radians(a)))
        for z in (0.0, 300.0)
        for a in range(0, 360, 30)
    ]
    return table(path, ["z_mm", "angle_deg", "probe1_um", "probe2_um"], rows)


def spindle(path: Path) -> str:
    hours = np.arange(0, 24, 1 / 6)
    on = hours < 8
    growth = np.where(on, 30 * (1 - np.exp(-hours)), 30 * np.exp(-(hours - 8) / 2))
    growth = growth + np.random.default_rng(1).normal(0, 0.1, len(hours))
    rows = zip(hours * 3600, np.where(on, 2000, 0), growth, 0.5 * growth, -growth, 22 + growth / 5, strict=True)
    return table(path, ["time_s", "spindle_rpm", "radial1_um", "radial2_um", "axial_um", "T_nose_degc"], rows)


def dat(path: Path) -> str:
    lines = ["UNIT=mm", "CYCLES=3", "POSITIONS=3", *(f"TGT_DATA[{i}]={10 * i}" for i in (1, 2, 3))]
    for i in (1, 2, 3):
        for j in (1, 2, 3):
            lines += [f"REF_DATA_FWD[{i},{j}]={10 * i + 0.001 * j}", f"REF_DATA_BWD[{i},{j}]={10 * i - 0.002}"]
    path.write_text("\n".join(lines))
    return str(path)


def as_json(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    assert status([*arguments, "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_straightness(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    r = as_json(["straightness", arbor(tmp_path / "a.csv")], capsys)
    assert (r["method"], r["repeats"]) == ("reversal", 2)
    np.testing.assert_allclose(r["straightness_um"], SLIDE - SLIDE.mean(), atol=1e-9)
    assert r["point_se_um"] == pytest.approx(0, abs=1e-9)
    r = as_json(["straightness", faces(tmp_path / "f.csv")], capsys)
    assert r["method"] == "face"
    assert r["slope_urad"] == pytest.approx(20)
    assert r["point_se_um"] is None


def test_parallelism(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    r = as_json(["parallelism", circles(tmp_path / "c.csv")], capsys)
    assert r["alpha_urad"] == pytest.approx(15)


def test_drift(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    r = as_json(["drift", spindle(tmp_path / "s.csv"), "--distance", "50"], capsys)
    assert [p["rpm"] for p in r["phases"]] == [2000, 0]
    tilt = r["traces"][3]
    assert (tilt["name"], tilt["unit"]) == ("tilt", "µrad")
    assert tilt["fits"][0]["approach"]["tau_s"] == pytest.approx(3600, rel=0.1)
    r = as_json(["drift", str(tmp_path / "s.csv"), "--axial", "radial2_um"], capsys)
    assert [t["name"] for t in r["traces"]] == ["axial"]


def test_iso230(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: B = 2 + 2 µm, mean of 1, 2 and 3 against -2; 4 s = 4 µm."""
    (r,) = as_json(["iso230", dat(tmp_path / "x.dat"), "--pitch", "5"], capsys)["tests"]
    assert r["both"]["B_um"] == pytest.approx(4)
    assert r["both"]["B_mean_um"] == pytest.approx(4)
    assert r["up"]["R_um"] == pytest.approx(4)
    assert any("multiples of the pitch" in w for w in r["warnings"])
    (r,) = as_json(["iso230", dat(tmp_path / "x.dat"), "--swap"], capsys)["tests"]
    assert r["both"]["B_mean_um"] == pytest.approx(-4)


COMMANDS = {
    "straightness": (arbor, "a.csv", [], "straightness.png", "straight to 2."),
    "parallelism": (circles, "c.csv", [], "parallelism.png", "15.0"),
    "drift": (spindle, "s.csv", ["--distance", "50"], "drift.png", "tilt, µrad"),
    "iso230": (dat, "x.dat", ["--pitch", "10"], "positioning-1.png", "multiples of the pitch"),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_terminal_and_report(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make, name, more, picture, said = COMMANDS[command]
    out = tmp_path / "out"
    assert status([command, make(tmp_path / name), *more, "--report", str(out)]) == 0
    printed = capsys.readouterr().out
    assert said in " ".join(printed.split())
    assert {p.name for p in out.iterdir()} == {"report.html", "result.json", picture}
    page = (out / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 1
    assert "http" not in page
    assert (out / picture).read_bytes().startswith(b"\x89PNG")
    json.loads((out / "result.json").read_text(encoding="utf-8"))


def measurement(folder: Path, name: str, head: dict[str, Any], columns: dict[str, Floats]) -> str:
    (folder / f"{name}.toml").write_text(tomli_w.dumps(head))
    return table(folder / f"{name}.csv", list(columns), zip(*columns.values(), strict=True))


def test_a_laser_measurement(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: readings of +1 µm upwards, -2 µm downwards, and the pitch of X in the machine file, 5 mm."""
    way = np.r_[5.0, 10, 60, 110, 160, 190, 160, 110, 60, 10]
    x = np.r_[np.tile(way, 3), 5.0]
    up = np.r_[False, np.diff(x) > 0]
    rng = np.random.default_rng(1)
    columns = {
        "run": np.ones(len(x)), "time_s": 10.0 * np.arange(len(x)), "x_mm": x,
        "reading_um": np.where(up, 1.0, -2.0) + rng.normal(0, 0.01, len(x)),
    }  # fmt: skip
    head = {
        "measurement": {"instrument": "laser_linear", "axis": "X", "component": "EXX", "machine": "turning-centre"},
        "setup": {},
    }
    file = measurement(tmp_path, "laser-x", head, columns)
    (r,) = as_json(["iso230", file, "--machine", MACHINE], capsys)["tests"]
    assert r["visits"]["target_mm"] == [10, 60, 110, 160]
    assert r["both"]["B_mean_um"] == pytest.approx(3, abs=0.02)
    assert any("multiples of the pitch" in w for w in r["warnings"])
    assert status(["iso230", file]) == 2
    assert "--machine" in capsys.readouterr().err
    assert status(["iso230", file, "--machine", MACHINE, "--swap"]) == 2
    assert "--swap is for the directions of a .dat" in capsys.readouterr().err


def test_a_straightedge_that_is_turned_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: slide and straightedge of made-up forms, s + a and s - a; it was set up 12 µrad askew, in no spindle."""
    z = np.arange(0.0, 301.0, 25.0)
    columns = {
        "run": np.repeat([1, 2], len(z)), "time_s": 10.0 * np.arange(2 * len(z)), "z_mm": np.r_[z, z],
        "reading_um": np.r_[SLIDE + ARBOR, SLIDE - ARBOR] + 0.012 * np.r_[z, z],
    }  # fmt: skip
    head = {
        "measurement": {"instrument": "straightness", "axis": "Z", "machine": "turning-centre"},
        "setup": {"direction": "X", "reversed_runs": [2]},
    }
    file = measurement(tmp_path, "edge", head, columns)
    r = as_json(["straightness", file, "--machine", MACHINE], capsys)
    assert r["method"] == "artefact"
    np.testing.assert_allclose(r["straightness_um"], SLIDE - SLIDE.mean(), atol=1e-9)
    np.testing.assert_allclose(r["artefact_um"], ARBOR - np.polyval(np.polyfit(z, ARBOR, 1), z), atol=1e-9)
    assert r["slope_urad"] == pytest.approx(12.0)
    assert status(["straightness", file, "--machine", MACHINE]) == 0
    said = capsys.readouterr().out
    assert "how the artefact was set up" in said
    assert "spindle" not in said
    assert status(["straightness", file, "--machine", MACHINE, "--method", "artefact", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == r
    assert status(["straightness", file, "--machine", MACHINE, "--method", "face"]) == 2
    assert "method 'face' needs a table" in capsys.readouterr().err


def test_a_drift_measurement(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: probes 60 mm apart; the second reads with the other sign, which the set-up tells."""
    time = np.arange(0.0, 8 * 3600.0, 600.0)
    growth = 20 * (1 - np.exp(-time / 5000))
    columns = {
        "run": np.ones(len(time)), "time_s": time, "spindle_rpm": np.full(len(time), 2000.0),
        "reading_radial1_um": growth, "reading_radial2_um": -0.4 * growth,
    }  # fmt: skip
    head = {
        "measurement": {"instrument": "spindle_drift", "machine": "turning-centre"},
        "setup": {
            "probe": {
                "radial1": {"direction": "X", "offset_mm": [0.0, 0.0, 60.0]},
                "radial2": {"direction": "X", "sign": -1},
            }
        },
    }
    file = measurement(tmp_path, "d", head, columns)
    assert status(["drift", file, "--machine", MACHINE, "--radial1", "reading_radial2_um"]) == 2
    assert "leave --radial1 out" in capsys.readouterr().err
    r = as_json(["drift", file, "--machine", MACHINE], capsys)
    assert r["traces"][2]["name"] == "tilt"
    np.testing.assert_allclose(r["traces"][2]["values"], 0.6 * growth / 60 * 1e3, atol=1e-9)
    assert r["traces"][0]["fits"][0]["approach"]["tau_s"] == pytest.approx(5000, rel=0.01)


def test_what_is_missing_from_a_measurement_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the one reading that was taken out, line 5 of the table, and the user's own note."""
    reading = 3.0 * np.arange(12.0)
    reading[3] = np.nan
    columns = {
        "run": np.ones(12), "time_s": 600.0 * np.arange(12), "spindle_rpm": np.full(12, 2000.0),
        "reading_axial_um": reading,
    }  # fmt: skip
    named = {"instrument": "spindle_drift", "machine": "turning-centre", "notes": ["new bearing"]}
    head = {"measurement": named, "setup": {"probe": {"axial": {"direction": "Z"}}}}
    command = ["drift", measurement(tmp_path, "d", head, columns), "--machine", MACHINE]
    said = as_json(command, capsys)["notes"]["d"]
    assert said[:2] == ["new bearing", "reading_axial_um: 1 of 12 readings missing (line 5)"]
    assert status([*command, "--report", str(tmp_path / "out")]) == 0
    assert "1 of 12 readings missing (line 5)" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_a_straightness_measurement(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: slide and artefact that the readings were made of."""
    columns = {
        "run": np.repeat([1.0, 2.0], len(Z)), "time_s": np.arange(2.0 * len(Z)), "z_mm": np.tile(Z, 2),
        "reading_um": -np.r_[SLIDE + ARBOR, SLIDE - ARBOR],
    }  # fmt: skip
    head = {
        "measurement": {"instrument": "straightness", "axis": "Z", "machine": "turning-centre"},
        "setup": {"direction": "X", "sign": -1, "reversed_runs": [2]},
    }
    r = as_json(["straightness", measurement(tmp_path, "s", head, columns), "--machine", MACHINE], capsys)
    np.testing.assert_allclose(r["straightness_um"], SLIDE - SLIDE.mean(), atol=1e-9)
    np.testing.assert_allclose(r["artefact_um"], ARBOR - np.polyval(np.polyfit(Z, ARBOR, 1), Z), atol=1e-9)


@pytest.mark.parametrize(
    ("command", "text", "said"),
    [
        ("straightness", "z_mm,spindle_deg,probe1_um\n0,0,1\n1,0,2\n2,0,3\n", "no readings at spindle_deg = 180"),
        ("straightness", "z_mm,spindle_deg,probe1_um\n0,90,1\n", "row 2: spindle_deg is 90"),
        ("straightness", "z_mm,spindle_deg,probe1_um\n0,0,1\n0,0,2\n", "row 3: run 0 reads 0 mm twice"),
        ("straightness", "z_mm,spindel_deg,probe1_um\n0,0,1\n", "did you mean 'spindel_deg'"),
        ("straightness", "probe1_um,spindle_deg\n1,0\n", "needs one column of positions"),
        (
            "parallelism",
            'z_mm,angle_deg,probe1_um,probe2_um\n0,0,"1,5",2\n',
            "line 2: column 'probe1_um': '1,5' is no number",
        ),
        ("parallelism", "z_mm,angle_deg,probe1_um,probe2_um\n0,0,1\n", "line 2: has 3 cells, the header has 4"),
        ("parallelism", "z_mm,angle_deg,probe1_um,probe2_um\n0,0,1,2\n", "two places"),
        ("drift", "time_s,spindle_rpm,ch1_um\n0,1,2\n", "name others with --radial1"),
        ("drift", "time_s,time_s\n0,1\n", "is 2 times in the header"),
        ("drift", "", "no rows"),
        ("drift", "time_s,spindle_rpm,axial_um\n", "no rows"),
        ("drift", "time_s,spindle_rpm,axial_um\n,1,2\n", "time"),
    ],
)
def test_wrong_tables_are_told(
    command: str, text: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "t.csv"
    file.write_text(text)
    assert status([command, str(file)]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert "t.csv" in error
    assert status([command, str(tmp_path / "none.csv")]) == 2
    assert "no such file" in capsys.readouterr().err


def test_an_unknown_method_names_the_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert status(["straightness", arbor(tmp_path / "a.csv"), "--method", "reversl"]) == 2
    assert "did you mean 'reversal'" in capsys.readouterr().err


def test_a_report_that_cannot_be_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out").write_text("a file")
    assert status(["parallelism", circles(tmp_path / "c.csv"), "--report", str(tmp_path / "out")]) == 2
    assert "cannot be written" in capsys.readouterr().err

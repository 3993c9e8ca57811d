"""`rtec compare`: sizes, floors and shares against closed forms and the simulated truth."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from rtec.cli.main import status
from rtec.diagnosis.compare.compare import compare, explained
from rtec.effects.derived import lag_track
from rtec.errors import MeasurementError
from rtec.estimation.floor import flattened
from rtec.machine import machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model, save_model
from rtec.report.compare import compare_page
from rtec.sim.campaign.campaign import simulate
from rtec.sim.campaign.settings import Settings
from tests.support.diagnosis_examples import TABLE, effects, laser, small_machine, write_laser, write_machine

SCALE = "scale,component=EXX,axis=X,k=40"
BACKLASH = "backlash,component=EXX,axis=X,B=3"
PNG = b"\x89PNG\r\n\x1a\n"


def model(*texts: str, **more: object) -> Model:
    """Model of the small machine."""
    return replace(Model(small_machine(), effects(*texts), name="first"), **more)  # type: ignore[arg-type]


def drift(seed: int, **noise: float) -> Measurement:
    """A spindle drift test, one probe."""
    instrument = make_instrument(
        "spindle_drift", {"probe": {"axial": {"direction": "Z"}}}, None, None, small_machine(), "t"
    )
    return simulate(model(), instrument, Settings.model_validate({"noise": noise}), seed, "drift")


def test_injected_backlash_is_what_is_left() -> None:
    """Oracle: a backlash B leaves ±B/2 at every reading: rms and largest are B/2; the noise is the simulated one."""
    item = compare(model(SCALE), [laser([SCALE, BACKLASH], 3, noise={"white_um": 0.01})]).items[0]
    assert item.left.rms == pytest.approx(1.5, rel=0.01)
    assert item.left.most == pytest.approx(1.5, abs=0.06)
    assert item.floor == pytest.approx(0.01, rel=0.15)
    assert item.noise.source == "repeats"
    # Scale over evenly spaced targets: k times the standard deviation of the positions.
    x = laser([SCALE], 3).channels["x"]
    assert item.predicted.rms == pytest.approx(0.04 * float(np.std(x)), rel=1e-3)


def test_parts_sum_to_predicted_and_predicted_to_measured() -> None:
    """Oracle: taking nuisances out is linear, so parts add up, reading by reading."""
    c = compare(model(SCALE, BACKLASH), [laser([SCALE, BACKLASH], 4)])
    total = np.sum(list(c.traces.parts.values()), axis=0)
    np.testing.assert_allclose(total, c.traces.predicted, atol=1e-9)
    np.testing.assert_allclose(c.traces.measured, c.traces.predicted + c.traces.left, atol=1e-9)
    assert {p.label for p in c.items[0].parts} == {"scale(EXX, X)", "backlash(EXX, X)"}
    assert c.items[0].parts[0].rms >= c.items[0].parts[1].rms
    again = flattened(c.traces.readings, c.traces.predicted)
    np.testing.assert_allclose(again, c.traces.predicted, atol=1e-9)


def test_explained_share() -> None:
    """Oracle: written out by hand: floor 1; measured √5 and left √2 means 1 of 4 is left."""
    assert explained(math.sqrt(5.0), math.sqrt(2.0), 1.0) == pytest.approx(0.75)
    assert explained(5.0, 0.9, 1.0) == 1.0
    assert explained(5.0, 5.0, 1.0) == pytest.approx(0.0)
    assert explained(2.0, 10.0, 1.0) == -1.0
    assert explained(1.05, 1.0, 1.0) is None
    assert explained(0.0, 0.0, 0.0) is None
    # Readings in mm under a column of µm: nothing to explain, and the model's micrometres are far off.
    assert explained(0.004, 3.8, 0.12) == -1.0


def test_perfect_model_is_at_the_floor() -> None:
    """Oracle: the simulated white noise; all that can be explained is."""
    item = compare(model(SCALE), [laser([SCALE], 5)]).items[0]
    assert item.left.rms == pytest.approx(0.3, rel=0.1)
    assert item.floor == pytest.approx(0.3, rel=0.1)
    assert item.explained == pytest.approx(1.0, abs=0.02)
    assert item.worst == ()


def test_floor_without_repeats_comes_from_neighbouring_readings() -> None:
    """Oracle: a drift test repeats nothing; the white noise that was simulated."""
    item = compare(model(), [drift(3, white_um=0.3)]).items[0]
    assert item.noise.source == "short-time differences"
    assert item.noise.repeats is None
    assert item.floor == pytest.approx(0.3, rel=0.1)
    assert item.noise.drift < 0.5 * item.floor
    assert item.explained is None
    # No axis moved: only links that stand still, and of these what shifts along the probe or turns.
    assert "EZ0workpiece" in item.sees
    assert not {c for c in item.sees if c[2:] in ("X", "Z")}


def test_slow_drift_is_no_noise() -> None:
    """Oracle: what was simulated: white noise, and what the drift does from one reading to the next."""
    c = compare(model(), [drift(3, white_um=0.3, drift_um=4.0, drift_tau_s=5400.0)])
    item = c.items[0]
    step_s = float(np.median(np.diff(c.traces.readings.time_s)))
    quick = np.sqrt(0.3**2 + 4.0**2 * -np.expm1(-step_s / 5400.0))
    assert item.floor == pytest.approx(quick, rel=0.15)
    assert item.floor < 0.4 * item.left.rms
    assert item.noise.drift == pytest.approx(item.left.rms, rel=0.2)
    (said,) = [s for s in compare_page(c, figures=False).sections if s.heading.startswith("Where the noise")]
    assert "slow drift that no recorded channel explains" in said.text[0]


def test_a_drift_that_a_delayed_temperature_explains_is_not_called_unexplained() -> None:
    """Oracle: the truth, the spindle's length an hour behind T_bed; diagnose would name it."""
    m = drift(3, white_um=0.3)
    late = lag_track(m.channels["T_bed"], m.time_s, 3600.0)
    m = replace(m, readings={"reading_axial_um": m.readings["reading_axial_um"] + 6.0 * (late - m.channels["T_bed"])})
    c = compare(model(), [m])
    assert c.items[0].drift_goes_with.startswith("goes with T_bed, about ")
    assert float(c.items[0].drift_goes_with.split()[4]) == pytest.approx(60.0, rel=0.5)
    page = compare_page(c, figures=False)
    said = " ".join(str(t) for s in page.sections for t in s.text) + page.lead
    assert "no recorded channel explains" not in said


def test_three_runs_of_a_long_wave_come_again() -> None:
    """Oracle: a wave along the axis, in three runs of a day without heat: a drift would be another in each."""
    m = laser([SCALE], 3)
    kept = m.run <= 2
    wave = 60.0 * np.sin(2 * np.pi * m.channels["x"][kept] / 190.0) + 0.4 * np.sin(np.arange(kept.sum()) ** 2)
    m = replace(
        m, run=m.run[kept], time_s=m.time_s[kept], channels={k: v[kept] for k, v in m.channels.items()},
        readings={"reading_um": wave},
    )  # fmt: skip
    c = compare(model(), [m])
    page = compare_page(c, figures=False)
    said = " ".join(t for s in page.sections for t in s.text) + page.lead
    assert "drift that no recorded channel" not in said
    assert "No place stands out" not in said


def test_a_wave_that_is_read_on_the_fly_comes_again() -> None:
    """Oracle: a wave along the axis, once there and once back; no place is read twice within a hundredth of a mm."""
    m = laser([SCALE], 3)
    there = np.linspace(1.0, 199.0, 300)
    x = np.concatenate([there, there[::-1] + 0.3])
    n, still = len(x), {k: v[0] for k, v in m.channels.items() if k.startswith("T_")}
    wave = 60.0 * np.sin(2 * np.pi * x / 45.0) + 0.4 * np.sin(np.arange(n) ** 2)
    m = replace(
        m, run=np.repeat([1, 2], 300), time_s=np.linspace(0.0, 0.2 * (n - 1), n), readings={"reading_um": wave},
        channels={"x": x, "d_x": np.repeat([1.0, -1.0], 300), **{k: np.full(n, v) for k, v in still.items()}},
    )  # fmt: skip
    page = compare_page(compare(model(), [m]), figures=False)
    assert "most of it comes again at the same places" in page.lead


def test_floor_from_repeats_does_not_depend_on_what_the_model_misses() -> None:
    """Oracle: the same noise, with and without an effect that the model lacks."""
    with_it = compare(model(SCALE), [laser([SCALE, BACKLASH], 6)]).items[0]
    without = compare(model(SCALE), [laser([SCALE], 6)]).items[0]
    assert with_it.floor == pytest.approx(without.floor, rel=0.02)
    assert with_it.left.rms > 4.0 * without.left.rms


def test_wrong_readings_are_left_out_and_told() -> None:
    """Oracle: three readings that were made wrong, one of them the first of its run."""
    m = laser([SCALE], 7)
    values = m.readings["reading_um"].copy()
    first = int(np.flatnonzero(np.diff(m.run))[2]) + 1
    wrong = np.array([40, 201, first])
    values[wrong] += (15.0, -20.0, 12.0)
    spoilt = replace(m, readings={"reading_um": values})
    c = compare(model(SCALE), [spoilt])
    assert c.items[0].n == len(m) - 3
    assert "3 wrong readings were left out" in c.notes[0]
    said = re.search(r"row 202 of run 7 \((-?[0-9.]+) µm\)", c.notes[0])
    assert said is not None
    assert float(said[1]) == pytest.approx(-20.0, abs=1.0)
    assert c.items[0].left.most < 2.0


def test_steep_end_of_travel_is_no_wrong_reading() -> None:
    """Oracle: an error that rises steeply in the last 20 mm, in every run: nothing is left out."""
    m = laser([SCALE], 9)
    steep = 4e-3 * np.clip(m.channels["x"] - 180.0, 0.0, None) ** 3
    c = compare(model(SCALE), [replace(m, readings={"reading_um": m.readings["reading_um"] + steep})])
    assert c.items[0].n == len(m)


def test_outside_the_valid_range_is_told() -> None:
    """Oracle: readings counted by hand."""
    m = laser([SCALE], 10)
    known = model(SCALE, valid_range={"x": (0.0, 150.0), "T_bed": (-100.0, 100.0)})
    (outside,) = compare(known, [m]).items[0].outside
    assert (outside.channel, outside.unit) == ("x", "mm")
    assert outside.n == int((m.channels["x"] > 150.0).sum())
    assert outside.highest == pytest.approx(m.channels["x"].max())


def test_model_that_makes_it_worse_is_said() -> None:
    """Oracle: a scale of the wrong sign doubles the error."""
    c = compare(model("scale,component=EXX,axis=X,k=-40"), [laser([SCALE], 11)])
    assert c.items[0].explained == -1.0
    assert any("larger than without one" in t for s in compare_page(c, figures=False).sections for t in s.text)


def test_another_machine_is_refused() -> None:
    """Oracle: the error names the measurement and both machines."""
    other = machine_from({**TABLE, "machine": {**TABLE["machine"], "name": "other"}}, "other")
    with pytest.raises(MeasurementError, match=r"laser-x-1: measured on machine 'small'.*'other'"):
        compare(Model(other, ()), [laser([SCALE], 1)])


def test_figures_show_the_readings() -> None:
    """Oracle: every figure is a PNG of some size; one over position only where an axis moved."""
    page = compare_page(compare(model(SCALE), [laser([SCALE, BACKLASH], 12), drift(4, white_um=0.3)]))
    files = {s.figure.name: s.figure.png for s in page.sections if s.figure}
    assert all(png.startswith(PNG) and len(png) > 10_000 for png in files.values())
    assert {"laser-x-12-position.png", "laser-x-12-map.png", "laser-x-12-time.png", "laser-x-12-effects.png"} <= set(
        files
    )
    assert "drift-time.png" in files
    assert "drift-position.png" not in files


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Machine, model and a laser of a machine with play."""
    folder = tmp_path_factory.mktemp("compare")
    write_machine(folder)
    save_model(model(SCALE), folder / "model.toml")
    write_laser(folder, [SCALE, BACKLASH], 3)
    return folder


def test_command_gives_the_documented_json(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the keys of the file formats; sizes from the play that was made true."""
    words = ["compare", str(folder / "model.toml"), str(folder / "laser-x-3.csv"), "--report", str(folder / "out")]
    capsys.readouterr()
    assert status([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    (item,) = found["measurements"]
    keys = {"name", "n", "rms_measured_um", "rms_residual_um", "max_residual_um", "noise_floor_um", "noise_floor_from"}
    assert keys | {"worst", "explained", "contributions"} <= set(item)
    assert item["name"] == "laser-x-3"
    assert item["rms_residual_um"] == pytest.approx(math.hypot(1.5, 0.3), rel=0.05)
    assert (folder / "out" / "report.html").read_text(encoding="utf-8").count("data:image/png") == 4
    assert json.loads((folder / "out" / "result.json").read_text(encoding="utf-8"))["measurements"] == [item]


def test_command_says_it_in_the_terminal(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the sentence holds the same numbers as the JSON."""
    assert status(["compare", str(folder / "model.toml"), str(folder / "laser-x-3.csv"), "--full"]) == 0
    said = capsys.readouterr().out
    assert said.startswith("The residual is ")
    assert "between repeats" in said


def test_missing_channel_is_one_clear_message(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: exit status 2, the channel's name, no traceback."""
    hot = model(SCALE, "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=11")
    save_model(hot, folder / "hot.toml")
    table = (folder / "laser-x-3.csv").read_text(encoding="utf-8").splitlines()
    place = next(i for i, name in enumerate(table[0].split(",")) if name.startswith("T_bed"))
    cut = [",".join(c for i, c in enumerate(line.split(",")) if i != place) for line in table]
    (folder / "cut.csv").write_text("\n".join(cut) + "\n", encoding="utf-8")
    (folder / "cut.toml").write_text((folder / "laser-x-3.toml").read_text(encoding="utf-8"), encoding="utf-8")
    assert status(["compare", str(folder / "hot.toml"), str(folder / "cut.csv")]) == 2
    said = capsys.readouterr().err
    assert "T_bed" in said
    assert "Traceback" not in said


def test_unknown_machine_is_one_clear_message(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: exit status 2 and the way on, where the machine file is of another machine."""
    table = {**TABLE, "machine": {**TABLE["machine"], "name": "other"}}
    (tmp_path / "other.toml").write_text(tomli_w.dumps(table), encoding="utf-8")
    words = [
        "compare",
        str(folder / "model.toml"),
        str(folder / "laser-x-3.csv"),
        "--machine",
        str(tmp_path / "other.toml"),
    ]
    assert status(words) == 2
    assert "Traceback" not in capsys.readouterr().err

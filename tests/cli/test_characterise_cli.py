"""`rtec fit` as typed: files in, model, report and JSON out; messages and exit status."""

import json
from pathlib import Path
from typing import Any

import pytest

from rtec.cli.main import status
from rtec.machine import load_machine
from rtec.metrology.files.load import save_measurement
from rtec.metrology.instruments.registry import make_instrument
from rtec.model import load_model
from rtec.sim.campaign.campaign import simulate
from rtec.sim.campaign.settings import Settings, Targets
from rtec.sim.campaign.truth import truth_of

MACHINE = Path(__file__).parents[2] / "configs" / "machines" / "turning-centre.toml"
EFFECTS = (
    "scale,component=EXX,axis=X,k=12",
    "backlash,component=EXX,axis=X,B=3",
    "axis_expansion,component=EXX,axis=X,sensor=T_x_nut,k=11",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a measurement `laser-x`."""
    out = tmp_path_factory.mktemp("fit")
    machine = load_machine(MACHINE)
    instrument = make_instrument("laser_linear", {}, "X", "EXX", machine, "test")
    settings = Settings(targets=Targets(step_mm=23.0), cycles=2)
    save_measurement(
        simulate(truth_of(machine, None, EFFECTS), instrument, settings, 3, "laser-x"), out / "laser-x.csv"
    )
    return out


def run(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, str, str]:
    code = status([str(a) for a in ("fit", *arguments)])
    said = capsys.readouterr()
    return code, said.out, said.err


def test_model_report_and_words(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the effects that the measurement was made with; of a second run, the bytes of the first."""
    model, again = (tmp_path / name / "model.toml" for name in ("first", "again"))
    code, out, _ = run(capsys, MACHINE, folder / "laser-x.csv", "-o", model, "--report", tmp_path / "report")
    assert code == 0
    assert run(capsys, MACHINE, folder / "laser-x.csv", "-o", again)[0] == 0
    assert again.read_bytes() == model.read_bytes()
    assert "the residual is " in out
    assert f"Next: rtec compare {model} " in out
    assert f"Figure: {tmp_path / 'report' / 'residuals.png'}\n" in out
    made = load_model(model, load_machine(MACHINE))
    assert {f.label for f in made.effects} == {
        "scale(EXX, X)",
        "backlash(EXX, X)",
        "axis_expansion(EXX, X, T_x_nut)",
    }
    assert made.name == "model"
    page = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    assert "axis_expansion(EXX, X, T_x_nut)" in page
    facts = json.loads((tmp_path / "report" / "result.json").read_text(encoding="utf-8"))
    assert facts["model"]["sha256"] == made.hash
    assert (tmp_path / "report" / "residuals.png").stat().st_size > 1000


def test_json_alone_on_standard_output(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the JSON parser, and the names that were asked for."""
    arguments = (MACHINE, folder / "laser-x.csv", "-o", tmp_path / "m.toml", "--effects", "scale,backlash", "--json")
    code, out, _ = run(capsys, *arguments)
    facts: dict[str, Any] = json.loads(out)
    assert code == 0
    assert {c["effect"] for c in facts["coefficients"]} == {"scale(EXX, X)", "backlash(EXX, X)"}
    assert {"rms_inside", "rms_held_out", "unit", "condition_number", "undecided", "warnings", "outliers"} <= set(facts)
    assert any(w["code"] == "left_over" for w in facts["warnings"])


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--effects", "scal"], "did you mean 'scale'"),
        (["--effects", "mount_expansion:EXX:sensor=T_x"], "did you mean 'T_x_nut'"),
        (["--effects", "scale:EZZ"], "no reading shows scale(EZZ, Z)"),
    ],
)
def test_wrong_use(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], said: str
) -> None:
    code, out, err = run(capsys, MACHINE, folder / "laser-x.csv", "-o", tmp_path / "m.toml", *more)
    assert code == 2
    assert said in err
    assert not out
    assert not (tmp_path / "m.toml").exists()


def test_missing_measurement(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = run(capsys, MACHINE, tmp_path / "none.csv", "-o", tmp_path / "m.toml")
    assert code == 2
    assert "no such file" in err


def test_takes_the_place_of_no_input(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the bytes of the measurement's TOML, which a model of that name would have taken the place of."""
    before = (folder / "laser-x.toml").read_bytes()
    code, _, err = run(capsys, MACHINE, folder / "laser-x.csv", "-o", folder / "laser-x.toml")
    assert code == 2
    assert "is read by this fit" in err
    assert (folder / "laser-x.toml").read_bytes() == before
    model = tmp_path / "new" / "folder" / "m.toml"
    assert run(capsys, MACHINE, folder / "laser-x.csv", "-o", model, "--effects", "scale")[0] == 0
    assert load_model(model, load_machine(MACHINE)).name == "m"


def test_only_what_goes_with_something_is_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: what the measurement was made with: the expansion of X; a laser at the tip sees the spindle too."""
    machine = load_machine(MACHINE)
    laser = make_instrument("laser_linear", {}, "X", None, machine, "test")
    made = simulate(truth_of(machine, None, EFFECTS), laser, Settings(cycles=2), 3, "tip")
    save_measurement(made, tmp_path / "tip.csv")
    code, out, _ = run(capsys, MACHINE, tmp_path / "tip.csv", "-o", tmp_path / "m.toml", "--json")
    assert code == 0
    weak = [c for c in json.loads(out)["correlations"] if abs(c["r"]) < 0.3]
    assert weak
    _, out, _ = run(capsys, MACHINE, tmp_path / "tip.csv", "-o", tmp_path / "m.toml", "--full")
    table = out[out.index("Correlations with temperatures") :]
    assert "T_x_nut" in table
    shown = [float(word) for word in table.split() if word[:3] in ("+0.", "-0.", "+1.", "-1.")]
    assert shown
    assert min(map(abs, shown)) >= 0.3
    assert "simulated, seed 3" not in out  # notes on the import were printed when it was imported

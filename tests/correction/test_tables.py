"""Compensation tables: what a model predicts, in a controller's format, and back."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtec.arrays import Floats
from rtec.cli.main import status
from rtec.correction.tables import FORMATS, table_format
from rtec.correction.tables.predict import beyond, checked, conditions, grids_mm, residuals, table_of
from rtec.correction.tables.table import CompensationTable, TableAxes
from rtec.effects.cyclic import InterpolationError
from rtec.effects.geometry import PolynomialPosition
from rtec.effects.reversal import Backlash
from rtec.errors import ConfigError
from rtec.machine import load_machine
from rtec.model import FittedEffect, Model, load_model, save_model
from tests.correction.table_examples import BECKHOFF, SINUMERIK, look_at_few_places

CONFIGS = Path(__file__).parents[2] / "configs" / "linuxcnc"
MACHINE = load_machine(CONFIGS / "mill-machine.toml")
MODEL = load_model(CONFIGS / "mill-model.toml", MACHINE)
X = MACHINE.axis("X")
AT = {"T_x": 26.0, "T_y": 25.0, "T_z": 24.0}
errors = st.lists(st.tuples(st.floats(-200, 200), st.floats(-200, 200)), min_size=2, max_size=256)


def grid_mm(step_mm: float) -> Floats:
    return grids_mm(FORMATS["siemens"], X, None, step_mm)[0]


@pytest.mark.parametrize("name", ["linuxcnc", "linuxcnc-type-1", "siemens", "siemens-cec", "isg", "heidenhain"])
@given(rows=errors, start=st.floats(-500, 500), step=st.floats(0.5, 50))
def test_a_table_comes_back_to_the_last_digit(
    name: str, rows: list[tuple[float, float]], start: float, step: float
) -> None:
    """Law: reading is the inverse of writing; lost is the format's smallest step, and the direction if it has none."""
    form = FORMATS[name]
    n = np.arange(len(rows))
    positions = np.round(start, 4) + np.round(step, 4) * n
    table = CompensationTable("X", "X", positions, *np.array(rows).T)
    back = form.read(form.text(checked(table, form)), "x", TableAxes("X", "X"))
    assert np.allclose(back.positions_mm, positions, atol=1e-5)
    forward, backward = table.forward_um, table.backward_um
    if not form.limits.both_directions:
        forward = backward = (forward + backward) / 2
    for mine, again in ((forward, back.forward_um), (backward, back.backward_um)):
        assert np.abs(mine - again).max() < form.limits.quantum_um


def test_play_of_an_axis_that_stands_is_in_no_table_of_another() -> None:
    """Y leaves X where it came from: half the play either way. Oracle: by hand; both tables together leave nothing."""
    play = FittedEffect(Backlash(component="EXY", axis="Y"), {"B": 6.0})
    model = Model(MACHINE, (play,), name="play")
    y, places = MACHINE.axis("Y"), np.array([-60.0, 0.0, 80.0])
    own = table_of(model, X, X, places, conditions(model, X, AT))
    assert not own.forward_um.any()
    assert not own.backward_um.any()
    cross = table_of(model, y, X, places, conditions(model, y, AT))
    np.testing.assert_allclose(cross.forward_um, 3.0)
    np.testing.assert_allclose(cross.backward_um, -3.0)
    (other,) = (r for r in residuals(model, own) if r.what.startswith("Y from"))
    assert other.largest_um == pytest.approx(3.0)


def test_the_two_types_of_linuxcnc_by_hand() -> None:
    """Oracle: LinuxCNC's manual: type 0 nominal, actual forward, actual reverse; type 1 nominal, nominal - actual."""
    table = CompensationTable("X", "X", np.array([0.0, 10.0]), np.array([5.0, -3.0]), np.array([7.0, 0.0]))
    first = [[float(w) for w in line.split()] for line in FORMATS["linuxcnc"].text(table).splitlines()[:2]]
    second = [[float(w) for w in line.split()] for line in FORMATS["linuxcnc-type-1"].text(table).splitlines()[:2]]
    assert first == [[0.0, 0.005, 0.007], [10.0, 9.997, 10.0]]
    assert second == [[0.0, -0.005, -0.007], [10.0, 0.003, 0.0]]


@pytest.mark.parametrize(
    ("name", "old", "new", "says"),
    [
        ("siemens", "[0,1,X1]", "[0,5,X1]", "3 points at a distance of 1 mm"),
        ("siemens", "MODULO[0,X1]=0", "MODULO[0,X1]=1", "rotary"),
        ("siemens", "[0,1,X1]", "[0,1,AX2]", "tables of 2 axes"),
        ("siemens", "[0,1,X1]", "[0,1,Z1]", "line 4: 'Z1' is another axis than X"),
        ("siemens", "MAX[0,X1]=-198", "MAX[0,X1]=600", "up to MAX = 600 mm there are 801: is the file cut off"),
        ("siemens", "$AA_ENC_COMP_STEP[0,X1]=1.0", "", "without .AA_ENC_COMP_STEP"),
        ("siemens", "M17", "R1=5\nM17", "line 10: 'R1=5' is no value"),
        ("isg", "unit                        1", "unit 0", "encoder increments"),
        ("isg", "table[2].neg                80", "table[9].neg 80", "each point needs its own"),
        ("isg", "kw_nr_max                   3", "kw_nr_max 999999999", "each point needs its own"),
        ("isg", "table[1].pos                24", "table[1].pos 2.5", "line 12: .* is no entry"),
    ],
)
def test_a_wrong_table_of_a_maker_is_told(name: str, old: str, new: str, says: str) -> None:
    text = {"siemens": SINUMERIK, "isg": BECKHOFF}[name]
    assert old in text
    axis = "X" if name == "siemens" else "Y"
    with pytest.raises(ConfigError, match=says):
        FORMATS[name].read(text.replace(old, new), "x", TableAxes(axis, axis))


def test_what_a_table_cannot_express_is_said_in_um() -> None:
    """Oracle: the model's own expansion: 11.5 µm/m/K x 0.1 m x (60 - 26) K at the ends of the travel."""
    table = checked(table_of(MODEL, X, X, grid_mm(5.0), conditions(MODEL, X, AT)), FORMATS["linuxcnc"])
    by_what = {r.what.split()[0]: r.largest_um for r in residuals(MODEL, table)}
    assert by_what["T_x"] == pytest.approx(11.5 * 0.1 * (60 - 26), rel=1e-3)
    assert by_what["at"] < 0.001
    assert by_what["Y"] == by_what["T_z"] == pytest.approx(0.0, abs=0.001)
    assert 0.01 < by_what["between"] < 1.0


def test_limits_of_the_format_are_checked() -> None:
    fine = table_of(MODEL, X, X, grid_mm(0.5), conditions(MODEL, X, AT))
    with pytest.raises(ConfigError, match="takes 2 to 256 points, the table has 401"):
        checked(fine, FORMATS["linuxcnc"])
    across = table_of(MODEL, X, MACHINE.axis("Y"), grid_mm(10.0), conditions(MODEL, X, AT))
    with pytest.raises(ConfigError, match="no tables between axes: Y cannot be corrected along X"):
        checked(across, FORMATS["linuxcnc"])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "fewer than two lines"),
        ("; a heading\n0 0 0\n1 1 1\n", "fewer than two lines"),
        ("0 0 0\n0 0 0\n", "does not lie beyond the one before"),
        ("0 0 0\n1 nan 1\n", "line 2: a value that is no finite number"),
        ("0 0 0\n100 0.01 0.01\n", "linuxcnc-type-1"),
        ("".join(f"{k} {k} {k}\n" for k in range(300)), "300 points; LinuxCNC takes 256"),
    ],
)
def test_a_wrong_file_is_told(text: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        FORMATS["linuxcnc"].read(text, "x.comp", TableAxes("X", "X"))


def test_the_command_writes_reads_and_compares(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the same model at the temperatures of the table differs by its rounding, at others by the expansion."""
    out, model = tmp_path / "x.comp", str(CONFIGS / "mill-model.toml")
    assert status(["table", model, "--axis", "X", "--at", "T_x=26,T_y=25,T_z=24", "-o", str(out)]) == 0
    said = capsys.readouterr().out
    assert "What the table cannot express" in said
    assert f"COMP_FILE = {out.name}" in said
    for degc, differs in ((26, "0.00"), (36, "11.50")):
        at = f"T_x={degc},T_y=25,T_z=24"
        assert status(["table", "read", str(out), "--axis", "X", "--model", model, "--at", at]) == 0
        assert f"by up to {differs} µm" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--axis", "Q", "--at", "T_x=26,T_y=25,T_z=24"], "no axis 'Q'"),
        (["--axis", "X", "--at", "T_x=26"], "the model reads T_y, T_z"),
        (["--axis", "X", "--at", "T_q=26"], "--at T_q"),
        (["--axis", "X", "--at", "T_x"], "write NAME=NUMBER"),
        (["--axis", "X", "--at", "T_x=26,T_y=25,T_z=24", "--cross", "EYZ"], "--cross EYZ moves Z: leave --axis X out"),
        (["--at", "T_x=26,T_y=25,T_z=24", "--cross", "X"], "is one axis: write --axis"),
        (["--at", "T_x=26,T_y=25,T_z=24"], "name the axis of the table; or --cross, as EYX"),
        (["--axis", "X", "--at", "T_x=26,y=25"], "did you mean 'Y'?"),
        (["--axis", "X", "--at", "T_x=26,T_y=25,T_z=24", "--format", "linuxnc"], "did you mean 'linuxcnc'"),
    ],
)
def test_wrong_use_is_one_clear_message(
    words: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "x.comp"
    assert status(["table", str(CONFIGS / "mill-model.toml"), *words, "-o", str(out)]) == 2
    assert says in " ".join(capsys.readouterr().err.split())
    assert not out.exists()


def test_a_format_that_is_none_is_told() -> None:
    with pytest.raises(ConfigError, match="did you mean 'linuxcnc'"):
        table_format("linuxnc", "here")


def with_effects(*effects: FittedEffect) -> Model:
    """The mill with these effects only."""
    return replace(MODEL, effects=effects, valid_range={})


def rolled(component: str = "ECX", peak_um: float = 20.0) -> FittedEffect:
    """A component along X that is equal at both ends of the travel, and differs by about `peak_um` between."""
    shape = PolynomialPosition.model_validate({"component": component, "axis": "X", "degrees": [2]})
    return FittedEffect(shape, {"c2": peak_um})


def test_other_axes_are_searched_within_their_travel_too() -> None:
    """Oracle: a component that is equal at both ends of X: between them it differs by its whole height. Of a wave
    whose period divides the travel, its amplitude twice (from the table's place to the other side)."""
    y = MACHINE.axis("Y")
    shape = rolled("EYX")
    at = {"X": 100.0, "Z": 0.0}
    table = table_of(with_effects(shape), y, y, grid_mm(50.0), conditions(with_effects(shape), y, at))
    found = {r.what[0]: r.largest_um for r in residuals(with_effects(shape), table)}
    heights = [with_effects(shape).predict(X=x, Y=0.0, Z=0.0)[1] for x in (-100.0, 0.0, 100.0)]
    assert heights[0] == pytest.approx(heights[2])
    assert abs(heights[1] - heights[0]) > 5.0
    assert found["X"] == pytest.approx(abs(heights[1] - heights[0]), rel=1e-3)
    wave = InterpolationError.model_validate({"component": "EYX", "axis": "X", "lambda_mm": 0.5})
    model = with_effects(FittedEffect(wave, {"s": 0.0, "c": 3.0}))
    table = table_of(model, y, y, grid_mm(50.0), conditions(model, y, at))
    assert {r.what[0]: r.largest_um for r in residuals(model, table)}["X"] == pytest.approx(6.0, rel=0.03)


def test_the_direction_of_another_axis_is_none_of_the_tables_own() -> None:
    """Oracle: play of 4 µm of X, which shows along Y: half of it to each side of the middle that the table has."""
    play = Backlash.model_validate({"component": "EYX", "axis": "X"})
    model, y = with_effects(FittedEffect(play, {"B": 4.0})), MACHINE.axis("Y")
    table = table_of(model, y, y, grid_mm(50.0), conditions(model, y, {}))
    assert {r.what[0]: r.largest_um for r in residuals(model, table)}["X"] == pytest.approx(2.0)


def test_the_zero_of_a_format_is_no_residual_of_another_axis(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Oracle: a model of X alone with 20 µm at position 0: no other axis changes it, and the list of the control, which
    is zero there, lacks the 20 µm everywhere: that is one constant, and no difference from the model."""
    curve = PolynomialPosition.model_validate({"component": "EXX", "axis": "X", "degrees": [0, 1]})
    model, form = with_effects(FittedEffect(curve, {"c0": 20.0, "c1": 30.0})), FORMATS["fanuc"]
    table = checked(table_of(model, X, X, grid_mm(10.0), conditions(model, X, {})), form)
    found = {r.what.split()[0]: r.largest_um for r in residuals(model, table)}
    assert found["Y"] == found["Z"] == 0.0
    assert found["a"] == pytest.approx(20.0)
    assert found["at"] <= 0.5 + 1e-9
    save_model(model, tmp_path / "m.toml")
    file = ["--machine", str(CONFIGS / "mill-machine.toml"), "--axis", "X", "--format", "fanuc"]
    assert status(["table", str(tmp_path / "m.toml"), *file, "-o", str(tmp_path / "x.txt")]) == 0
    capsys.readouterr()
    assert status(["table", "read", str(tmp_path / "x.txt"), "--model", str(tmp_path / "m.toml"), *file]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "compared without its +20.00 µm" in said
    assert float(said.split("by up to ")[1].split()[0]) <= 0.5


def test_a_table_beyond_the_models_range_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the model's own range, 15 to 60 degrees, within the sensor's."""
    out, model = tmp_path / "x.comp", str(CONFIGS / "mill-model.toml")
    for degc, warned in ((60, False), (61, True)):
        at = ["--at", f"T_x={degc},T_y=25,T_z=24"]
        assert status(["table", model, "--axis", "X", *at, "-o", str(out)]) == 0
        assert ("T_x is outside the range of the model (15 to 60): 61" in capsys.readouterr().out) == warned
        assert status(["table", "read", str(out), "--axis", "X", "--model", model, *at]) == 0
        assert ("T_x is outside the range of the model (15 to 60): 61" in capsys.readouterr().out) == warned
    narrow = replace(MODEL, valid_range={"x": (-50.0, 100.0)})
    assert beyond(narrow, {}, [X]) == ["X is outside the range of the model (-50 to 100): -100"]


@pytest.mark.parametrize(
    ("component", "axes"),
    [("EYX", ("X", "Y", "")), ("EZXY", ("X", "Z", "Y"))],
)
def test_a_component_names_the_axis_that_moves(
    component: str,
    axes: tuple[str, str, str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Oracle: the same command with the axis that moves; written, read with a model, and read without one.

    What a table leaves is looked for at few places; it is not asked here.
    """
    look_at_few_places(monkeypatch)
    model, at = str(CONFIGS / "mill-model.toml"), ["--at", "T_x=26,T_y=25,T_z=24"]
    form = "siemens-cec" if not axes[2] else "isg-crosscomp2"
    of = ["--cross", component, "--format", form]
    for name, more in (("short", []), ("long", ["--axis", axes[0]])):
        out = tmp_path / name
        assert status(["table", model, *of, *more, *at, "--grid", "50", "-o", str(out)]) == 0
        assert status(["table", "read", str(out), *of, *more, "--model", model, *at]) == 0
        capsys.readouterr()
        assert status(["table", "read", str(out), *of, *more]) == 0
        facts = json.loads(capsys.readouterr().out)
        assert (facts["axis"], facts["corrects"], facts.get("second", "")) == axes
    assert (tmp_path / "short").read_text() == (tmp_path / "long").read_text()


@pytest.mark.parametrize("pitch_mm", [5.0, 4.0, 2.5])
@pytest.mark.parametrize("grid", [20.0, 50.0, 100.0, 200.0])
def test_a_wave_of_which_the_grid_is_a_multiple_is_seen_between_the_points(grid: float, pitch_mm: float) -> None:
    """Oracle: straight lines through its values at the points, at 20 000 places."""
    wave = InterpolationError.model_validate({"component": "EXX", "axis": "X", "lambda_mm": pitch_mm})
    model = with_effects(FittedEffect(wave, {"s": 0.0, "c": 3.0}))
    table = table_of(model, X, X, grid_mm(grid), conditions(model, X, {}))
    everywhere = np.linspace(*X.travel_mm, 20_001)
    um = 3.0 * np.cos(2.0 * np.pi * everywhere / pitch_mm)
    line = np.interp(everywhere, table.positions_mm, 3.0 * np.cos(2.0 * np.pi * table.positions_mm / pitch_mm))
    found = {r.what.split()[0]: r.largest_um for r in residuals(model, table)}
    assert found["between"] == pytest.approx(float(np.abs(um - line).max()), rel=0.03)

"""Each format of a compensation table against its maker's printed example, and there and back for random models."""

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtec.cli.main import status
from rtec.correction.tables import FORMATS
from rtec.correction.tables.predict import checked, conditions, grids_mm, residuals, table_axes, table_of, with_heat
from rtec.correction.tables.table import CompensationTable, TableAxes
from rtec.errors import ConfigError
from rtec.machine import load_machine
from rtec.model import Model, load_model
from rtec.model.model import FittedEffect
from tests.correction.table_examples import (
    BECKHOFF,
    CROSS,
    FANUC,
    HEIDENHAIN,
    PLANE,
    SAG,
    SINUMERIK,
    look_at_few_places,
)

CONFIGS = Path(__file__).parents[2] / "configs" / "linuxcnc"
MACHINE = load_machine(CONFIGS / "mill-machine.toml")
MODEL = load_model(CONFIGS / "mill-model.toml", MACHINE)
AT = {"T_x": 26.0, "T_y": 25.0, "T_z": 24.0}
OF = {"isg-crosscomp": "EYX", "isg-crosscomp2": "EZXY"}
"""What a format has a table for, where it is not one axis."""


def words(text: str) -> set[str]:
    """Lines without comments, with single spaces, and none around "="."""
    plain = (re.sub(r"/\*.*?\*/|[;#].*", "", line) for line in text.splitlines())
    return {" ".join(re.sub(r"(?<=\$AN_CEC)\s+|\s+(?==)|(?<==)\s+", "", line).split()) for line in plain} - {""}


def random_model(seed: int) -> Model:
    """The mill with other numbers, and with straightness, roll, pitch and yaw of X and Y."""
    rng = np.random.default_rng(seed)
    curve = next(f for f in MODEL.effects if f.effect.effect == "piecewise_position")
    more = [replace(curve, effect=curve.effect.model_copy(update={"component": f"E{what}X"})) for what in "YZABC"]
    more += [
        replace(curve, effect=curve.effect.model_copy(update={"component": f"E{what}Y", "axis": "Y"}))
        for what in "XZAC"
    ]
    return replace(
        MODEL,
        effects=tuple(
            FittedEffect(f.effect, {name: float(v * rng.normal(0.0, 1.0)) for name, v in f.values.items()}, f.theta)
            for f in (*MODEL.effects, *more)
        ),
    )


def predicted(model: Model, form_name: str, component: str, step_mm: float) -> CompensationTable:
    form = FORMATS[form_name]
    moves, corrects, second = table_axes(model.machine, component)
    grid, across = grids_mm(form, moves, second, step_mm)
    return table_of(model, moves, corrects, grid, conditions(model, moves, AT), None, second, across)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", sorted(FORMATS))
def test_a_random_model_comes_back_with_the_rounding_of_the_format(name: str, seed: int) -> None:
    """Law: reading undoes writing. What is lost is half the step of a value, and what the limits say: the mean of the
    directions, and a zero. FANUC's step is that of its magnification."""
    model, form = random_model(seed), FORMATS[name]
    component = OF.get(name, "X" if seed else "Y")
    wanted = predicted(model, name, component, 9.0)
    held = checked(wanted, form)
    text = form.text(held)
    back = form.read(text, "there", TableAxes(wanted.axis, wanted.corrects, wanted.second))
    assert np.allclose(back.positions_mm, wanted.positions_mm, atol=1e-4)
    assert np.allclose(back.second_mm, wanted.second_mm, atol=1e-4)
    assert np.allclose(back.forward_um, held.forward_um, atol=1e-6)
    assert np.allclose(back.backward_um, held.backward_um, atol=1e-6)
    assert form.text(replace(back, at=held.at)) == text
    forward, backward = wanted.forward_um, wanted.backward_um
    if not form.limits.both_directions:
        forward = backward = 0.5 * (forward + backward)
    zero = {"": None, "origin": 0.0, "first": wanted.positions_mm[0]}[form.limits.zero]
    shift = 0.0 if zero is None else np.interp(zero, wanted.positions_mm, forward)
    step = form.limits.quantum_um * int((re.findall(r"3623 = (\d+)", text) or [1])[0])
    assert step < 8.0
    for mine, again in ((forward, back.forward_um), (backward, back.backward_um)):
        assert np.abs(mine - shift - again).max() <= 0.5 * step + 1e-6


def test_siemens_lec_as_printed() -> None:
    """Oracle: 6FC5397-1BP40-3BA1, page 242."""
    table = FORMATS["siemens"].read(SINUMERIK, "manual", TableAxes("X", "X"))
    assert table.positions_mm.tolist() == [-200.0, -199.0, -198.0]
    assert table.forward_um.tolist() == table.backward_um.tolist() == [3.0, 10.0, 12.0]
    lines = FORMATS["siemens"].text(table).splitlines()
    assert "$AA_ENC_COMP[0,1,X1]=0.010000" in lines
    assert "$AA_ENC_COMP_MIN[0,X1]=-200" in lines


def test_siemens_cec_as_printed() -> None:
    """Oracle: 6FC5397-1CP10-5BA0, page 222: X1 is corrected along Y1, whose general names are AX1 and AX2."""
    table = FORMATS["siemens-cec"].read(SAG, "manual", TableAxes("Y", "X"))
    assert table.positions_mm == pytest.approx([-400.0, -393.27, -386.54])
    assert table.forward_um.tolist() == table.backward_um.tolist() == [0.0, 10.0, 12.0]
    written = words(FORMATS["siemens-cec"].text(table))
    names = {"(AX2)": "(Y1)", "(AX1)": "(X1)", "[0.": "[0,", "-400.0": "-400"}
    names |= {"]=0.012": "]=0.012000", "]=0.01\n": "]=0.010000\n", "[0,0]=0": "[0,0]=0.000000"}
    printed = "\n".join(sorted(words(SAG)))
    for old, new in names.items():
        printed = printed.replace(old, new)
    assert set(printed.splitlines()) <= written


def test_beckhoff_ssfk_as_printed() -> None:
    """Oracle: TF5200: actual 19856.5 µm at setpoint 19866.7 is the value -102, 19874.7 is 80."""
    isg = FORMATS["isg"].read(BECKHOFF, "manual", TableAxes("Y", "Y"))
    assert isg.positions_mm.tolist() == pytest.approx([-20.0, -19.9306, -19.8667])
    assert isg.forward_um[2] == pytest.approx(19856.5 - 19866.7)
    assert isg.backward_um[2] == pytest.approx(19874.7 - 19866.7)
    assert words(BECKHOFF) - words(FORMATS["isg"].text(isg)) == {"kopf.achs_nr 2", "kopf.log_achs_name Y AXIS"}


def test_beckhoff_crosscomp_as_printed() -> None:
    """Oracle: TF5200, 113391499: 1000 mm and 0.1 mm at its last point."""
    table = FORMATS["isg-crosscomp"].read(CROSS, "manual", TableAxes("X", "Z"))
    assert table.positions_mm.tolist() == pytest.approx([1.0735, 1.1523, 1000.0])
    assert table.forward_um.tolist() == pytest.approx([0.3, 0.5, 100.0])
    missing = words(CROSS) - words(FORMATS["isg-crosscomp"].text(table))
    assert missing == {"kopf.achs_nr 3", "kw.crosscomp.master_ax_nr 1", "kw.crosscomp.n_cycles 10"}


def test_beckhoff_crosscomp2_as_printed() -> None:
    """Oracle: TF5200, 113417611 and P-COMP-00016: the first index is that of the second master axis."""
    table = FORMATS["isg-crosscomp2"].read(PLANE, "manual", TableAxes("Y", "X", "Z"))
    assert table.positions_mm.tolist() == [-40.0, -30.0, -20.0, -10.0]
    assert table.second_mm.tolist() == [-70.0, -60.0]
    assert table.forward_um == pytest.approx(0.1 * np.array([[-3, -1, 4, 9], [82, 77, 68, 63]]))
    assert table.error_um(np.array([-35.0]), 1.0, -65.0) == pytest.approx([0.1 * (-3 - 1 + 82 + 77) / 4])
    written = FORMATS["isg-crosscomp2"].text(table)
    missing = words(PLANE) - {re.sub(r"\[(\d)\]", r"[ \1]", w) for w in words(written)}
    assert {re.sub(r"\d+$", "N", w) for w in missing} == {
        "kopf.achs_nr N", "kw.crosscomp2.n_cycles N", "kw.crosscomp2.master1_ax_nr N", "kw.crosscomp2.master2_ax_nr N"
    }  # fmt: skip


def test_heidenhain_as_printed() -> None:
    """Oracle: TNC 406 / TNC 306, 3/97, page 4-21: 2^14 µm are 16.384 mm; lines without an entry lie on the
    straight line between their neighbours."""
    old = FORMATS["heidenhain-old"]
    table = old.read(HEIDENHAIN, "manual", TableAxes("Z", "Y"))
    assert table.positions_mm.tolist() == pytest.approx([-990 + 16.384 * k for k in range(9)])
    assert table.forward_um.tolist() == pytest.approx([0, -60, -90, -100, -110, -120, -120, -100, -90])
    again = old.text(table).splitlines()
    assert "Y = F(Z)" in again
    assert "DATUM POINT -990" in again
    assert "SETUP 14" in again
    assert "1 Z-973.616 Y-0.060" in again


def test_fanuc_as_printed() -> None:
    """Oracle: B-63980EN/01, page 100: the values, and the sums that its figure draws. The sign is ours."""
    text = "3620 = 40\n3621 = 33\n3622 = 49\n3623 = 1\n3624 = 50.000\n"
    text += "".join(f"point {k} = {v:+d}\n" for k, v in FANUC.items())
    table = FORMATS["fanuc"].read(text, "manual", TableAxes("X", "X"))
    added = dict(zip(table.positions_mm.tolist(), (-table.forward_um).tolist(), strict=True))
    assert (added[-400.0], added[0.0], added[400.0]) == (0.0, 0.0, 0.0)
    assert max(added, key=added.__getitem__) == -250.0
    assert added[-250.0] == 4.0
    assert min(added.values()) == -1.0
    again = FORMATS["fanuc"].text(table)
    assert re.findall(r"point \d+ = (\S+)", again) == [f"{v:+d}" for v in FANUC.values()]


def test_fanuc_takes_the_magnification_that_the_steepest_section_needs() -> None:
    """Oracle: by hand: 15 µm in a section are 7 x 3 and not 7 x 2; the roundings do not add up."""
    form = FORMATS["fanuc"]
    positions = 10.0 * np.arange(-2.0, 4.0)
    errors = np.array([-30.0, -15.0, 0.0, 15.0, 16.0, 16.0])
    held = checked(CompensationTable("X", "X", positions, errors, errors), form)
    text = form.text(held)
    assert "3623 = 3" in text
    assert [int(v) for v in re.findall(r"point \d+ = (\S+)", text)] == [-5, -5, -5, 0, 0]
    steep = CompensationTable("X", "X", positions, 100 * errors, errors)
    with pytest.raises(ConfigError, match="700 µm in a section"):
        checked(steep, form)


def test_fanuc_both_directions_have_the_backlash_at_the_reference() -> None:
    """Oracle: by hand: the backlash of 4 µm at position 0 is parameter 3627, as what is added: -4."""
    form = FORMATS["fanuc-both"]
    positions = 50.0 * np.arange(-1.0, 3.0)
    table = CompensationTable("X", "X", positions, np.array([3.0, 0, 2, 1]), np.array([7.0, 4, 7, 5]))
    text = form.text(checked(table, form))
    assert "3627 = -4" in text
    assert "3626 = 129" in text
    assert [int(v) for v in re.findall(r"point 12\d = (\S+)|point 13\d = (\S+)", text)[0] if v] == [3]
    back = form.read(text, "x", TableAxes("X", "X"))
    assert back.backward_um.tolist() == table.backward_um.tolist()


@pytest.mark.parametrize("name", ["isg-crosscomp2", "fanuc", "heidenhain-old"])
@pytest.mark.parametrize("travel", [(-123.4, 567.8), (-900.0, -100.0), (30.0, 401.5)])
def test_a_step_that_does_not_divide_the_travel(name: str, travel: tuple[float, float]) -> None:
    """Law: within the travel the table is right at its points and at the ends of the travel, whatever lies beyond."""
    axes = tuple(replace(a, travel_mm=travel) for a in MACHINE.axes)
    model, form = replace(random_model(5), machine=replace(MACHINE, axes=axes)), FORMATS[name]
    moves, corrects, second = table_axes(model.machine, OF.get(name, "X"))
    grid, across = grids_mm(form, moves, second, 27.0)
    assert grid[0] <= travel[0]
    assert grid[-1] >= travel[1]
    table = table_of(model, moves, corrects, grid, conditions(model, moves, AT), None, second, across)
    inside = np.array([q for q in grid if travel[0] <= q <= travel[1]] + list(travel))
    y = travel[1] if second else 0.0
    at = {**conditions(model, moves, AT), **({second.name: y} if second else {})}
    true = table_of(model, moves, corrects, np.sort(inside), at).forward_um
    if second:  # relative to the middle of both axes, not of the first alone
        middle = {second.name: 0.5 * sum(second.travel_mm)}
        here = [0.5 * sum(moves.travel_mm)]
        absolute = table_of(model, second, corrects, np.array([middle[second.name], y]), {**at, moves.name: here[0]})
        true = true + absolute.error_um(np.array([y]), 1.0) - absolute.error_um(np.array([middle[second.name]]), 1.0)
    assert table.error_um(np.sort(inside), 1.0, y) == pytest.approx(true, abs=1e-9)


def test_temperature_coefficients_are_the_models_own() -> None:
    """Oracle: the model's expansion: 11.5 µm/m·°C of T_x along X, nothing at position 0, and nothing of T_y."""
    axis = MACHINE.axis("X")
    form = FORMATS["siemens"]
    table = checked(predicted(MODEL, "siemens", "X", 10.0), form)
    (line,) = with_heat(MODEL, table).heat
    assert (line.sensor, line.reference_mm) == ("T_x", 0.0)
    assert line.slope_um_per_m == pytest.approx(11.5, rel=1e-6)
    assert abs(line.offset_um) < 1e-6
    assert line.residual_um < 1e-6
    text = form.text(with_heat(MODEL, table))
    assert "SD43910 $SA_TEMP_COMP_SLOPE[X1] +0.000011500" in text
    assert form.read(text, "x", TableAxes("X", "X")).forward_um == pytest.approx(table.forward_um, abs=1e-3)
    warm = table_of(MODEL, axis, axis, table.positions_mm, {**table.at, "T_x": 31.0})
    now = table_of(MODEL, axis, axis, table.positions_mm, table.at)
    assert warm.forward_um - now.forward_um == pytest.approx(5 * 11.5e-3 * table.positions_mm, abs=1e-6)


def test_a_plane_says_what_lies_between_its_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: the finer the squares, the less there is between them; rounding and direction stay."""
    look_at_few_places(monkeypatch, per_step=10)
    model = random_model(7)
    warmth = {*MACHINE.sensor_names, "spindle_rpm", "time_s"}
    model = replace(model, effects=tuple(f for f in model.effects if not warmth & set(f.effect.channels(MACHINE))))
    by_step = {}
    for step in (50.0, 8.0):
        table = checked(predicted(model, "isg-crosscomp2", "EZXY", step), FORMATS["isg-crosscomp2"])
        by_step[step] = {r.what.split()[0]: r.largest_um for r in residuals(model, table)}
    assert by_step[8.0]["between"] < 0.5 * by_step[50.0]["between"]
    assert by_step[8.0]["at"] <= 0.06
    assert "Y" not in by_step[8.0]
    assert "Z" in by_step[8.0]


def test_a_table_between_axes_adds_to_the_one_of_the_corrected_axis() -> None:
    """Oracle: the model: Y's own table and the one of Y along X together are Y's error at a pose with Z at its middle,
    but for the direction of X."""
    model = random_model(3)
    x, y = MACHINE.axis("X"), MACHINE.axis("Y")
    at = conditions(model, y, AT)
    places = np.array([-70.0, 0.0, 40.0])
    own = table_of(model, y, y, places, at)
    cross = table_of(model, x, y, np.array([-60.0, 0.0, 80.0]), conditions(model, x, AT))
    assert cross.error_um(np.array([0.0]), 1.0) == pytest.approx([0.5 * (cross.forward_um - cross.backward_um)[1]])
    pose = table_of(model, y, y, np.array([0.0, 1.0]), {**at, "X": 80.0})
    both = own.error_um(np.array([0.0]), 1.0) + cross.error_um(np.array([80.0]), 1.0)
    assert both == pytest.approx(pose.forward_um[:1], abs=0.5 * abs(cross.forward_um - cross.backward_um).max() + 1e-9)
    assert abs(pose.forward_um[0] - own.forward_um[1]) > 1.0


@pytest.mark.parametrize(
    ("name", "component", "says"),
    [
        ("siemens", "EYX", "no tables between axes"),
        ("isg", "EZXY", "no tables over two axes"),
        ("isg-crosscomp", "X", "write --cross, as EYX"),
        ("isg-crosscomp2", "EYX", "write --cross EZXY"),
    ],
)
def test_what_a_format_has_no_table_for(name: str, component: str, says: str) -> None:
    moves, corrects, second = table_axes(MACHINE, component)
    grid = np.linspace(-100.0, 100.0, 5)
    across = grid if second else np.zeros(0)
    table = table_of(MODEL, moves, corrects, grid, conditions(MODEL, moves, AT), None, second, across)
    with pytest.raises(ConfigError, match=says):
        checked(table, FORMATS[name])


@pytest.mark.parametrize("name", sorted(FORMATS))
def test_a_table_cut_off_anywhere_is_refused(name: str) -> None:
    """Law: no half of a file is read as a whole table. (A COMP_FILE cut in its points is a shorter one, as LinuxCNC
    itself sees it.)"""
    form, component = FORMATS[name], OF.get(name, "X")
    moves, corrects, second = table_axes(MACHINE, component)
    axes = TableAxes(moves.name, corrects.name, second.name if second else "")
    whole = checked(predicted(random_model(2), name, component, 25.0), form)
    text = form.text(whole).rstrip("\n")
    for cut in [*range(0, len(text) - 60, 7), *range(max(0, len(text) - 60), len(text))]:
        try:
            table = form.read(text[:cut], "half", axes)
        except ConfigError:
            continue
        if not name.startswith("linuxcnc") or cut > text.index(";"):
            assert table.forward_um == pytest.approx(whole.forward_um), cut


@pytest.mark.parametrize("name", sorted(FORMATS))
@pytest.mark.parametrize(
    "text",
    ["", "\0" * 50, "nan nan nan\n" * 9, "$AN_CEC[0,999999999999]=1e400\n", "x" * 100_000,
     "\x1b[2J = F(\x1b)\n", "=" * 99,
     "kw.crosscomp2.table[9999999][0].correction 1e999\n", "point 1 = 99\n3624 = inf\n", "NR AXISPOS\n[END]\n"],
)  # fmt: skip
def test_hostile_text_is_one_message(name: str, text: str) -> None:
    """Law: a ConfigError that names the file, without control characters, of two lines at most."""
    second = "Y" if name == "isg-crosscomp2" else ""
    with pytest.raises(ConfigError) as error:
        FORMATS[name].read(text, "file", TableAxes("X", "Z", second))
    said = str(error.value)
    assert said.startswith("file: ")
    assert len(said) < 300
    assert said.isprintable()


def test_the_command_writes_and_reads_a_plane(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Oracle: the same model differs from its own table by the rounding; what the table leaves is not asked here."""
    look_at_few_places(monkeypatch)
    out, model = tmp_path / "z.lis", str(CONFIGS / "mill-model.toml")
    of = ["--axis", "X", "--cross", "EZXY", "--format", "isg-crosscomp2", "--at", "T_x=26,T_y=25,T_z=24"]
    assert status(["table", model, *of, "--grid", "20", "-o", str(out)]) == 0
    assert "axis Z over X and Y, 11 x 11 points" in " ".join(capsys.readouterr().out.split())
    assert status(["table", "read", str(out), "--model", model, *of]) == 0
    assert "differs from it by up to 0.0" in " ".join(capsys.readouterr().out.split())
    assert status(["table", "read", str(out), *of[:6]]) == 0
    assert '"second": "Y"' in capsys.readouterr().out


def test_a_table_that_ends_before_the_travel_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    short, model = tmp_path / "x.comp", str(CONFIGS / "mill-model.toml")
    short.write_text("-50 -50.01 -50.01\n50 50.01 50.01\n")
    assert status(["table", "read", str(short), "--axis", "X", "--model", model, "--at", "T_x=26,T_y=25,T_z=24"]) == 0
    assert "covers -50 to 50 mm of the travel, -100 to 100 mm" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("at", "says"),
    [
        ("T_x=nan,T_y=24,T_z=20", "outside the machine's own range, 5 to 70"),
        ("T_x=inf,T_y=24,T_z=20", "outside the machine's own range"),
        ("T_x=1e9,T_y=24,T_z=20", "outside the machine's own range"),
        ("T_x=26,T_y=24,T_z=20,Y=101", "outside the machine's own range, -100 to 100"),
        ("T_x=26,T_y=24,T_z=20,spindle_rpm=-1", "outside the machine's own range, 0"),
    ],
)
def test_conditions_that_cannot_be_make_no_table(
    at: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Law: no table of a temperature that no sensor of the machine can show, and none of no number."""
    out = tmp_path / "x.eec"
    model = str(CONFIGS / "mill-model.toml")
    assert status(["table", model, "--axis", "X", "--at", at, "--format", "siemens", "-o", str(out)]) == 2
    assert says in " ".join(capsys.readouterr().err.split())
    assert not out.exists()


@pytest.mark.parametrize("name", ["siemens", "fanuc", "heidenhain-old"])
def test_a_step_longer_than_the_travel_is_the_travel(name: str) -> None:
    """Law: no point lies farther beyond the travel than the travel is long."""
    grid, _ = grids_mm(FORMATS[name], MACHINE.axis("X"), None, 1e9)
    assert 2 <= len(grid) <= 3 or name == "heidenhain-old"
    assert np.abs(grid).max() <= 300.0


def test_what_is_no_file_of_a_table_is_one_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A FIFO keeps nobody waiting, a huge file fills no memory; letters of older controls in a comment are read."""
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "huge").write_bytes(b"\n" * (5 << 20))
    (tmp_path / "other.lis").write_text(
        FORMATS["isg"].text(FORMATS["siemens"].read(SINUMERIK, "x", TableAxes("X", "X")))
    )
    for name, says in (
        ("fifo", "no plain file"),
        ("huge", "more than 4 MB"),
        ("none", "no such file"),
        ("other.lis", "is no value of $AA_ENC_COMP"),
    ):
        assert status(["table", "read", str(tmp_path / name), "--axis", "X", "--format", "siemens"]) == 2
        assert says in " ".join(capsys.readouterr().err.split())
    old = tmp_path / "old.eec"
    old.write_bytes(SINUMERIK.replace("\n", "\r\n").encode("latin-1"))
    assert status(["table", "read", str(old), "--axis", "X", "--format", "siemens"]) == 0

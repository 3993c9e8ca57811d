"""What `rtec effects` tells: words, data, the drawing on the terminal and the picture."""

import json
import re
import struct
from pathlib import Path

import numpy as np
import pytest

from rtec.cli.main import status
from rtec.diagnosis.words import spoken
from rtec.effects import EFFECTS
from rtec.effects.base import DRIVES
from rtec.effects.registry import FAMILIES
from rtec.effects.time_data import NOT_EFFECTS
from rtec.metrology.instruments.registry import INSTRUMENTS
from rtec.report import effects as effects_page
from rtec.report import effects_figures as effects_figure
from rtec.report.effects_figures import POINTS, EffectCurve, EffectShape, example_machine, example_of, shape_of

ABOUTS = {**{name: kind.about for name, kind in EFFECTS.items()}, **NOT_EFFECTS}
OWN = {"expression"}
"""The user's: nothing is known about it beforehand."""
CATALOGUE = set(
    re.findall(
        r"\w+",
        """
    scale polynomial_position piecewise_position cyclic_screw coupling_misalignment interpolation_error cyclic_pole
    straightness squareness parallelism angular_motion guide_curvature guide_twist backlash backlash_position
    backlash_zone backlash_wear backlash_load backlash_temperature angular_reversal servo_lag servo_phase change_over
    lost_motion reversal_spike stribeck guide_lift inertia axis_expansion mount_expansion axis_expansion_nonuniform
    spindle_growth spindle_speed_shift spindle_tilt column_tilt bed_bending ambient_drift coolant_expansion ram_sag
    cross_talk load_deformation force_deflection daily_drift wear_drift missed_counts centre_offset instrument_drift
    outliers
""",
    )
)
"""The rows of the catalogue, typed in."""

CONSTANT = {"squareness", "parallelism", "backlash", "angular_reversal"}
"""Their shape is a level line, or one for each direction."""

each_entry = pytest.mark.parametrize("name", ABOUTS)
each_drawn = pytest.mark.parametrize("name", [n for n in EFFECTS if n not in OWN])


def test_every_row_of_the_catalogue_is_there() -> None:
    """Oracle: the list above; those that a model can hold and those that it cannot."""
    assert set(ABOUTS) == CATALOGUE | {"expression"}
    assert set(NOT_EFFECTS) == {"centre_offset", "instrument_drift", "outliers"}
    assert sorted(n for names in FAMILIES.values() for n in names) == sorted(EFFECTS)


@each_entry
def test_what_is_said_is_whole(name: str) -> None:
    """Each names its confusions, and for each an experiment; names are those of the catalogue and the instruments."""
    about = ABOUTS[name]
    assert all((about.title, about.equation, about.typical, about.source))
    assert set(about.seen_by) <= set(INSTRUMENTS)
    if name in OWN:
        return
    assert about.reveal
    assert about.confusions
    for c in about.confusions:
        assert c.effect in ABOUTS
        assert c.effect != name
        assert c.why
        assert c.separate_by
    assert len({c.effect for c in about.confusions}) == len(about.confusions)


@pytest.mark.parametrize("name", EFFECTS)
def test_what_it_needs_is_named(name: str) -> None:
    """`driven_by` uses words that can be asked for; an effect that feeds nothing is the user's or one of a pair."""
    kind = EFFECTS[name]
    assert set(kind.driven_by) <= set(DRIVES)
    assert bool(kind.feeds) == (name not in OWN)


@each_entry
def test_a_page_of_each(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Everything that About says stands on the page, and the data are the same."""
    assert status(["effects", name]) == 0
    shown = re.sub(r"\s+", " ", capsys.readouterr().out)
    about = ABOUTS[name]
    assert f"{name}: {about.title}" in shown
    assert about.equation.split(",")[0] in shown
    for c in about.confusions:
        assert c.effect in shown
        assert c.separate_by.split()[0] in shown
    assert status(["effects", name, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)[name]
    assert facts["equation"] == about.equation
    assert [c["separate_by"] for c in facts["confusions"]] == [c.separate_by for c in about.confusions]
    assert facts["in_a_model"] == (name in EFFECTS)
    assert bool(facts["parameters"]) == (name in EFFECTS and name not in OWN)


def test_the_table_of_all(capsys: pytest.CaptureFixture[str]) -> None:
    assert status(["effects"]) == 0
    shown = capsys.readouterr().out
    for name in (*ABOUTS, *FAMILIES, effects_page.NO_EFFECTS):
        assert name in shown
    assert f"{len(EFFECTS)} effects" in shown


def test_arguments_are_all_explained() -> None:
    fields = {f for kind in EFFECTS.values() for f in kind.model_fields} - {"effect"}
    assert fields == set(effects_page.ARGUMENTS)


@each_drawn
def test_every_effect_has_a_shape(name: str) -> None:
    """Finite, not flat unless the effect is a constant, of the unit of its component, and it says what was held."""
    shape = shape_of(EFFECTS[name])
    assert shape is not None
    assert shape.x.shape == (POINTS,)
    assert np.all(np.diff(shape.x) > 0)
    assert 1 <= len(shape.curves) <= len(effects_figure.DASHES)
    assert len({c.held for c in shape.curves}) == len(shape.curves)
    for curve in shape.curves:
        assert curve.error.shape == (POINTS,)
        assert np.all(np.isfinite(curve.error))
    size = max(np.abs(c.error).max() for c in shape.curves)
    assert size > 0.1
    if name not in CONSTANT:
        assert max(np.ptp(c.error) for c in shape.curves) > 0.3 * size
    assert shape.unit == ("µrad" if shape.component[1] in "ABC" else "µm")
    assert shape.component in example_machine().components
    assert shape.sizes


def test_shapes_that_are_known_by_heart() -> None:
    """Oracles: values worked out by hand from the equations and the sizes that the drawing names."""
    scale = shape_of(EFFECTS["scale"])
    assert scale is not None
    assert scale.sizes == "k = 20 µm/m"
    assert scale.curves[0].error[-1] == pytest.approx(20 * 0.4)
    lost = shape_of(EFFECTS["lost_motion"])
    assert lost is not None
    assert [c.error[0] for c in lost.curves] == pytest.approx([2.0, -2.0])
    assert [np.interp(2.0, lost.x, c.error) for c in lost.curves] == pytest.approx([2 / np.e, -2 / np.e], rel=1e-3)
    growth = shape_of(EFFECTS["spindle_growth"])
    assert growth is not None
    top = 3.0 * 3.0 * (1.0 - np.exp(-0.45 * 4.0 / 0.5))  # 3 µm at 1000/min, 3000/min for 0.45 of 4 h, τ half an hour
    assert growth.curves[0].error.max() == pytest.approx(top, rel=0.01)
    assert growth.curves[0].error[0] == 0.0


def line_shape(*errors: np.ndarray) -> EffectShape:
    names = ("up", "down", "third")
    return EffectShape("EXX", "µm", "x, mm", np.linspace(0, 1, 97), tuple(map(EffectCurve, names, errors)), "A = 1 µm")


def dots(lines: list[str]) -> np.ndarray:
    """Rows and columns of a braille drawing back from its characters."""
    body = [line.split("┤")[1] for line in lines if "┤" in line]
    codes = np.array([[ord(c) - 0x2800 for c in line] for line in body])
    out = np.zeros((4 * codes.shape[0], 2 * codes.shape[1]), dtype=bool)
    order = ((0, 0, 1), (1, 0, 2), (2, 0, 4), (3, 0, 64), (0, 1, 8), (1, 1, 16), (2, 1, 32), (3, 1, 128))
    for row, column, bit in order:  # the numbering of the dots in the Unicode standard
        out[row::4, column::2] = (codes & bit) > 0
    return out


def test_the_drawing_is_the_curve() -> None:
    """Oracle: the straight line from corner to corner, dot by dot; and its scale."""
    lines = effects_figure.sketch(line_shape(np.linspace(0.0, 5.0, 97)), columns=20, rows=5)
    drawn = dots(lines)
    assert drawn.shape == (20, 40)
    rows = np.array([np.flatnonzero(drawn[:, k]).mean() for k in range(40)])
    np.testing.assert_allclose(rows, np.linspace(19, 0, 40), atol=0.75)
    assert lines[1].split()[0] == "5"
    assert lines[5].split()[0] == "0"
    assert "EXX, µm" in lines[0]
    assert lines[7].split() == ["0", "x,", "mm", "1"]


def test_a_step_is_joined_and_further_curves_are_broken() -> None:
    """Oracle: every column of the first curve has a dot; the second has gaps."""
    step = np.where(np.arange(97) > 48, 4.0, -4.0)
    drawn = dots(effects_figure.sketch(line_shape(step), columns=20, rows=4))
    assert drawn.any(axis=0).all()
    assert drawn.all(axis=1).sum() == 0
    assert drawn[:, 18:22].any(axis=1).all(), "the step itself, from bottom to top"
    both = effects_figure.sketch(line_shape(np.full(97, 4.0), np.full(97, -4.0)), columns=20, rows=4)
    assert dots(both)[0].all()
    assert 0 < dots(both)[-1].sum() < 40
    assert "up" in both[-1]
    assert "down" in both[-1]


def test_a_curve_of_nothing_is_drawn_at_zero() -> None:
    drawn = dots(effects_figure.sketch(line_shape(np.zeros(97)), columns=10, rows=3))
    assert drawn.any(axis=0).all()
    assert drawn.sum() == 20


@pytest.mark.parametrize("name", ["cross_talk", "daily_drift"])
def test_the_picture(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the head of a PNG file: its signature, and a size that is read at arm's length."""
    path = tmp_path / "shape.png"
    assert status(["effects", name, "--figure", str(path)]) == 0
    assert f"Figure: {path}" in capsys.readouterr().out.replace("\n", "")
    head = path.read_bytes()[:24]
    assert head[:8] == b"\x89PNG\r\n\x1a\n"
    wide, high = struct.unpack(">II", head[16:24])
    assert wide == 1100
    assert high >= 400


def test_pictures_that_cannot_be(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, said in (
        (["--figure", str(tmp_path / "a.png")], "--figure draws one effect; name it"),
        (["expression", "--figure", str(tmp_path / "a.png")], "effect 'expression' has no shape of its own"),
        (["outliers", "--figure", str(tmp_path / "a.png")], "effect 'outliers' has no shape of its own"),
        (["scale", "--figure", str(tmp_path / "no" / "a.png")], "a.png: cannot be written: No such file"),
    ):
        assert status(["effects", *arguments]) == 2
        assert said in capsys.readouterr().err.replace("\n", " ")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("unit", "said"),
    [
        ("um", "µm"),
        ("um_per_m_degc", "µm/(m·K)"),
        ("urad_per_h", "µrad/h"),
        ("um_s_per_mm", "µm·s/mm"),
        ("urad_s2_per_m", "µrad·s²/m"),
        ("um_per_krpm_to_p", "µm/(1000/min)^p"),
        ("um_per_krpm2", "µm/(1000/min)²"),
        ("um_per_100kg", "µm/(100 kg)"),
        ("1", ""),
    ],
)
def test_units_as_people_write_them(unit: str, said: str) -> None:
    assert spoken(unit) == said


def test_equations_and_words_hold_no_letter_that_the_font_lacks() -> None:
    """Oracle: the font's own table of letters; a missing one would be a box in the picture."""
    from matplotlib import font_manager

    known = set(font_manager.get_font(font_manager.findfont("DejaVu Sans")).get_charmap())
    for about in ABOUTS.values():
        assert {ord(c) for c in about.title + about.equation} <= known


PAGE = Path(__file__).parents[2] / "docs" / "effects.md"


def test_the_page_in_docs_is_the_catalogue() -> None:
    """Oracle: the registry. After a change of an effect, put what `catalogue_markdown()` gives in its place."""
    text = PAGE.read_text(encoding="utf-8")
    assert text.endswith(effects_page.catalogue_markdown())
    drawn = [line.rstrip() for line in effects_figure.sketch_of("reversal_spike")]
    assert "\n".join(drawn) in text


def test_the_commands_in_docs_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    commands = re.findall(r"^(?:\$ )?rtec (effects.*?)(?: +#.*)?$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert len(commands) == 4
    for command in commands:
        assert status(command.split()) == 0
    assert (tmp_path / "spike.png").exists()
    assert capsys.readouterr().out


def test_what_the_loop_refuses_is_named_in_docs() -> None:
    """Oracle: the channels that the effects read on the example machine."""
    machine = example_machine()
    examples = {n: example_of(kind, machine) for n, kind in EFFECTS.items()}
    of_time = {n for n, e in examples.items() if e is not None and "time_s" in e.channels(machine)}
    (said,) = re.findall(r"those of the time \((.*?)\)", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert set(re.findall(r"`(\w+)`", said)) == of_time


def test_the_parameters_of_every_form_are_in_the_table() -> None:
    """Oracle: the effects that the catalogue itself tries, in all their forms; their parameters by name."""
    machine = example_machine()
    for name, kind in EFFECTS.items():
        forms = list(effects_figure._instances(kind, machine))
        tried = {p.name for e in forms for p in e.nonlinear(machine)}
        page = effects_page.effect_page(name)
        rows = [row for s in page.sections if s.heading == "Parameters" and s.table for row in s.table.rows]
        assert tried <= {row[0] for row in rows}, name
    assert ("T", "s", "0.05", "0.002 … 2", "searched for, with builds_up = true") in [
        row for s in effects_page.effect_page("servo_lag").sections if s.table for row in s.table.rows
    ]

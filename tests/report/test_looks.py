"""Words, units and figures of the diagnosis: what a first-time user stumbled over."""

import csv
import json
import math
import re
import shlex
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from numpy.typing import NDArray

from rtec.cli.common import print_table
from rtec.cli.main import status
from rtec.cli.screen import Console
from rtec.diagnosis import words
from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.result import Alike, Diagnosis, Finding
from rtec.diagnosis.search.diagnose import diagnose
from rtec.diagnosis.words import named, spoken, titled
from rtec.machine import load_machine
from rtec.metrology.instruments.registry import make_instrument
from rtec.model import FittedEffect, Model, save_model
from rtec.report.compare import compare_page
from rtec.report.diagnosis import _next, diagnosis_page
from rtec.report.figures import as_png, canvas
from rtec.report.page import Table
from rtec.sim.campaign.campaign import simulate
from rtec.sim.campaign.settings import Settings
from tests.diagnosis.test_compare import SCALE, model
from tests.report.test_compare_report import TILT, angular
from tests.support.diagnosis_examples import QUICK, effects, laser, small_machine, write_laser, write_machine

Floats = NDArray[np.float64]
TURN = "angular_reversal,component=EBX,axis=X,theta=12"
PLAY = "backlash,component=EXX,axis=X,B=5"


@pytest.mark.parametrize(
    ("channel", "said"),
    [
        ("x", "X, mm"),
        ("s_y", "distance since Y turned round, mm"),
        ("v_x", "velocity of X, mm/s"),
        ("T_bed", "T_bed, °C"),
        ("spindle_rpm", "spindle speed, rpm"),
    ],
)
def test_axes_of_figures_are_named_for_people(channel: str, said: str) -> None:
    """Oracle: by hand."""
    assert titled(channel) == said


def test_units_and_names_for_people() -> None:
    """Oracle: by hand; a sensor may have any name where its unit is known."""
    assert [spoken(u) for u in ("um_per_m_degc", "degC", "mm/s2", "1")] == ["µm/(m·K)", "°C", "mm/s²", ""]
    assert (named("x"), named("T_bed"), titled("bed", "degC")) == ("X", "T_bed", "bed, °C")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("backlash(EXX, X) is missing", "backlash(EXX, X) is missing."),
        ("ccw reading_um: 3 single readings", "ccw reading_um: 3 single readings."),
        ("one of backlash(EXX, X), scale(EXX) is missing", "One of backlash(EXX, X), scale(EXX) is missing."),
        ("temperatures are smoothed.", "Temperatures are smoothed."),
    ],
)
def test_names_keep_their_case_at_the_head_of_a_sentence(text: str, said: str) -> None:
    """Oracle: by hand."""
    assert words.sentence(text) == said


@pytest.mark.parametrize(
    ("times", "said"),
    [
        (1.1, "as likely as rank 1"),
        (43.0, "43 times less likely than rank 1"),
        (3.4e6, "over a million times less likely than rank 1"),
        (1e40, "over a million times less likely than rank 1"),
    ],
)
def test_odds_in_words(times: float, said: str) -> None:
    """Oracle: by hand."""
    assert words.why_not(0.0, math.log(times), 1.0, same=False) == said


def test_nothing_of_a_table_is_cut() -> None:
    """Oracle: the letters of the cells themselves; where there is room, words stay whole."""
    name, why = "backlash_temperature(EXX, X, T_spindle_front)", "over a million times less likely than rank 1"
    row = ["1", name, "k 0.39 ± 0.02 µm/K; tau 3 s", "1.4", why]
    for width in (60, 80, 110):
        console = Console(width=width, file=StringIO())
        print_table(Table(("", "effect", "numbers", "size", "why"), [row], words=(1, 2, 4)), console)
        shown = console.file.getvalue()  # type: ignore[attr-defined]
        assert max(map(len, shown.splitlines())) <= width
        letters = Counter("".join("".join(row).split()))
        assert not letters - Counter(shown)
    assert "backlash_temperature(EXX," in shown


def test_both_ways_apart_everywhere_is_said_plainly() -> None:
    """Oracle: the play put in, 5 µm; no list of places."""
    c = compare(model(SCALE), [laser([SCALE, PLAY], 7)])
    (region,) = c.items[0].worst
    assert region.apart is not None
    # Going + the slide stays behind or runs ahead as the effect defines it: the size is what was put in.
    assert abs(region.apart) == pytest.approx(5.0, abs=0.15)
    assert re.search(
        r"moving \+ and moving − differ by (4\.9\d|5\.0\d) µm everywhere",
        compare_page(c, figures=False).lead,
        re.IGNORECASE,
    )


def test_a_quiet_reading_that_noise_makes_no_better_hides_no_bad_one() -> None:
    """Oracle: of two measurements one has an error of 0.02 µm less than the model says, the other one of 8 µm."""
    small = "scale,component=EZZ,axis=Z,k=0.4"
    known = Model(small_machine(), effects(SCALE, small), name="known")
    quiet, loud = laser([], 21, along="Z"), laser([SCALE.replace("k=40", "k=120")], 22)
    c = compare(known, [quiet, loud])
    item = next(i for i in c.items if i.name == quiet.name)
    worse = replace(item, explained=-0.3)
    page = compare_page(replace(c, items=(worse, *(i for i in c.items if i is not item))), figures=False)
    assert page.lead.startswith(f"{loud.name}: the residual is")
    assert page.numbers[0][1] == f"measured in {loud.name}"
    assert "larger than without one" not in page.lead + str(page.sections)


def test_play_that_changes_along_the_way_is_no_gap_everywhere() -> None:
    """Oracle: a play of 5 µm on half of the way, put in by hand."""
    m = laser([SCALE], 8)
    half = np.where(m.channels["x"] > 100.0, 2.5, 0.0) * m.state().value("d_x")
    m.readings["reading_um"][:] += half
    c = compare(model(SCALE), [m])
    assert c.items[0].worst
    assert all(r.apart is None for r in c.items[0].worst)


def test_the_worst_measurement_is_the_verdict_and_each_has_its_row() -> None:
    """Oracle: a model whose tilt has the wrong sign is worse than none; the scale of the other one is right."""
    tilted = angular(3)
    wrong = Model(small_machine(), effects(TILT.replace("k=30", "k=-30"), SCALE), name="wrong")
    page = compare_page(compare(wrong, [laser([SCALE], 4), tilted]))
    assert page.lead.startswith("tilt: the residual is")
    assert "With the model the error is larger than without one." in page.lead
    assert page.lead.endswith("The other residual is in the table.")
    assert page.first_figure is not None
    assert page.first_figure.name.startswith("tilt-")
    assert page.brief is not None
    assert page.brief.table is not None
    assert [row[0] for row in page.brief.table.rows] == ["laser-x-4", "tilt"]


TRUE = {
    "hump": lambda x: 8.0 * np.exp(-(((x - 120.0) / 20.0) ** 2)),
    "wave": lambda x: 4.0 * np.sin(2.0 * np.pi * x / 63.0 + 0.7) * (x / 100.0),
}


@pytest.mark.parametrize(("others", "command"), [((), "add"), (("backlash",), "plan")])
def test_forms_of_one_effect_are_no_rivals_to_plan_for(others: tuple[str, ...], command: str) -> None:
    """Oracle: a plan separates effects of different names; where there is one, the sentence says to add it."""
    scale, play = effects(SCALE, PLAY)
    of = {"scale": FittedEffect(scale.effect, {}), "backlash": FittedEffect(play.effect, {})}
    alikes = [Alike(name, "EXX", "the same shape", "", fitted=of[name]) for name in ("scale", "scale", *others)]
    first = Finding(1, scale.effect, {}, {}, ("x",), 0.9, 0.99, 50.0, 0.001, 3.0, True, True, tuple(alikes))
    made = Diagnosis("ambiguous", "said", "um", 3.0, 0.3, 1.0, (first,), None, (), (), (), ())
    there = replace(made, files=(Path("m.toml"), Path("x.csv")), machine_file=Path("my machine.toml"))
    (line,) = diagnosis_page(there, figures=False).next
    assert line.startswith(f"rtec {command} ")
    assert not others or line == "rtec plan 'my machine.toml' x.csv --rivals scale:EXX,backlash:EXX --noise 0.3"
    # What is no candidate of the catalogue cannot be written: then nothing is, and the sentence says what to do.
    odd = replace(
        first, confused_with=(*alikes[:2], Alike("cyclic_screw", "EXX", "of another pitch", "read the pitch"))
    )
    assert diagnosis_page(replace(there, findings=(odd,)), figures=False).next == []


@pytest.mark.parametrize("kind", list(TRUE))
def test_the_printed_command_runs_and_lowers_the_error(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Oracle: the shape put in by hand, and what `rtec add` says of the error on held-out runs."""
    write_machine(tmp_path)
    table = write_laser(tmp_path, [SCALE], 5, targets={"step_mm": 9.3})
    with_shape(table, TRUE[kind])
    first = tmp_path / "first.toml"
    save_model(model(SCALE, machine=load_machine(tmp_path / "machine.toml")), first)
    capsys.readouterr()
    assert status(["diagnose", str(first), str(table), "--only", "scale"]) == 0
    printed = capsys.readouterr().out
    command = next(line.removeprefix("Next: ") for line in printed.splitlines() if line.startswith("Next: rtec add"))
    if kind == "hump":
        assert re.search(r"hump at X ≈ 1(19|20|21)(\.\d|) mm, about 3[2-5] mm\s+wide", " ".join(printed.split()))
    assert status([*shlex.split(command)[1:], "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["after"]["held_out"] < 0.5 * facts["before"]["held_out"]


def test_a_searched_period_is_added_by_the_command_that_keeps_it() -> None:
    """Oracle: `rtec add` takes no period; `rtec improve` begins with the diagnosis."""

    def command(text: str, theta: dict[str, float]) -> str:
        (fitted,) = effects(text)
        first = SimpleNamespace(effect=fitted.effect, theta=theta, partner=None)
        d: Any = SimpleNamespace(
            files=(Path("m.toml"), Path("d.csv")),
            verdict="missing_effect",
            findings=(first,),
            together=(),
            machine_option=(),
            refits_changed=False,
        )
        return _next(d)[0]

    assert command("cyclic_pole,component=EXX,axis=X,period=43.7,s=3,c=0", {"period": 43.7}).startswith("rtec improve ")
    assert command("scale,component=EXX,axis=X,k=3", {}).startswith("rtec add ")


def with_shape(table: Path, shape: Callable[[Floats], Floats]) -> None:
    """Add a shape to the readings in a table."""
    with table.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        row["reading_um"] = str(float(row["reading_um"]) + float(shape(np.array(float(row["x_mm"])))))
    with table.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def test_figures_of_several_measurements_show_each() -> None:
    """Oracle: a tilt that an angular laser reads directly and a linear one through its offset beam: two panels."""
    beside = laser([TURN], 9, setup={"beam_offset_mm": [0.0, 0.0, 300.0]})
    about = make_instrument("laser_angular", {}, "X", "EBX", small_machine(), "test")
    tilt = simulate(model(TURN), about, Settings.model_validate(QUICK), 10, "tilt")
    d = diagnose(Model(small_machine(), name="empty"), [tilt, beside])
    assert d.picture is not None
    titles = [p.title for p in (d.picture, *d.picture.others)]
    assert {t.rsplit(", in ", 1)[1] for t in titles} == {"tilt", "laser-x-9"}
    page = diagnosis_page(d)
    assert any(s.figure is not None and s.figure.name == "evidence.png" for s in page.sections)


@pytest.mark.parametrize("columns", [1, 2])
def test_a_long_title_is_whole(columns: int) -> None:
    """Oracle: the words that went in, and the edges of the picture."""

    @as_png
    def draw() -> Figure:
        figure = canvas(4.0)
        for ax in np.atleast_1d(figure.subplots(1, columns)):
            ax.set_title("axis_expansion_nonuniform(EXX, X, T_x_nut - T_headstock), in 2026-03-09 laser of the X axis")
            ax.plot([0.0, 1.0], [-5e-5, 5e-5])
        return figure

    figure = draw().figure
    figure.draw_without_rendering()
    for ax in figure.axes:
        title = next(t for t in ax.findobj(Text) if t.get_text().startswith("axis_"))
        assert " ".join(title.get_text().split()).endswith("in 2026-03-09 laser of the X axis")
        assert title.get_window_extent().x1 <= figure.bbox.x1
        assert not ax.yaxis.get_offset_text().get_text()

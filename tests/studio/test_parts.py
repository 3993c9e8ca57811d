"""Numbers as people type them, and what is drawn of very many readings."""

import json
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.errors import RtecError
from rtec.report import thinning
from rtec.report.evidence import Curve, Evidence
from rtec.studio.pages.compare import colours
from rtec.studio.parts import figures
from rtec.studio.parts.controls import from_home, number
from rtec.tasks.model import DIRECTION, SeriesView


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("12.5", 12.5), ("12,5", 12.5), ("-0,3", -0.3), ("−2", -2.0), ("1.234,5", 1234.5), ("1,234.5", 1234.5),
        ("1.234.567", 1234567.0), ("1,234,567", 1234567.0), ("1 234,5", 1234.5), ("3e-2", 0.03), (",5", 0.5),
        ("1.234", 1.234), ("1,234", 1.234),
    ],
)  # fmt: skip
def test_numbers_are_read_in_german_and_in_english(text: str, value: float) -> None:
    """Oracle: DIN 1333 and English usage; one mark alone is the decimal one."""
    assert number(text) == value


@pytest.mark.parametrize("text", ["", "abc", "1,2,3", "1.2.3", "12a", "nan", "inf", "1,23.4,5", "--1"])
def test_what_is_no_number_is_refused(text: str) -> None:
    """With the text and an example."""
    with pytest.raises(RtecError, match="is no number, for example"):
        number(text)


def _many(n: int) -> SeriesView:
    rng = np.random.default_rng(1)
    x = rng.uniform(0.0, 500.0, n)
    measured = rng.normal(0.0, 1.0, n)
    measured[7] = 40.0
    ones = np.ones(n, dtype=np.int64)
    return SeriesView("m", "µm", ones, ones, {"X, mm": x}, (), np.zeros(n), measured, np.zeros(n), 1.0, 1.0, 0)


def test_of_very_many_readings_so_many_are_drawn_that_none_stands_apart_unseen() -> None:
    """Oracle: a grid over the plot: no cell with readings is empty; no column is shorter by more than a cell."""
    many = _many(100_000)
    x, left = many.channels["X, mm"], many.residuals
    rows = thinning.drawn(many.residuals, x, left)
    assert len(rows) <= thinning.MOST
    assert 7 in rows

    def cells(some: NDArray[np.int64]) -> set[tuple[int, int]]:
        low, wide = (np.array([f(x), f(left)]) for f in (np.min, np.ptp))
        part = (np.stack([x[some], left[some]], axis=1) - low) / wide * [thinning.ACROSS, thinning.UP]
        return {(int(a), int(b)) for a, b in np.minimum(part, [thinning.ACROSS - 1, thinning.UP - 1])}

    assert cells(rows) == cells(np.arange(len(many)))
    column = np.floor(x / 500.0 * thinning.ACROSS).astype(int)
    for k in range(thinning.ACROSS):
        here = column[rows] == k
        assert np.abs(left[rows][here]).max() == np.abs(left[column == k]).max()


def test_every_plot_draws_the_same_even_sample() -> None:
    """So that what is marked in one plot is mostly seen in the others. Oracle: the readings that both draw."""
    many = _many(100_000)
    one, two = (
        thinning.drawn(many.residuals, v, many.residuals) for v in (many.channels["X, mm"], np.arange(100_000.0))
    )
    assert len(np.intersect1d(one, two)) > 0.9 * thinning.EVENLY


def test_no_plot_gets_all_of_very_many_readings() -> None:
    """Oracle: the lengths of what is sent, of which no plot gets more than the page moves fluently."""
    many = _many(100_000)
    hours = {"time since the first reading, h": np.arange(100_000) / 3600.0, "T_bed, °C": 20.0 + many.residuals}
    place = many.channels["X, mm"]
    s = replace(many, channels={**many.channels, "Y, mm": place[::-1], **hours}, sensors=("T_bed, °C",))
    made = {
        "residual": figures.residual_over(s, "X, mm"),
        "coloured": figures.residual_over(s, "X, mm", "T_bed, °C"),
        "measured": figures.residual_over(s, "X, mm", what="measured"),
        "time": figures.over_time(
            s, thinning.drawn(s.residuals, hours["time since the first reading, h"], s.residuals)
        ),
        "map": figures.residual_map(s, "X, mm", "Y, mm"),
        "polar": figures.polar(s, np.deg2rad(place), thinning.drawn(s.residuals, place, s.residuals)),
    }
    sent = {n: sum(len(t.get("x", t.get("r", []))) for t in f["data"]) for n, f in made.items()}
    assert {n: k for n, k in sent.items() if k > 2 * thinning.MOST} == {}
    assert {n: len(json.dumps(f)) for n, f in made.items() if len(json.dumps(f)) > 1_500_000} == {}


def test_a_plot_is_drawn_in_one_way_whatever_part_of_it_is_seen() -> None:
    """Few readings without WebGL, many with it. Oracle: the number of all readings, not that of those drawn."""
    for n, way in ((figures.SINGLY, "scatter"), (figures.SINGLY + 1, "scattergl")):
        for rows in (np.arange(n), np.arange(5)):
            made = figures.residual_over(_many(n), "X, mm", chosen=rows)
            assert {t["type"] for t in made["data"]} == {way}


def test_zoomed_in_every_reading_there_is_drawn() -> None:
    """Oracle: the readings in that box."""
    many = _many(100_000)
    x, left = many.channels["X, mm"], many.residuals
    rows = thinning.drawn(many.residuals, x, left, {"x": (100.0, 120.0), "y": (2.0, -1.0)})
    assert list(rows) == list(np.flatnonzero((x >= 100.0) & (x <= 120.0) & (left >= -1.0) & (left <= 2.0)))


def test_a_noise_that_is_not_known_yet_is_not_drawn() -> None:
    """Oracle: JSON, which has no NaN; and the band where the noise is known."""
    many = replace(_many(50), channels={"X, mm": np.arange(50.0), "time since the first reading, h": np.arange(50.0)})
    over = partial(figures.residual_over, over="X, mm")
    time = partial(figures.over_time, rows=np.arange(50))
    for made in (over, time):
        assert len(made(many)["layout"]["shapes"]) == 1
        unknown = made(replace(many, floor=float("nan")))
        assert unknown["layout"]["shapes"] == []
        json.dumps(unknown, allow_nan=False)


def test_a_prediction_is_a_line_over_a_position_alone() -> None:
    """Over a temperature readings of all places follow each other. Oracle: the prediction of each reading drawn."""
    many = replace(_many(40), predicted=np.arange(40.0), direction=np.tile([1.0, -1.0], 20))
    s = replace(many, channels={**many.channels, "T_bed, °C": np.sin(np.arange(40.0))})
    along = figures.residual_over(s, "X, mm", what="measured")["data"]
    assert [t["mode"] for t in along if t["name"].startswith("predicted")] == ["lines", "lines"]
    over = [
        t for t in figures.residual_over(s, "T_bed, °C", what="measured")["data"] if t["name"].startswith("predicted")
    ]
    assert {t["mode"] for t in over} == {"markers"}
    drawn = {(x, y) for t in over for x, y in zip(t["x"], t["y"], strict=True)}
    assert drawn == set(zip(figures.numbers(s.channels["T_bed, °C"]), figures.numbers(s.predicted), strict=True))


def test_the_legend_of_the_time_plot_takes_none_of_its_width() -> None:
    """On a narrow screen it had more of it than the readings. Oracle: where Plotly puts a legend."""
    many = replace(_many(40), channels={"time since the first reading, h": np.arange(40.0), "T_bed, °C": np.ones(40)})
    legend = figures.over_time(replace(many, sensors=("T_bed, °C",)), np.arange(40))["layout"]["legend"]
    assert legend["orientation"] == "h"
    assert (legend["x"], legend["yanchor"]) == (0, "top")
    assert legend["y"] < 0.0


def test_each_choice_of_a_colour_is_there_once() -> None:
    """The direction of motion is the first, whether or not the readings have it as a channel."""
    s = replace(_many(9), channels={"X, mm": np.arange(9.0), DIRECTION: np.ones(9)})
    assert list(colours(s).values()) == [DIRECTION, "X, mm"]


def test_curves_of_two_directions_differ_without_their_colours() -> None:
    """Oracle: WCAG 1.4.1, colour is not the only difference: the dash and the marker are others, as in the report."""
    place = np.arange(3.0)
    curves = tuple(Curve(way, None, place, way * place, place, way * place) for way in (1, -1))
    made = figures.evidence_figure(Evidence("m", "µm", "X, mm", curves, (place, place)))
    lines = [t["line"]["dash"] for t in made["data"] if t["mode"] == "lines"]
    markers = [t["marker"]["symbol"] for t in made["data"] if t["name"].startswith("residual, mean")]
    assert (lines, markers) == (["solid", "dash"], ["triangle-up", "triangle-down"])


@pytest.mark.parametrize("theme", ["body {", "body.body--dark {"])
def test_every_colour_of_a_scale_is_seen_on_light_and_on_dark_paper(theme: str) -> None:
    """Oracle: WCAG 1.4.11, a contrast of 3, between the colours and on the paper of the style sheet."""
    style = Path(figures.__file__).with_name("studio.css").read_text(encoding="utf-8")
    paper = _light(style.partition(theme)[2].partition("--paper: ")[2][:7])
    ends = [np.array([int(c[k : k + 2], 16) for k in (1, 3, 5)]) for _, c in figures.SCALE]
    for a, b in pairwise(ends):
        for share in np.linspace(0.0, 1.0, 11):
            shade = _light("#" + "".join(f"{round(v):02x}" for v in a + share * (b - a)))
            assert (max(shade, paper) + 0.05) / (min(shade, paper) + 0.05) >= 3.0


def _light(colour: str) -> float:
    """The relative luminance of a colour as in CSS, by WCAG 2.1."""
    parts = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    linear = [v / 12.92 if v <= 0.03928 else ((v + 0.055) / 1.055) ** 2.4 for v in parts]
    return float(np.dot((0.2126, 0.7152, 0.0722), linear))


def test_a_text_from_a_file_is_no_markup() -> None:
    """Plotly reads some HTML in its texts; a name from a file is shown as it is."""
    assert figures.text('<a href="javascript:x">&\x1b') == '&lt;a href="javascript:x"&gt;&amp;\\u001b'


def test_numbers_for_the_page_have_few_digits() -> None:
    """Oracle: Python's own rounding to five significant digits; what is not finite is a gap."""
    values = np.concatenate([np.random.default_rng(2).normal(0.0, 300.0, 500), [0.0, 1e-4, 123456.7, 3e-12]])
    assert figures.numbers(values) == [pytest.approx(float(f"{v:.5g}"), rel=1e-9) for v in values]
    assert figures.numbers(np.array([np.nan, np.inf, 2.0])) == [None, None, 2.0]
    assert max(len(repr(v)) for v in figures.numbers(values[:500])) <= 9


def test_a_path_in_ones_own_folder_is_short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: the shell's `~`."""
    monkeypatch.setenv("HOME", str(tmp_path))
    assert from_home(str(tmp_path / "workshop" / "lathe")) == "~/workshop/lathe"
    assert from_home("/mnt/lathe") == "/mnt/lathe"
    assert Path(from_home(str(tmp_path / "a"))).expanduser() == tmp_path / "a"

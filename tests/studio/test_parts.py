"""Numbers as people type them, and what is drawn of very many readings."""

import json
from dataclasses import replace

import numpy as np
import pytest

from rtec.errors import RtecError
from rtec.studio import figures
from rtec.studio.parts import number
from rtec.studio.tasks import SeriesView


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


def test_of_very_many_readings_the_worst_are_drawn() -> None:
    """Oracle: sorting all of them; and no more than the page can move fluently."""
    many = _many(100_000)
    rows = figures.drawn(many, many.channels["X, mm"])
    assert len(rows) == figures.MOST
    worst = np.argsort(-np.abs(many.left))[: figures.WORST]
    assert set(worst) <= set(rows)


def test_no_plot_gets_all_of_very_many_readings() -> None:
    """Oracle: the lengths of what is sent, of which no plot gets more than the page moves fluently."""
    many = _many(100_000)
    hours = {"time since the first reading, h": np.arange(100_000) / 3600.0, "T_bed, °C": 20.0 + many.left}
    place = many.channels["X, mm"]
    s = replace(many, channels={**many.channels, "Y, mm": place[::-1], **hours}, sensors=("T_bed, °C",))
    made = {
        "residual": figures.residual_over(s, "X, mm"),
        "coloured": figures.residual_over(s, "X, mm", "T_bed, °C"),
        "measured": figures.residual_over(s, "X, mm", what="measured"),
        "time": figures.over_time(s),
        "map": figures.residual_map(s, "X, mm", "Y, mm"),
        "polar": figures.polar(s, np.deg2rad(place)),
    }
    sent = {n: sum(len(t.get("x", t.get("r", []))) for t in f["data"]) for n, f in made.items()}
    assert {n: k for n, k in sent.items() if k > 2 * figures.MOST} == {}
    assert {n: len(json.dumps(f)) for n, f in made.items() if len(json.dumps(f)) > 1_500_000} == {}


def test_zoomed_in_every_reading_there_is_drawn() -> None:
    """Oracle: the readings in that stretch."""
    many = _many(100_000)
    x = many.channels["X, mm"]
    rows = figures.drawn(many, x, (100.0, 120.0))
    assert list(rows) == list(np.flatnonzero((x >= 100.0) & (x <= 120.0)))


def test_a_text_from_a_file_is_no_markup() -> None:
    """Plotly reads some HTML in its texts; a name from a file is shown as it is."""
    assert figures.text('<a href="javascript:x">&\x1b') == '&lt;a href="javascript:x"&gt;&amp;\\u001b'


def test_numbers_for_the_page_have_few_digits() -> None:
    """Oracle: Python's own rounding to five significant digits; what is not finite is a gap."""
    values = np.concatenate([np.random.default_rng(2).normal(0.0, 300.0, 500), [0.0, 1e-4, 123456.7, 3e-12]])
    assert figures.numbers(values) == [pytest.approx(float(f"{v:.5g}"), rel=1e-9) for v in values]
    assert figures.numbers(np.array([np.nan, np.inf, 2.0])) == [None, None, 2.0]
    assert max(len(repr(v)) for v in figures.numbers(values[:500])) <= 9

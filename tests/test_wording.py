"""Numbers as people read them. Oracle: by hand."""

import math
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtec.wording import counted, number, percent, probability, significant, sizes, two_numbers, with_error

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    ("value", "digits", "said"),
    [(1.005, 1, "1.0"), (-0.001, 2, "0.00"), (-0.006, 2, "-0.01"), (math.nan, 2, "–"), (math.inf, 2, "–")],
)
def test_decimals(value: float, digits: int, said: str) -> None:
    """Oracle: by hand; no negative zero."""
    assert number(value, digits) == said


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ((185.0512, 3.0), ("185.05", "3.00")),
        ((0.0123, 0.0112), ("0.012", "0.011")),
        ((7.04, 0.0996, 0.2), ("7.04", "0.10", "0.20")),
        ((0.00004, 1e-9), ("0.000040", "0.000000")),
        ((0.0, math.nan), ("0.00", "–")),
    ],
)
def test_errors_that_are_compared_have_two_digits(values: tuple[float, ...], said: tuple[str, ...]) -> None:
    """Oracle: by hand."""
    assert sizes(*values) == said


def test_sign_of_nothing_is_plus() -> None:
    """Oracle: by hand."""
    assert [number(v, sign=True) for v in (-0.001, 0.3, -0.3)] == ["+0.00", "+0.30", "-0.30"]


@pytest.mark.parametrize(
    ("value", "digits", "said"),
    [
        (19.6, 1, "20"),
        (20.4, 2, "20"),
        (0.0012345, 3, "0.00123"),
        (99.96, 3, "100"),
        (1234.5, 2, "1200"),
        (0.5, 2, "0.50"),
        (-3.0, 2, "-3.0"),
        (0.0, 3, "0"),
    ],
)
def test_significant_digits_without_an_exponent(value: float, digits: int, said: str) -> None:
    """Oracle: by hand."""
    assert significant(value, digits) == said


@given(st.floats(-1e6, 1e6).filter(lambda v: abs(v) > 1e-6), st.integers(1, 6))
def test_significant_digits_keep_the_value(value: float, digits: int) -> None:
    """Oracle: the same rounding by Python's own exponent format."""
    said = significant(value, digits)
    assert "e" not in said
    assert float(said) == pytest.approx(float(f"{value:.{digits - 1}e}"), rel=10.0 ** -(digits - 1))


@pytest.mark.parametrize(
    ("value", "error", "said"),
    [
        (3.0812, 0.0661, ("3.081", "0.066")),
        (38.5123, 0.82, ("38.51", "0.82")),
        (-0.02197, 0.038, ("-0.022", "0.038")),
        (11.7041, 19.0, ("12", "19")),
        (8.8564, None, ("8.856", "–")),
        (8.8564, 0.0, ("8.856", "–")),
    ],
)
def test_a_value_has_the_decimals_of_its_error(value: float, error: float | None, said: tuple[str, str]) -> None:
    """Oracle: by hand, the rule of the Guide to the Expression of Uncertainty in Measurement, 7.2.6."""
    assert with_error(value, error) == said


@pytest.mark.parametrize(
    ("share", "said"),
    [
        (0.0, "0 %"),
        (1.0, "100 %"),
        (0.9999, "> 99.9 %"),
        (0.0001, "< 0.1 %"),
        (0.997, "99.7 %"),
        (0.97, "97 %"),
        (0.052, "5.2 %"),
        (-0.31, "-31 %"),
        (1.2, "120 %"),
    ],
)
def test_shares(share: float, said: str) -> None:
    """Oracle: by hand; neither never nor certain where it is neither."""
    assert percent(share) == said


def test_a_probability_is_never_certain() -> None:
    """Oracle: by hand."""
    assert [probability(p) for p in (0.0, 1.0, 0.26)] == ["< 0.1 %", "> 99.9 %", "26 %"]


def test_counts() -> None:
    """Oracle: English."""
    assert [counted(1, "log"), counted(2, "log"), counted(0, "entry", "entries")] == ["1 log", "2 logs", "0 entries"]


def test_two_numbers_show_their_difference() -> None:
    """Oracle: by hand; equal numbers have no more digits than usual."""
    assert two_numbers(3.323, 0.588) == ("3.32", "0.59")
    assert two_numbers(0.58812, 0.58801) == ("0.5881", "0.5880")
    assert two_numbers(0.5, 0.5) == ("0.50", "0.50")


def test_every_percentage_is_written_by_percent() -> None:
    """Oracle: the rule "97 %", "5.2 %", "< 0.1 %", which Python's own `%` format does not keep."""
    code = [*(ROOT / "rtec").rglob("*.py"), *(ROOT / "drivers").rglob("*.py")]
    assert len(code) > 200
    assert not [str(p) for p in code if re.search(r":[+,.\d]*%\}", p.read_text(encoding="utf-8"))]

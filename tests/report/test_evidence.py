"""What the figure of a finding draws: curves over what drives it, their families, the height of a shape.

Oracles: readings made here by exact laws, so that every curve is known.
"""

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.diagnosis.result import Picture
from rtec.report.diagnosis import evidence_figure, spread_out
from rtec.report.evidence import LEVELS, Evidence, evidence, explained, places, roughness
from tests.support.figures import drawn, lines

Floats = NDArray[np.float64]
RUNS, TARGETS = 12, 20
X = np.tile(np.concatenate([np.linspace(5.0, 195.0, TARGETS), np.linspace(195.0, 5.0, TARGETS)]), RUNS)
WAY = np.tile(np.repeat([1.0, -1.0], TARGETS), RUNS)
RUN = np.repeat(np.arange(RUNS), 2 * TARGETS)
TIME_S = np.asarray(300.0 * RUN + np.tile(np.arange(2.0 * TARGETS), RUNS), dtype=np.float64)
RISE = np.array([0.0, 4.0, 1.0, 5.0, 2.0, 6.0, 3.0, 3.5, 0.5, 4.5, 1.5, 5.5])[RUN]
"""Temperatures that go up and down from run to run, K."""
NOISE: Floats = 0.1 * np.random.default_rng(1).standard_normal(len(X))


def picture(
    part: Floats,
    drivers: Sequence[tuple[str, str, Floats]],
    direction: Floats | None = WAY,
    period_mm: float | None = None,
) -> Picture:
    """A finding that explains all but noise."""
    part = np.asarray(part - part.mean())
    residual, title = np.asarray(part + NOISE), "effect, in laser"
    return Picture("effect", "um", residual, part, tuple(drivers), direction, TIME_S, RUN, title, period_mm=period_mm)


OVER_X, WARM = ("x", "mm", X), ("T_bed", "degC", 20.0 + RISE)
CASES = {
    "position": picture(0.02 * X, [OVER_X]),
    "both directions": picture(1.5 * WAY + 0.01 * X, [OVER_X]),
    "wave": picture(2.0 * np.sin(2.0 * np.pi * X / 7.0), [OVER_X], period_mm=7.0),
    "temperature": picture(0.8 * RISE, [WARM], None),
    "play by temperature": picture(0.3 * WAY * RISE, [OVER_X, WARM]),
    "product": picture(0.01 * X * RISE, [OVER_X, WARM]),
    "moving hump": picture(5.0 * np.exp(-(((X - 60.0 - 12.0 * RISE) / 30.0) ** 2)), [OVER_X, WARM]),
    "memory": picture(np.exp(-TIME_S / 900.0), [("spindle_rpm", "rpm", np.where(RUN % 2, 1000.0, 0.0))], None),
    "three": picture(
        np.random.default_rng(2).standard_normal((TARGETS, RUNS, 2))[
            np.rint((X - 5.0) / 10.0).astype(int), RUN, (WAY > 0).astype(int)
        ] * np.cos(37.0 * TIME_S),
        [OVER_X, WARM],
    ),
}  # fmt: skip

each_case = pytest.mark.parametrize("name", CASES)


@each_case
def test_lines_run_forward_and_none_lies_on_another(name: str) -> None:
    """Oracle: places rise strictly, so no line turns back or stands upright; and no two curves are equal."""
    shown = evidence(CASES[name])
    for curve in shown.curves:
        assert np.all(np.diff(curve.place) > 0.0)
    figure = drawn(evidence_figure, [shown])
    for ax in (a for part in figure.subfigs for a in part.axes):
        assert ", " in ax.get_ylabel() or ",\n" in ax.get_ylabel()
        box = ax.get_legend()
        if box is None:  # what drives the finding, over time
            continue
        assert ", " in (ax.get_xlabel() or figure.subfigs[0].axes[-1].get_xlabel())
        legend = [t.get_text() for t in box.get_texts()]
        assert len(legend) == len(set(legend))
        points = lines(ax)
        assert all(np.all(np.diff(p[:, 0]) > 0.0) for p in points)
        for curve, other in ((a, b) for i, a in enumerate(shown.curves) for b in shown.curves[i + 1 :]):
            assert curve.part.shape != other.part.shape or not np.allclose(curve.part, other.part)


@each_case
def test_what_is_drawn_is_what_the_finding_explains(name: str) -> None:
    """Oracle: drawn curves, read back at every reading, hold nearly all of what the finding explains there."""
    p = CASES[name]
    shown = evidence(p)
    if len(shown.curves) > 2:
        return  # levels are means over a range of the second variable
    rest = np.min([np.abs(np.interp(shown.dots[0], c.place, c.part) - p.part) for c in shown.curves], axis=0)
    assert float(np.sqrt(np.mean(rest**2))) < 0.2 * float(np.std(p.part))


def over(name: str) -> Evidence:
    return evidence(CASES[name])


def test_one_line_where_the_direction_does_not_matter() -> None:
    """Oracle: a straight line over position is one curve; play makes two, 3 µm apart at every place."""
    (line,) = over("position").curves
    assert over("position").below == "X, mm"
    np.testing.assert_allclose(line.place, np.linspace(5.0, 195.0, TARGETS))
    np.testing.assert_allclose(np.diff(line.part), 0.2)
    plus, minus = over("both directions").curves
    assert (plus.direction, minus.direction) == (1, -1)
    np.testing.assert_allclose(plus.part - minus.part, 3.0)


def test_temperature_takes_the_place_of_position_where_that_says_nothing() -> None:
    """Oracle: 0.8 µm a kelvin; and play of 0.3 µm a kelvin in either direction."""
    (line,) = over("temperature").curves
    assert over("temperature").below == "T_bed, °C"
    np.testing.assert_allclose(np.diff(line.part) / np.diff(line.place), 0.8)
    play = over("play by temperature")
    assert play.below == "T_bed, °C"
    np.testing.assert_allclose([np.polyfit(c.place, c.part, 1)[0] for c in play.curves], [0.3, -0.3])


def test_a_wave_of_many_periods_is_drawn_over_one() -> None:
    """Oracle: the wave itself, within one period."""
    (wave,) = over("wave").curves
    assert over("wave").below == "X, mm, within one period of 7 mm"
    assert 0.0 <= wave.place[0] < wave.place[-1] < 7.0
    true = 2.0 * np.sin(2.0 * np.pi * wave.place / 7.0)
    np.testing.assert_allclose(wave.part - wave.part[0], true - true[0], atol=1e-9)


def test_a_product_is_a_family_with_the_height_of_its_shape() -> None:
    """Oracle: 0.01 µm/(mm·K) over 190 mm, run by run; slopes of the curves in the order of their temperatures."""
    shown = over("product")
    assert (shown.below, shown.second) == ("X, mm", "T_bed, °C")
    assert len(shown.curves) == LEVELS
    for curve in shown.curves:
        assert curve.level is not None
        np.testing.assert_allclose(np.diff(curve.part), 0.1 * (curve.level - 20.0), atol=1e-9)
    a = shown.amplitudes
    assert a is not None
    assert a.below == "T_bed, °C"
    np.testing.assert_allclose(a.value, 20.0 + np.sort(RISE[:: 2 * TARGETS]))
    np.testing.assert_allclose(a.explained, 1.9 * (a.value - 20.0), atol=1e-9)
    assert np.all(np.abs(a.measured - a.explained) < 4.0 * a.error)


def test_a_shape_that_wanders_has_a_family_but_no_height() -> None:
    """Oracle: the top of each curve is where the temperature puts it."""
    shown = over("moving hump")
    assert shown.second == "T_bed, °C"
    assert shown.amplitudes is None
    tops = [float(c.place[np.argmax(c.part)]) for c in shown.curves]
    assert tops == sorted(tops)
    assert tops[-1] - tops[0] > 40.0


def test_what_hangs_on_a_difference_is_drawn_against_it() -> None:
    """Oracle: a bend of 0.5 µm a kelvin between two temperatures of which neither alone says it."""
    other = np.asarray(np.random.default_rng(4).permutation(RUNS)[RUN] * 0.5)
    p = picture(0.5 * (RISE - other), [("T_a", "degC", 20.0 + RISE), ("T_b", "degC", 20.0 + other)], None)
    shown = evidence(p)
    assert shown.below == "T_a − T_b, K"
    (line,) = shown.curves
    np.testing.assert_allclose(np.diff(line.part) / np.diff(line.place), 0.5)


def test_memory_is_drawn_over_time_and_what_has_no_line_against_itself() -> None:
    """Oracle: a decay that the speed at the instant does not give; noise in three variables at once."""
    assert over("memory").below == "time since the first reading, hours"
    assert [name for name, _ in over("memory").causes] == ["spindle speed, rpm"]
    shown = over("three")
    assert shown.below == "what the finding explains, µm"
    for curve in shown.curves:
        np.testing.assert_allclose(curve.part, curve.place)


def test_every_place_has_its_own_point_of_the_line() -> None:
    """Oracle: counted by hand; stretches of about as many readings where there are too many places."""
    value = np.tile(np.arange(60.0), 3)
    np.testing.assert_array_equal(places(value), value.astype(int))
    many = np.random.default_rng(1).uniform(0.0, 1.0, 400)
    code = places(many)
    assert set(np.bincount(code)) <= {9, 10, 11}
    assert np.all(np.diff(code[np.argsort(many)]) >= 0)
    # Half of the readings stand at one value: no stretch ends among them.
    halted = np.concatenate([many, np.full(400, 0.5)])
    assert len(set(places(halted)[400:])) == 1


def test_cells_by_chance_explain_nothing() -> None:
    """Oracle: random cells hold no part of noise, exact ones all of it."""
    rng = np.random.default_rng(5)
    noise, cell = rng.standard_normal(600), rng.integers(0, 60, 600)
    assert abs(explained(noise, cell)) < 0.1
    assert explained(cell.astype(float), cell) == pytest.approx(1.0)


def test_a_line_is_smooth_and_chance_is_rough() -> None:
    """Oracle: a line has no roughness, independent values 1 on average."""
    rng = np.random.default_rng(6)
    value = np.sort(rng.uniform(0.0, 1.0, 400))
    code, side = np.arange(400), np.zeros(400, dtype=np.int64)
    assert roughness(3.0 * value, value, code, side) == pytest.approx(0.0, abs=1e-12)
    chance = np.mean([roughness(rng.standard_normal(400), np.arange(400.0), code, side) for _ in range(20)])
    assert float(chance) == pytest.approx(1.0, abs=0.1)


def test_names_at_the_ends_make_room_for_each_other() -> None:
    """Oracle: by hand."""
    assert spread_out([0.0, 1.0, 5.0], 1.0) == [0.0, 1.0, 5.0]
    assert spread_out([2.0, 2.0, 2.0], 1.0) == [1.0, 2.0, 3.0]
    apart = spread_out([0.0, 0.1, 0.2, 3.0], 0.5)
    assert np.all(np.diff(apart) >= 0.5 - 1e-12)

"""Grid plates as they are really used: positions off a display, a plate laid down by hand, the same plate twice."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.metrology.grid.compare import evaluate, moved_along, not_compared, places
from rtec.metrology.grid.paths import straight_pieces
from rtec.metrology.grid.setup import GridSetup, analyse
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.report.grid import drawn_pieces, grid_page, plate_turn
from tests.metrology.test_grid_encoder import bridge, measured, own

Floats = NDArray[np.float64]
ROLL = own("EBY", "0.01 * y")
"""10 µrad for a metre."""


def line(corners: Sequence[tuple[float, float]], step_mm: float) -> Floats:
    """A path with a place at every step, corners once, (2, n)."""
    out = [corners[0]]
    for (a, b), (c, d) in pairwise(corners):
        n = round(float(np.hypot(c - a, d - b)) / step_mm)
        out += [(a + (c - a) * i / n, b + (d - b) * i / n) for i in range(1, n + 1)]
    return np.array(out).T


SQUARE = ((-80.0, -80.0), (80.0, -80.0), (80.0, 80.0), (-80.0, 80.0), (-80.0, -80.0))
EXPECTED = [(0, 1), (1, 1), (0, -1), (1, -1)]


def test_both_senses_of_a_square() -> None:
    """Oracle: the square, the other way round: up first, and every corner turns from one direction to the other."""
    found = list(straight_pieces(line(SQUARE[::-1], 0.5)))
    assert [(along, way) for along, way, _, _ in found] == [(1, 1), (0, 1), (1, -1), (0, -1)]
    assert [last - first for _, _, first, last in found] == [320] * 4


@pytest.mark.parametrize("step_mm", [0.0004, 0.03, 0.5, 4.0])
@pytest.mark.parametrize("jitter_mm", [0.0, 0.001])
def test_pieces_of_a_square_however_it_was_recorded(step_mm: float, jitter_mm: float) -> None:
    """Oracle: the square. Positions rounded to 1 µm stand still between readings that lie closer; those of an encoder
    jitter by a count. Either broke every side into bits, which were then left out without a word."""
    place = np.round(line(SQUARE, step_mm), 3)
    place += jitter_mm * np.random.default_rng(1).standard_normal(place.shape)
    found = list(straight_pieces(place))
    assert [(along, way) for along, way, _, _ in found] == EXPECTED
    for along, _, first, last in found:
        own_way = place[along, first : last + 1]
        assert (own_way.min(), own_way.max()) == pytest.approx((-80.0, 80.0), abs=6 * jitter_mm + 1e-9)


def test_pieces_of_a_line_there_and_back_with_a_rest() -> None:
    """Oracle: the path; the axis rests for a hundred readings in the middle and at the far end."""
    way = line(((-50.0, 0.0), (50.0, 0.0)), 0.01)[0]
    there = np.concatenate([way[:5000], np.full(100, way[5000]), way[5000:], np.full(100, 50.0), way[::-1]])
    found = list(straight_pieces(np.stack([there, np.zeros(len(there))])))
    assert [(along, way) for along, way, _, _ in found] == [(0, 1), (0, -1)]
    assert there[found[0][2]] == -50.0
    assert there[found[0][2] : found[0][3] + 1].max() == 50.0


def test_circles_and_slants_have_no_straight_pieces() -> None:
    """Oracle: they are not straight along a direction."""
    turn = np.linspace(0.0, 2.0 * np.pi, 5000)
    assert not list(straight_pieces(80.0 * np.stack([np.cos(turn), np.sin(turn)])))
    assert not list(straight_pieces(line(((0.0, 0.0), (100.0, 3.0)), 0.5)))
    assert not list(straight_pieces(np.zeros((2, 50))))


def laid(origin: list[float], seed: int, shift_mm: float = 0.0, **setup: object) -> GridSetup:
    """Squares on the bridge whose Y rolls; the middle is written down `shift_mm` off in X and Z."""
    m = bridge()
    made = measured(m, "XZ", origin, (ROLL,), seed, kinds=("square",), cycles=2)
    said = {"plane": "XZ", "origin_mm": [origin[0] + shift_mm, origin[1], origin[2] + shift_mm], **setup}
    grid = make_instrument("grid_encoder", said, None, None, m, "test")
    return analyse(
        Measurement(f"y {origin[1]:g}", grid, m, made.run, made.time_s, made.channels, made.readings)
    )  # fmt: skip


def test_the_same_plate_falls_out_between_setups() -> None:
    """Oracle: the roll that was made true, 10 µrad; a plate's own error is the same in both, so only noise is left."""
    far = [[0.0, y, 300.0] for y in (-500.0, 500.0)]
    (unknown,) = places(*(laid(o, s, accuracy_um=2.0) for s, o in enumerate(far)))
    (same,) = places(*(laid(o, s, accuracy_um=2.0, plate="7") for s, o in enumerate(far)))
    (bare,) = places(*(laid(o, s) for s, o in enumerate(far)))
    assert same.value == unknown.value == pytest.approx(-10.0, abs=1.0)
    # U of ±2 µm on both lengths of both squares: 2 · 2/√3 · √2 · √2 / 0.16 m.
    assert unknown.u == pytest.approx(np.hypot(bare.u, 2.0 * 2.0 / np.sqrt(3.0) * 2.0 / 0.16))
    assert same.u == pytest.approx(bare.u)
    assert same.chance < 1e-6 < unknown.chance
    other = laid(far[1], 1, accuracy_um=2.0, plate="8")
    (two_plates,) = places(laid(far[0], 0, accuracy_um=2.0, plate="7"), other)
    assert two_plates.u == pytest.approx(unknown.u)
    elsewhere = laid(far[1], 1, shift_mm=5.0, accuracy_um=2.0, plate="7")
    (part,) = places(laid(far[0], 0, accuracy_um=2.0, plate="7"), elsewhere)
    assert part.u == pytest.approx(unknown.u), "another part of the plate has another error"


def test_a_plate_laid_by_hand_is_still_compared() -> None:
    """Oracle: the same roll; the plate missed its place in X and Z by 10 mm on a metre."""
    one, two = laid([0.0, -500.0, 300.0], 0), laid([0.0, 500.0, 300.0], 1, shift_mm=10.0)
    assert moved_along(one, two) == ("Y",)
    assert places(one, two)[0].value == pytest.approx(-10.0, abs=1.0)
    assert not not_compared([one, two])


def test_what_is_not_compared_is_told() -> None:
    """Oracle: the plate was moved along X and Z by 400 mm, and along Y by a metre."""
    m = bridge()
    made = [measured(m, "XZ", o, (ROLL,), 1, kinds=("square",)) for o in ([0.0, -500.0, 300.0], [400.0, 500.0, 700.0])]
    report = evaluate(made)
    told = not_compared(report.setups)
    assert len(told) == 1
    assert "moved along X and Y and Z at once" in told[0]
    assert report.facts()["not_compared"] == told
    assert told[0] + "." in [line for s in grid_page(report, figures=False).sections for line in s.text]
    assert not not_compared(report.setups[:1])


def test_the_figures_lie_as_the_machine_does() -> None:
    """Oracle: a plate turned by 60 µrad reads each side turned by as much; drawn, the sides along X are level, and
    those along Z lean by the squareness, 20 µm/m."""
    m = bridge()
    made = measured(m, "XZ", [0.0, 0.0, 0.0], (own("EB0Z", "20"),), 1, noise_um=0.0, kinds=("square",))
    phi = 60.0
    x, z = made.channels["x"], made.channels["z"]
    turned = {"reading_x_um": made.readings["reading_x_um"] - phi * z * 1e-3,
              "reading_z_um": made.readings["reading_z_um"] + phi * x * 1e-3}  # fmt: skip
    s = analyse(Measurement("t", made.instrument, m, made.run, made.time_s, made.channels, turned))
    pieces = drawn_pieces(s.edges, 0, {0: 0.0, 1: 0.0}, plate_turn(s, s.edges))
    lean = {k: [np.polyfit(p.place_mm, p.deviation_um, 1)[0] * 1e3 for p in pieces if p.along == k] for k in (0, 1)}
    np.testing.assert_allclose(lean[0], 0.0, atol=0.1)
    np.testing.assert_allclose(lean[1], 20.0, atol=0.1)

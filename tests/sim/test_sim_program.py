"""The part-program reader and the interpolator's moves."""

import math

import numpy as np
import pytest

from rtec.errors import ConfigError
from rtec.sim.controller import place_on
from rtec.sim.program import END, ProgramReader, table_of
from tests.support.sim_example import MS, S, plain


def reader(axes: tuple[str, ...] = ("X", "Z")) -> ProgramReader:
    return ProgramReader(axes, ((0.0, 200.0),) * len(axes), (50.0,) * len(axes), 250.0)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("G1 X10 F100\nG1 X250", "line 2 'G1 X250': X 250 mm is outside the travel, 0 to 200 mm"),
        ("G7 X10", "unknown word G7; allowed: G0"),
        ("G1 Q5 F10", "unknown word Q; allowed"),
        ("X10", "without G0"),
        ("G1 X10", "no feed"),
        ("G1 X10 F0", "F must be above zero"),
        ("M8", "unknown word M8"),
        ("G1 X1O F5", "is no word"),
        ("G4 P-1", "P must not be below zero"),
        ("G3 X60 Z60 I10 K5 F100", "radius is"),
        ("G17", "plane XY; this machine has X Z"),
        ("G3 X50 Z50 I100 K100 F100", "outside the travel"),
        ("G1.5 X1", "whole numbers"),
    ],
)
def test_what_a_wrong_program_is_told(text: str, says: str) -> None:
    """Oracle: the message that a user should see, with the line."""
    with pytest.raises(ConfigError, match=r"program line \d") as caught:
        reader().read(text)
    assert says in str(caught.value)


def test_modal_words_comments_and_end() -> None:
    """Oracle: the moves as read by a person."""
    moves = reader().read("(start) g0 x10 z20 ; away\nG1 X30 F600\nZ40\nS800 M4\nG4 P0.5\nM5\nM30\nG0 X99")
    assert [m.end_mm for m in moves] == [(10, 20), (30, 20), (30, 40), (30, 40), (30, 40), (30, 40)]
    assert [m.feed_mm_s for m in moves[:3]] == [250.0, 10.0, 10.0]
    assert [m.rpm for m in moves] == [0, 0, 0, -800, -800, 0]
    assert moves[4].wait_s == 0.5


@pytest.mark.parametrize(("word", "quarter"), [("G3", 1), ("G2", -1)])
def test_sense_of_arcs_in_the_turning_plane(word: str, quarter: int) -> None:
    """Oracle: G18 is the plane Z, X; anticlockwise (G3) goes from Z towards X [ISO 6983]."""
    # From the centre (X50, Z50) the start lies on +Z; a quarter turn later the tool is on +X (G3) or -X (G2).
    moves = reader().read(f"G18 G1 Z80 F600\n{word} X{50 + 30 * quarter} Z50 K-30")
    table = table_of(moves, 2, 2000.0, 5e-4)
    place, velocity = np.zeros(2), np.zeros(2)
    angles = []
    for t in np.linspace(0.0, moves[1].length_mm / 10.0 + 10.0 / 2000.0, 200):
        place_on(table[1], t, place, velocity)
        assert abs(math.hypot(place[0] - 50, place[1] - 50) - 30) < 1e-9
        angles.append(math.atan2(place[0] - 50, place[1] - 50))
    assert abs(angles[-1] - quarter * math.pi / 2) < 1e-9
    assert np.all(np.diff(angles) * quarter >= 0)


def test_a_full_circle_and_its_length() -> None:
    """Oracle: 2πr."""
    (move,) = reader().read("G3 X50 Z50 I-20 F600")
    assert move.arc is not None
    assert abs(move.length_mm - 2 * math.pi * 20) < 1e-9


def test_other_planes_and_helices() -> None:
    """Oracle: G17 anticlockwise goes from X towards Y; the third axis moves evenly: half way at half the length."""
    (move,) = reader(("X", "Y", "Z")).read("G17 G3 X30 Y50 Z90 I-10 F600")
    assert abs(move.length_mm - math.hypot(10 * math.pi, 40)) < 1e-9
    table = table_of([move], 3, 2000.0, 5e-4)
    place, velocity = np.zeros(3), np.zeros(3)
    place_on(table[0], (move.length_mm / 10 + 10 / 2000) / 2, place, velocity)
    np.testing.assert_allclose(place, [40, 60, 70], atol=1e-9)


@pytest.mark.parametrize("text", ["G0 X180 Z20", "G1 X50.003 F3000", "G1 X90 Z10 F6000", "G2 X50 Z50 K25 F3000"])
def test_speed_profile(text: str) -> None:
    """Oracle: differences of position: speed ≤ feed, change of speed ≤ acceleration, ends at rest on the target."""
    (move,) = reader().read(text)
    table = table_of([move], 2, 2000.0, 5e-4)
    ticks = np.arange(int(table[0, END]) + 1) * 5e-4
    place, velocity, rows, speeds = np.zeros(2), np.zeros(2), [], []
    for t in ticks:
        place_on(table[0], t, place, velocity)
        rows.append(place.copy())
        speeds.append(velocity.copy())
    steps = np.linalg.norm(np.diff(rows, axis=0), axis=1) / 5e-4
    assert steps.max() <= move.feed_mm_s + 1e-6
    assert np.abs(np.diff(steps)).max() <= 2000.0 * 5e-4 + 1e-6
    np.testing.assert_allclose(rows[-1], move.end_mm, atol=1e-9)
    np.testing.assert_allclose(speeds[-1], 0.0, atol=1e-9)
    middle = (np.array(speeds[1:]) + np.array(speeds[:-1])) / 2
    np.testing.assert_allclose(np.diff(rows, axis=0) / 5e-4, middle, atol=0.6)


def test_dwell_lasts_and_a_program_repeats() -> None:
    """Oracle: the clock; a program that repeats is at the same place one period later."""
    sim = plain()
    sim.load_program("G0 X20\nG4 P0.25\nG0 X60", repeat=True)
    period_ns = round(sim.program_s * S)
    for instant_ns in (70 * MS, period_ns - 60 * MS):  # on the way out, and on the way back
        sim = plain()
        sim.load_program("G0 X20\nG4 P0.25\nG0 X60", repeat=True)
        sim.advance_to(instant_ns)
        first = sim.commanded_mm
        sim.advance_to(instant_ns + MS + 4 * period_ns)
        last = sim.commanded_mm
        sim.advance_to(instant_ns + 5 * period_ns)
        np.testing.assert_allclose(first, sim.commanded_mm, atol=1e-9)
        assert abs(last[0] - first[0]) > 0.05
    still = plain()
    still.load_program("G4 P0.25")
    assert still.program_s == pytest.approx(0.25)


def test_a_program_waits_while_hours_pass() -> None:
    """Oracle: the same program without the hours."""
    sim, twin = plain(), plain()
    for one in (sim, twin):
        one.load_program("G1 X100 F3000")
        one.advance_to(700 * MS)
    sim.work(3600.0)
    assert sim.time_ns == 700 * MS + 3600 * S
    for one in (sim, twin):
        one.advance_to(one.time_ns + 900 * MS)
    np.testing.assert_array_equal(sim.raw_counts, twin.raw_counts)
    assert 70 < sim.commanded_mm[0] < 90

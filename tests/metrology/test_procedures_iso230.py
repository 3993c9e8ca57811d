"""ISO 230-2: figures against sums written out by hand, drift against what was put in."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.errors import MeasurementError
from rtec.metrology.procedures.iso230_2 import Visits, hidden_period, positioning, stops
from rtec.metrology.procedures.tables import read_dat

Floats = NDArray[np.float64]
TARGET = np.array([0.0, 53.0, 111.0])
UP = np.array([[1.0, 3.0, 2.0], [4.0, 4.0, 4.0], [-2.0, 0.0, 2.0]])
DOWN = np.array([[-1.0, -1.0, -1.0], [7.0, 9.0, 8.0], [1.0, 1.0, 4.0]])


def test_every_figure_by_hand() -> None:
    """Oracle: mean and standard deviation on paper: up x̄ = 2, 4, 0, s = 1, 0, 2; down x̄ = -1, 8, 2, s = 0, 1, √3."""
    r = positioning(Visits("t", TARGET, UP, DOWN))
    assert r.up
    assert r.down
    assert r.both
    np.testing.assert_allclose(r.up.mean_um, [2, 4, 0])
    np.testing.assert_allclose(r.up.s_um, [1, 0, 2])
    np.testing.assert_allclose(r.down.s_um, [0, 1, np.sqrt(3)])
    assert (r.up.E_um, r.up.R_um, r.up.A_um) == (4.0, 8.0, 8.0)  # A↑: max(4, 4, 4) - min(0, 4, -4)
    np.testing.assert_allclose([r.down.E_um, r.down.R_um], [9.0, 4 * np.sqrt(3)])
    np.testing.assert_allclose(r.down.A_um, 10 - (2 - 2 * np.sqrt(3)))  # the lowest is target 3's, -1.46
    np.testing.assert_allclose(r.both.B_i_um, [3, -4, -2])
    assert (r.both.B_um, r.both.B_mean_um) == (4.0, -1.0)
    np.testing.assert_allclose(r.both.mean_um, [0.5, 6, 1])
    assert (r.both.M_um, r.both.E_um) == (5.5, 9.0)
    np.testing.assert_allclose(r.both.R_i_um, [2 + 0 + 3, 0 + 2 + 4, 4 + 2 * np.sqrt(3) + 2])
    assert r.both.A_um == pytest.approx(10 + 4)


def test_swapping_directions_turns_the_sign_of_the_reversal_only() -> None:
    one, other = positioning(Visits("t", TARGET, UP, DOWN)).both, positioning(Visits("t", TARGET, DOWN, UP)).both
    assert one
    assert other
    np.testing.assert_allclose(one.B_i_um, -other.B_i_um)
    for key in ("B_um", "M_um", "E_um", "R_um", "A_um"):
        assert getattr(one, key) == pytest.approx(getattr(other, key))


def campaign(seed: int, zero_um: Floats, stretch_um: Floats, s_um: float = 1.0) -> Visits:
    """Both directions of eleven targets over 1 m: fixed shape and backlash, drift by cycle, white scatter."""
    rng = np.random.default_rng(seed)
    target = np.linspace(0, 1000, 11)
    drift = zero_um + np.outer((target - 500) / 1000, stretch_um)
    shape = 5 * np.sin(target / 150)[:, None]
    up, down = (shape + side + drift + rng.normal(0, s_um, drift.shape) for side in (1.0, -1.0))
    return Visits("t", target, up, down)


def test_drift_is_told_apart_from_repeatability() -> None:
    """Oracle: what was put in: 12 µm of zero and 8 µm of stretch over five cycles, scatter s = 1 µm."""
    steps = np.linspace(0, 1, 5)
    drifts = [positioning(campaign(k, 12 * steps, 8 * steps)).drift for k in range(40)]
    assert all(d and d.is_drift and "rising in every cycle" in d.words for d in drifts)
    known = [d for d in drifts if d]
    assert np.mean([d.range_um for d in known]) == pytest.approx(12, abs=0.3)
    assert np.mean([d.stretch_range_um_per_m for d in known]) == pytest.approx(8, abs=0.5)
    assert np.mean([d.R_um for d in known]) > 18
    still = [positioning(campaign(k, 0 * steps, 0 * steps)).drift for k in range(40)]
    calm = [d.R_um for d in still if d]
    assert np.mean([d.R_without_stretch_um for d in known]) == pytest.approx(np.mean(calm), rel=0.12)


def test_scatter_alone_is_called_drift_as_seldom_as_promised() -> None:
    """Oracle: two tests at 1 % each: at most 2 % of 400 campaigns, plus three standard deviations."""
    called = sum(
        bool(d and d.is_drift) for d in (positioning(campaign(k, np.zeros(5), np.zeros(5))).drift for k in range(400))
    )
    assert called <= 8 + 3 * np.sqrt(8)


@pytest.mark.parametrize(
    ("target", "hidden"),
    [
        (np.arange(0, 100, 10.0), "multiples of the pitch"),
        (np.arange(3, 100, 20.0), "multiples of the pitch"),
        (np.arange(0, 100, 5.0), "multiples of half the pitch"),
        (np.array([0.0, 10.05, 19.95, 30.0]), "multiples of the pitch"),
        (np.arange(0, 100, 7.0), ""),
        (np.arange(0, 100, 2.5), ""),
    ],
)
def test_targets_that_hide_the_pitch(target: Floats, hidden: str) -> None:
    """Oracle: a sine of pitch 10 mm sampled there is constant, or takes two values only."""
    said = hidden_period(target, 10.0)
    assert (hidden in said[0]) if hidden else not said
    sine = np.cos(2 * np.pi * target / 10 + 0.7)
    assert (len(np.unique(np.round(sine, 1))) <= 2) == bool(hidden)
    assert hidden_period(target, None) == []


def walk(targets: Floats, cycles: int) -> tuple[Floats, Floats]:
    """Positions and directions of cycles up and down, overrunning both ends, two rows a stop."""
    way = np.concatenate([[targets[0] - 1], targets, [targets[-1] + 1], targets[::-1]])
    whole = np.concatenate([*[way] * cycles, [targets[0] - 1]]).repeat(2)
    sense = np.concatenate([np.r_[-1, np.ones(len(targets) + 1), -np.ones(len(targets))]] * cycles + [[-1]]).repeat(2)
    sense[:2] = 0
    return whole, sense


def test_stops_of_a_measurement_become_visits() -> None:
    """Oracle: readings made from target, cycle and direction, so that every cell of the table is known."""
    targets = np.array([0.0, 13.0, 29.0])
    position, sense = walk(targets, 4)
    leg = np.cumsum(np.abs(np.diff(sense, prepend=0)) > 0)
    reading = position + 100 * sense + leg + np.tile([-0.5, 0.5], len(position) // 2)
    v = stops("m", position + 1e-5 * np.sin(leg), sense, np.zeros(len(position), np.int64), reading)
    np.testing.assert_allclose(v.target_mm, targets, atol=1e-4)
    assert v.up_um.shape == v.down_um.shape == (3, 4)
    np.testing.assert_allclose(v.up_um - 100 - targets[:, None], np.tile(v.up_um[0] - 100, (3, 1)))
    np.testing.assert_allclose(np.diff(v.up_um[0]), 2.0)
    np.testing.assert_allclose(v.down_um[:, 0] - v.up_um[:, 0], -199.0)
    assert any("-1, 30 mm" in n for n in v.notes)


@pytest.mark.parametrize("scatter_mm", [0.004, 0.02, 0.2])
def test_logged_positions_scatter_about_their_target(scatter_mm: float) -> None:
    """Oracle: the same test with commanded positions."""
    rng, targets = np.random.default_rng(5), np.array([0.0, 13.0, 29.0, 41.0, 58.0])
    position, sense = walk(targets, 5)
    leg = np.cumsum(np.abs(np.diff(sense, prepend=0)) > 0)
    reading, run = position + 3 * sense + leg, np.zeros(len(position), np.int64)
    commanded = stops("m", position, sense, run, reading)
    logged = stops("m", position + rng.uniform(-0.5, 0.5, len(position)) * scatter_mm, sense, run, reading)
    np.testing.assert_allclose(logged.target_mm, targets, atol=scatter_mm)
    np.testing.assert_array_equal(logged.up_um, commanded.up_um)
    np.testing.assert_array_equal(logged.down_um, commanded.down_um)
    assert any("count as one target" in n for n in logged.notes)
    assert not any("count as one target" in n for n in commanded.notes)


def test_places_that_are_read_once_stay_apart() -> None:
    """A dense stretch beside targets, each of which comes again: nothing is put together."""
    targets = np.concatenate([np.arange(0.0, 0.4, 0.1), [50.0, 100.0, 150.0]])
    position, sense = walk(targets, 3)
    v = stops("m", position, sense, np.zeros(len(position), np.int64), position)
    np.testing.assert_allclose(v.target_mm, targets)


def test_one_direction_only_and_missing_readings_are_said() -> None:
    holes = UP.copy()
    holes[1, 2] = np.nan
    r = positioning(Visits("t", TARGET, holes, np.full_like(UP, np.nan)))
    assert r.both is None
    assert r.drift is None
    text = " ".join(r.warnings)
    assert "1 readings are missing" in text
    assert "one direction" in text


def test_a_target_read_once_is_an_error() -> None:
    lone = UP.copy()
    lone[2, 1:] = np.nan
    with pytest.raises(MeasurementError, match="target 111 mm has 1 reading"):
        positioning(Visits("t", TARGET, lone, DOWN))
    with pytest.raises(MeasurementError, match="no target was approached twice"):
        stops("m", np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0, 1.0]), np.zeros(3, np.int64), np.zeros(3))


DAT = """UNIT=um
CYCLES=2
POSITIONS=2
TGT_DATA[1]=2000
TGT_DATA[2]=1000
REF_DATA_FWD[1,1]=2001
REF_DATA_FWD[1,2]=2003
REF_DATA_FWD[2,1]=1005
REF_DATA_FWD[2,2]=1007
REF_DATA_BWD[1,1]=1998
REF_DATA_BWD[1,2]=1998
REF_DATA_BWD[2,1]=1000
REF_DATA_BWD[2,2]=1001
"""


def test_dat_in_micrometres_with_falling_targets(tmp_path: Path) -> None:
    """Oracle: differences on paper; FWD runs through falling targets, so it approaches downwards."""
    file = tmp_path / "a.dat"
    file.write_text(DAT)
    v = read_dat(file)
    np.testing.assert_allclose(v.target_mm, [1.0, 2.0])
    np.testing.assert_allclose(v.down_um, [[5, 7], [1, 3]])
    np.testing.assert_allclose(v.up_um, [[0, 1], [-2, -2]])
    swapped = read_dat(file, swap=True)
    np.testing.assert_allclose(swapped.up_um, v.down_um)


@pytest.mark.parametrize(("old", "new", "said"), [("UNIT=um", "UNIT=deg", "linear"), ("2]=1001", "2]=x", "line 13")])
def test_a_wrong_dat_is_told(tmp_path: Path, old: str, new: str, said: str) -> None:
    file = tmp_path / "a.dat"
    file.write_text(DAT.replace(old, new))
    with pytest.raises(MeasurementError, match=said):
        read_dat(file)
    with pytest.raises(MeasurementError, match="no such file"):
        read_dat(tmp_path / "b.dat")

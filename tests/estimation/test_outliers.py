"""The one rule for wrong readings. Oracles: rows that were made wrong, and a real file whose README counts them."""

from dataclasses import replace

import numpy as np
import pytest

from rtec.estimation.outliers import clean, wrong_readings
from rtec.estimation.readings import read
from rtec.metrology.measurement import Measurement
from tests.support import proof
from tests.support.characterise_examples import Probe, ProbeSetup, measurement, runs
from tests.support.diagnosis_examples import laser
from tests.support.frame_thermal import recorded

SCALE = "scale,component=EXX,axis=X,k=12"


def spoilt(m: Measurement, rows: list[int], by: list[float]) -> Measurement:
    values = m.readings["reading_um"].copy()
    values[rows] += by
    return replace(m, readings={"reading_um": values})


def found(m: Measurement) -> list[int]:
    return [w.row for w in clean([m]).wrong]


def test_single_wrong_readings_are_found_whatever_their_size() -> None:
    m = measurement(runs([40] * 20), noise_um=0.3)
    rows, by = [37, 202, 415, 640], [400.0, -25.0, 12.0, -1000.0]
    given = clean([spoilt(m, rows, by)])
    assert [w.row for w in given.wrong] == rows
    assert [w.run for w in given.wrong] == [m.run[r] for r in rows]
    np.testing.assert_allclose([w.off for w in given.wrong], by, atol=3.0)
    assert not given.kept[rows].any()


def test_clean_readings_are_kept() -> None:
    """Oracle: normal noise; seven standard deviations happen once in 4e11."""
    for seed in range(20):
        assert not found(measurement(runs([40] * 20), noise_um=0.3, seed=seed))


@pytest.mark.parametrize("cycles", [1, 2, 3, 4])
def test_few_runs_are_kept_too(cycles: int) -> None:
    """Oracle: normal noise about a slope, there and back over twenty targets; a wrong reading in it is found."""
    place = np.tile(np.concatenate([np.linspace(10.0, 190.0, 20), np.linspace(190.0, 10.0, 20)]), cycles)
    way = np.tile(np.repeat([1.0, -1.0], 20), cycles)
    probe = Probe(ProbeSetup(zero="setup"), component="EXX")
    for seed in range(12):
        m = measurement(runs([40] * cycles), noise_um=0.5, seed=seed, instrument=probe)
        values = {"reading_um": m.readings["reading_um"] + 0.1 * place}
        m = replace(m, channels={"x": place, "d_x": way}, readings=values)
        assert not found(m), seed
        assert found(spoilt(m, [17], [30.0])) == [17]


def test_a_burst_where_other_visits_show_nothing_is_wrong() -> None:
    """Two and three in a row at targets that seventeen other runs pass; in all runs it would be the machine."""
    m = laser([SCALE], 8, noise={"white_um": 0.1})
    rows = [100, 101, 212, 213, 214]
    assert found(spoilt(m, rows, [9.0] * 5)) == rows
    target = m.channels["x"][100]
    again = np.flatnonzero(np.abs(m.channels["x"] - target) < 0.01).tolist()
    assert len(again) > 10
    assert not found(spoilt(m, again, [9.0] * len(again)))


def with_places_of_their_own(seed: int) -> Measurement:
    """Sixteen runs there and back past 26 targets each way, of which none comes twice."""
    rng = np.random.default_rng(seed)
    there = (np.arange(26) + rng.uniform(0.02, 0.98, (16, 26))) * 23.0
    back = (np.arange(26) + rng.uniform(0.02, 0.98, (16, 26)))[:, ::-1] * 23.0
    x, way = np.concatenate([there, back], axis=1).ravel(), np.tile(np.repeat([1.0, -1.0], 26), 16)
    curve = 4.0 * np.sin(x / 150.0) + 0.5 * rng.standard_normal(len(x))
    return replace(
        measurement(runs([52] * 16)), channels={"x": x, "d_x": way}, readings={"reading_um": curve},
        instrument=Probe(ProbeSetup(zero="setup"), component="EXX"),
    )  # fmt: skip


@pytest.mark.parametrize("seed", proof.few(range(6), 2))
def test_bursts_at_places_of_their_own_are_wrong_where_other_runs_pass_nearby(seed: int) -> None:
    """Oracle: what was added. No target comes twice; two to five in a row are far off in one run of sixteen.

    A hump of some targets that all runs see is the machine, and kept.
    """
    m = with_places_of_their_own(seed)
    x = m.channels["x"]
    assert not found(m)
    rows = [60, 61, 200, 201, 202, 203, 204, 412, 413, 414, 415]
    assert found(spoilt(m, rows, [15.0] * 11)) == rows
    hump = np.flatnonzero(np.abs(x - 300.0) < 60.0).tolist()
    assert not found(spoilt(m, hump, [15.0] * len(hump)))


@pytest.mark.parametrize("first", [87, 1, 250])
def test_bursts_of_a_machine_at_rest_are_wrong_in_short_runs_and_at_the_ends(first: int) -> None:
    """Oracle: what was added. Five in a row of runs of seventeen, behind the first reading of all, and the last of all.

    A jump that lasts longer is the machine, and kept.
    """
    rng = np.random.default_rng(first)
    heat = 6.0 * (1.0 - np.exp(-np.arange(255) / 60.0)) + 0.3 * rng.standard_normal(255)
    probe = Probe(ProbeSetup(zero="setup"), component="EXX")
    m = replace(measurement(runs([17] * 15), noise_um=0.0), readings={"reading_um": heat}, instrument=probe)
    m = replace(m, channels={k: np.zeros(255) for k in m.channels})
    assert not found(m)
    rows = list(range(first, first + 5))
    assert found(spoilt(m, rows, [30.0] * 5)) == rows
    longer = list(range(120, 255))
    assert not found(spoilt(m, longer, [30.0] * len(longer)))


def test_peaks_that_come_again_are_the_machine() -> None:
    """Nine targets of ninety stand out by 40 noises in each of five runs: the pitch, not the reader."""
    rng = np.random.default_rng(3)
    x = np.tile(np.linspace(0.0, 180.0, 18), 5)
    peaks = np.isin(np.arange(90) % 18, [4, 11])
    peaks[[4, 11]] = True
    m = replace(
        measurement(runs([18] * 5)),
        channels={"x": x, "d_x": np.ones(90)},
        readings={"reading_um": 8.0 * peaks + 0.2 * rng.standard_normal(90)},
        instrument=Probe(ProbeSetup(zero="run"), component="EXX"),
    )
    assert not found(m)


@pytest.mark.parametrize("off_mm", [0.0, 3.0])
@pytest.mark.parametrize("where", ["both ends", "after each reversal"])
def test_ends_that_are_off_in_every_pass_are_the_machine(where: str, off_mm: float) -> None:
    """Oracle: what was added to each of two passes, one there and one back, places up to 3 mm off their targets.

    One of these readings alone off, or three in a row across the reversal, are found.
    """
    rng = np.random.default_rng(4)
    targets = np.linspace(5.0, 195.0, 20)
    x = np.concatenate([targets, targets[::-1]]) + rng.uniform(-off_mm, off_mm, 40)
    way = np.repeat([1.0, -1.0], 20)
    first = [0, 20]
    rows, by = ([0, 19, 20, 39], [8.0] * 4) if where == "both ends" else (first, (8.0 * way[first]).tolist())
    m = replace(
        measurement(runs([20, 20])), channels={"x": x, "d_x": way},
        readings={"reading_um": 0.02 * x + 0.3 * rng.standard_normal(40)},
        instrument=Probe(ProbeSetup(zero="setup"), component="EXX"),
    )  # fmt: skip
    assert not found(spoilt(m, rows, by))
    assert found(spoilt(m, [20], [8.0])) == [20]


@pytest.mark.parametrize("run", range(16))
def test_a_burst_around_the_end_of_the_travel_is_wrong(run: int) -> None:
    """Oracle: what was added. Two readings before the reversal and three behind it, at places of their own."""
    rows = (52 * run + np.arange(24, 29)).tolist()
    assert found(spoilt(with_places_of_their_own(1), rows, [45.0] * 5)) == rows


def test_two_bursts_around_the_end_of_the_travel_do_not_excuse_each_other() -> None:
    """Oracle: what was added. Both hold the first reading behind a reversal at the same feed; the rest comes once."""
    m = with_places_of_their_own(1)
    m = replace(m, channels={**m.channels, "v_x": m.channels["d_x"] * np.repeat(10.0 * 1.5 ** np.arange(8), 104)})
    one, two = 52 + np.arange(22, 27), np.arange(25, 29)
    rows = [*two.tolist(), *one.tolist()]
    assert found(spoilt(m, rows, [25.0] * 4 + [35.0] * 5)) == rows


@pytest.mark.parametrize("seed", proof.few(range(4), 1))
def test_two_bursts_in_one_run_do_not_make_it_a_loud_one(seed: int) -> None:
    """Oracle: what was added: five readings, and three a little later, near the end of a run."""
    rows = [*range(341, 346), *range(360, 363)]
    assert found(spoilt(with_places_of_their_own(seed), rows, [30.0] * 5 + [-60.0] * 3)) == rows


@pytest.mark.parametrize("step", [0.5, 1.0])
def test_one_step_of_a_coarse_display_is_no_mistake(step: float) -> None:
    """Oracle: what was added. Most readings show the same, so that the median of what they are off is nothing."""
    rng = np.random.default_rng(7)
    probe = Probe(ProbeSetup(zero="setup"), component="EXX")
    shown = step * np.round(0.22 * rng.standard_normal(255))
    shown[::40] += step
    m = replace(measurement(runs([17] * 15), noise_um=0.0), readings={"reading_um": shown}, instrument=probe)
    m = replace(m, channels={k: np.zeros(255) for k in m.channels})
    assert not found(m)
    assert found(spoilt(m, [100], [9.0 * step])) == [100]


def test_a_burst_across_a_reversal_is_wrong() -> None:
    """Oracle: what was added. The reading before a reversal and that behind it are no two visits to the place."""
    m = laser([SCALE], 8, noise={"white_um": 0.1})
    way = np.asarray(m.state().value("d_x"))
    turn = int(np.flatnonzero(np.diff(way))[6])
    assert found(spoilt(m, [turn, turn + 1], [9.0, 9.0])) == [turn, turn + 1]


def test_a_burst_is_found_where_every_way_has_a_slope_of_its_own() -> None:
    """A screw that grows unseen made the neighbours look noisy. Oracle: what was added."""
    m = laser([SCALE], 8, noise={"white_um": 0.3})
    way = np.cumsum(np.diff(m.state().value("d_x"), prepend=0.0) != 0.0)
    slopes = np.random.default_rng(2).normal(0.0, 0.06, way[-1] + 1)
    um = slopes[way] * (m.channels["x"] - 100.0)
    grown = replace(m, readings={"reading_um": m.readings["reading_um"] + um})
    assert not found(grown)
    rows = [95, 96, 97]
    assert found(spoilt(grown, rows, [9.0, 8.0, 9.5])) == rows


@pytest.mark.parametrize("length", [15, 24, 40])
def test_readings_of_loud_runs_are_kept(length: int) -> None:
    """Oracle: normal noise, ten times as large in every other run; what is far off among such readings is found."""
    for seed in range(8):
        m = measurement(runs([length] * 16), noise_um=0.0, seed=seed)
        noise = np.random.default_rng(seed).standard_normal(len(m)) * np.where(m.run % 2 == 0, 3.0, 0.3)
        m = replace(m, readings={"reading_um": noise})
        assert not found(m), seed
        loud = int(np.flatnonzero(m.run == 8)[length // 2])
        assert found(spoilt(m, [loud], [60.0])) == [loud]


@pytest.mark.parametrize("first", [100, 137])
@pytest.mark.parametrize("size", [30.0, 900.0])
def test_a_machine_that_is_elsewhere_for_a_while_is_no_mistake_and_a_broken_beam_is(first: int, size: float) -> None:
    """Oracle: eight readings that are off by as much each, and eight that are off by chance."""
    m = laser([SCALE], 8, noise={"white_um": 0.1})
    rows = list(range(first, first + 8))
    assert not found(spoilt(m, rows, [size] * 8))
    wild = size * np.random.default_rng(3).uniform(0.5, 2.0, 8)
    assert found(spoilt(m, rows, list(wild))) == rows


def test_a_long_burst_is_no_mistake_of_reading() -> None:
    m = laser([SCALE], 8, noise={"white_um": 0.1})
    rows = list(range(100, 108))
    assert not found(spoilt(m, rows, [9.0] * 8))


def test_the_numbering_of_runs_does_not_matter_where_nothing_is_anew() -> None:
    """A machine that stands still, three readings a minute: each minute a run, or all of it one."""
    rng = np.random.default_rng(1)
    n = 300
    table = {"T_bed": 20.0 + np.linspace(0.0, 5.0, n)}
    values = 3.0 * table["T_bed"] + rng.standard_normal(n)
    values[[40, 41, 42, 120]] += 900.0
    setup = Probe(ProbeSetup(zero="setup"), component="EX0spindle")
    m = replace(
        measurement(runs([n])), channels=table, readings={"reading_um": values}, instrument=setup,
        time_s=20.0 * np.arange(n, dtype=np.float64),
    )  # fmt: skip
    minutes = replace(m, run=runs([3] * (n // 3)))
    assert found(m) == found(minutes) == [40, 41, 42, 120]


@pytest.mark.parametrize(("size", "counted"), [(900.0, True), (14.0, False)])
def test_gross_mistakes_may_be_more_than_a_few_in_a_hundred(size: float, counted: bool) -> None:
    """A machine that stands still, 12 of 180 readings off. Oracle: which; by so little, so many are what it does."""
    rng = np.random.default_rng(4)
    rows = [4, 21, 37, 52, 70, 86, 103, 119, 133, 150, 163, 175]
    values = rng.standard_normal(180)
    values[rows] += size * rng.choice([-1.0, 1.0], 12)
    setup = Probe(ProbeSetup(zero="setup"), component="EX0spindle")
    m = replace(
        measurement(runs([180])), channels={"T_bed": np.full(180, 20.0)}, readings={"reading_um": values},
        instrument=setup, time_s=20.0 * np.arange(180.0),
    )  # fmt: skip
    assert found(m) == (rows if counted else [])


@pytest.mark.parametrize(("name", "count"), [("gross_outliers", 11), ("wrong_thermistor", 0), ("right_thermistor", 0)])
def test_failed_homings_of_a_gantry(name: str, count: int) -> None:
    """Oracle: README of the data: 11 of 570 readings are off, by up to 4.3 mm; the other files hold none."""
    m = recorded(name)
    off = wrong_readings(read([m], smooth=False))
    assert np.isfinite(off).sum() == count
    if count:
        assert np.nanmax(np.abs(off)) == pytest.approx(4300.0, rel=0.02)


@pytest.mark.parametrize("seed", proof.few(range(3), 1))
def test_wrong_readings_of_a_machine_that_warms_up_are_found(seed: int) -> None:
    """Oracle: the rows made wrong by 23 times the noise; each way has a slope of its own, up to 45 µm in all."""
    growth = "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=40"
    m = laser(
        [
            growth,
            "backlash,component=EXX,axis=X,B=4",
            "cyclic_screw,component=EXX,axis=X,harmonics=1,s1=1,c1=0,pitch=5",
        ],
        seed,
    )
    assert not found(m)
    rows = [70 + seed, 200 + 3 * seed, 333, 501 - seed]
    assert found(spoilt(m, rows, [7.0, -7.0, 7.0, -7.0])) == rows


def test_what_one_place_does_on_two_days_is_the_machine() -> None:
    """A chip at one target in one direction, of another size each time: no mistake of reading."""
    m = laser(["axis_expansion,component=EXX,axis=X,sensor=T_bed,k=40"], 3)
    way, place = np.sign(m.channels["x"] - np.roll(m.channels["x"], 1)), m.channels["x"]
    there = np.flatnonzero((np.abs(place - np.unique(place)[6]) < 0.01) & (way > 0))
    assert not found(spoilt(m, there[[3, 6, 9, 12]].tolist(), [3.3, 5.4, 2.5, 5.8]))

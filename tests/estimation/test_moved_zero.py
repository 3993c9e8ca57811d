"""A run that was zeroed again. Oracle: what was done to the file, and the fit of the file without that run."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.characterise import characterise
from rtec.diagnosis.compare.compare import compare
from rtec.effects.effect_list import read_wanted
from rtec.estimation.moved_zero import moved_zeros
from rtec.estimation.outliers import clean
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support import proof
from tests.support.diagnosis_examples import laser, small_machine

Floats = NDArray[np.float64]
HOT = {"air_degc": 22.0, "body": {"T_bed": {"on_degc": 16.0}}}
TRUTH = ["scale,component=EXX,axis=X,k=30", "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=9"]


def changed(m: Measurement, by: Callable[[NDArray[np.int64]], Floats]) -> Measurement:
    return replace(m, readings={k: v + by(m.run) for k, v in m.readings.items()})


@pytest.mark.parametrize("by", [-12.0, 40.0])
def test_it_is_named(by: float) -> None:
    good = laser(TRUTH, 3)
    bad = changed(good, lambda run: np.where(run == run[0] + 6, by, 0.0))
    (found,) = moved_zeros(clean([bad]).readings)
    assert found.run == good.run[0] + 6
    assert found.by == pytest.approx(by, abs=2.0)
    (doubt,) = compare(Model(small_machine(), (), name="none"), [bad]).doubts
    assert doubt.kind == "moved_zero"
    assert f"run {good.run[0] + 6} is" in doubt.message


def test_fit_leaves_it_out_and_says_so() -> None:
    good = laser(TRUTH, 3)
    bad = changed(good, lambda run: np.where(run == run[0] + 6, 40.0, 0.0))
    lost = changed(good, lambda run: np.where(run == run[0] + 6, np.nan, 0.0))
    wanted = read_wanted("scale,axis_expansion", small_machine())
    whole, without = (characterise([m], wanted=wanted) for m in (bad, lost))
    assert [w.code for w in whole.warnings].count("moved_zero") == 1
    for one, other in zip(whole.coefficients, without.coefficients, strict=True):
        assert one.value == pytest.approx(other.value, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize(
    "moved",
    [[(3, 3), (6, 6), (9, 9)], [(5, 7)], [(4, 5), (8, 8)]],
    ids=["three apart", "three in a row", "two and one"],
)
@pytest.mark.parametrize("warm", [False, True])
def test_several_are_named(moved: list[tuple[int, int]], warm: bool) -> None:
    """Oracle: the runs whose readings were moved by 15 µm here."""
    good = expanding(50) if warm else laser(TRUTH, 3)
    first = int(good.run[0])
    mine = np.any([(good.run >= first + a) & (good.run <= first + b) for a, b in moved], axis=0)
    bad = changed_at(good, 15.0 * mine)
    found = moved_zeros(clean([bad]).readings)
    assert [(f.run - first, f.last - first) for f in found] == moved
    assert [f.by for f in found] == pytest.approx([15.0] * len(moved), abs=1.5)
    texts = [f"run {first + a} is" if a == b else f"runs {first + a} to {first + b} are" for a, b in moved]
    assert all(t in f.message for t, f in zip(texts, found, strict=True))
    assert not found[0].readings[good.run == first].any()


def test_the_middle_one_of_three_runs_is_named() -> None:
    good = laser(TRUTH, 6)
    few = changed(good, lambda run: np.where(run < run[0] + 3, 0.0, np.nan))
    assert not moved_zeros(clean([few]).readings)
    (found,) = moved_zeros(clean([changed(few, lambda run: np.where(run == run[0] + 1, 12.0, 0.0))]).readings)
    assert found.run == good.run[0] + 1


@pytest.mark.parametrize("seed", proof.few(range(3), 1))
def test_a_temperature_that_changed_as_much_without_it_is_no_reason(seed: int) -> None:
    """Oracle: T_air is 1 K off in the run that moved, and goes up and down by 2 K between others that did not move."""
    good = laser(TRUTH, 60 + seed)
    number = good.run - good.run[0]
    course = np.array([0.0, 0.0, 0.0, 0.0, 2.0, 3.0, 2.0, 0.0, 2.0, 0.0, 1.0, 0.0] + [0.0] * 20)
    warm = replace(good, channels={**good.channels, "T_air": 20.0 + course[number]})
    (found,) = moved_zeros(clean([changed_at(warm, np.where(number == 5, 20.0, 0.0))]).readings)
    assert found.run == good.run[0] + 5


@pytest.mark.parametrize(
    "by",
    [
        lambda run: np.where(run > run[0] + 6, 40.0, 0.0),
        lambda run: 8.0 * np.random.default_rng(1).normal(size=20)[run - run[0]],
        lambda run: 12.0 * np.sin(0.7 * (run - run[0])),
        lambda run: 25.0 * ((run - run[0]) % 2),
    ],
    ids=["a step that stays", "every run has its own", "slow there and back", "every other run"],
)
def test_nothing_is_said_where_runs_differ_otherwise(by: Callable[[NDArray[np.int64]], Floats]) -> None:
    assert not moved_zeros(clean([changed(laser(TRUTH, 4), by)]).readings)


def test_a_good_record_has_none() -> None:
    """Oracle: nothing was done to twelve files, with heat that comes and goes and runs that have zeros of their own."""
    for seed in range(12):
        noise = {"white_um": 0.1, "run_offset_um": 1.5 * (seed % 2)}
        assert not moved_zeros(clean([laser(TRUTH, 100 + seed, noise=noise)]).readings)


def test_a_run_that_was_warm_is_none() -> None:
    """Oracle: the reason is in the file."""
    good = laser(TRUTH, 5)
    warm = good.run == good.run[0] + 6
    hot = replace(good, channels={**good.channels, "T_air": good.channels["T_air"] + 6.0 * warm})
    assert not moved_zeros(clean([changed(hot, lambda run: np.where(run == run[0] + 6, 40.0, 0.0))]).readings)


def expanding(seed: int) -> Measurement:
    """A day on which the ends of X move by 25 µm, about its middle."""
    m = laser(TRUTH, seed, thermal=HOT)
    return changed_at(m, -9e-3 * 100.0 * (m.channels["T_bed"] - 20.0))


def changed_at(m: Measurement, added: Floats) -> Measurement:
    return replace(m, readings={k: v + added for k, v in m.readings.items()})


@pytest.mark.parametrize("number", [1, 2, 4, 9])
@pytest.mark.parametrize("by", [-10.0, 30.0])
def test_it_is_named_while_the_machine_warms_up(number: int, by: float) -> None:
    good = expanding(20 + number)
    assert not moved_zeros(clean([good]).readings)
    bad = changed(good, lambda run: np.where(run == run[0] + number, by, 0.0))
    (found,) = moved_zeros(clean([bad]).readings)
    assert found.run == good.run[0] + number
    assert found.by == pytest.approx(by, abs=1.5)


@pytest.mark.parametrize("number", [1, 2, 3, 4])
@pytest.mark.parametrize("runs", [5, 8])
def test_a_zero_that_moves_in_a_warm_up_and_stays_is_none(number: int, runs: int) -> None:
    """With few runs heat bends far enough to make a run that is apart of a step."""
    whole = changed(expanding(30 + number), lambda run: np.where(run >= run[0] + number, 20.0, 0.0))
    early = changed(whole, lambda run: np.where(run < run[0] + runs, 0.0, np.nan))
    assert not moved_zeros(clean([early]).readings)


@pytest.mark.parametrize(("number", "by"), [(1, -20.0), (2, 40.0), (1, 12.0)])
def test_the_thermal_law_is_not_spoilt(number: int, by: float) -> None:
    """Oracle: what was put in. With the second run 20 µm off a fit had a scale of 150 µm/m, and no heat."""
    bad = changed(expanding(40), lambda run: np.where(run == run[0] + number, by, 0.0))
    made = characterise([bad], wanted=read_wanted("scale,axis_expansion,mount_expansion", small_machine()))
    assert made.warnings[0].code == "moved_zero"
    known = {c.effect.split("(")[0]: c.value for c in made.coefficients}
    assert known == pytest.approx({"scale": 30.0, "axis_expansion": 9.0, "mount_expansion": -0.9}, rel=0.06)


def test_a_run_at_another_feed_is_none() -> None:
    """Oracle: the reason is in the file: the axis moved faster in that run."""
    good = laser(TRUTH, 6)
    fast = good.run == good.run[0] + 6
    speed = good.channels["d_x"] * np.where(fast, 80.0, 10.0)
    fed = replace(good, channels={**good.channels, "v_x": speed})
    assert not moved_zeros(clean([changed(fed, lambda run: np.where(run == run[0] + 6, 40.0, 0.0))]).readings)


def noisy(seed: int, runs: int, warm: bool = False) -> Measurement:
    """The first runs of a day, cold or warming up, whose readings scatter by 0.7 µm."""
    thermal = HOT if warm else {"air_degc": 20.0, "swing_degc": 0.0, "walk_degc": 0.0}
    m = laser(TRUTH, seed, noise={"white_um": 0.7}, thermal=thermal)
    return changed(m, lambda run: np.where(run < run[0] + runs, 0.0, np.nan))


@pytest.mark.parametrize("seed", proof.few(range(4), 1))
@pytest.mark.parametrize(
    ("warm", "runs", "first", "last", "by"),
    [
        (False, 9, 3, 3, 8.0),
        (False, 9, 3, 4, -8.0),
        (False, 18, 6, 8, 6.5),
        (False, 7, 2, 2, 9.0),
        (True, 9, 3, 3, 8.0),
        (True, 9, 3, 4, -8.0),
        (True, 18, 6, 8, 6.5),
    ],
)
def test_it_is_named_where_run_means_show_it(
    seed: int, warm: bool, runs: int, first: int, last: int, by: float
) -> None:
    """Oracle: the runs that were moved, by 9 to 13 times the noise; the others differ by noise and heat."""
    good = noisy(200 + seed, runs, warm)
    assert not moved_zeros(clean([good]).readings)
    number = good.run - good.run[0]
    bad = changed_at(good, np.where((number >= first) & (number <= last), by, 0.0))
    (found,) = moved_zeros(clean([bad]).readings)
    assert (found.run - good.run[0], found.last - good.run[0]) == (first, last)
    assert found.by == pytest.approx(by, abs=1.0)


def test_a_small_one_with_a_reason_is_none() -> None:
    """Oracle: the reason is in the file: the air was warmer by 2 K in that run."""
    good = noisy(210, 9)
    mine = good.run - good.run[0] == 3
    moved = changed_at(good, 8.0 * mine)
    warm = replace(moved, channels={**good.channels, "T_air": good.channels["T_air"] + 2.0 * mine})
    assert moved_zeros(clean([moved]).readings)
    assert not moved_zeros(clean([warm]).readings)


@pytest.mark.parametrize("noise", [{"drift_um": 2.0, "drift_tau_s": 2400.0}, {"run_offset_um": 1.0}])
def test_runs_that_wander_have_none(noise: dict[str, float]) -> None:
    """Oracle: nothing was done to eight files of nine runs, whose zero wanders or differs from run to run."""
    for seed in range(8):
        m = laser(TRUTH, 220 + seed, noise={"white_um": 0.3, **noise})
        assert not moved_zeros(clean([changed(m, lambda run: np.where(run < run[0] + 9, 0.0, np.nan))]).readings)

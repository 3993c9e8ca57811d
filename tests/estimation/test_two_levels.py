"""Runs at two levels. Oracle: what was added to the readings, and the channels of the file."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from rtec.diagnosis.compare.compare import compare
from rtec.estimation.judge import Judgement
from rtec.estimation.outliers import clean
from rtec.estimation.two_levels import TwoLevels, two_levels
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support.both import both
from tests.support.diagnosis_examples import effects, laser, small_machine

TRUTH = ["scale,component=EXX,axis=X,k=30", "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=9"]
MODEL = Model(small_machine(), effects(*TRUTH), name="m")
HIGH = (2, 3, 6, 8, 9, 13, 17)
"""Runs of eighteen in which something acted that nobody noted."""


def raised(m: Measurement, runs: Sequence[int], by: float, **channels: np.ndarray) -> Measurement:
    number = m.run - m.run[0] + 1
    readings = {k: v + by * np.isin(number, runs) for k, v in m.readings.items()}
    return replace(m, readings=readings, channels={**m.channels, **channels})


def found(*measurements: Measurement) -> list[TwoLevels]:
    judged = Judgement(MODEL, clean(measurements).without_ends())
    return two_levels(judged.readings, judged.left)


@pytest.mark.parametrize("by", [2.0, -6.0])
def test_what_nobody_noted_is_no_effect_of_the_machine(by: float) -> None:
    m = raised(laser(TRUTH, 3), HIGH, by)
    (levels,) = found(m)
    assert levels.readings.max() == pytest.approx(abs(by), abs=0.2)
    raised_runs = {k for k, high in enumerate(levels.high, 1) if high}
    assert raised_runs == (set(HIGH) if by > 0.0 else set(range(1, 19)) - set(HIGH))
    d, done = both(MODEL, [m], draws=50)
    assert d.verdict == "undecided"
    assert d.sentence.startswith("laser-x-3 reading_um: the runs are at two levels")
    assert not d.findings or not d.findings[0].accepted
    assert [b.kind for b in compare(MODEL, [m]).doubts] == ["two_levels"]
    assert done.model.effects == MODEL.effects


def test_the_runs_are_named_by_their_numbers_in_the_file() -> None:
    m = raised(laser(TRUTH, 3), (2, 3, 4, 8, 10), 5.0)
    (levels,) = found(m)
    first = int(m.run[0]) - 1
    assert f"runs {first + 2} to {first + 4}, {first + 8}, {first + 10} are higher" in levels.message


def test_a_recorded_load_is_a_reason() -> None:
    """A load in these runs, and a spindle speed at which something resonates: both are on record."""
    m = laser(TRUTH, 3)
    number = m.run - m.run[0] + 1
    load = 80.0 * np.isin(number, HIGH)
    assert not found(raised(m, HIGH, 4.0, load_kg=load))
    speeds = np.where(np.isin(number, HIGH), 3000.0, np.where(number % 2, 500.0, 6000.0))
    assert not found(raised(m, HIGH, 4.0, spindle_rpm=speeds))


def test_a_limit_of_a_recorded_speed_is_a_reason() -> None:
    """Above 5000 1/min something gives way; the lowest such speed is nearer to those below."""
    m, speeds = laser(TRUTH, 3), np.linspace(0.0, 4800.0, 18)
    speeds[np.array(HIGH) - 1] = np.linspace(5200.0, 9000.0, len(HIGH))
    number = m.run - m.run[0] + 1
    assert not found(raised(m, HIGH, 5.0, spindle_rpm=speeds[number - 1]))


def test_one_step_that_lasts_and_one_to_and_fro_are_other_things() -> None:
    assert not found(raised(laser(TRUTH, 3), range(9, 19), 4.0))
    assert not found(raised(laser(TRUTH, 3), (7, 8, 9), 4.0))


def test_runs_that_scatter_stand_at_no_level() -> None:
    """A random offset of each run, a random walk of them, and a daily swing."""
    rng = np.random.default_rng(5)
    for seed in range(6):
        m = laser(TRUTH, 20 + seed)
        number = m.run - m.run[0]
        offsets = rng.standard_normal(18)
        for by in (offsets, np.cumsum(offsets), 3.0 * np.sin(np.arange(18) * 0.7)):
            assert not found(replace(m, readings={k: v + by[number] for k, v in m.readings.items()}))


def test_a_zero_of_each_run_hides_the_levels() -> None:
    assert not found(raised(laser(TRUTH, 3, setup={"zero": "run"}), HIGH, 4.0))


def test_runs_that_read_the_same_are_at_no_level() -> None:
    """A display that is stuck, or coarser than anything that happens."""
    m = laser(TRUTH, 3)
    assert not found(replace(m, readings={"reading_um": np.zeros(len(m))}))

"""Events of one record, which no model for other days can hold. Oracle: what was done to the file, and another day."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import rtec
from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.extend.add import add, new_effect
from rtec.diagnosis.extend.improve import Improved, improve
from rtec.diagnosis.result import Diagnosis
from rtec.diagnosis.search.diagnose import diagnose
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.report.history import improved_page
from rtec.sim.campaign.truth import effect_from_text
from tests.support import proof
from tests.support.both import both
from tests.support.diagnosis_examples import NOISE_UM, effects, laser, small_machine
from tests.support.setups import CONFIGS

KNOWN = [
    "scale,component=EXX,axis=X,k=30", "backlash,component=EXX,axis=X,B=3",
    "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=9",
]  # fmt: skip
HIDDEN = "cyclic_screw,component=EXX,axis=X,harmonics=1,s1=1.5,c1=0,pitch=5"
JUMP_UM = 9.0


def known() -> Model:
    return Model(small_machine(), effects(*KNOWN), name="known")


def jumped(m: Measurement, share: float = 0.5) -> tuple[Measurement, float]:
    """The same with another zero from a run on, and the time at which that run begins."""
    runs = np.unique(m.run)
    later = m.run >= runs[int(share * len(runs))]
    read = {k: v + JUMP_UM * later for k, v in m.readings.items()}
    return replace(m, readings=read), float(m.time_s[np.argmax(later)])


def rms(model: Model, m: Measurement) -> float:
    return compare(model, [m]).judged.residual


@cache
def after_a_jump() -> tuple[Improved, float]:
    m, at = jumped(laser([*KNOWN, HIDDEN], 21))
    return improve(known(), [m], draws=50), at


@cache
def moved() -> tuple[Diagnosis, Improved, float]:
    m, at = jumped(laser(KNOWN, 11))
    return *both(known(), [m], draws=50), at


@pytest.mark.xdist_group("moved")
def test_a_zero_that_moved_is_not_written_into_the_model() -> None:
    d, done, at = moved()
    assert d.findings[0].effect.effect == "missed_counts"
    assert d.sentence.endswith("; a display that was zeroed again, or a set-up that was touched, makes the same jump")
    assert not done.steps
    assert done.model.hash == known().hash
    assert done.reason == "nothing_missing"
    (event,) = done.events
    assert event.size == pytest.approx(JUMP_UM, abs=0.3)
    assert event.time_s == pytest.approx(at, abs=60.0)


def test_a_level_that_was_touched_is_no_heat_of_the_spindle() -> None:
    """An ambient drift of 34 µrad/K had been written for a step while the air moved by 0.04 K."""
    roll = "polynomial_position,component=EAX,axis=X,degrees=[1],c1=12"
    mill = CONFIGS / "machines" / "vertical-mill.toml"
    m, at = jumped(rtec.simulate(mill, "level", axis="X", setup={"about": "A"}, effects=[roll], seed=4).measurement)
    model = Model(m.machine, (effect_from_text(roll, m.machine),), name="known")
    done = improve(model, [m], draws=50)
    (event,) = done.events
    assert done.model.hash == model.hash
    assert event.size == pytest.approx(JUMP_UM, abs=0.3)
    assert event.time_s == pytest.approx(at, abs=60.0)


@pytest.mark.xdist_group("after-a-jump")
def test_the_other_effects_are_found_beside_it_and_another_day_is_predicted() -> None:
    done, at = after_a_jump()
    assert [s.labels for s in done.steps] == [("cyclic_screw(EXX, X)",)]
    (event,) = done.events
    assert event.time_s == pytest.approx(at, abs=60.0)
    other = laser([*KNOWN, HIDDEN], 22)
    assert rms(done.model, other) < 1.1 * NOISE_UM < 0.5 * rms(known(), other)


def test_numbers_that_are_out_of_date_do_not_follow_it() -> None:
    """The backlash has grown from 3 to 5 µm."""
    worn = [KNOWN[0], KNOWN[1].replace("B=3", "B=5"), KNOWN[2]]
    done = improve(known(), [jumped(laser(worn, 31, protocol="cold", cycles=8))[0]], draws=50)
    assert done.refit is not None
    assert len(done.events) == 1
    assert rms(done.model, laser(worn, 32, protocol="cold", cycles=8)) < 1.1 * NOISE_UM


def test_numbers_that_were_fitted_to_it_are_refitted_without_it() -> None:
    """The model was fitted to the record with the jump, which its numbers had taken up."""
    m, _ = jumped(laser(KNOWN, 51))
    poor = add(known(), [], [m], own=0).model
    other = laser(KNOWN, 52)
    assert rms(poor, other) > 2.0 * NOISE_UM
    done = improve(poor, [m], draws=50)
    assert len(done.events) == 1
    assert done.refit is not None
    assert rms(done.model, other) < 1.2 * NOISE_UM


def test_what_wears_while_it_is_measured_leaves_the_numbers_at_its_mean() -> None:
    """The backlash grows all day. Oracle: the model that knew its mean, on the same readings."""
    m = laser([*KNOWN, "backlash_wear,component=EXX,axis=X,w=0.6"], 61)
    hours = m.time_s / 3600.0
    mean = [KNOWN[0], f"backlash,component=EXX,axis=X,B={3.0 + 2.0 * 0.6 * hours.mean():.3f}", KNOWN[2]]
    fair = Model(small_machine(), effects(*mean), name="fair")
    done = improve(fair, [m], draws=50)
    assert [e.label for e in done.events] == ["backlash_wear(EXX, X)"]
    assert rms(done.model, m) <= 1.01 * rms(fair, m)


@pytest.mark.xdist_group("after-a-jump")
def test_it_is_reported_with_the_time_and_what_to_do() -> None:
    done, _ = after_a_jump()
    lead = improved_page(done, figures=False).lead
    assert "laser-x-21: at " in lead
    assert "between run 9 and run 10, the readings jump by +9" in lead
    assert "not written into the model" in lead
    assert done.facts()["events"][0]["measurement"] == "laser-x-21"


@pytest.mark.xdist_group("moved")
def test_the_jump_comes_first_and_nothing_else_is_said_to_be_missing() -> None:
    """`diagnose` names it on the same file."""
    lead = improved_page(moved()[1], figures=False).lead
    assert re.match(r"laser-x-11: at \d+ s, between run 9 and run 10, the readings jump by \+[89]\.\d µm", lead)
    assert "No effect was added. Beside that no effect is missing that these readings could show (half " in lead
    assert lead.count("missing") == 1


def test_added_by_hand_it_warns() -> None:
    m, at = jumped(laser(KNOWN, 11))
    (effect,) = effects(f"missed_counts,component=EXX,axis=X,q=5,t0={at}")
    made = add(known(), [new_effect(effect.effect, known(), {"t0": at})], [m])
    assert made.better
    assert any("missed_counts(EXX, X) belongs to this record" in n for n in made.notes)


@pytest.mark.parametrize("seed", proof.few([2, 6, 8], 2))
def test_counts_that_are_lost_between_two_runs_are_no_temperature(seed: int) -> None:
    """The zero jumps by eight times the noise before a run. Oracle: the jump.

    A drift that lasts as long as the record follows it, too; beside that drift another instant seems better.
    """
    static = ["scale,component=EXX,axis=X,k=10", "backlash,component=EXX,axis=X,B=2"]
    m = laser(static, seed, noise={"white_um": 0.4})
    first = np.flatnonzero(m.run == np.unique(m.run)[7 + seed])[0]
    values = m.readings["reading_um"] + 3.2 * (np.arange(len(m)) >= first)
    model = Model(small_machine(), effects(*static))
    d = diagnose(model, [replace(m, readings={"reading_um": values})], draws=50)
    assert d.verdict == "missing_effect"
    assert d.findings[0].effect.effect == "missed_counts"
    assert m.time_s[first - 1] <= d.findings[0].theta["t0"] < m.time_s[first]
    assert d.findings[0].parameters["q"].value == pytest.approx(3.2, abs=0.3)

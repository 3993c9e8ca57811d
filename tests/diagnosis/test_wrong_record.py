"""Faults of a record that a refit would take up. Oracle: what was done to the file, and another day that was not.

The model was fitted to an earlier day, and met it.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.extend.add import add, refused
from rtec.diagnosis.extend.improve import improve
from rtec.diagnosis.search.diagnose import diagnose
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support import proof
from tests.support.both import both
from tests.support.diagnosis_examples import NOISE_UM, effects, laser, small_machine

SCALE, PLAY = "scale,component=EXX,axis=X,k=60", "backlash,component=EXX,axis=X,B=3"
BOW = "polynomial_position,component=EXX,axis=X,degrees=[2,3],c2=7,c3=12"
HEAT = "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=11"
KNOWN = [SCALE, PLAY, BOW, HEAT]
HOT: dict[str, Any] = {"air_degc": 20.0, "body": {"T_bed": {"on_degc": 12.0}}}


def day(truth: list[str], seed: int, thermal: Mapping[str, Any] = HOT) -> Measurement:
    return laser(truth, seed, thermal=thermal, log_every_s=60.0)


@cache
def fitted() -> Model:
    return add(Model(small_machine(), effects(*KNOWN), name="known"), [], [day(KNOWN, 1)]).model


def turned(m: Measurement) -> Measurement:
    there = {"x": 200.0 - m.channels["x"], "d_x": -m.channels["d_x"]}
    return replace(m, channels={**m.channels, **there})


def late(m: Measurement, by_s: float) -> Measurement:
    there = {n: np.interp(m.time_s - by_s, m.time_s, m.channels[n]) for n in ("T_bed", "T_air")}
    return replace(m, channels={**m.channels, **there})


def moved(m: Measurement, by_mm: float) -> Measurement:
    return replace(m, channels={**m.channels, "x": m.channels["x"] + by_mm})


def rms(model: Model, m: Measurement) -> float:
    return compare(model, [m]).judged.residual


WRONG: dict[str, tuple[Callable[[], Measurement], str]] = {
    "turned_axis": (lambda: turned(day(KNOWN, 11)), "with X turned round (x read as 200 mm - x) the model leaves "),
    "late_temperatures": (
        lambda: late(day(KNOWN, 12), 1500.0), "with all temperatures moved 25 min earlier the model leaves ",
    ),
    "moved_origin": (lambda: moved(day(KNOWN, 13), 1.5), "with x moved by -1."),
}  # fmt: skip


@pytest.mark.parametrize("kind", WRONG)
def test_the_fault_is_named_and_nothing_is_fitted(kind: str) -> None:
    record, said = WRONG[kind]
    wrong = record()
    d, done = both(fitted(), [wrong], draws=50)
    assert [(x.kind, x.fatal) for x in d.doubts] == [(kind, True)]
    assert d.verdict == "undecided"
    assert said in d.sentence
    assert done.reason == "undecided"
    assert done.model.hash == fitted().hash
    made = add(fitted(), [], [wrong])
    assert not made.better
    assert said in refused(made)


def test_a_refit_to_it_would_do_harm() -> None:
    """Why it is asked about: another day, and what `--force` writes where nobody knows how sure the numbers are."""
    unsure = replace(fitted(), effects=tuple(replace(f, errors={}) for f in fitted().effects))
    other = day(KNOWN, 14)
    assert rms(fitted(), other) < 1.2 * NOISE_UM
    for record, _ in WRONG.values():
        assert rms(add(unsure, [], [record()]).model, other) > 1.4 * NOISE_UM


@pytest.mark.parametrize("worn", [SCALE.replace("60", "75"), PLAY.replace("3", "7"), HEAT.replace("11", "15")])
def test_a_number_that_has_changed_is_no_fault_of_the_record(worn: str) -> None:
    now = [worn if t.split(",")[0] == worn.split(",", maxsplit=1)[0] else t for t in KNOWN]
    done = improve(fitted(), [day(now, 21)], draws=50)
    assert done.refit is not None
    assert rms(done.model, day(now, 22)) < 1.1 * NOISE_UM


NEW = [
    "mount_expansion,component=EXX,sensor=T_bed,k=0.4",
    "cyclic_screw,component=EXX,axis=X,harmonics=1,s1=1.5,c1=0,pitch=5",
]


@pytest.mark.parametrize("new", NEW)
def test_a_new_effect_is_no_fault_of_the_record(new: str) -> None:
    d = diagnose(fitted(), [day([*KNOWN, new], 31)], draws=50)
    assert not any(x.fatal for x in d.doubts)
    assert new.split(",", maxsplit=1)[0] in {f.effect.effect for f in d.group}


def test_a_delay_that_the_model_lacks_on_the_readings_of_its_fit_is_no_clock() -> None:
    """The body follows its sensor by 25 minutes; the model was fitted to this file, so it never was right."""
    lags = [*KNOWN[:3], f"{HEAT},lag=true,tau=1500"]
    m = day(lags, 41)
    poor = add(Model(small_machine(), effects(*KNOWN), name="known"), [], [m]).model
    assert not diagnose(poor, [m], draws=50).doubts


def test_a_model_by_hand_is_asked_about_the_clock_as_well() -> None:
    by_hand = Model(small_machine(), effects(*KNOWN), name="by hand")
    early = late(day(KNOWN, 12), -1200.0)
    d, done = both(by_hand, [early], draws=50)
    assert [x.kind for x in d.doubts if x.fatal] == ["late_temperatures"]
    assert "with all temperatures moved 20 min later the model leaves" in d.sentence
    assert not done.steps


def test_a_part_before_its_sensor_may_be_the_clock() -> None:
    """In a smooth warm-up a sensor that is warm after its part and a clock that is late look the same."""
    by_hand = Model(small_machine(), effects(*KNOWN), name="by hand")
    d = diagnose(by_hand, [late(day(KNOWN, 12), 1500.0)], draws=50)
    assert [(x.kind, x.fatal) for x in d.doubts] == [("late_temperatures", False)]
    assert "unless the sensors warm up that much later than their parts" in d.doubts[0].message
    assert d.findings[0].effect.effect == "axis_expansion"


@pytest.mark.parametrize("hours", [1.0, 2.0])
def test_temperatures_that_are_late_by_whole_hours_are_of_another_time_zone(hours: float) -> None:
    by_hand = Model(small_machine(), effects(*KNOWN), name="by hand")
    d = diagnose(by_hand, [late(day(KNOWN, 12), 3600.0 * hours)], draws=50)
    assert [(x.kind, x.fatal) for x in d.doubts] == [("late_temperatures", True)]
    assert "by time zone or summer time" in d.sentence
    assert not d.group


@pytest.mark.parametrize("tau_s", [400, 1500, 4000])
def test_a_delay_that_a_model_by_hand_lacks_is_no_clock(tau_s: float) -> None:
    by_hand = Model(small_machine(), effects(*KNOWN), name="by hand")
    m = day([*KNOWN[:3], f"{HEAT},lag=true,tau={tau_s}"], 42)
    d = diagnose(by_hand, [m], draws=50)
    assert "late_temperatures" not in [x.kind for x in d.doubts]
    assert d.findings[0].effect.effect == "axis_expansion"


@pytest.mark.parametrize("seed", proof.few([61, 65], 1))
def test_numbers_do_not_follow_an_instrument_that_warms_up(seed: int) -> None:
    """Oracle: 1.2 µm (1 - exp(-t/1 h)) was taken from the readings; the machine is as it was."""
    m = day(KNOWN, seed, {"air_degc": 20.0, "body": {"T_bed": {"on_degc": 4.0}}})
    warms = {k: v - 1.2 * (1.0 - np.exp(-m.time_s / 3600.0)) for k, v in m.readings.items()}
    done = improve(fitted(), [replace(m, readings=warms)], draws=50)
    assert done.reason == "undecided"
    assert [d.kind for d in done.diagnoses[-1].doubts] == ["instrument_warm_up"]
    assert done.model.hash == fitted().hash

"""A free choice on a record that was taken while the machine warmed up, judged on another day.

Oracle: the law of the generator, which shares no code with the program: least squares with its columns.
"""

from dataclasses import replace

import numpy as np
import pytest

from rtec.characterise import Characterisation, characterise
from rtec.effects.effect_list import read_wanted
from rtec.estimation.columns import base_of, ordered
from rtec.estimation.readings import read
from rtec.metrology.instruments.registry import make_instrument
from tests.support import proof
from tests.support.diagnosis_examples import laser, small_machine
from tests.support.warming import Warming, warming


def other_day_um(found: Characterisation, w: Warming) -> float:
    return w.missed_um(base_of(found.model, read([w.other])).predicted)


def most_over_sum(found: Characterisation, w: Warming) -> float:
    """The largest contribution of an effect over that of all together, standard deviations."""
    readings = read([w.given])
    parts = [readings.columns(f.effect, f.theta) @ ordered(f, readings) for f in found.model.effects]
    return float(max(np.std(p) for p in parts) / np.std(np.sum(parts, axis=0)))


@pytest.mark.parametrize(
    ("seed", "runs", "source", "lag_s"),
    proof.few(
        [
            (42, 8, "T_bed", 0.0),
            (86, 8, "T_nut", 2500.0),
            (119, 20, "T_nut", 900.0),
            (76, 20, "T_nut", 2500.0),
            (2, 12, "T_nut", 2500.0),
            (62, 12, "T_nut", 2500.0),
        ],
        2,
    ),
)
def test_another_day_is_predicted_as_by_the_law(seed: int, runs: int, source: str, lag_s: float) -> None:
    w = warming(seed, runs, source=source, lag_s=lag_s)
    found = characterise([w.given])
    assert other_day_um(found, w) < w.lawful_um + 0.3
    assert most_over_sum(found, w) < 2.0


@pytest.mark.parametrize(
    ("seed", "runs", "source", "lag_s"),
    [(16, 6, "T_air", 2500.0), (115, 6, "T_bed", 0.0), (200, 6, "T_air", 2500.0), (498, 12, "T_air", 900.0)],
)
def test_no_effects_that_cancel_on_a_short_record(seed: int, runs: int, source: str, lag_s: float) -> None:
    """The record tells too little of the law, so the other day is at least met better than by no model at all."""
    w = warming(seed, runs, source=source, lag_s=lag_s)
    found = characterise([w.given])
    assert most_over_sum(found, w) < 1.5
    assert other_day_um(found, w) < w.missed_um(np.zeros(len(w.other)))


@pytest.mark.parametrize(("seed", "runs"), [(196, 6), (257, 12)])
def test_two_delays_of_one_temperature_do_not_take_back_what_each_makes(seed: int, runs: int) -> None:
    """They had fitted how fast it changes. Oracle: the law has one delay, of another temperature."""
    w = warming(seed, runs, source="T_air", lag_s=900.0)
    found = characterise([w.given])
    late = [getattr(f.effect, "sensor", "") for f in found.model.effects if f.theta]
    assert len(late) == len(set(late))
    assert other_day_um(found, w) < w.missed_um(np.zeros(len(w.other)))


@pytest.mark.parametrize("seed", proof.few([16, 73, 107], 2))
def test_no_delay_is_longer_than_half_of_the_record(seed: int) -> None:
    """A temperature that lags by more hardly moves, so that its number may be of any size."""
    w = warming(seed, 8, source="T_air", lag_s=2500.0)
    longest = 0.5 * float(np.ptp(w.given.time_s))
    delays = [f.theta["tau"] for f in characterise([w.given]).model.effects if "tau" in f.theta]
    assert all(tau < 1.0001 * longest for tau in delays)


@pytest.mark.parametrize("seed", proof.few([1, 2, 3, 4], 2))
def test_a_machine_that_does_not_grow_gets_no_temperature(seed: int) -> None:
    """Oracle: only a scale error and a backlash were put in."""
    found = characterise([warming(seed, 8, grows=False).given])
    assert {f.effect.effect for f in found.model.effects} <= {"scale", "backlash"}


@pytest.mark.parametrize(
    ("truth", "warned"),
    [("scale,component=EXX,axis=X,k=25", True), ("axis_expansion,component=EXX,axis=X,sensor=T_bed,k=12", False)],
)
def test_an_expansion_beyond_all_materials_is_warned_of(truth: str, warned: bool) -> None:
    """Oracle: handbooks, steel 12 and aluminium 23 µm/(m·K). A constant scale, where only expansions may be fitted."""
    made = characterise([laser([truth], 3)], wanted=read_wanted("axis_expansion", small_machine()))
    assert ("expands_much" in [w.code for w in made.warnings]) is warned


def test_a_named_straightness_has_the_degrees_of_its_help() -> None:
    """Oracle: the cubic that was put in, and `rtec effects straightness`: degrees 2 and 3 if none are given."""
    laid, rng = laser([], 5), np.random.default_rng(5)
    u = laid.channels["x"] / 100.0 - 1.0
    away = 3.0 * (1.5 * u**2 - 0.5) - 1.0 * (2.5 * u**3 - 1.5 * u) + 0.3 * rng.standard_normal(len(u))
    probe = make_instrument(
        "straightness", {"direction": "Z", "probe_offset_mm": [0.0, 0.0, 0.0]}, "X", None, laid.machine, "test"
    )
    m = replace(laid, instrument=probe, readings={"reading_um": away})
    made = characterise([m], wanted=read_wanted("straightness", small_machine()))
    assert {c.name: c.value for c in made.coefficients} == pytest.approx({"c2": 3.0, "c3": -1.0}, abs=0.15)
    assert "confounded" not in [w.code for w in made.warnings]

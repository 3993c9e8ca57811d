"""A scale error that only looks changed because the day is warmer. Oracle: what was hidden."""

from dataclasses import replace

import pytest

from rtec.characterise import characterise
from rtec.diagnosis.extend.add import add, asked_effect
from rtec.diagnosis.search.diagnose import diagnose
from rtec.effects.effect_list import read_wanted
from rtec.estimation.warmth import differs_from_fit_day, expands_much
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from rtec.report.history import _refit_words, improved_page
from tests.diagnosis import test_stretched as bar
from tests.support import proof
from tests.support.both import both
from tests.support.diagnosis_examples import effects, laser, small_machine

SCALE = "scale,component=EXX,axis=X,k=12"
GROWTH = "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=10"
"""With that, 3 K make 30 µm/m."""


def day(effects: list[str], seed: int, air_degc: float) -> Measurement:
    thermal = {"air_degc": air_degc, "body": {"T_bed": {"on_degc": 0.0}}}
    return laser(effects, seed, thermal=thermal, protocol="cold")


def first() -> Model:
    wanted = read_wanted("scale:EXX", small_machine())
    return characterise([day([SCALE, GROWTH], 1, 20.0)], wanted=wanted).model


@pytest.mark.parametrize("seed", proof.few([2, 3], 1))
def test_the_warmer_day_is_said_with_the_expansion_that_would_do_it(seed: int) -> None:
    warm = day([SCALE, GROWTH], seed, 23.0)
    d, done = both(first(), [warm], changes=True, draws=50)
    (changed,) = d.changed
    assert changed.warmer is not None
    assert changed.warmer.sensor == "T_bed"
    assert changed.warmer.by_k == pytest.approx(3.0, abs=0.3)
    assert changed.warmer.growth == pytest.approx(10.0, abs=1.0)
    assert "K warmer than in the fit: an expansion of " in improved_page(done, figures=False).lead
    assert "recorded_degc" in done.model.history[-1]


def test_a_number_that_an_added_effect_sets_back_is_not_said_to_have_changed() -> None:
    """Oracle: the numbers of the model in the end."""
    refit = add(first(), [], [day([SCALE, GROWTH], 2, 23.0)])
    assert "have changed since it was fitted: scale(EXX, X) k from " in _refit_words(refit, refit.model)
    back = _refit_words(refit, first())
    assert back.startswith("These readings refine the model's own numbers")
    assert "warmer" not in back


def test_a_scale_that_changed_at_the_same_temperature_is_no_warmth() -> None:
    worn = day(["scale,component=EXX,axis=X,k=42"], 4, 20.0)
    (changed,) = diagnose(first(), [worn], draws=50, explain=True).changed
    assert changed.warmer is None


def test_nothing_grows_so_much() -> None:
    worn = day(["scale,component=EXX,axis=X,k=130"], 5, 23.0)
    (changed,) = diagnose(first(), [worn], draws=50, explain=True).changed
    assert changed.warmer is None


def test_an_angle_that_grows_along_an_axis_is_no_expansion_of_a_material() -> None:
    """A guide of 1 m and 0.3 m high whose top is 1 K warmer turns by 11 µm / 0.3 m, 37 µrad."""
    expansion, turn = effects(GROWTH, "axis_expansion,component=EBX,axis=X,sensor=T_bed,k=37")
    assert expands_much(expansion.effect, 37.0, 1.0)
    assert expands_much(expansion.effect, 4000.0, 3000.0), "one of two that cancel"
    assert not expands_much(expansion.effect, 37.0, 10.0)
    assert not expands_much(turn.effect, 37.0, 1.0)


def by_sensors(*numbers: tuple[str, float]) -> tuple[FittedEffect, ...]:
    """Expansions of X, µm/(m·K), each by a sensor and known to 0.2."""
    (plain,) = effects(GROWTH)
    return tuple(
        FittedEffect(plain.effect.model_copy(update={"sensor": n}), {"k": k}, {}, {"k": 0.2}) for n, k in numbers
    )


@pytest.mark.parametrize(
    ("after", "possible"),
    [
        ((("T_bed", 8.0), ("T_air", 6.0)), True),  # 8 + 6 / 2 on that day
        ((("T_bed", 5.0), ("T_air", 2.0)), False),  # 6 in all
        ((("T_bed", 24.0), ("T_air", -26.0)), False),  # 11 in all, but one takes back what the other makes
        ((("T_bed", 16.0), ("T_bed", -5.0)), True),  # a body that leads or lags its own sensor
    ],
)
def test_several_temperatures_make_together_what_the_day_of_the_fit_showed(
    after: tuple[tuple[str, float], ...], possible: bool
) -> None:
    """Oracle: arithmetic. On that day the bed warmed by 4 K and the air by 2, and X grew by 11 µm per m and K of the
    bed."""
    history = ({"recorded_degc": {"T_bed": [20.0, 24.0], "T_air": [20.0, 22.0]}},)
    was = Model(small_machine(), by_sensors(("T_bed", 11.0)), name="was", history=history)
    now = Model(small_machine(), by_sensors(*after), name="now")
    assert (not differs_from_fit_day(was, now)) == possible


def test_of_two_expansions_against_each_other_the_second_is_no_contradiction_of_the_first() -> None:
    """A scale grows by 18 µm/(m·K) and the work by 11.5, on one record. `add` refused the second: "The expansion of X
    would have been -7.9 on the day of the fit, which showed -11", and that day was the same record.
    """
    day_ = bar.day(1, 0.0, slack=False)
    x, nut, bed = (day_.channels[c] for c in ("x", "T_x_nut", "T_bed"))
    screw = bar.screw_um(x, nut, 0.0)
    grown = day_.readings["reading_um"] - 2.0 * screw + 18e-3 * (x - 300.0) * (bed - 20.0)
    made, days = bar.empty(), [replace(day_, readings={"reading_um": grown})]
    for sensor, fixed_mm in (("T_x_nut", 0.0), ("T_bed", 300.0)):
        given = {"axis": "X", "sensor": sensor, "fixed_mm": fixed_mm}
        added = add(made, [asked_effect("axis_expansion", "EXX", given, made)], days)
        assert (added.better, added.impossible) == (True, ())
        made = added.model
    assert [f.values["k"] for f in made.effects] == pytest.approx([-11.5, 18.0], rel=0.05)

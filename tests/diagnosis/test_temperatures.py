"""Further temperatures of an expansion; oracle: the temperatures that the readings were made from."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest

from rtec.bench.own import own_answer
from rtec.bench.score import held_back
from rtec.bench.sets import measurements_of, model_of
from rtec.bench.trials import build
from rtec.diagnosis.extend import improve as module
from rtec.diagnosis.extend.add import Added, add
from rtec.diagnosis.extend.improve import FURTHER, improve
from rtec.diagnosis.extend.temperatures import further_temperatures
from rtec.effects.thermal import AxisExpansion
from rtec.estimation.judge import Judgement
from rtec.estimation.outliers import clean
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from rtec.wording import duration
from tests.support import proof


def screw(sensor: str, lag: bool = False) -> AxisExpansion:
    return AxisExpansion(component="EXX", axis="X", sensor=sensor, lag=lag)


def made(parts: Mapping[str, float], seed: int) -> tuple[Model, Measurement]:
    """A day of the rig, its readings made from some of its temperatures, µm/m/K, and white noise of 0.4 µm.

    Returns:
        A model that knows the nut's, fitted; and the measurement.
    """
    trial = build("lean", "warm_screw", seed)
    model, (m,) = model_of(trial), measurements_of(trial)
    state = m.state()
    effects = (*model.effects, FittedEffect(screw("T_nut"), {"k": 1.0}))
    grown = [FittedEffect(screw(sensor), {"k": k}) for sensor, k in parts.items()]
    values = 0.4 * np.random.default_rng(seed).standard_normal(len(m))
    for f in (*model.effects, *grown):
        basis = f.effect.basis(model.machine, state, f.theta)
        values += sum(v * np.asarray(b) for v, b in zip(f.values.values(), basis, strict=True))
    m = replace(m, readings={"reading_um": values})
    return add(replace(model, effects=effects), [], [m]).model, m


@pytest.mark.parametrize("seed", proof.few([50, 51, 52], 2))
def test_one_temperature_is_enough_where_one_is_all(seed: int) -> None:
    model, m = made({"T_nut": 4.0}, seed)
    assert not list(further_temperatures(Judgement(model, clean([m], model.reference_degc))))


def test_the_temperature_that_is_missing_is_found() -> None:
    """The screw follows the nut and the bed."""
    model, m = made({"T_nut": 4.0, "T_bed": 9.0}, 50)
    found = next(further_temperatures(Judgement(model, clean([m], model.reference_degc))))
    assert getattr(found.effect, "sensor", "") == "T_bed"


def test_a_model_without_a_temperature_is_offered_none() -> None:
    model, m = made({"T_nut": 4.0, "T_bed": 9.0}, 50)
    alone = replace(model, effects=model.effects[:2])
    assert not list(further_temperatures(Judgement(alone, clean([m], model.reference_degc))))


@pytest.mark.parametrize("seed", proof.few([50, 51, 52], 2))
def test_no_further_temperature_stands_for_a_missing_scale_error(seed: int) -> None:
    """The air acts, too; without a scale error in the model its number would follow that."""
    model, m = made({"T_nut": 4.0, "T_air": 2.0}, seed)
    found = next(further_temperatures(Judgement(model, clean([m], model.reference_degc))))
    assert getattr(found.effect, "sensor", "") == "T_air"
    assert model.effects[0].effect.effect == "scale"
    without = replace(model, effects=model.effects[1:])
    assert not list(further_temperatures(Judgement(without, clean([m], model.reference_degc))))


def test_who_is_asked_at_each_step_is_asked_for_it_too_and_may_leave_it_out() -> None:
    model, m = made({"T_nut": 4.0, "T_air": 2.0}, 50)
    known, labels = replace(model, effects=model.effects[:2]), ("axis_expansion(EXX, X, T_air)",)
    asked: list[tuple[str, ...]] = []

    def answered(wanted: bool) -> Callable[[Added], bool]:
        def ask(made: Added) -> bool:
            asked.append(made.labels)
            return wanted or not made.labels

        return ask

    for wanted in (True, False):
        asked.clear()
        done = improve(known, [m], ask=lambda step: step.finding, ask_made=answered(wanted))
        assert asked.count(labels) == 1
        assert any(FURTHER in s.notes for s in done.steps) is wanted


def test_none_is_tried_where_the_noise_is_all_that_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """The nut is all that the readings were made from; oracle: nobody looks for another."""
    model, m = made({"T_nut": 4.0}, 50)
    looked: list[Judgement] = []
    monkeypatch.setattr(module, "further_temperatures", looked.append)
    done = improve(replace(model, effects=model.effects[:2]), [m])
    assert [s.labels for s in done.steps] == [("axis_expansion(EXX, X, T_nut)",)]
    assert done.reason == "at_floor"
    assert not looked


def test_improve_takes_it_as_a_step_of_its_own_and_says_what_it_is() -> None:
    """The air's part is too small to be named by itself; oracle: both temperatures, and the white noise of 0.4 µm."""
    model, m = made({"T_nut": 4.0, "T_air": 2.0}, 50)
    done = improve(replace(model, effects=model.effects[:2]), [m])
    told = [s for s in done.steps if FURTHER in s.notes]
    assert [s.labels for s in told] == [("axis_expansion(EXX, X, T_air)",)]
    assert done.steps[-1].after.held_out == pytest.approx(0.4, rel=0.06)


def test_of_two_delays_the_name_gives_the_fitted_one() -> None:
    """The search for the delay starts at 300 s. Oracle: the parameter of the fitted effect."""
    model, m = made({"T_nut": 4.0}, 50)
    late = [FittedEffect(screw("T_nut", lag=True), {"k": 1.0}, {"tau": tau}) for tau in (4800.0, 300.0)]
    added = add(replace(model, effects=(*model.effects[:2], late[0])), [late[1]], [m])
    fitted = added.model.effects[-1].theta["tau"]
    assert fitted != pytest.approx(300.0, rel=0.05)
    assert added.labels == (f"axis_expansion(EXX, X, T_nut), {duration(fitted)} late",)


@pytest.mark.parametrize("seed", proof.few([50, 51], 1))
def test_a_body_is_not_warmer_where_another_is_colder(seed: int) -> None:
    """The air acts against the nut. Oracle: a body is as warm as a mean of those around it."""
    model, m = made({"T_nut": 4.0, "T_air": -2.0}, seed)
    found = next(further_temperatures(Judgement(model, clean([m], model.reference_degc))))
    assert getattr(found.effect, "sensor", "") == "T_air"
    done = improve(replace(model, effects=model.effects[:2]), [m])
    assert not [s.labels for s in done.steps if FURTHER in s.notes and "T_nut" not in s.labels[0]]


@pytest.mark.parametrize(
    ("scale", "other", "own", "taken"),
    [(9.0, 0.2, 0.2, True), (-1.7, 0.2, 4.2, False), (0.1, 0.2, 0.4, True), (9.0, 2.0, 0.2, True)],
)
def test_a_further_temperature_leaves_other_effects_determined(
    scale: float, other: float, own: float, taken: bool
) -> None:
    """A scale error of 6.2 ± 0.39 µm/m that another delay of the nut changes; the first delay may become uncertain."""
    model, m = made({"T_nut": 4.0}, 50)
    names = {"k": 6.2}, {"B": 2.0}, {"k": 3.0}
    errors = {"k": 0.39}, {"B": 0.1}, {"k": 0.1}
    before = replace(
        model,
        effects=tuple(FittedEffect(f.effect, v, {}, e) for f, v, e in zip(model.effects, names, errors, strict=True)),
    )
    after = (
        FittedEffect(before.effects[0].effect, {"k": scale}, {}, {"k": own}),
        before.effects[1],
        FittedEffect(before.effects[2].effect, {"k": 3.0}, {}, {"k": other}),
        FittedEffect(screw("T_nut", lag=True), {"k": 2.0}, {"tau": 4000.0}, {"k": 0.1, "tau": 100.0}),
    )
    added = replace(add(model, [], [m]), model=replace(before, effects=after))
    assert module._determined(before, added) is taken


@pytest.mark.parametrize(("what", "seed"), proof.few([("warm_up_warm_screw", 83002), ("any_spindle_heat", 84007)], 1))
def test_where_the_first_is_uncertain_another_is_tried(what: str, seed: int) -> None:
    """A screw between nut, bed and air; a bearing between friction and spindle.

    Oracle: the law of the body, from the exact heat flow; with one temperature the error is 1.15 times as large.
    """
    trial = build("improve", what, seed)
    answer = own_answer(trial)
    held = held_back(trial, answer)
    assert len(answer.claimed) >= 2
    assert held.error <= 1.1 * held.reachable

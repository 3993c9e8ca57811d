"""One pass there and back while the machine warms up: place, direction and heat can stand for each other.

Oracle: what the generator put in, without noise, on another day.
"""

from dataclasses import replace

import numpy as np
import pytest

from rtec.diagnosis.doubts import one_pass
from rtec.diagnosis.extend.improve import Improved, improve
from rtec.effects import effect_class
from rtec.estimation.columns import base_of
from rtec.estimation.readings import read
from rtec.model import FittedEffect, Model
from tests.support.warming import Warming, warming


def improved(w: Warming, scale_um_m: float = 0.0) -> Improved:
    """A model with a scale error, or without any effect, improved as `--yes` does."""
    scale = effect_class("scale", "test").model_validate({"effect": "scale", "component": "EXX", "axis": "X"})
    known = (FittedEffect(scale, {"k": scale_um_m}, errors={"k": 0.3}),) if scale_um_m else ()
    return improve(Model(w.given.machine, known), [w.given], draws=50)


def other_day_um(model: Model, w: Warming) -> float:
    return w.missed_um(base_of(model, read([w.other])).predicted)


@pytest.mark.parametrize("seed", [3, 6, 12, 18])
def test_what_one_pass_cannot_separate_is_not_added(seed: int) -> None:
    w = warming(seed, 1, source="T_screw")
    before = w.missed_um(np.zeros(len(w.other)))
    assert other_day_um(improved(w).model, w) < 1.1 * before


@pytest.mark.parametrize("seed", [19, 23])
def test_a_number_does_not_take_up_heat_in_one_pass(seed: int) -> None:
    """The scale error of the model is the true one; heat beside it is not in the model."""
    w = warming(seed, 1, source="T_screw")
    true = float(np.linalg.lstsq(w.law[0], w.true_um[0], rcond=None)[0][0])
    done = improved(w, true)
    assert done.refit is None
    known = Model(w.given.machine, done.model.effects[:1])
    assert other_day_um(done.model, w) < 1.1 * other_day_um(known, w)


def test_the_doubt_says_what_to_measure() -> None:
    (doubt,) = one_pass(read([warming(1, 1).given]))
    assert "went there and back only once while T_nut changed by" in doubt.message
    assert doubt.next_step == "Repeat the pass, and measure once more when the machine is warm."
    assert not doubt.fatal


def test_two_passes_and_a_machine_without_heat_are_not_doubted() -> None:
    assert one_pass(read([warming(1, 2).given])) == []
    once = warming(1, 1).given
    calm = {n: np.full(len(once), 21.0) for n in once.machine.sensor_names}
    assert one_pass(read([replace(once, channels={**once.channels, **calm})])) == []


@pytest.mark.parametrize("seed", [0, 3, 10, 19])
def test_one_reversal_does_not_show_how_reversals_change(seed: int) -> None:
    """Nothing grows, but a backlash that wears or that a temperature changes would meet the readings."""
    w = warming(seed, 1, grows=False)
    assert other_day_um(improved(w).model, w) < 1.1 * w.missed_um(np.zeros(len(w.other)))


@pytest.mark.parametrize("seed", [2, 5, 9, 13])
def test_scale_and_backlash_are_added_nonetheless(seed: int) -> None:
    """Nothing grows: the simplest explanation is right, and it is taken."""
    w = warming(seed, 1, grows=False)
    done = improved(w)
    assert {f.effect.effect for f in done.model.effects} == {"scale", "backlash"}
    assert other_day_um(done.model, w) < w.lawful_um + 0.3

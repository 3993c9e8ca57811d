"""One pass there and back while the machine warms up: place, direction and heat can stand for each other.

Oracle: what the generator put in, without noise, on another day.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.characterise import characterise
from rtec.diagnosis.extend.improve import Improved, improve
from rtec.effects import effect_class
from rtec.effects.effect_list import read_wanted
from rtec.errors import ModelError
from rtec.estimation.columns import base_of
from rtec.estimation.one_pass import one_pass
from rtec.estimation.readings import read
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from tests.support import proof
from tests.support.diagnosis_examples import laser, read_by
from tests.support.warming import Warming, warming


def improved(w: Warming, scale_um_m: float = 0.0) -> Improved:
    """A model with a scale error, or without any effect, improved as `--yes` does."""
    scale = effect_class("scale", "test").model_validate({"effect": "scale", "component": "EXX", "axis": "X"})
    known = (FittedEffect(scale, {"k": scale_um_m}, errors={"k": 0.3}),) if scale_um_m else ()
    return improve(Model(w.given.machine, known), [w.given], draws=50)


def part(m: Measurement, keep: NDArray[np.bool_]) -> Measurement:
    """Some rows of a measurement."""
    channels, readings = ({k: v[keep] for k, v in values.items()} for values in (m.channels, m.readings))
    return replace(m, run=m.run[keep], time_s=m.time_s[keep], channels=channels, readings=readings)


def other_day_um(model: Model, w: Warming) -> float:
    return w.missed_um(base_of(model, read([w.other])).predicted)


@pytest.mark.parametrize("seed", proof.few([3, 6, 12, 18], 2))
def test_what_one_pass_cannot_separate_is_not_added(seed: int) -> None:
    w = warming(seed, 1, source="T_screw")
    before = w.missed_um(np.zeros(len(w.other)))
    assert other_day_um(improved(w).model, w) < 1.1 * before


@pytest.mark.parametrize("seed", proof.few([19, 23], 1))
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
    assert not doubt.one_way


def test_two_passes_and_a_machine_without_heat_are_not_doubted() -> None:
    assert one_pass(read([warming(1, 2).given])) == []
    once = warming(1, 1).given
    calm = {n: np.full(len(once), 21.0) for n in once.machine.sensor_names}
    assert one_pass(read([replace(once, channels={**once.channels, **calm})])) == []


@pytest.mark.parametrize("seed", proof.few([0, 3, 10, 19], 1))
def test_one_reversal_does_not_show_how_reversals_change(seed: int) -> None:
    """Nothing grows, but a backlash that wears or that a temperature changes would meet the readings."""
    w = warming(seed, 1, grows=False)
    assert other_day_um(improved(w).model, w) < 1.1 * w.missed_um(np.zeros(len(w.other)))


@pytest.mark.parametrize("seed", proof.few([2, 5, 9, 13], 1))
def test_scale_and_backlash_are_added_nonetheless(seed: int) -> None:
    """Nothing grows: the simplest explanation is right, and it is taken."""
    w = warming(seed, 1, grows=False)
    done = improved(w)
    assert {f.effect.effect for f in done.model.effects} == {"scale", "backlash"}
    assert other_day_um(done.model, w) < w.lawful_um + 0.3


def test_fit_says_what_one_pass_cannot_separate_and_takes_places_only_of_one_way() -> None:
    """A bent scale is read once, going one way, while the machine warms. Oracle: the bend; of another day, too."""
    day = warming(3, 1, grows=False)
    once = part(day.given, np.arange(len(day.given)) < len(day.given) // 2)
    bend = 20.0 * ((once.channels["x"] - once.channels["x"].mean()) / np.ptp(once.channels["x"])) ** 2
    once = replace(once, readings={k: v + bend for k, v in once.readings.items()})
    made = characterise([once])
    first = made.warnings[0]
    assert first.code == "one_pass"
    assert "went through once, in one direction" in first.text
    machine = once.machine
    read = {c for f in made.model.effects for c in f.effect.channels(machine)}
    assert read <= {"x"}
    assert characterise([day.given]).warnings[0].code == "one_pass"


def test_fit_of_few_runs_says_that_they_are_few() -> None:
    """Oracle: the number of runs, each of which has a zero of its own."""
    many = laser(["backlash,component=EXX,axis=X,B=0.1"], 5)
    with pytest.raises(ModelError, match=r"2 blocks of readings are too few to choose among \d+ effects"):
        characterise([part(many, many.run < many.run[0] + 3)])


@pytest.mark.parametrize(
    ("name", "setup", "first"),
    [
        ("laser_linear", {}, ["scale(EXX, X)", "backlash(EXX, X)"]),
        ("straightness", {"direction": "Z"}, ["straightness(EZX, X)"]),
        ("laser_angular", {"about": "B"}, ["angular_motion(EBX, X)"]),
        ("level", {"about": "B"}, ["angular_motion(EBX, X)"]),
    ],
)
def test_fit_of_few_runs_names_a_first_model(name: str, setup: dict[str, str], first: list[str]) -> None:
    """Oracle: the words that it proposes, typed; a newcomer had no model to begin with."""
    many = read_by(name, [], 5, "X", setup)
    few = part(many, many.run < many.run[0] + 5)
    with pytest.raises(ModelError, match="for a choice measure at least 8 runs") as caught:
        characterise([few])
    typed = re.search(r"add --effects (\S+), fitted without a choice", str(caught.value))
    assert typed is not None
    made = characterise([few], wanted=read_wanted(typed[1], few.machine))
    assert [f.label for f in made.model.effects] == first

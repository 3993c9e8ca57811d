"""Readings of another machine than the model. Oracle: what each file was simulated with."""

from functools import cache

import pytest

from rtec.characterise import characterise, fitted_model
from rtec.diagnosis.search.diagnose import diagnose
from rtec.effects.effect_list import read_wanted
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support.diagnosis_examples import NOISE_UM, laser

OURS = ["scale,component=EXX,axis=X,k=30", "backlash,component=EXX,axis=X,B=3"]
THEIRS = ["scale,component=EXX,axis=X,k=-45", "backlash,component=EXX,axis=X,B=6"]
HEAT = "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=9"
SCALE, PLAY = "scale,component=EXX,axis=X,k=12", "backlash,component=EXX,axis=X,B=3"
COLD, HOT = ({"air_degc": 20.0, "body": {"T_bed": {"on_degc": on}}} for on in (3.0, 16.0))


@cache
def fitted() -> tuple[Model, tuple[Measurement, ...]]:
    files = tuple(laser([*OURS, HEAT], seed, thermal=HOT) for seed in (1, 2))
    return characterise(files).model, files


def test_a_file_of_another_machine_is_asked_about() -> None:
    d = diagnose(fitted()[0], [laser([*THEIRS, HEAT], 3, thermal=HOT)], draws=50)
    assert [doubt.kind for doubt in d.doubts] == ["other_machine"]
    answer, _, doubt = d.sentence.partition(". The model leaves ")
    assert "out of date" in answer
    assert "µm of laser-x-3, and left " in doubt
    assert "Check whether it is of this machine." in doubt


@pytest.mark.parametrize("thermal", [HOT, COLD], ids=["hot", "cold"])
def test_beside_the_files_of_the_fit_it_is_the_odd_one(thermal: dict[str, object]) -> None:
    """On a colder day, too: the model meets the hot files, so heat is no reason. Two against one is not needed."""
    model, files = fitted()
    other = laser([*THEIRS, HEAT], 4, targets={"step_mm": 17.3}, thermal=thermal)
    for given in (files, files[:1]):
        d = diagnose(model, [*given, other], draws=50)
        assert d.verdict == "undecided"
        assert d.sentence.startswith(f"laser-x-4 contradicts {', '.join(f.name for f in given)}: ")


@pytest.mark.parametrize("thermal", [HOT, COLD], ids=["hot", "cold"])
def test_a_further_file_of_the_same_machine_is_not_doubted(thermal: dict[str, object]) -> None:
    model, files = fitted()
    more = laser([*OURS, HEAT], 5, targets={"step_mm": 17.3}, thermal=thermal)
    for given in ([more], [*files, more]):
        assert not diagnose(model, given, draws=50).doubts


def test_a_model_of_no_fit_and_the_files_of_the_fit_are_not_asked() -> None:
    model, files = fitted()
    poor = characterise(files[:1]).model
    own = Model(model.machine, model.effects[:1], name="by hand")
    assert not any(d.kind == "other_machine" for d in diagnose(poor, files[:1], draws=50).doubts)
    assert not any(d.kind == "other_machine" for d in diagnose(own, files, draws=50).doubts)


def test_what_nothing_describes_is_not_called_nothing() -> None:
    """The screw's wave is there on the second, warmer day only. Oracle: the noise, a quarter of the residual."""
    wave = "cyclic_screw,component=EXX,axis=X,s1=2.5,c1=0,pitch=5"
    first = laser([SCALE, PLAY], 101, thermal=COLD)
    second = laser([SCALE, PLAY, wave], 102, thermal=HOT)
    model = fitted_model([first], wanted=read_wanted("scale,backlash", first.machine))
    d = diagnose(model, [first, second], draws=50)
    assert d.rms_residual > 4.0 * NOISE_UM
    assert d.verdict == "undecided"
    assert [doubt.kind for doubt in d.doubts if doubt.fatal] == ["unexplained"]
    assert "Diagnose each file alone" in d.sentence
    assert not diagnose(model, [first], draws=50).doubts

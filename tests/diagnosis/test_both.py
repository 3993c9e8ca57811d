"""`improve` begins with the diagnosis that `diagnose` makes; tests that need both make it once. Oracle: each other."""

from dataclasses import replace

import pytest

from rtec.diagnosis.extend.improve import improve
from rtec.diagnosis.search.diagnose import diagnose
from rtec.model import Model
from tests.support.both import both
from tests.support.diagnosis_examples import effects, laser, small_machine

SCALE, PLAY = "scale,component=EXX,axis=X,k=12", "backlash,component=EXX,axis=X,B=5"
WORN, WAVE = PLAY.replace("5", "9"), "cyclic_screw,component=EXX,axis=X,pitch=5,s1=1.5,c1=0"


@pytest.mark.parametrize("truth", [(SCALE, PLAY), (SCALE, PLAY, WAVE), (SCALE, WORN)])
def test_the_first_diagnosis_of_an_improvement_is_that_of_diagnose(truth: tuple[str, ...]) -> None:
    """Nothing is missing, an effect is, or numbers are out of date."""
    model, files = Model(small_machine(), effects(SCALE, PLAY), name="known"), [laser(truth, 3)]
    found, done = both(model, files, draws=50)
    assert found.facts() == diagnose(model, files, draws=50).facts()
    assert done.facts() == improve(model, files, draws=50).facts()
    assert (done.refit is not None) == (WORN in truth)


def test_the_numbers_that_changed_are_those_of_an_explained_diagnosis() -> None:
    fitted = tuple(replace(f, errors=dict.fromkeys(f.values, 0.2)) for f in effects(SCALE, PLAY))
    model, files = Model(small_machine(), fitted, name="known"), [laser((SCALE, WORN), 3)]
    found, _ = both(model, files, changes=True, draws=50)
    explained = diagnose(model, files, draws=50, explain=True)
    assert found.changed == explained.changed
    assert len(found.changed) == 1
    assert found.sentence == explained.sentence

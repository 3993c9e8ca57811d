"""Readings of the wrong sign or unit. Oracle: the factor that the readings were multiplied with."""

from dataclasses import replace

import numpy as np
import pytest

from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.extend.add import add
from rtec.diagnosis.extend.improve import improve
from rtec.diagnosis.search.diagnose import diagnose
from rtec.errors import MeasurementError
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support.diagnosis_examples import effects, laser, small_machine

TRUTH = ["scale,component=EXX,axis=X,k=40", "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=11"]


def model(*texts: str) -> Model:
    return Model(small_machine(), effects(*texts), name="base")


def times(m: Measurement, factor: float) -> Measurement:
    return replace(m, readings={k: factor * v for k, v in m.readings.items()})


@pytest.mark.parametrize(
    ("factor", "said"),
    [(-1.0, "is minus what"), (1e-3, "in mm?"), (-1e-3, "in mm, with the other sign?"), (1e3, "in nm?"),
     (1 / 25.4, "thousandths of an inch?")],
)  # fmt: skip
def test_a_wrong_factor_is_told_and_not_fitted(factor: float, said: str) -> None:
    """A model that took the sign over would make the loop double the error."""
    known, wrong = model(*TRUTH), times(laser(TRUTH, 41), factor)
    assert said in compare(known, [wrong]).notes[0]
    d = diagnose(known, [wrong])
    assert said in d.notes[0]
    assert said in d.sentence
    for fit in (lambda: improve(known, [wrong]), lambda: add(known, [], [wrong])):
        with pytest.raises(MeasurementError, match="rtec fit"):
            fit()


@pytest.mark.parametrize("factor", [1.0, 1.4, 0.6])
def test_a_machine_that_changed_is_fitted(factor: float) -> None:
    """A screw that grows by half as much again is a machine, and no slip of a pen."""
    changed = times(laser(TRUTH, 42), factor)
    assert not compare(model(*TRUTH), [changed]).notes
    assert add(model(*TRUTH), [], [changed]).after.held_out < 1.0


def test_what_does_not_follow_the_model_is_not_judged() -> None:
    """Noise alone may be of a machine that is corrected, and has no sign; and a model that says nothing."""
    m = laser([], 43)
    assert [d.kind for d in compare(model(*TRUTH), [m]).doubts] == ["corrected"]
    assert not compare(model(), [times(laser(TRUTH, 44), -1.0)]).notes


def test_of_several_the_wrong_one_is_named() -> None:
    good, bad = laser(TRUTH, 45), times(laser(TRUTH, 46), -1.0)
    (said,) = compare(model(*TRUTH), [good, bad]).notes
    assert said.startswith("laser-x-46 reading_um")
    assert np.isfinite(diagnose(model(*TRUTH), [good, bad]).rms_residual)

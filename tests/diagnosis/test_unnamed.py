"""What has no name in the catalogue. Oracle: what the benchmark's own physics hid."""

import numpy as np
import pytest

from rtec.bench.sets import measurements_of, model_of
from rtec.bench.trials import build
from rtec.diagnosis.search.diagnose import diagnose
from rtec.diagnosis.search.shapes import LocalPlace
from rtec.model import Model
from tests.support.diagnosis_examples import laser, small_machine


@pytest.mark.parametrize(("what", "seed"), [("bump", 2), ("step", 1), ("step", 2), ("sawtooth", 1)])
def test_a_place_along_an_axis_is_no_catalogue_effect_of_many_numbers(what: str, seed: int) -> None:
    trial = build("beyond", what, seed)
    d = diagnose(model_of(trial), measurements_of(trial), draws=50)
    assert d.verdict == "unknown_effect"
    assert d.unknown is not None
    assert d.unknown.channels == ("x",)
    assert not d.together


def test_a_curve_of_the_whole_travel_is_still_named() -> None:
    """Ten knots put in by hand: no hump and no step says them with fewer numbers."""
    truth = [
        "piecewise_position,component=EXX,axis=X,knots_mm=[0,40,80,120,160,200],at0=0,at1=4,at2=-3,at3=4,at4=-4,at5=3"
    ]
    d = diagnose(Model(small_machine(), name="empty"), [laser(truth, 3)], draws=50)
    assert d.unknown is None
    assert d.findings[0].accepted


def test_hump_and_step_are_what_they_say() -> None:
    """Oracle: the values of exp(-1) one width from the centre, and of tanh."""
    hump, step = LocalPlace("hump", 10.0, 2.0), LocalPlace("step", 10.0, 2.0)
    at = np.array([8.0, 10.0, 12.0])
    assert hump.curve(at) == pytest.approx([np.exp(-1.0), 1.0, np.exp(-1.0)])
    assert step.curve(at) == pytest.approx([-np.tanh(1.0), 0.0, np.tanh(1.0)])

"""A gantry's frame, recorded by others. Oracle: the least-squares figures of the data's README.

Blind: models are chosen on stretches of the record that are not judged.
"""

from functools import cache

import numpy as np
import pytest

from rtec.characterise import Characterisation, characterise, read_wanted
from rtec.diagnosis.extend.add import add
from rtec.diagnosis.extend.improve import improve
from rtec.diagnosis.search.diagnose import diagnose
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support.frame_thermal import COMPONENT, recorded

pytestmark = pytest.mark.xdist_group("real-frame")  # what is fitted once is used by all of them

FRAME = f"mount_expansion:{COMPONENT}:sensor=T_frame"
BED = f"mount_expansion:{COMPONENT}:sensor=T_bed"


def fitted(m: Measurement, effects: str) -> Characterisation:
    return characterise([m], wanted=read_wanted(effects, m.machine))


def rms_um(model: Model, given: Measurement, judged: Measurement) -> float:
    """Residual of a part of the record; its zero is that of the part that was given."""
    at = model.machine.components.index(COMPONENT)
    zero, left = (m.readings["reading_um"] - model.components(m.state())[:, at] for m in (given, judged))
    return float(np.sqrt(np.mean((left - np.median(zero)) ** 2)))


@cache
def improved(name: str) -> tuple[float, float]:
    """Residual of the unseen stretches, with the frame alone and after `improve`."""
    given, unseen = recorded(name, part="given"), recorded(name, part="unseen")
    start = fitted(given, FRAME).model
    return rms_um(start, given, unseen), rms_um(improve(start, [given]).model, given, unseen)


@pytest.mark.parametrize(("name", "least_squares_um"), [("wrong_thermistor", 3.4), ("right_thermistor", 9.6)])
def test_improve_reaches_least_squares_on_stretches_never_seen(name: str, least_squares_um: float) -> None:
    before, after = improved(name)
    assert before > 3.0 * least_squares_um
    assert after <= 1.2 * least_squares_um


@pytest.mark.parametrize(("name", "least_squares_um"), [("wrong_thermistor", 4.8), ("right_thermistor", 8.0)])
def test_a_refit_of_two_temperatures_stays_what_it_was(name: str, least_squares_um: float) -> None:
    m = recorded(name)
    model = fitted(m, f"{FRAME},{BED}").model
    made = add(model, [], [m])
    assert made.before.as_given == pytest.approx(least_squares_um, rel=0.03)
    assert made.before.as_given is not None
    assert made.after.inside <= made.before.as_given
    assert any("weighted least squares" in n for n in made.notes)


def test_a_wrong_law_of_a_sensor_is_a_curve_over_it_and_the_right_one_is_not() -> None:
    """While the bed is hot: README of the data, T⁴ is needed with the wrong law, nothing is missing with the right."""
    said = {}
    for name in ("wrong_thermistor", "right_thermistor"):
        m = recorded(name, hot=True)
        said[name] = diagnose(fitted(m, FRAME).model, [m], draws=50)
    wrong, right = said["wrong_thermistor"], said["right_thermistor"]
    assert wrong.verdict == "unknown_effect"
    assert wrong.unknown is not None
    assert wrong.unknown.channels == ("T_frame",)
    assert "it rises with time in this record" in wrong.sentence
    assert right.verdict == "nothing_missing"


def test_the_fit_is_not_bent_by_failed_homings() -> None:
    """Oracle: README of the data: -14.9 µm/K, 3.7 µm once 11 readings are removed."""
    m = recorded("gross_outliers", hot=True)
    result = fitted(m, FRAME)
    assert len(result.outliers) >= 8
    assert result.inside_rms == pytest.approx(3.7, rel=0.1)
    assert result.coefficients[0].value == pytest.approx(-14.9, abs=0.3)

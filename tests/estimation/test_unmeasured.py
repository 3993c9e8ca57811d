"""Motions that an added angle brings along and that nobody measured. Oracle: the arms of the machine, by hand."""

from dataclasses import replace

import pytest

from rtec.characterise import characterise, read_wanted
from rtec.diagnosis.extend.add import Added, add, asked_effect
from rtec.diagnosis.extend.improve import improve
from rtec.estimation.outliers import clean
from rtec.estimation.unmeasured import unmeasured_motions
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.report.history import added_page, improved_page
from tests.support.diagnosis_examples import effects, laser, read_by, small_machine

SCALE = "scale,component=EXX,axis=X,k=12"
TILT = "angular_reversal,component=EBX,axis=X,theta=40"
ARM_MM = 120.0
"""From the frame of X to the tool, along X: a turn about Y by 1 µrad moves the tool by 0.12 µm along Z."""
BEAMS = (
    laser([SCALE, TILT], 11),
    laser([SCALE, TILT], 12, setup={"beam_offset_mm": [0.0, 0.0, 100.0]}),
)


def with_tilt(*measurements: Measurement) -> Added:
    model = Model(small_machine(), effects(SCALE), name="test")
    return add(model, [asked_effect("angular_reversal", "EBX", {}, model)], measurements)


def test_a_laser_along_x_does_not_show_what_a_tilt_makes_along_z() -> None:
    added = with_tilt(*BEAMS)
    (motion,) = added.unmeasured
    assert (motion.label, motion.direction) == ("angular_reversal(EBX, X)", "Z")
    assert motion.um == pytest.approx(abs(added.model.effects[-1].values["theta"]) * ARM_MM * 1e-3)
    assert motion.um == pytest.approx(4.8, abs=0.2)
    said = "moves the tool along Z, by up to 4.8 µm, and no reading shows that: measure along Z"
    assert said in added_page(added, figures=False).lead
    assert added.facts()["unmeasured"][0]["direction"] == "Z"


def test_improve_says_it_too() -> None:
    result = improve(Model(small_machine(), effects(SCALE), name="test"), BEAMS)
    assert [s.labels for s in result.steps] == [("angular_reversal(EBX, X)",)]
    assert "moves the tool along Z" in improved_page(result, figures=False).lead


@pytest.mark.parametrize(("instrument", "setup"), [("straightness", {"direction": "Z"}), ("level", {"about": "B"})])
def test_nothing_is_said_where_it_was_measured(instrument: str, setup: dict[str, str]) -> None:
    """A straightness along Z shows the motion; a level shows the angle itself."""
    assert not with_tilt(BEAMS[0], read_by(instrument, [SCALE, TILT], 13, setup=setup)).unmeasured


def test_a_fit_warns_of_it() -> None:
    fitted = characterise(BEAMS, wanted=read_wanted("scale,angular_reversal", small_machine()))
    (warning,) = (w for w in fitted.warnings if w.code == "unmeasured_motion")
    assert "angular_reversal(EBX, X) also moves the tool along Z, by up to 4.8 µm" in warning.text


def test_a_shift_has_no_other_arm() -> None:
    model = Model(small_machine(), effects(), name="test")
    (scale,) = effects(SCALE)
    assert not add(model, [scale], BEAMS).unmeasured


def test_a_file_that_lacks_a_channel_shows_no_motion() -> None:
    """A bar's model may have an inertia; a file that was read in motion has no acceleration."""
    (inertia,) = effects("inertia,component=EXX,axis=X,k=2")
    read = clean([BEAMS[0]]).readings
    moving = read.with_states([replace(s, at_rest=False) for s in read.states])
    assert unmeasured_motions([inertia], moving) == ()


def test_a_direction_that_follows_from_the_positions_is_no_missing_channel() -> None:
    bare = replace(BEAMS[0], channels={name: v for name, v in BEAMS[0].channels.items() if name != "d_x"})
    (tilt,) = effects(TILT)
    (motion,) = unmeasured_motions([tilt], clean([bare]).readings)
    assert motion.um == pytest.approx(40.0 * ARM_MM * 1e-3)

"""An angle that one beam reads at one lever arm is not named together with others: it reads as a shift.

Oracle: the lever arm of each beam, which is its height above the axis.
"""

import numpy as np
import pytest

from rtec.diagnosis.search.diagnose import Search, diagnose
from rtec.diagnosis.search.refit import Refitted
from rtec.effects.reversal import AngularReversal, Backlash
from rtec.estimation.candidates import behind_arm, library
from rtec.estimation.outliers import clean
from rtec.model import Model
from tests.support.diagnosis_examples import effects, laser, small_machine

TRUE = ("scale,component=EXX,axis=X,k=8",)


@pytest.mark.parametrize(("heights_mm", "behind"), [((100.0,), True), ((100.0, 100.0), True), ((0.0, 100.0), False)])
def test_beams_at_one_height_show_no_angle(heights_mm: tuple[float, ...], behind: bool) -> None:
    beams = [laser(TRUE, 1 + i, setup={"beam_offset_mm": [0.0, 0.0, h]}, cycles=1) for i, h in enumerate(heights_mm)]
    model = Model(small_machine(), (), name="empty")
    search = Search(model, clean(beams).without_ends(), 1, 0.05, 50, None, False, lambda *_: None)
    turns = AngularReversal(component="EBX", axis="X")
    plays = Backlash(component="EXX", axis="X")
    assert behind_arm(search.readings, turns.component) is behind
    assert not behind_arm(search.readings, plays.component)


WARM = "axis_expansion,component=EBX,axis=X,sensor=T_bed,k={k}"


@pytest.mark.parametrize(("heights_mm", "k"), [((-60.0, 140.0), 20.0), ((0.0, 100.0), -35.0)])
def test_a_guideway_that_bends_as_it_warms_up_is_named(heights_mm: tuple[float, ...], k: float) -> None:
    """Two beams, each at a height of its own. Oracle: the number that was simulated, µrad/(m·K)."""
    truth = (*TRUE, WARM.format(k=k))
    beams = [laser(truth, 5 + i, setup={"beam_offset_mm": [0.0, 0.0, h]}) for i, h in enumerate(heights_mm)]
    found = diagnose(Model(small_machine(), effects(*TRUE), name="empty"), beams, explain=True)
    assert found.verdict == "missing_effect"
    assert (found.findings[0].effect.effect, found.findings[0].effect.component) == ("axis_expansion", "EBX")
    number = found.findings[0].parameters["k"]
    assert number.value == pytest.approx(k, abs=4.0 * (number.se or 0.0))


def test_one_beam_does_not_show_a_guideway_that_bends() -> None:
    """One beam reads it as an expansion of the screw: the same column, and the screw is there on every machine."""
    for heights_mm, offered in (((100.0,), False), ((100.0, 0.0), True)):
        beams = [laser(TRUE, 1 + i, setup={"beam_offset_mm": [0.0, 0.0, h]}) for i, h in enumerate(heights_mm)]
        bends = [c.effect for c in library(clean(beams).readings)[0] if c.effect.label.startswith("axis_expansion(EBX")]
        assert bool(bends) is offered


@pytest.mark.parametrize(("less", "first"), [(1.0, "mount_expansion"), (4.0, "column_tilt")])
def test_a_shift_by_one_temperature_is_before_an_angle_by_two(less: float, first: str) -> None:
    """One beam reads both alike; of any two temperatures the difference makes many a curve. Oracle: odds of 20 to 1."""
    beam = laser(TRUE, 1, setup={"beam_offset_mm": [0.0, 0.0, 100.0]}, cycles=1)
    model = Model(small_machine(), (), name="empty")
    search = Search(model, clean([beam]).without_ends(), 1, 0.05, 50, None, False, lambda *_: None)

    def fitted(name: str, component: str, log_evidence: float) -> Refitted:
        number = next(
            i
            for i, c in enumerate(search.candidates)
            if (c.effect.effect, c.effect.component) == (name, component) and c.thetas == ({},)
        )
        columns = search.readings.columns(search.candidates[number].effect, {})
        fit = search.refits.fit(np.concatenate([search.prepared.base, columns], axis=1))
        return Refitted(number, {}, columns, fit, log_evidence, 0.9, 0.9)

    tilt, shift = fitted("column_tilt", "EBX", 9.0), fitted("mount_expansion", "EXX", 9.0 - less)
    assert search.candidates[search._direct_first([tilt, shift])[0].number].effect.effect == first

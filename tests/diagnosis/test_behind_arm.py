"""An angle that one beam reads at one lever arm is not named together with others: it reads as a shift.

Oracle: the lever arm of each beam, which is its height above the axis.
"""

import numpy as np
import pytest

from rtec.diagnosis.search.diagnose import Search
from rtec.diagnosis.search.refit import Refitted
from rtec.effects.reversal import AngularReversal, Backlash
from rtec.estimation.outliers import clean
from rtec.model import Model
from tests.support.diagnosis_examples import laser, small_machine

TRUE = ("scale,component=EXX,axis=X,k=8",)


@pytest.mark.parametrize(("heights_mm", "behind"), [((100.0,), True), ((100.0, 100.0), True), ((0.0, 100.0), False)])
def test_beams_at_one_height_show_no_angle(heights_mm: tuple[float, ...], behind: bool) -> None:
    beams = [laser(TRUE, 1 + i, setup={"beam_offset_mm": [0.0, 0.0, h]}, cycles=1) for i, h in enumerate(heights_mm)]
    model = Model(small_machine(), (), name="empty")
    search = Search(model, clean(beams).without_ends(), 1, 0.05, 50, None, False, lambda *_: None)
    turns = AngularReversal(component="EBX", axis="X")
    plays = Backlash(component="EXX", axis="X")
    assert search._behind_arm(turns) is behind
    assert not search._behind_arm(plays)


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

"""An angle that one beam reads at one lever arm is not named together with others: it reads as a shift.

Oracle: the lever arm of each beam, which is its height above the axis.
"""

import pytest

from rtec.diagnosis.search.diagnose import Search
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

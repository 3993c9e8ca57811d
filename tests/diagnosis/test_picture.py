"""The figure of a finding is one figure, on a page, in a report and on the command line.

Oracle: least squares by hand on the readings, with what was put in.
"""

import functools

import numpy as np
import pytest

from rtec.diagnosis.result import Diagnosis, Picture
from rtec.diagnosis.search.diagnose import diagnose
from rtec.diagnosis.search.picture import of_finding
from rtec.model import Model
from tests.support.diagnosis_examples import laser, small_machine

CLEARANCE = "backlash,component=EXX,axis=X,B=4"
TILT = "angular_motion,component=EBX,axis=X,c2=30,c3=0"

pytestmark = pytest.mark.xdist_group("picture")


@functools.cache
def found() -> Diagnosis:
    """A clearance and a tilt of the slide, read with and without an arm."""
    near, far = ({"beam_offset_mm": [0.0, 0.0, height]} for height in (-80.0, 120.0))
    measured = [laser([CLEARANCE, TILT], 4, setup=near), laser([CLEARANCE, TILT], 5, setup=far)]
    return diagnose(Model(small_machine(), name="empty"), measured)


def test_the_page_draws_rank_1_as_the_report_and_says_what_was_subtracted() -> None:
    """The same numbers, and both effects in the title."""
    d = found()
    first, other = (m.label for m in d.together)
    assert {first, other} == {"backlash(EXX, X)", "angular_motion(EBX, X)"}
    shown = of_finding(d, d.findings[0])
    assert shown is d.picture
    assert shown is not None
    assert shown.title == f"{first} less {other}, in {shown.place}"
    assert d.shows_rank_1


def test_each_of_two_effects_is_drawn_without_the_other() -> None:
    """Of a residual less the other effect, what an effect does not explain is the noise that was put in."""
    d = found()
    for f in d.findings:
        if f.label in {m.label for m in d.together}:
            p = of_finding(d, f)
            assert p is not None
            assert " less " in p.title
            for q in (p, *p.others):
                assert _rms(q) < 0.4


def _rms(p: Picture) -> float:
    return float(np.sqrt(np.mean((p.residual - p.part) ** 2)))

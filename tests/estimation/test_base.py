"""What a refit of the model may explain before anything is missing. Oracle: what was put in."""

from dataclasses import replace

import pytest

from rtec.estimation.columns import base_of
from rtec.estimation.outliers import clean
from rtec.model import Model
from tests.support.diagnosis_examples import effects, laser

LATE = "axis_expansion,component=EXX,axis=X,sensor=T_bed,lag=true,k=11,tau={tau}"
OTHER = "axis_expansion,component=EXX,axis=X,sensor=T_air,k={k}"


@pytest.mark.parametrize(("truth", "refitted"), [(LATE.format(tau=1100), True), (OTHER.format(k=60), False)])
def test_a_delay_that_would_have_to_move_out_of_reach_is_kept(truth: str, refitted: bool) -> None:
    """Known as 900 ± 20 s. Oracle: what was put in: another delay near by, or another temperature's expansion.

    The slope by the delay had explained the other temperature's growth, and nothing was missing.
    """
    m = laser([truth], 4, thermal={"air_degc": 24.0, "body": {"T_bed": {"on_degc": 2.0}}})
    (late,) = effects(LATE.format(tau=900))
    known = replace(late, errors={"k": 0.2, "tau": 20.0})
    names = base_of(Model(m.machine, (known,)), clean([m]).readings).names
    assert any(n.endswith(" tau") for n in names) == refitted

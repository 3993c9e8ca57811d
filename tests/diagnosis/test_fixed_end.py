"""The fixed end of an expansion between the places where one is offered. Oracle: where it was put; a hotter day."""

import pytest

from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.extend.improve import improve
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support import proof
from tests.support.diagnosis_examples import effects, laser, small_machine

SCALE = "scale,component=EXX,axis=X,k=60"
NOISE_UM = 0.3


def day(end_mm: float, seed: int, on_degc: float) -> Measurement:
    """A screw that warms up, with its fixed end at one place."""
    screw = f"axis_expansion,component=EXX,axis=X,sensor=T_bed,k=11,fixed_mm={end_mm}"
    heat = {"air_degc": 20.0, "body": {"T_bed": {"on_degc": on_degc}}}
    return laser([SCALE, screw], seed, thermal=heat, noise={"white_um": NOISE_UM})


@pytest.mark.parametrize(("end_mm", "seed"), proof.few([(180.0, 3), (215.0, 3), (185.0, 2), (185.0, 3)], 1))
def test_it_is_where_a_shift_by_the_same_temperature_says(end_mm: float, seed: int) -> None:
    done = improve(Model(small_machine(), effects(SCALE), name="scale"), [day(end_mm, seed, 6.0)], draws=50)
    found = {f.effect.effect: f for f in done.model.effects}
    assert sorted(found) == ["axis_expansion", "mount_expansion", "scale"]
    assert len(done.model.effects) == 3
    screw, shift = found["axis_expansion"], found["mount_expansion"]
    fixed_mm = float(getattr(screw.effect, "fixed_mm", 0.0))
    assert fixed_mm - 1000.0 * shift.values["k"] / screw.values["k"] == pytest.approx(end_mm, abs=3.0)
    hotter = compare(done.model, [day(end_mm, seed + 30, 24.0)])
    assert hotter.judged.residual < 1.4 * NOISE_UM
    assert any("the fixed end of axis_expansion(EXX, X, T_bed) is at " in n for s in done.steps for n in s.notes)

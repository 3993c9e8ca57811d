"""Reversals that a touch probe makes, and those of screws. Oracle: what was added to the readings."""

import numpy as np
import pytest

from rtec.diagnosis.search.diagnose import diagnose
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support.diagnosis_examples import small_machine


@pytest.mark.parametrize(("x_um", "z_um", "said"), [(6.0, 6.0, True), (-6.0, -6.0, True), (6.0, 3.0, False)])
def test_reversals_that_are_alike_in_all_directions_may_be_the_probe_s(x_um: float, z_um: float, said: bool) -> None:
    """Of a machine without play, "backlash is missing" in both axes alone would have put 6 µm into every reversal."""
    rng, machine, n = np.random.default_rng(5), small_machine(), 240
    ways = {f"d_{a}": rng.choice([-1.0, 1.0], n) for a in "xz"}
    places = {"x": rng.uniform(20.0, 180.0, n), "z": rng.uniform(40.0, 360.0, n)}
    readings = {
        f"reading_{a}_um": 0.5 * um * ways[f"d_{a}"] + 0.4 * rng.standard_normal(n)
        for a, um in (("x", x_um), ("z", z_um))
    }
    instrument = make_instrument("tool_tip", {"directions": ["X", "Z"]}, None, None, machine, "test")
    m = Measurement(
        "ball",
        instrument,
        machine,
        np.arange(n) * 6 // n,
        15.0 * np.arange(n, dtype=np.float64),
        {**places, **ways},
        readings,
    )
    found = diagnose(Model(machine, (), name="empty"), [m], draws=50)
    assert found.findings[0].effect.effect == "backlash"
    assert [d.kind for d in found.doubts if d.kind == "pre_travel"] == ["pre_travel"] * said
    assert ("by its pre-travel" in found.sentence) is said

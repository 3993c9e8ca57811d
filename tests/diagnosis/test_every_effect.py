"""A model of each effect of the catalogue is compared with readings that it describes.

Oracle: the model's own prediction, with noise of known size.
"""

from dataclasses import replace

import numpy as np
import pytest

from rtec.diagnosis.compare.compare import compare
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support.effect_example import MACHINE, Example, states
from tests.support.effect_examples import EXAMPLES

NOISE_UM, READINGS, RUNS = 0.3, 120, 4


def described_by(model: Model) -> Measurement:
    """The tool tip in X and Z, as a model has it, while all channels vary."""
    state = states(READINGS)
    instrument = make_instrument("tool_tip", {"directions": ["X", "Z"]}, None, None, MACHINE, "test")
    empty = Measurement(
        name="tip", instrument=instrument, machine=MACHINE, run=np.arange(READINGS) * RUNS // READINGS + 1,
        time_s=state.time_s, channels=state.channels,
        readings={f"reading_{a}_um": np.zeros(READINGS) for a in "xz"},
    )  # fmt: skip
    errors = np.einsum("rnc,nc->rn", instrument.arms(MACHINE, state.positions_mm()), model.components(state))
    noise = np.random.default_rng(3).normal(0.0, NOISE_UM, errors.shape)
    return replace(empty, readings=dict(zip(empty.readings, errors + noise, strict=True)))


@pytest.mark.parametrize("example", EXAMPLES, ids=str)
def test_readings_that_a_model_describes_are_at_the_noise(example: Example) -> None:
    """As it was, a model with `servo_lag`, whose coefficient is called tau, could not be read."""
    errors = {**example.fitted.errors, **{n: 0.01 * v for n, v in example.theta.items()}}
    model = replace(example.model, effects=(replace(example.fitted, errors=errors),))
    assert compare(model, [described_by(model)]).judged.residual == pytest.approx(NOISE_UM, rel=0.15)

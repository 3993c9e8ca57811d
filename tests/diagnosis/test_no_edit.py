"""What is no fault of a record, though an edit of the record would follow it. Oracle: what was put in, nothing to it."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.extend.add import add
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support.diagnosis_examples import effects, laser, small_machine

Floats = NDArray[np.float64]

SCALE, PLAY = "scale,component=EXX,axis=X,k=15", "backlash,component=EXX,axis=X,B=2"
HEAT = "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=11"
LAG = "servo_lag,component=EXX,axis=X,tau"
KNOWN = [SCALE, PLAY, HEAT]
HOT: dict[str, Any] = {"air_degc": 20.0, "body": {"T_bed": {"on_degc": 12.0}}}
FAULTS = {"wrong_channel", "swapped_sensors", "moved_origin", "turned_axis", "late_temperatures"}


def day(truth: list[str], seed: int, thermal: Mapping[str, Any] = HOT, **more: Any) -> Measurement:
    return laser(truth, seed, thermal=thermal, log_every_s=60.0, **more)


def plus(m: Measurement, um: Floats) -> Measurement:
    return replace(m, readings={k: v + um for k, v in m.readings.items()})


@cache
def fitted() -> Model:
    return add(Model(small_machine(), effects(*KNOWN), name="known"), [], [day(KNOWN, 1)]).model


def blamed(model: Model, m: Measurement) -> list[str]:
    """What of the record is asked about first."""
    return [d.message for d in compare(model, [m]).doubts if d.fatal and d.kind in FAULTS]


@pytest.mark.parametrize("seed", [11, 12, 13])
@pytest.mark.parametrize("um", [-45.0, -50.0])
def test_an_expansion_that_ends_is_no_unit_of_the_position(um: float, seed: int) -> None:
    """A position of nearly zero, and a bed of the temperature of the air, switch the model's expansion off."""
    known = Model(small_machine(), effects(PLAY, HEAT), name="known")
    m = day([PLAY, HEAT], seed, {"air_degc": 20.0, "body": {"T_bed": {"on_degc": 4.0}}})
    ends = um * np.tanh((m.channels["T_bed"] - 20.0) / 2.5) * m.channels["x"] / 1000.0
    assert not blamed(known, plus(m, ends))


@pytest.mark.parametrize("seed", [14, 15])
@pytest.mark.parametrize("left", [0.0, 0.1])
def test_a_lag_that_has_gone_is_no_unit_of_the_speed(left: float, seed: int) -> None:
    """The feed forward of the axis was switched on: a speed of nearly zero, or of the other sign, would say the same."""
    known = Model(small_machine(), effects(SCALE, f"{LAG}=300"), name="known")
    assert not blamed(known, laser([SCALE, f"{LAG}={300.0 * left}"], seed))

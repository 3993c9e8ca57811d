"""What is no fault of a record, though an edit of the record would follow it. Oracle: what was put in."""

from collections.abc import Mapping, Sequence
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
from tests.support import proof
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


def some_runs(m: Measurement, which: Sequence[int]) -> Measurement:
    """These runs of a measurement, by number from 0."""
    keep = np.isin(m.run, np.unique(m.run)[list(which)])
    channels = {k: v[keep] for k, v in m.channels.items()}
    readings = {k: v[keep] for k, v in m.readings.items()}
    return replace(m, run=m.run[keep], time_s=m.time_s[keep], channels=channels, readings=readings)


def zeros(m: Measurement, um: Sequence[float] | Floats) -> Floats:
    """A zero of its own in each run."""
    return np.asarray(um)[np.unique(m.run, return_inverse=True)[1]]


@cache
def fitted() -> Model:
    return add(Model(small_machine(), effects(*KNOWN), name="known"), [], [day(KNOWN, 1)]).model


def blamed(model: Model, *given: Measurement) -> list[str]:
    """What of the record is asked about first."""
    return [d.message for d in compare(model, given).doubts if d.fatal and d.kind in FAULTS]


@pytest.mark.parametrize("seed", proof.few([11, 12, 13], 1))
@pytest.mark.parametrize("um", [-45.0, -50.0])
def test_an_expansion_that_ends_is_no_unit_of_the_position(um: float, seed: int) -> None:
    """A position of nearly zero, and a bed of the temperature of the air, switch the model's expansion off."""
    known = Model(small_machine(), effects(PLAY, HEAT), name="known")
    m = day([PLAY, HEAT], seed, {"air_degc": 20.0, "body": {"T_bed": {"on_degc": 4.0}}})
    ends = um * np.tanh((m.channels["T_bed"] - 20.0) / 2.5) * m.channels["x"] / 1000.0
    assert not blamed(known, plus(m, ends))


@pytest.mark.parametrize("seed", proof.few([14, 15], 1))
@pytest.mark.parametrize("left", [0.0, 0.1])
def test_a_lag_that_has_gone_is_no_unit_of_the_speed(left: float, seed: int) -> None:
    """The feed forward of the axis was switched on: a speed of nearly zero would say the same."""
    known = Model(small_machine(), effects(SCALE, f"{LAG}=300"), name="known")
    assert not blamed(known, laser([SCALE, f"{LAG}={300.0 * left}"], seed))


@pytest.mark.parametrize(("c2", "c3"), [(20, 5), (30, 1)])
def test_a_beam_that_leans_is_no_moved_origin(c2: int, c3: int) -> None:
    """A laser with a cosine error reads 12.5 µm/m less; a curve that moves is nearly, or quite, as steep."""
    curve = f"polynomial_position,component=EXX,axis=X,degrees=[2,3],c2={c2},c3={c3}"
    known = Model(small_machine(), effects(SCALE, PLAY, curve), name="known")
    m = laser([SCALE.replace("k=15", "k=2.5"), PLAY, curve], 11)
    assert not blamed(known, m)
    said = [d.message for d in compare(known, [m]).doubts if d.kind == "moved_origin"]
    assert all("unless a number of the model has changed, or the beam of a laser leans" in text for text in said)
    assert bool(said) is (c3 == 1)


BOTH = [*KNOWN, *(t.replace("EXX,axis=X", "EZZ,axis=Z") for t in KNOWN)]
DRIFTS = [(0.0, 0.5, 0.9, 0.8), (0.0, 1.2, 1.9, 1.7), (0.0, -1.4, -2.2, -2.5), (0.0, 2.0, 3.0, 2.5)]


def drift(m: Measurement, seed: int) -> Measurement:
    """The same with a zero that wanders from run to run."""
    return plus(m, zeros(m, np.cumsum(np.random.default_rng(seed).normal(0.0, 0.4, len(np.unique(m.run))))))


@cache
def drifting() -> Model:
    """A model of two axes that was fitted under a drift."""
    days = [drift(day(BOTH, 2 + i, along=a), 2 + i) for i, a in enumerate("XZ")]
    return add(Model(small_machine(), effects(*BOTH), name="known"), [], days).model


@pytest.mark.parametrize("seed", proof.few([21, 22, 23], 1))
@pytest.mark.parametrize("um", DRIFTS)
def test_four_runs_of_which_the_zero_drifts_are_no_other_home(um: Sequence[float], seed: int) -> None:
    """The axis grows with the bed: a shift of its origin is a zero of each run, and so is a drift."""
    few = some_runs(day(BOTH, seed, along="Z"), (0, 4, 8, 12))
    assert not blamed(drifting(), day(BOTH, seed, along="X"), plus(few, zeros(few, um)))


RESTS = "mount_expansion,component=EXX,sensor=T_air,k=0.5"


@pytest.mark.parametrize("seed", proof.few([31, 32, 33], 1))
@pytest.mark.parametrize("um_h", [(1.0, 1.1, 0.9), (-2.2, -1.8, -2.0), (4.2, 3.8, 4.0)])
def test_three_runs_that_drift_are_no_scale_of_a_temperature(um_h: Sequence[float], seed: int) -> None:
    """The air warms steadily, the mount with it, and each run drifts as steadily."""
    m = laser([SCALE, PLAY], seed, protocol="cold", cycles=3)
    time_s = 30.0 * m.time_s
    hours = (time_s - time_s[0]) / 3600.0
    warms = {**m.channels, "T_air": 20.0 + 2.0 * hours + 0.02 * np.random.default_rng(seed).standard_normal(len(m))}
    slopes = np.asarray(um_h)[np.unique(m.run, return_inverse=True)[1]] * hours
    known = Model(small_machine(), effects(SCALE, PLAY, RESTS), name="known")
    assert not blamed(known, plus(replace(m, time_s=time_s, channels=warms), hours + slopes))


@pytest.mark.parametrize("which", [(0, 4, 8, 12), (1, 3, 5, 10, 15)])
@pytest.mark.parametrize("factor", [2.0, 5.0, 0.1])
def test_few_runs_show_a_factor_that_is_far_beyond_any_drift(factor: float, which: Sequence[int]) -> None:
    """Oracle: what the column was multiplied with."""
    few = some_runs(day(KNOWN, 41), which)
    (said,) = blamed(fitted(), replace(few, channels={**few.channels, "T_bed": factor * few.channels["T_bed"]}))
    assert said.startswith(f"with T_bed times {f'1/{factor:g}' if factor > 1.0 else '10'} the model leaves ")

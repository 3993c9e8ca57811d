"""Readings of a display with coarse steps. Oracle: what was put into the readings before they were rounded."""

import numpy as np
import pytest

from rtec.diagnosis.result import Diagnosis
from rtec.diagnosis.search.diagnose import diagnose
from rtec.estimation.display import display_step
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support import proof
from tests.support.diagnosis_examples import effects, small_machine

STEP_UM, NOISE_UM, TARGETS, RUNS = 1.0, 0.15, 13, 9
MODEL = Model(small_machine(), effects("straightness,component=EZX,axis=X,degrees=[2,3],c2=0,c3=0"), name="guide")


def displayed(seed: int, extra: float = 0.0, step_um: float = STEP_UM) -> Measurement:
    """A bent guide that the model knows, at unequal targets there and back; the display rounds to its step."""
    machine, rng = small_machine(), np.random.default_rng(seed)
    at = np.linspace(5.0, 195.0, TARGETS) + rng.uniform(-4.0, 4.0, TARGETS)
    x = np.tile(np.concatenate([at, at[::-1]]), RUNS)
    n, u = len(x), x / 100.0 - 1.0
    day = np.linspace(0.0, 1.0, n)
    channels = {"x": x, "d_x": np.tile(np.repeat([1.0, -1.0], TARGETS), RUNS)}
    channels |= {"T_bed": 20.0 + 2.0 * day, "T_air": 21.0 - day**2}
    error = rng.uniform(2.0, 4.0) * u**2 + rng.uniform(0.5, 1.5) * u**3 + rng.uniform(-5.0, 5.0)
    error = error + extra * np.exp(-(((x - 120.0) / 15.0) ** 2)) + NOISE_UM * rng.standard_normal(n)
    made = make_instrument("straightness", {"direction": "Z"}, "X", None, machine, "test")
    run = np.repeat(np.arange(1, RUNS + 1), 2 * TARGETS)
    readings = {"reading_um": np.round(error / step_um) * step_um}
    return Measurement("guide", made, machine, run, np.linspace(0.0, 10.0 * n, n), channels, readings)


def found(*measured: Measurement) -> Diagnosis:
    return diagnose(MODEL, measured, draws=50)


@pytest.mark.parametrize("seed", proof.few(range(6), 2))
def test_what_the_display_rounds_is_no_error_of_the_machine(seed: int) -> None:
    assert found(displayed(seed)).verdict == "nothing_missing"


@pytest.mark.parametrize("seed", proof.few(range(3), 2))
def test_a_hump_larger_than_the_step_is_found(seed: int) -> None:
    d = found(displayed(seed, extra=3.0))
    assert d.verdict == "unknown_effect"
    assert d.unknown is not None
    assert d.unknown.channels == ("x",)


def test_a_small_hump_is_found_where_the_display_is_fine() -> None:
    d = found(displayed(1, extra=0.5, step_um=0.01))
    assert d.verdict == "unknown_effect"


@pytest.mark.parametrize("step_um", [0.36, 1.0, 1.41, 0.0])
def test_the_step_is_read_from_the_readings(step_um: float) -> None:
    """Written with three decimals; without a step each value is a new one."""
    smooth = 6.0 * np.random.default_rng(2).standard_normal(300)
    values = np.round(np.round(smooth / step_um) * step_um, 3) if step_um else smooth
    assert display_step(values) == pytest.approx(step_um, rel=1e-3)


@pytest.mark.parametrize("seed", proof.few(range(8), 2))
def test_no_effect_of_the_position_is_named_for_what_the_display_rounds(seed: int) -> None:
    """Positioning at unequal targets: a scale error whose rounding repeats as X moves on by what makes one step."""
    machine, rng = small_machine(), np.random.default_rng(100 + seed)
    at = np.linspace(4.0, 196.0, 31) + rng.uniform(-2.5, 2.5, 31)
    x = np.tile(np.concatenate([at, at[::-1]]), 5)
    n = len(x)
    channels = {"x": x, "d_x": np.tile(np.repeat([1.0, -1.0], 31), 5), "T_bed": np.full(n, 20.0)}
    channels |= {"T_air": np.full(n, 20.0)}
    error = rng.uniform(12.0, 30.0) * x / 1000.0 + rng.uniform(-5.0, 5.0) + NOISE_UM * rng.standard_normal(n)
    made = make_instrument("laser_linear", {}, "X", None, machine, "test")
    readings = {"reading_um": np.round(error / STEP_UM) * STEP_UM}
    m = Measurement(
        "x", made, machine, np.repeat(np.arange(1, 6), 62), np.linspace(0.0, 10.0 * n, n), channels, readings
    )
    model = Model(machine, effects("scale,component=EXX,axis=X,k=0", "backlash,component=EXX,axis=X,B=0"), name="known")
    assert diagnose(model, [m], draws=50).verdict == "nothing_missing"

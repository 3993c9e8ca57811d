"""Readings that swing by themselves. Oracle: the switch that was put in, its period and its height."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from rtec.diagnosis.search.diagnose import diagnose
from rtec.estimation.cycles import cycles
from rtec.estimation.readings import read
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support import proof
from tests.support.diagnosis_examples import small_machine

Floats = NDArray[np.float64]
STEP_S, READINGS, PERIOD_S = 60.0, 500, 1500.0


def drift(rng: np.random.Generator, keeps: float, count: int = READINGS) -> Floats:
    """An Ornstein-Uhlenbeck process of standard deviation one."""
    return np.asarray(lfilter([np.sqrt(1.0 - keeps**2)], [1.0, -keeps], rng.standard_normal(count)))


def switch(rng: np.random.Generator) -> Floats:
    """On and off every 25 minutes, give or take a minute each time, and only while a spindle runs."""
    turn = np.cumsum(STEP_S / (PERIOD_S + 60.0 * rng.uniform(-1.0, 1.0, READINGS)))
    return np.sign(np.sin(2.0 * np.pi * turn)) * (np.arange(READINGS) % 200 > 60)


def probe(read_um: Floats, chiller: Floats | None = None, seed: int = 1) -> Measurement:
    """A probe at the spindle for eight hours; the air has a sensor, and sees a chiller where one is given."""
    machine, rng = small_machine(), np.random.default_rng(seed)
    warm = 20.0 + 0.3 * np.sin(np.arange(READINGS) / 80.0) + 0.02 * rng.standard_normal(READINGS)
    channels = {"T_bed": warm, "T_air": warm + (0.0 if chiller is None else 0.5 * np.roll(chiller, 4))}
    made = make_instrument("spindle_drift", {"probe": {"z": {"direction": "Z"}}}, None, None, machine, "probe")
    time_s, run = np.arange(0.0, READINGS * STEP_S, STEP_S), np.ones(READINGS, dtype=np.int64)
    return Measurement("probe", made, machine, run, time_s, channels, {"reading_z_um": read_um})


@pytest.mark.parametrize("seed", proof.few(range(4), 1))
def test_a_switch_that_nothing_recorded_is_found(seed: int) -> None:
    rng = np.random.default_rng(seed)
    swing = 2.0 * switch(rng)
    readings = read([probe(swing + drift(rng, 0.97) + 0.3 * rng.standard_normal(READINGS))])
    (found,) = cycles(readings, readings.values, np.array([0.5]))
    assert found.period_s == pytest.approx(PERIOD_S, rel=0.1)
    # A square wave of height two: its first harmonic is 4/π times it, and it rests for a third of the time.
    assert 1.2 < found.swing < 2.6


@pytest.mark.parametrize("seed", proof.few(range(25), 5))
def test_noise_and_drift_swing_with_no_period(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    for values in (
        rng.standard_normal(READINGS),
        drift(rng, rng.uniform(0.5, 0.99)) + rng.uniform(0.0, 1.0) * rng.standard_normal(READINGS),
        np.cumsum(rng.standard_normal(READINGS)),
    ):
        readings = read([probe(values)])
        assert cycles(readings, readings.values, np.zeros(1)) == []


def test_what_a_recorded_temperature_does_as_well_is_no_riddle() -> None:
    """The same switch, a little later, in the air's sensor."""
    rng = np.random.default_rng(3)
    chiller = switch(rng)
    readings = read([probe(2.0 * chiller + 0.3 * rng.standard_normal(READINGS), chiller)])
    assert cycles(readings, readings.values, np.array([0.5])) == []


@pytest.mark.parametrize("seed", proof.few([5, 6], 1))
def test_a_diagnosis_asks_what_switches(seed: int) -> None:
    """It had been "no effect is missing", with the swing as a part of noise and drift."""
    rng = np.random.default_rng(seed)
    d = diagnose(Model(small_machine()), [probe(2.0 * switch(rng) + 0.4 * rng.standard_normal(READINGS))], draws=50)
    assert d.verdict == "undecided"
    assert [x.kind for x in d.doubts if x.fatal] == ["cycle"]
    assert "with a period of 2" in d.sentence
    assert d.sentence.endswith("record its temperature or state beside the readings.")

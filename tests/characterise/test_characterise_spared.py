"""What a free choice makes of a short record of drift alone. Oracle: nothing is hidden in it."""

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

import rtec
from rtec.characterise import characterise
from rtec.errors import ModelError
from rtec.metrology.measurement import Measurement
from tests.support import proof
from tests.support.characterise_examples import Probe, ProbeSetup, measurement, runs
from tests.support.sim_example import MACHINE_FILE

CYCLES, TARGETS, STEP_S, MEMORY_S = 5, 10, 20.0, 300.0


def positioning_test(seed: int, play_um: float = 0.0, cycles: int = CYCLES) -> Measurement:
    """Five ways there and back in half an hour, under a drift of 3 µm and a noise of 1 µm."""
    rng, n = np.random.default_rng(seed), cycles * 2 * TARGETS
    place = np.linspace(10.0, 190.0, TARGETS)
    way = np.tile(np.repeat([1.0, -1.0], TARGETS), cycles)
    kept, drift = np.exp(-STEP_S / MEMORY_S), np.zeros(n)
    drift[0] = rng.normal()
    for i in range(1, n):
        drift[i] = kept * drift[i - 1] + np.sqrt(1.0 - kept**2) * rng.normal()
    m = measurement(runs([2 * TARGETS] * cycles), instrument=Probe(ProbeSetup(zero="setup"), component="EXX"))
    return replace(
        m,
        time_s=np.linspace(0.0, STEP_S * (n - 1), n),
        channels={"x": np.tile(np.concatenate([place, place[::-1]]), cycles), "d_x": way},
        readings={"reading_um": 3.0 * drift + rng.normal(size=n) + 0.5 * play_um * way},
    )


@pytest.mark.parametrize("seed", proof.few(range(1000, 1008), 2))
def test_one_stretch_of_time_is_no_witness_of_an_effect(seed: int) -> None:
    with pytest.raises(ModelError, match="the readings are noise"):
        characterise([positioning_test(seed)])


def test_play_that_every_stretch_shows_is_found() -> None:
    made = characterise([positioning_test(1003, play_um=12.0)])
    (value,) = (c.value for c in made.coefficients if c.effect.startswith("backlash(EXX"))
    assert value == pytest.approx(12.0, abs=3.0)


@pytest.mark.parametrize("seed", proof.few([0, 14, 18], 1))
def test_play_that_every_machine_has_needs_no_more_than_three_ways(seed: int) -> None:
    """Of three stretches 45 standard errors would be needed against all candidates, eight against the usual ones."""
    made = characterise([positioning_test(seed, play_um=6.0, cycles=3)])
    (value,) = (c.value for c in made.coefficients if c.effect.startswith("backlash(EXX"))
    assert value == pytest.approx(6.0, abs=2.0)


def test_a_quiet_spindle_day_has_hardly_an_effect() -> None:
    """Five probes that wander by 0.6 µm within three hours: seven of 16 such days had from one to three effects."""
    noise = {"white_um": 0.1, "drift_um": 0.6, "drift_tau_s": 10800.0}
    found = 0
    for seed in range(310, 310 + proof.of(16, 4)):
        day = rtec.simulate(MACHINE_FILE, "spindle_drift", seed=seed, changes={"noise": noise})
        with suppress(ModelError):
            found += bool(characterise([day.measurement]).model.effects)
    assert found <= 1

"""A slow drift during a warm-up is no dependence on a temperature. Oracle: what was put into the readings."""

from dataclasses import replace

import numpy as np
import pytest

from rtec.diagnosis.result import Diagnosis
from rtec.diagnosis.search.diagnose import diagnose
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support import proof
from tests.support.diagnosis_examples import laser, small_machine

SEEDS = range(201, 209)


def wandering(seed: int, drift_um: float, memory_s: float) -> Measurement:
    """A laser that drifts, and a machine without an error, through a day's warm-up."""
    return laser([], seed, noise={"white_um": 0.3, "drift_um": drift_um, "drift_tau_s": memory_s})


def diagnosed(m: Measurement) -> Diagnosis:
    return diagnose(Model(small_machine(), name="none"), [m], draws=50)


@pytest.mark.parametrize(("drift_um", "memory_s"), proof.few([(3.0, 4000.0), (1.0, 2400.0)], 1))
def test_a_drift_is_no_effect_that_follows_a_temperature(drift_um: float, memory_s: float) -> None:
    """Before, half of these drifts were said to depend on a temperature."""
    named = [d.sentence for d in (diagnosed(wandering(s, drift_um, memory_s)) for s in SEEDS) if d.unknown is not None]
    assert len(named) <= 1, named


@pytest.mark.parametrize("seed", proof.few([301, 302], 1))
def test_a_curve_over_a_temperature_is_still_seen(seed: int) -> None:
    m = wandering(seed, 0.2, 2400.0)
    heat = m.channels["T_bed"]
    share = (heat - heat.min()) / np.ptp(heat)
    bent = {k: v + 3.0 * np.sin(5.0 * share) for k, v in m.readings.items()}
    d = diagnosed(replace(m, readings=bent))
    assert d.verdict == "unknown_effect"
    assert d.unknown is not None
    assert "T_bed" in d.unknown.channels

"""Spindle drift read in X and Z from an empty machine: a tilt is named only where one delay moves both probes.

Oracle: bodies that lag behind the spindle's sensor, integrated in steps of a second; the chain's lever arms.
"""

from dataclasses import replace

import numpy as np
import pytest

from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.extend.improve import improve
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.characterise.test_characterise_drift import drift
from tests.diagnosis import test_warm_start as warm
from tests.support import proof


def empty() -> Model:
    return Model(warm.lathe(), (), name="empty")


@pytest.mark.parametrize("seed", proof.few([1, 5], 1))
@pytest.mark.parametrize(("tau_z_s", "tau_x_s"), [(1800, 3600), (2700, 2700), (6800, 3400), (900, 5000)])
def test_growth_in_two_directions_is_improved_to_the_truth(tau_z_s: float, tau_x_s: float, seed: int) -> None:
    """As it was: a tilt and two growths of opposite signs; or, after the tilt, "undecided" at five times the noise."""
    days = [drift(seed, tau_z_s, tau_x_s), drift(seed + 1, tau_z_s, tau_x_s)]
    model = improve(empty(), days, ask=None, draws=50).model
    by_component = {f.effect.component: f for f in model.effects}
    assert sorted(by_component) == ["EX0spindle", "EZ0spindle"]
    assert len(model.effects) == 2
    for component, k, tau_s in (("EZ0spindle", -warm.K_Z, tau_z_s), ("EX0spindle", -warm.K_X, tau_x_s)):
        assert by_component[component].values["k"] == pytest.approx(k, rel=0.03)
        assert by_component[component].theta["tau"] == pytest.approx(tau_s, rel=0.05)
    unseen = compare(model, [drift(seed + 20, tau_z_s, tau_x_s)]).judged
    assert unseen.residual == pytest.approx(warm.NOISE_UM, rel=0.1)


def tilted(seed: int, grows: float = 0.0) -> Measurement:
    """The spindle tilts by 8 µrad/K with a delay of 2000 s; Z grows beside it at once."""
    m, rng = drift(seed, 2000.0, 2000.0), np.random.default_rng(seed)
    rise = np.interp(np.arange(0.0, 3600.0 * warm.HOURS), m.time_s, m.channels["T_spindle"]) - 20.0
    rows = m.time_s.astype(np.int64)
    turned = 8.0 * warm.behind(rise, 2000.0)[rows]
    arms = m.instrument.arms_of(m.machine, m.state().positions_mm(), "EB0spindle")
    names = m.instrument.columns()
    z = [grows * rise[rows] * (name == "reading_z_um") for name in names]
    noise = rng.normal(0.0, warm.NOISE_UM, (2, len(m)))
    return replace(m, readings={n: arms[i] * turned + z[i] + noise[i] for i, n in enumerate(names)})


@pytest.mark.parametrize("seed", proof.few([1, 5], 1))
@pytest.mark.parametrize("grows", [0.0, -0.5])
def test_a_tilt_with_one_delay_stays_a_tilt(seed: int, grows: float) -> None:
    model = improve(empty(), [tilted(seed, grows), tilted(seed + 1, grows)], ask=None, draws=50).model
    tilt, *beside = model.effects
    assert tilt.label == "spindle_tilt(EB0spindle, T_spindle)"
    assert tilt.values["k"] == pytest.approx(8.0, rel=0.02)
    assert tilt.theta["tau"] == pytest.approx(2000.0, rel=0.05)
    assert [(f.label, f.theta) for f in beside] == [("spindle_growth(EZ0spindle, T_spindle)", {})] * (grows != 0.0)

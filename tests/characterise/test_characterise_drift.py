"""A free fit of spindle drift, read in X and Z: two directions that grow with delays of their own are no tilt.

Oracle: bodies that lag behind the spindle's sensor, integrated in steps of a second; an angle moves both probes, with
one delay.
"""

from dataclasses import replace

import numpy as np
import pytest

from rtec.characterise import characterise
from rtec.diagnosis.compare.compare import compare
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from tests.diagnosis import test_warm_start as warm
from tests.support import proof


def drift(seed: int, tau_z_s: float, tau_x_s: float) -> Measurement:
    """A day of the warm-up records, with other delays; the sensor's display has steps of 0.1 K."""
    m, rng = warm.day(seed), np.random.default_rng(seed + 90)
    degc = m.channels["T_spindle"]
    rise = np.interp(np.arange(0.0, 3600.0 * warm.HOURS), m.time_s, degc) - 20.0
    rows = m.time_s.astype(np.int64)
    of = {"z": warm.K_Z * warm.behind(rise, tau_z_s)[rows], "x": warm.K_X * warm.behind(rise, tau_x_s)[rows]}
    noise = {n: warm.NOISE_UM * rng.standard_normal(len(rows)) for n in of}
    readings = {f"reading_{n}_um": v + noise[n] for n, v in of.items()}
    return replace(m, channels={**m.channels, "T_spindle": np.round(degc, 1)}, readings=readings)


def fitted(tau_z_s: float, tau_x_s: float, seed: int) -> Model:
    return characterise([drift(seed, tau_z_s, tau_x_s), drift(seed + 1, tau_z_s, tau_x_s)]).model


def growth(model: Model, component: str) -> list[FittedEffect]:
    """Growth of a component by the spindle's sensor."""
    return [f for f in model.effects if f.label == f"spindle_growth({component}, T_spindle)"]


@pytest.mark.parametrize("seed", proof.few([1, 5], 1))
@pytest.mark.parametrize(("tau_z_s", "tau_x_s"), [(1800, 3600), (2700, 2700), (3400, 3400), (6800, 3400), (900, 5000)])
def test_two_directions_with_delays_of_their_own_are_no_tilt(tau_z_s: float, tau_x_s: float, seed: int) -> None:
    """As it was, up to nine effects, of which -4 ± 20 and 4.2 ± 20.6 µm/K were two, predicted as well."""
    model = fitted(tau_z_s, tau_x_s, seed)
    assert "spindle_tilt" not in {f.effect.effect for f in model.effects}
    assert len(model.effects) <= 3
    for component, k, tau_s in (("EZ0spindle", -warm.K_Z, tau_z_s), ("EX0spindle", -warm.K_X, tau_x_s)):
        (found,) = growth(model, component)
        assert found.values["k"] == pytest.approx(k, rel=0.03)
        assert found.theta["tau"] == pytest.approx(tau_s, rel=0.08)
    unseen = compare(model, [drift(seed + 20, tau_z_s, tau_x_s)]).judged
    assert unseen.residual == pytest.approx(warm.NOISE_UM, rel=0.1)


@pytest.mark.parametrize("seed", proof.few([1, 5], 1))
def test_an_angle_that_moves_both_probes_stays_one(seed: int) -> None:
    """Arms of 100 mm: 10 µrad/K move X and Z by 1 µm/K, in opposite directions."""
    days = []
    for s in (seed, seed + 1):
        m = drift(s, 2000.0, 2000.0)
        arms = m.instrument.arms_of(m.machine, m.state().positions_mm(), "EB0spindle")
        turned = (m.readings["reading_x_um"] / warm.K_X) * 8.0
        noise = np.random.default_rng(s).normal(0.0, warm.NOISE_UM, (2, len(m)))
        readings = {n: arms[i] * turned + noise[i] for i, n in enumerate(m.instrument.columns())}
        days.append(replace(m, readings=readings))
    (one,) = characterise(days).model.effects[:1]
    assert one.effect.effect == "spindle_tilt"

"""Proof on simulated machines whose truth is known: coefficients, and the prediction of another day."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from rtec.characterise import characterise
from rtec.estimation.gram.fit import estimate
from rtec.estimation.gram.source import Source
from rtec.estimation.gram.stream import Term
from rtec.machine import Machine
from rtec.metrology.instruments.base import Instrument
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.sim.campaign.campaign import simulate_with_truth
from rtec.sim.campaign.settings import DayPhase, ReadingNoise, Sensors, Settings, Targets, Thermal
from rtec.sim.campaign.truth import truth_of
from tests.support.machines import turning_centre, vertical_mill
from tests.support.sim_example import PERFECT

TURNING = (
    "scale,component=EXX,axis=X,k=20",
    "polynomial_position,component=EXX,axis=X,degrees=[2],c2=3",
    "backlash,component=EXX,axis=X,B=4",
    "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=11",
    "scale,component=EZZ,axis=Z,k=-15",
    "backlash,component=EZZ,axis=Z,B=2",
    "axis_expansion,component=EZZ,axis=Z,sensor=T_bed,k=11",
    "polynomial_position,component=EBZ,axis=Z,degrees=[1,2],c1=8,c2=-5",
    "spindle_growth,component=EZ0spindle,sensor=T_spindle,k=1.2",
    "spindle_growth,component=EX0spindle,sensor=T_spindle,k=0.5",
)
MILL = (
    "scale,component=EXX,axis=X,k=-12",
    "backlash,component=EXX,axis=X,B=3",
    "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=11",
    "scale,component=EYY,axis=Y,k=9",
    "backlash,component=EYY,axis=Y,B=-2",
    "polynomial_position,component=EZZ,axis=Z,degrees=[1,2],c1=4,c2=2.5",
    "axis_expansion,component=EZZ,axis=Z,sensor=T_column,k=12",
    "squareness,component=EC0Y,alpha=18",
    "spindle_growth,component=EZ0S,sensor=T_spindle,k=1.5",
)
DAY = (
    DayPhase(name="cold", cycles=2),
    DayPhase(name="moving", hours=0.5, moving=0.6, rpm=1500.0),
    DayPhase(name="warmer", cycles=2),
    DayPhase(name="spindle", hours=1.0, moving=0.3, rpm=3000.0),
    DayPhase(name="warm", cycles=2),
    DayPhase(name="idle", hours=1.0),
    DayPhase(name="less warm", cycles=2),
    DayPhase(name="long", hours=1.5, moving=0.5, rpm=2500.0),
    DayPhase(name="warmest", cycles=2),
)


@dataclass(frozen=True)
class Case:
    """A machine, what is true of it, and the instruments that it is measured with."""

    machine: Machine
    effects: tuple[str, ...]
    instruments: tuple[tuple[str, str | None, str | None, dict[str, object]], ...]

    def truth(self) -> Model:
        return truth_of(self.machine, None, self.effects)

    def instrument(self, i: int) -> Instrument:
        name, axis, component, setup = self.instruments[i]
        return make_instrument(name, setup, axis, component, self.machine, "test")


CASES = {
    "turning centre": Case(
        turning_centre(),
        TURNING,
        (
            ("laser_linear", "X", "EXX", {"zero": "run"}),
            ("laser_linear", "Z", "EZZ", {}),
            ("laser_angular", "Z", "EBZ", {}),
            ("tool_tip", None, None, {"directions": ["X", "Z"]}),
        ),
    ),
    "vertical machining centre": Case(
        vertical_mill(),
        MILL,
        (
            ("laser_linear", "X", "EXX", {}),
            ("laser_linear", "Y", "EYY", {"zero": "run"}),
            ("tool_tip", None, None, {}),
        ),
    ),
}


def clean(case: Case, seed: int, sensors: Sensors = PERFECT, targets: Targets | None = None) -> list[Measurement]:
    """Measurements without noise of their own; the sensors have what faults they are given."""
    out = []
    for i in range(len(case.instruments)):
        where = targets or Targets(axes=tuple(a.name for a in case.machine.axes if a.name != "W"), step_mm=40.0)
        if case.instruments[i][1] is not None:
            where = where.model_copy(update={"axes": None})
        settings = Settings(
            phase=DAY, targets=where, thermal=Thermal(sensors=sensors), noise=ReadingNoise(white_um=0.0)
        )
        made = simulate_with_truth(case.truth(), case.instrument(i), settings, seed + i, f"{i}")
        out.append(made.measurement)
    return out


def noisy(
    measurements: Sequence[Measurement], seed: int, noise_um: float = 0.3, drift_um: float = 0.3
) -> list[Measurement]:
    """White noise, and drift that goes on within a run and starts anew with the next."""
    out = []
    for i, m in enumerate(measurements):
        rng = np.random.default_rng([seed, i])
        readings = {}
        for name, values in m.readings.items():
            drift = rng.standard_normal(len(m))
            same = np.concatenate([[False], np.diff(m.run) == 0])
            for k in range(1, len(m)):
                if same[k]:
                    drift[k] = 0.9 * drift[k - 1] + np.sqrt(1 - 0.81) * drift[k]
            readings[name] = values + noise_um * rng.standard_normal(len(m)) + drift_um * drift
        out.append(replace(m, readings=readings))
    return out


@pytest.mark.parametrize("name", CASES)
def test_coefficients_within_three_standard_errors(name: str) -> None:
    """Oracle: the truth that made the readings; 100 seeds a machine, 200 in all.

    In at least 95 % of the seeds all ten or so coefficients together are within three of their standard errors.
    """
    case = CASES[name]
    truth = case.truth()
    true = np.array([f.values[k] for f in truth.effects for k in f.values])
    exact = clean(case, 11)
    terms = [Term(f.effect) for f in truth.effects]
    off = []
    for seed in range(100):
        fit = estimate([Source.of(m) for m in noisy(exact, seed)], terms)
        off.append(np.abs(fit.values[: len(true)] - true) / fit.errors[: len(true)])
    within = np.array(off) < 3.0
    assert within.all(axis=1).mean() >= 0.95, within.all(axis=1).mean()
    assert np.median(off) > 0.3  # standard errors are not merely huge


@pytest.mark.parametrize("name", CASES)
def test_prediction_of_an_unseen_warm_up(name: str) -> None:
    """Oracle: noise alone. On another day, read with the same noise, what the prediction leaves exceeds it by < 10 %.

    Effects, sensors and lags are chosen freely; the sensors have noise, lag and resolution, as on a machine.
    """
    case = CASES[name]
    sensors = Sensors(offset_degc=0.0)
    targets = Targets(axes=tuple(a.name for a in case.machine.axes if a.name != "W"), step_mm=23.0)
    day = noisy(clean(case, 21, sensors, targets), 1, 0.3, 0.0)
    model = characterise(day).model
    tip = len(case.instruments) - 1
    other = noisy(clean(case, 77, sensors, targets), 2, 0.3, 0.0)[tip]
    state = other.state()
    arms = other.instrument.arms(case.machine, state.positions_mm())
    predicted = np.einsum("rnc,nc->rn", arms, model.components(state))
    left = other.matrix() - predicted
    left -= np.nanmean(left, axis=1, keepdims=True)  # the instrument's zero of that day
    before = other.matrix() - np.nanmean(other.matrix(), axis=1, keepdims=True)
    rms = float(np.sqrt(np.nanmean(left**2)))
    assert rms < 1.1 * 0.3, (rms, float(np.sqrt(np.nanmean(before**2))), [f.label for f in model.effects])
    assert float(np.sqrt(np.nanmean(before**2))) > 10 * rms

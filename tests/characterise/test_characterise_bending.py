"""What a free choice takes for the straightness of a bed that heat bends. Oracle: the law, on another day."""

import numpy as np
import pytest

from rtec.characterise import fitted_model
from rtec.estimation.judge import Judgement
from rtec.estimation.outliers import clean
from rtec.machine import machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from tests.support.machines import axis

NOISE_UM = 0.3
MACHINE = machine_from(
    {
        "machine": {"name": "grinder", "tool_chain": ["X", "wheel"], "work_chain": ["table"]},
        "axis": {"X": axis("X", travel_mm=[0.0, 800.0])},
        "link": {"wheel": {}, "table": {}},
        "temperature": {"T_oil": {}, "T_coolant": {}, "T_room": {}},
    },
    "grinder",
)


def day(seed: int, oil_degc: float, coolant_degc: float, bend: float, shift: float) -> Measurement:
    """Twelve runs along X in four hours; oil and coolant warm by as much, at their own rates.

    Args:
        seed: of the noise.
        oil_degc, coolant_degc: rises.
        bend: µm/K at the ends of the travel, of the difference of both.
        shift: µm/K of the oil.
    """
    rng = np.random.default_rng(seed)
    places = np.linspace(20.0, 780.0, 21)
    x, run = np.tile(np.concatenate([places, places[::-1]]), 12), np.repeat(np.arange(1, 13), 42)
    time_s = 15.0 * np.arange(len(x)) + 650.0 * run
    rises = {
        "T_oil": oil_degc * (1.0 - np.exp(-time_s / 4000.0)),
        "T_coolant": coolant_degc * (1.0 - np.exp(-time_s / 1500.0)) * np.where(time_s > 8000.0, 0.4, 1.0),
        "T_room": 0.7 * np.sin(time_s / 9000.0),
    }
    u = x / 400.0 - 1.0
    true = bend * (rises["T_oil"] - rises["T_coolant"]) * u**2 + shift * rises["T_oil"] + 3.0 * u**2
    instrument = make_instrument("straightness", {"direction": "Z"}, "X", "EZX", MACHINE, "day")
    return Measurement(
        name="day", machine=MACHINE, instrument=instrument, run=run, time_s=time_s,
        channels={"x": x, "d_x": np.tile(np.repeat([1.0, -1.0], 21), 12),
                  **{k: np.round(20.0 + v + 0.03 * rng.normal(size=len(x)), 1) for k, v in rises.items()}},
        readings={"reading_um": true + NOISE_UM * rng.normal(size=len(x))},
    )  # fmt: skip


@pytest.mark.parametrize(("bend", "shift", "effect"), [(1.2, 0.0, "bed_bending"), (0.0, 1.0, "mount_expansion")])
def test_the_bend_is_one_effect_and_a_shift_is_no_bend(bend: float, shift: float, effect: str) -> None:
    model = fitted_model([day(1, 6.0, 4.0, bend, shift)])
    thermal = [f.label for f in model.effects if f.effect.effect not in ("polynomial_position", "straightness")]
    assert [label.partition("(")[0] for label in thermal] == [effect]
    other = clean([day(2, 2.0, 7.0, bend, shift)], model.reference_degc)
    assert Judgement(model, other).residual < 1.25 * NOISE_UM

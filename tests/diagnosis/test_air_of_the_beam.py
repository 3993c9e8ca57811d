"""A laser whose air nobody corrects, on a machine with two sensors that move alike.

Oracle: the index of air, -0.93e-6 per kelvin over the whole beam, of which 450 mm are dead path.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.heat import beam_in_air
from rtec.diagnosis.search.diagnose import diagnose
from rtec.estimation.outliers import clean
from rtec.machine import machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from rtec.sim.campaign.truth import effect_from_text
from tests.support import proof
from tests.support.both import both
from tests.support.machines import axis

NOISE_UM, DEAD_MM, INDEX_UM_PER_M_DEGC = 0.15, 450.0, -0.93
MACHINE = machine_from(
    {
        "machine": {"name": "bridge", "tool_chain": ["X", "probe"], "work_chain": ["plate"]},
        "axis": {"X": axis("X", travel_mm=[0.0, 700.0], pitch_mm=0.02, counts_per_mm=2000)},
        "link": {"probe": {}, "plate": {}},
        "temperature": {"T_x": {}, "T_y": {}, "T_air": {}},
    },
    "bridge",
)


def model() -> Model:
    """What the machine is: its scale, which warms up."""
    texts = ("scale,component=EXX,axis=X,k=3", "axis_expansion,component=EXX,axis=X,sensor=T_x,k=8")
    known: list[FittedEffect] = [effect_from_text(t, MACHINE) for t in texts]
    return Model(MACHINE, tuple(replace(f, errors=dict.fromkeys(f.values, 0.1)) for f in known), name="bridge")


def day(seed: int, warm_degc: float, air_degc: float, exchanged: bool = False) -> Measurement:
    """Twelve runs there and back while the hall and the machine warm up; the second scale is farther from the air."""
    rng = np.random.default_rng(seed)
    places = np.arange(0.0, 701.0, 35.0)
    x = np.tile(np.concatenate([places, places[::-1]]), 12)
    way = np.tile(np.repeat([1.0, -1.0], len(places)), 12)
    run = np.repeat(np.arange(1, 13), 2 * len(places))
    time_s = 3.0 * np.arange(len(x)) + 1500.0 * (run - 1)
    hours = time_s / 3600.0
    air = air_degc * np.sin(2.0 * np.pi * hours / 9.0) + 0.3 * np.sin(2.0 * np.pi * hours / 1.7)
    slow = 0.5 + warm_degc * (1.0 - np.exp(-hours / 2.0))
    scale, second = slow + 0.6 * air, slow + 0.4 * air
    shown = {"T_x": second if exchanged else scale, "T_y": scale if exchanged else second, "T_air": air}
    beam = 0.0 if exchanged else INDEX_UM_PER_M_DEGC * 1e-3 * (x + DEAD_MM) * air
    true = 3e-3 * x + 8e-3 * x * scale + beam
    sensors = {n: 20.0 + v + 0.01 * rng.normal(size=len(x)) for n, v in shown.items()}
    return Measurement(
        name="beam", machine=MACHINE, instrument=make_instrument("laser_linear", {}, "X", "EXX", MACHINE, "beam"),
        run=run, time_s=time_s, channels={"x": x, "d_x": way, **sensors},
        readings={"reading_um": true + NOISE_UM * rng.normal(size=len(x))},
    )  # fmt: skip


@pytest.mark.parametrize("seed", proof.few([1, 2, 3], 1))
def test_the_air_is_named_and_no_exchange_of_sensors(seed: int) -> None:
    today, other = day(seed, 1.5, 3.0), day(seed + 50, 3.0, -2.5)
    d, done = both(model(), [today], draws=50)
    assert "swapped_sensors" not in [x.kind for x in d.doubts]
    assert "mount_expansion(EXX, T_air)" in [label for step in done.steps for label in step.labels]
    assert compare(done.model, [other]).judged.residual < 1.2 * NOISE_UM


@pytest.mark.parametrize("seed", proof.few([1, 2, 3], 2))
def test_exchanged_sensors_are_still_seen(seed: int) -> None:
    d = diagnose(model(), [day(seed, 1.5, 3.0, exchanged=True)], draws=50)
    assert [x.kind for x in d.doubts if x.fatal] == ["swapped_sensors"]


@pytest.mark.parametrize(
    ("sensor", "setup", "asks"),
    [
        ("T_air", {}, True),
        ("T_x", {}, False),
        ("T_air", {"air_sensor": "T_air", "interferometer_mm": -DEAD_MM}, False),
    ],
)
def test_an_effect_of_the_air_asks_whether_the_beam_was_corrected(
    sensor: str, setup: dict[str, Any], asks: bool
) -> None:
    """Only where a laser read it, and its file does not say what its air did."""
    m = replace(day(1, 2.0, 2.0), instrument=make_instrument("laser_linear", setup, "X", None, MACHINE, "test"))
    named = effect_from_text(f"mount_expansion,component=EXX,sensor={sensor},k=2", MACHINE).effect
    doubt = beam_in_air(clean([m], 20.0).readings, [named])
    assert (doubt is not None) == asks
    assert doubt is None or (not doubt.fatal and "T_air is also the air of the beam of" in doubt.message)

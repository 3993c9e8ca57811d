"""A model that follows a sensor which was near the right one on the day of its fit, and only then.

Oracle: the laws by which the days were made.
"""

import numpy as np
import pytest

from rtec.diagnosis.extend.add import add
from rtec.diagnosis.result import Diagnosis
from rtec.diagnosis.search.diagnose import diagnose
from rtec.machine import machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.sim.campaign.truth import effect_from_text
from tests.support import proof
from tests.support.machines import axis

MACHINE = machine_from(
    {
        "machine": {"name": "mill", "tool_chain": ["X", "tool"], "work_chain": ["table"]},
        "axis": {"X": axis("X", travel_mm=[0.0, 600.0], pitch_mm=10.0)},
        "link": {"tool": {}, "table": {}},
        "temperature": {"T_x_nut": {}, "T_bed": {}, "T_air": {}},
    },
    "mill",
)


def day(seed: int, nut_k: float, play: float = 1.0, wave: float = 0.0, exchanged: bool = False) -> Measurement:
    """Nine runs there and back in a day on which the air warms by four kelvin and the bed follows it; a glass scale
    grows with the bed.

    Args:
        seed: random numbers.
        nut_k: by how much the nut is warmer than the bed at the end of the day.
        play: backlash, µm.
        wave: of the screw, µm.
        exchanged: whether the columns of the nut and of the bed are exchanged.
    """
    rng = np.random.default_rng(seed)
    places = np.sort(rng.uniform(5.0, 595.0, 19))
    x = np.tile(np.concatenate([places, places[::-1]]), 9)
    way = np.tile(np.repeat([1.0, -1.0], len(places)), 9)
    run = np.repeat(np.arange(1, 10), 2 * len(places))
    time_s = 3000.0 * (run - 1) + 8.0 * np.tile(np.arange(2 * len(places)), 9)
    air = 20.0 + 4.0 * np.sin(np.pi * time_s / 30000.0)
    bed = 20.0 + 3.4 * np.sin(np.pi * (time_s - 1800.0) / 30000.0)
    nut = bed + nut_k * np.sin(np.pi * time_s / 13000.0) ** 2
    error = 1e-3 * x * (6.0 + 9.0 * (bed - 20.0)) + 0.5 * play * way + wave * np.sin(2.0 * np.pi * x / 10.0)
    shown = {"T_x_nut": bed, "T_bed": nut, "T_air": air} if exchanged else {"T_x_nut": nut, "T_bed": bed, "T_air": air}
    return Measurement(
        name=f"laser-{seed}", machine=MACHINE,
        instrument=make_instrument("laser_linear", {}, "X", "EXX", MACHINE, "laser"), run=run, time_s=time_s,
        channels={"x": x, "d_x": way, **{n: v + 0.03 * rng.normal(size=len(x)) for n, v in shown.items()}},
        readings={"reading_um": error + 0.3 * rng.normal(size=len(x))},
    )  # fmt: skip


def diagnosed(sensor: str, fit: Measurement, today: Measurement) -> Diagnosis:
    texts = (
        "scale,component=EXX,axis=X,k=5",
        "backlash,component=EXX,axis=X,B=2",
        f"axis_expansion,component=EXX,axis=X,sensor={sensor},k=8",
    )
    start = Model(MACHINE, tuple(effect_from_text(t, MACHINE) for t in texts), name="mill")
    return diagnose(add(start, [], [fit]).model, [today], draws=50, explain=True)


@pytest.mark.parametrize("seed", proof.few([2, 3], 1))
def test_the_sensor_of_the_model_is_wrong_and_none_is_exchanged(seed: int) -> None:
    """The air is nearer to the bed than the nut is: an exchange of the two had been asserted."""
    found = diagnosed("T_x_nut", day(1, 0.3), day(seed, 9.0))
    assert not [d.kind for d in found.doubts if d.fatal]
    assert found.findings[0].label.startswith("axis_expansion(EXX, X, T_bed"), found.sentence


def test_an_exchange_that_reaches_the_noise_is_still_seen() -> None:
    found = diagnosed("T_bed", day(1, 9.0), day(4, 9.0, exchanged=True))
    assert [d.kind for d in found.doubts if d.fatal] == ["swapped_sensors"]


def test_a_number_that_changed_is_said_where_only_what_is_named_beside_it_shows_it() -> None:
    """A wave of the screw hides that the backlash went from 1 to 3 µm. Oracle: what was put in."""
    found = diagnosed("T_bed", day(1, 3.0), day(5, 3.0, play=3.0, wave=6.0))
    assert found.findings[0].label == "cyclic_screw(EXX, X)"
    said = found.sentence.split("changed")[-1]
    assert "backlash(EXX, X) B from " in said
    was, now = (float(said.split(word)[1].split(" ")[0]) for word in (" from ", " to "))
    assert was == pytest.approx(1.0, abs=0.2)
    assert now == pytest.approx(3.0, abs=0.2)

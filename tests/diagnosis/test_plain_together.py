"""Plain effects that are missing together, on uneven targets. Oracle: what was put in."""

import numpy as np
import pytest

from rtec.diagnosis.search.diagnose import diagnose
from rtec.machine import machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.report.diagnosis import bars
from tests.support.machines import axis

MACHINE = machine_from(
    {
        "machine": {"name": "lathe", "tool_chain": ["Z", "tool"], "work_chain": ["workpiece"]},
        "axis": {"Z": axis("Z", travel_mm=[0.0, 500.0], pitch_mm=10.0)},
        "link": {"tool": {"offset_mm": [0.0, 0.0, 80.0]}, "workpiece": {"offset_mm": [0.0, 0.0, 0.0]}},
        "temperature": {"T_bed": {}, "T_z_nut": {}},
    },
    "lathe",
)


def line(seed: int, targets: int) -> Measurement:
    """Fourteen runs to and fro: a scale, a backlash, a wave of the screw; and a zero that wanders."""
    rng = np.random.default_rng(seed)
    there = np.linspace(10.0, 490.0, targets) + rng.uniform(-3.0, 3.0, targets)
    z = np.tile(np.concatenate([there, there[::-1]]), 14)
    way = np.tile(np.repeat([1.0, -1.0], targets), 14)
    run = np.repeat(np.arange(1, 15), 2 * targets)
    time_s = 5.0 * np.arange(len(z)) + 1800.0 * (run - 1)
    warm = {n: 20.0 + a * (1.0 - np.exp(-time_s / tau)) for n, a, tau in (("T_bed", 2.0, 9e3), ("T_z_nut", 6.0, 3e3))}
    warm = {n: np.round(v + rng.normal(0.0, 0.02, len(z)), 2) for n, v in warm.items()}
    wander = np.interp(time_s, np.linspace(0.0, time_s[-1], 25), np.cumsum(rng.normal(0.0, 0.4, 25)))
    um = 12.5e-3 * z + 1.5 * way + 1.4 * np.sin(2.0 * np.pi * z / 10.0 + 0.6) + wander
    readings = {"reading_um": um + rng.normal(0.0, 0.4, len(z))}
    instrument = make_instrument("laser_linear", {}, "Z", None, MACHINE, "line")
    return Measurement("line", instrument, MACHINE, run, time_s, {"z": z, "d_z": way, **warm}, readings)


@pytest.mark.parametrize(("seed", "targets"), [(1, 50), (2, 24)])
def test_three_plain_effects_are_no_curve_of_many_knots(seed: int, targets: int) -> None:
    """A curve through eleven knots had stood for the scale, and the backlash was not named."""
    d = diagnose(Model(MACHINE), [line(seed, targets)], draws=50)
    assert {m.fitted.effect.effect for m in d.together} == {"scale", "backlash", "cyclic_screw"}
    assert not any("cyclic_pole" in r for m in d.together for r in m.rivals)
    drawn = bars(d)  # what is named, one on top of the other
    assert [chosen for _, _, chosen, _ in drawn] == [True] * 3
    assert [drop for _, drop, _, _ in drawn] == sorted(drop for _, drop, _, _ in drawn)

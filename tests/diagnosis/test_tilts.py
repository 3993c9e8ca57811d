"""A part that tilts with one temperature. Oracle: its rotation, as an angle times an arm that is worked out here."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.diagnosis.result import Diagnosis
from rtec.diagnosis.search.diagnose import diagnose
from rtec.estimation.candidates import library
from rtec.estimation.readings import read
from rtec.machine import Machine
from rtec.machine.machine import machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support import proof

Floats = NDArray[np.float64]
RUNS, EACH = 14, 25
AXIS: dict[str, Any] = {"counts_per_mm": 2000}
SENSORS = ("T_air", "T_bed", "T_head", "T_motor")


def machine(tool: list[str], work: list[str], offsets: dict[str, list[float]]) -> Machine:
    return machine_from(
        {
            "machine": {"name": "tilts", "tool_chain": tool, "work_chain": work},
            "axis": {a: {**AXIS, "direction": a, "travel_mm": [0.0, 400.0]} for a in "XZ"},
            "link": {name: {"offset_mm": offset} for name, offset in offsets.items()},
            "temperature": {s: {"range_degc": [5.0, 80.0]} for s in SENSORS},
        },
        "test",
    )


def temperatures(seed: int, hot: str) -> dict[str, Floats]:
    """A body that is heated and cools down, beside others that follow the room."""
    rng = np.random.default_rng(seed)
    hours = np.arange(RUNS * EACH) * 72.0 / 3600.0
    out = {}
    for i, name in enumerate(SENSORS):
        room = 20.0 + 0.8 * np.sin(0.7 * hours + rng.uniform(0.0, 6.0)) + 0.2 * i
        heat = sum(6.0 * np.exp(-np.abs(hours - at) / 0.8) for at in rng.uniform(0.5, 6.5, 3))
        out[name] = np.round(room + (heat if name == hot else 0.0) + rng.normal(0.0, 0.03, len(hours)), 2)
    return out


def measured(
    of: Machine, kind: str, setup: dict[str, Any], seed: int, readings: dict[str, Floats], channels: dict[str, Floats]
) -> Measurement:
    rng = np.random.default_rng(seed)
    n = RUNS * EACH
    return Measurement(
        name=f"{kind}-{seed}",
        instrument=make_instrument(kind, setup, None, None, of, "test"),
        machine=of,
        run=np.repeat(np.arange(RUNS) + 1, EACH),
        time_s=np.arange(0.0, 72.0 * n, 72.0),
        channels=channels,
        readings={c: v + rng.normal(0.0, 0.3, n) for c, v in readings.items()},
    )


def bare(of: Machine) -> Model:
    return Model(of, (), name="bare")


def first(d: Diagnosis) -> list[str]:
    """The names that the answer gives, of the candidates it cannot distinguish from the best."""
    return [f.label for f in d.findings if f.accepted] or [d.findings[0].label]


LATHE = {"headstock": [0.0, 0.0, -200.0], "spindle": [0.0, 0.0, 150.0], "tool": [0.0, 0.0, 90.0]}


@pytest.mark.parametrize("seed", proof.few(range(6), 2))
def test_two_probes_show_that_the_headstock_tilts_with_its_temperature(seed: int) -> None:
    """The headstock turns at -200 mm, the tool's tip is at 100 + 90 mm: one probe has an arm of 390 mm, one of 270."""
    of = machine(["Z", "X", "tool"], ["headstock", "spindle"], LATHE)
    warm = temperatures(seed, "T_head")
    still = {"x": np.full(RUNS * EACH, 30.0), "z": np.full(RUNS * EACH, 100.0)}
    probes = {"r1": {"direction": "X"}, "r2": {"direction": "X", "offset_mm": [0.0, 0.0, -120.0]}}
    turn_urad = 2.4 * (warm["T_head"] - 20.0)
    shifts = {"reading_r1_um": -0.39 * turn_urad, "reading_r2_um": -0.27 * turn_urad}
    d = diagnose(bare(of), [measured(of, "spindle_drift", {"probe": probes}, seed, shifts, {**still, **warm})])
    assert "mount_expansion(EB0headstock, T_head)" in first(d), d.sentence


def test_one_probe_shows_a_shift() -> None:
    """At one height an angle times its arm is a shift, and nothing in the readings is an angle."""
    of = machine(["Z", "X", "tool"], ["headstock", "spindle"], LATHE)
    warm = temperatures(3, "T_head")
    still = {"x": np.full(RUNS * EACH, 30.0), "z": np.full(RUNS * EACH, 100.0)}
    shift = 0.6 * (warm["T_head"] - 20.0)
    m = measured(
        of, "spindle_drift", {"probe": {"r1": {"direction": "X"}}}, 3, {"reading_r1_um": shift}, {**still, **warm}
    )
    tried = [c.effect for c in library(read([m]))[0]]
    assert not [e for e in tried if e.effect == "mount_expansion" and e.component[1] in "ABC"]
    assert "mount_expansion(EX0spindle, T_head)" in first(diagnose(bare(of), [m]))


@pytest.mark.parametrize("seed", proof.few(range(6), 2))
def test_a_level_sees_the_first_part_of_its_own_chain(seed: int) -> None:
    """No link is named after a spindle, and the first one of the other chain is none that a level on the tool sees."""
    of = machine(["X", "wheel"], ["Z", "workhead"], {"wheel": [-250.0, 0.0, 0.0], "workhead": [0.0, 0.0, -300.0]})
    warm = temperatures(seed, "T_motor")
    still = {"x": np.full(RUNS * EACH, 100.0), "z": np.full(RUNS * EACH, 100.0)}
    setup = {"about": "A", "on": "tool", "vertical": "Y"}
    m = measured(of, "level", setup, seed, {"reading_urad": 2.2 * (warm["T_motor"] - 20.0)}, {**still, **warm})
    d = diagnose(bare(of), [m])
    assert "mount_expansion(EA0wheel, T_motor)" in first(d), d.sentence

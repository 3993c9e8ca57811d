"""Fine steps over a few signal periods or turns: far less than a hundredth of the travel, as the catalogue asks for.

Oracle: the wave and the backlash of which the readings were made.
"""

import numpy as np
import pytest

from rtec.diagnosis.compare.compare import compare
from rtec.machine import machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support.both import both
from tests.support.machines import axis

MACHINE = machine_from(
    {
        "machine": {"name": "stage", "tool_chain": ["probe"], "work_chain": ["X", "Y", "chuck"]},
        "axis": {
            "X": axis("X", travel_mm=[-30.0, 30.0], counts_per_mm=1_000_000),
            "Y": axis("Y", travel_mm=[0.0, 3000.0], pitch_mm=10.0),
        },
        "link": {"probe": {}, "chuck": {}},
        "temperature": {},
    },
    "stage",
)


def fine(
    along: str,
    step_mm: float,
    wave_um: float,
    period_mm: float,
    backlash_um: float,
    noise_um: float,
    spots_mm: tuple[float, ...] = (0.0,),
) -> Measurement:
    """Six runs there and back over sixty targets at unequal steps, at one place of the axis or shared among several."""
    rng = np.random.default_rng(7)
    each = 60 // len(spots_mm)
    places = np.concatenate([spot + np.cumsum(step_mm * rng.uniform(0.5, 1.5, each)) + 0.001 for spot in spots_mm])
    x = np.tile(np.concatenate([places, places[::-1]]), 6)
    way = np.tile(np.repeat([1.0, -1.0], 60), 6)
    run = np.repeat(np.arange(1, 7), 120)
    time_s = 2.0 * np.arange(len(run)) + 60.0 * run
    true = wave_um * np.sin(2.0 * np.pi * x / period_mm + 0.5) + 0.5 * backlash_um * way
    letter = along.lower()
    instrument = make_instrument("laser_linear", {}, along, f"E{along}{along}", MACHINE, "fine")
    return Measurement(
        name="fine", machine=MACHINE, instrument=instrument, run=run, time_s=time_s,
        channels={letter: x, f"d_{letter}": way}, readings={"reading_um": true + noise_um * rng.normal(size=len(run))},
    )  # fmt: skip


@pytest.mark.parametrize(
    ("along", "step_mm", "wave_um", "period_mm", "backlash_um", "noise_um", "name"),
    [
        ("X", 0.003, 0.05, 0.02, 0.0, 0.01, "interpolation_error(EXX, X)"),
        ("X", 0.003, 0.0, 0.02, 0.05, 0.01, "backlash(EXX, X)"),
        ("Y", 0.33, 3.0, 10.0, 0.0, 0.5, "cyclic_screw(EYY, Y)"),
    ],
)
def test_what_fine_steps_over_a_short_way_show_is_named(
    along: str, step_mm: float, wave_um: float, period_mm: float, backlash_um: float, noise_um: float, name: str
) -> None:
    m = fine(along, step_mm, wave_um, period_mm, backlash_um, noise_um)
    empty = Model(MACHINE, (), name="empty")
    found, done = both(empty, [m], draws=50)
    assert found.verdict in ("missing_effect", "ambiguous")
    assert found.findings[0].effect.label == name
    floor = compare(done.model, [m]).items[0]
    assert floor.left.rms < 1.1 * noise_um
    assert floor.floor == pytest.approx(noise_um, rel=0.1)


def test_a_wave_of_the_scale_is_named_from_fine_steps_at_three_places() -> None:
    # the places are no whole number of periods apart; all targets of one place lie within the pitch of the scale or two
    m = fine("X", 0.002, 0.2, 0.02, 0.0, 0.05, spots_mm=(-25.0, 0.0133, 21.0071))
    empty = Model(MACHINE, (), name="empty")
    found, done = both(empty, [m], draws=50)
    assert found.verdict in ("missing_effect", "ambiguous")
    assert "interpolation_error(EXX, X)" in [f.effect.label for f in found.findings if f.group]
    assert compare(done.model, [m]).items[0].left.rms < 1.1 * 0.05

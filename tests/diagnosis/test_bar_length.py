"""A ball bar that warms up in the hand. Oracle: what was added to the circles."""

from dataclasses import replace

import pytest

import rtec
from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.doubts.doubt import Doubt
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.report.diagnosis import diagnosis_page
from rtec.sim.campaign.truth import effect_from_text
from tests.support.both import both
from tests.support.setups import CONFIGS

MADE = (
    "scale,component=EXX,axis=X,k=12",
    "scale,component=EYY,axis=Y,k=-8",
    "squareness,component=EC0Y,alpha=25",
)
MILL = CONFIGS / "machines" / "vertical-mill.toml"


def circles(direction: str, longer_um: float, warmer_k: float) -> Measurement:
    """Four circles; a nut gets warmer from one to the next, and each is longer than the last one."""
    setup = {
        "plane": "XY",
        "centre_mm": [250.0, 200.0, 200.0],
        "radius_mm": 150.0,
        "feed_mm_min": 1000.0,
        "direction": direction,
    }
    settings = {"cycles": 4, "noise": {"white_um": 0.2, "drift_um": 0.1, "drift_tau_s": 300.0}}
    m = rtec.simulate(MILL, "ball_bar", setup=setup, effects=MADE, changes=settings, seed=5).measurement
    turn = (m.run - m.run.min()).astype(float)
    readings = {"reading_um": m.readings["reading_um"] + longer_um * turn}
    channels = {**m.channels, "T_x_nut": m.channels["T_x_nut"] + warmer_k * turn}
    return replace(m, name=direction, readings=readings, channels=channels)


def doubts(longer_um: float, warmer_k: float = 0.0) -> tuple[list[Doubt], Model, list[Measurement]]:
    files = [circles(direction, longer_um, warmer_k) for direction in ("ccw", "cw")]
    machine = files[0].machine
    model = Model(machine, tuple(effect_from_text(text, machine) for text in MADE), name="known")
    return [d for d in compare(model, files).doubts if d.fatal], model, files


def test_a_bar_that_warms_up_is_no_scale_of_the_machine() -> None:
    """Both scales had become 20 µm/m larger."""
    found, model, files = doubts(1.2)
    (doubt,) = found
    assert doubt.message.startswith("The circles differ in size by up to 3.")
    assert 'zero = "run"' in doubt.next_step
    d, result = both(model, files, draws=50)
    page = diagnosis_page(d)
    assert "rivals.png" not in [s.figure.name for s in page.sections if s.figure]  # no candidate has a bar in it
    assert (result.model.hash, result.reason) == (model.hash, "undecided")


@pytest.mark.parametrize(("longer_um", "warmer_k"), [(0.0, 0.0), (1.2, 0.8)])
def test_circles_that_are_as_large_or_follow_a_temperature_are_no_doubt(longer_um: float, warmer_k: float) -> None:
    assert not doubts(longer_um, warmer_k)[0]

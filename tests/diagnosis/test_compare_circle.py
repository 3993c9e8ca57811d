"""Ball bars in the report of a comparison or a diagnosis: drawn on their circle and over its angle."""

import numpy as np
import pytest

from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.compare.result import Comparison
from rtec.diagnosis.search.picture import of_effect
from rtec.estimation.noise import Noise, Whitener
from rtec.metrology.instruments.registry import make_instrument
from rtec.report.compare import compare_page
from rtec.report.compare_figures import angle_of, circle_picture
from rtec.report.diagnosis import on_its_circle
from rtec.sim.campaign.campaign import simulate
from rtec.sim.campaign.settings import Settings
from tests.diagnosis.test_compare import PNG, SCALE, model
from tests.support.diagnosis_examples import effects, laser, small_machine

COLD = {"noise": {"white_um": 0.2}, "phase": [{"name": "cold", "cycles": 1}]}


def compared(start_deg: float, arc_deg: float, sense: str) -> Comparison:
    """A circle and a laser, against a model that has the scale."""
    setup = {"plane": "XZ", "centre_mm": [100.0, 0.0, 100.0], "radius_mm": 50.0, "direction": sense,
             "feed_mm_min": 1000.0, "start_deg": start_deg, "arc_deg": arc_deg}  # fmt: skip
    bar = make_instrument("ball_bar", setup, None, None, small_machine(), "test")
    circle = simulate(model(SCALE), bar, Settings.model_validate(COLD), 3, "circle")
    return compare(model(SCALE), [circle, laser([SCALE], 4)])


def test_a_circle_is_drawn_as_one_and_a_laser_is_not() -> None:
    """Oracle: the instruments."""
    c = compared(0.0, 360.0, "ccw")
    figures = {s.figure.name: s.figure for s in compare_page(c).sections if s.figure}
    assert figures["circle-polar.png"].png.startswith(PNG)
    assert {"circle-position.png", "laser-x-4-position.png"} <= set(figures)
    assert "laser-x-4-polar.png" not in figures
    assert "angle on the circle" in figures["circle-position.png"].shows
    assert "angle" not in figures["laser-x-4-position.png"].shows
    readings = c.traces.readings
    bar, other = readings.series
    assert angle_of(readings, other) is None
    assert circle_picture(readings, other, "laser", np.zeros(len(other)), np.zeros(len(other))) is None
    found = angle_of(readings, bar)
    assert found is not None
    assert found[0] == "angle on the circle, degrees"


def test_a_finding_on_a_ball_bar_is_drawn_on_its_circle() -> None:
    """Oracle: the instruments; and the angles of the path."""
    readings = compared(0.0, 360.0, "cw").traces.readings
    noise = Noise(0.2, 1e-4, 100.0, 100.0)
    whitener = Whitener(readings, (noise,) * len(readings.series), (np.zeros(0),) * len(readings.series))
    effect = effects(SCALE)[0].effect
    shown = of_effect(readings, np.zeros((len(readings), 0)), whitener, "scale", effect, {})
    assert shown is not None
    pictures = {p.title.rpartition(", in ")[2]: p for p in (shown, *shown.others)}
    assert pictures["laser-x-4"].circle is None
    on = pictures["circle"].circle
    assert on is not None
    assert (on.letters, on.sense) == (("X", "Z"), -1)
    x = readings.states[0].channels["x"][readings.series[0].row]
    np.testing.assert_allclose(x, 100.0 + 50.0 * np.cos(on.angle_rad), atol=2e-3)
    section = on_its_circle(pictures["circle"], on)
    assert section.figure is not None
    assert (section.figure.name, section.figure.png[:4]) == ("polar-circle.png", PNG[:4])


@pytest.mark.parametrize(("start", "sense"), [(-20.0, "ccw"), (200.0, "cw"), (340.0, "ccw")])
def test_an_arc_is_not_torn_apart_at_zero(start: float, sense: str) -> None:
    """Oracle: 220° with the middle at 90°, whichever way round and however its angles count: from -20° to 200°."""
    readings = compared(start, 220.0, sense).traces.readings
    found = angle_of(readings, readings.series[0])
    assert found is not None
    _, angle, direction = found
    assert (angle.min(), angle.max()) == pytest.approx((-20.0, 200.0), abs=2.0)
    assert not direction.any()
    x = readings.states[0].channels["x"][readings.series[0].row]
    np.testing.assert_allclose(x, 100.0 + 50.0 * np.cos(np.deg2rad(angle)), atol=2e-3)

"""Which way axes lean, in words, in each plane: a tool moved by hand-written geometry, the bar's length exactly."""

from pathlib import Path

import numpy as np
import pytest

from rtec.machine import Machine, load_machine
from rtec.metrology.ball_bar.diagnosis import diagnose
from rtec.metrology.measurement import Measurement
from tests.support.ball_bar_examples import bar, recorded

MILL = Path(__file__).parents[2] / "configs/machines/vertical-mill.toml"
CENTRE = np.array([250.0, 200.0, 200.0])
LEANS_UM_PER_M = {"second": 25.0, "third_a": 15.0, "third_b": -9.0}
"""The first axis' line leans towards the second; both lines climb, or fall, along the third."""


def circle(m: Machine, plane: str, height: float, sense: str, seed: int) -> Measurement:
    a, b = ("XYZ".index(d) for d in plane)
    n = 3 - a - b
    radius = float(np.sqrt(100.0**2 - height**2))
    instrument = bar(m, plane=plane, centre_mm=CENTRE.tolist(), radius_mm=radius, height_mm=height, direction=sense)
    angle = np.arange(0.25, 360.0, 0.5) * (1.0 if sense == "ccw" else -1.0)
    p, q = radius * np.cos(np.deg2rad(angle)), radius * np.sin(np.deg2rad(angle))
    ends = np.zeros((len(angle), 3))
    ends[:, a] = p
    ends[:, b] = q + LEANS_UM_PER_M["second"] * 1e-6 * p
    ends[:, n] = -height + LEANS_UM_PER_M["third_a"] * 1e-6 * p + LEANS_UM_PER_M["third_b"] * 1e-6 * q
    reading = (np.linalg.norm(ends, axis=1) - 100.0) * 1e3 + 0.05 * np.random.default_rng(seed).standard_normal(len(p))
    return recorded(m, instrument, angle, reading, f"{plane} {height:g} {sense}")


@pytest.mark.parametrize("plane", ["XY", "YZ", "ZX", "XZ"])
def test_which_way_an_axis_leans(plane: str) -> None:
    """Oracle: the geometry above. The turn's sign follows the right hand, so it is minus in plane XZ."""
    m = load_machine(MILL)
    tests = [circle(m, plane, h, s, i) for i, (h, s) in enumerate(((0.0, "ccw"), (60.0, "cw"), (60.0, "ccw")))]
    fitted = diagnose(tests, "linear", dynamic=False).fitted
    a, b = plane[0], plane[1]
    n = next(d for d in "XYZ" if d not in plane)
    square = fitted.value("squareness")
    assert square.note == f"the angle between +{a} and +{b} is less than 90°"
    assert square.value == pytest.approx(-25.0 if plane == "XZ" else 25.0, abs=0.5)
    first, second = (fitted.value(f"perpendicularity_{x.lower()}") for x in (a, b))
    assert first.note == f"towards +{a} the line climbs in {n}"
    assert second.note == f"towards +{b} the line falls in {n}"
    assert (abs(first.value), abs(second.value)) == pytest.approx((15.0, 9.0), abs=0.5)

"""Which part of a recording is the measured arc: overshoot with and without its key, wrong arcs, gaps."""

from typing import Any

import numpy as np
import pytest

from rtec.errors import MeasurementError
from rtec.metrology.ball_bar.circle import circle_of
from rtec.metrology.ball_bar.iso230_4 import both_ways, roundness
from rtec.metrology.measurement import Measurement
from rtec.report.ball_bar_figures import shown_deg
from tests.support.ball_bar_examples import bar, gantry, recorded


def oval_um(angle_deg: np.ndarray[Any, Any], sense: int = 1) -> np.ndarray[Any, Any]:
    """An oval of 8 µm whose axis depends on the sense by a known step of 2 µm."""
    return np.asarray(4.0 * np.cos(2.0 * np.deg2rad(angle_deg)) + sense)


def made(low: float, high: float, start: float = 0.0, sense: int = 1, **setup: Any) -> Measurement:
    """From `low` to `high` along the path, degrees from `start`."""
    m = gantry()
    instrument = bar(m, radius_mm=100.0, direction="ccw" if sense > 0 else "cw", start_deg=start, **setup)
    angle = start + sense * np.arange(low, high + 0.25, 0.5)
    return recorded(m, instrument, angle, oval_um(angle, sense), f"test{sense}")


@pytest.mark.parametrize("overshoot", [0.0, 45.0, 180.0])
@pytest.mark.parametrize("begins", [-180.0, -45.0, 0.0])
def test_the_overshoot_need_not_be_named(begins: float, overshoot: float) -> None:
    """Oracle: the oval's 8 µm over the whole circle. Half of it alone was analysed where 180° were run before."""
    circle = circle_of(made(begins, 360.0 - begins, overshoot_deg=overshoot))
    assert len(circle) == 721
    assert circle.full
    # 0° and 360° are both read, and lean on the centre a little.
    assert roundness(circle).g_um == pytest.approx(8.0, abs=0.02)


def test_hysteresis_of_recordings_with_overshoot() -> None:
    """Oracle: the step of 2 µm between the senses."""
    pair = [circle_of(made(-180.0, 540.0, 360.0 if s < 0 else 0.0, s)) for s in (1, -1)]
    (both,) = both_ways(pair)
    assert both.h_um == pytest.approx(2.0, abs=1e-6)


@pytest.mark.parametrize(("sense", "ends"), [(1, "-20 to 200"), (-1, "200 to -20")])
def test_an_arc_that_was_not_run_is_told(sense: int, ends: str) -> None:
    """Oracle: 220° were run; with `arc_deg` left at 360 harmonics of a full turn would be made of them."""
    start = -20.0 if sense > 0 else 200.0
    with pytest.raises(MeasurementError, match=rf"only go from {ends}°; set start_deg and arc_deg \(220 or less\)"):
        circle_of(made(0.0, 220.0, start, sense))
    assert circle_of(made(0.0, 220.0, start, sense, arc_deg=220.0)).full is False


def test_a_gap_makes_no_full_circle_and_no_hysteresis() -> None:
    """Oracle: readings taken out by hand; across the gap the other sense has a spike that nothing was compared with."""
    whole, other = made(0.0, 360.0), made(0.0, 360.0, 360.0, -1)
    spike = np.where(np.abs(other.channels["angle_deg"] - 120.0) < 5.0, 50.0, 0.0)
    readings = {"reading_um": other.readings["reading_um"] + spike}
    other = Measurement("cw", other.instrument, other.machine, other.run, other.time_s, other.channels, readings)
    angle = whole.channels["angle_deg"]
    holes = np.where((angle > 100.0) & (angle < 140.0), np.nan, whole.readings["reading_um"])
    part = Measurement("part", whole.instrument, whole.machine, whole.run, whole.time_s, whole.channels,
                       {"reading_um": holes})  # fmt: skip
    circle = circle_of(part)
    assert circle.gaps == ((100.0, 140.0),)
    assert not circle.full
    (both,) = both_ways([circle, circle_of(other)])
    assert both.h_um == pytest.approx(2.0, abs=0.01)


def test_angles_are_shown_where_the_arc_lies() -> None:
    """Oracle: by hand: an arc from -20° to 200° is not shown from 340° on."""
    for low, high, shown in ((-20.0, 200.0, -20.0), (340.0, 560.0, -20.0), (0.0, 360.0, 0.0), (-360.0, 0.0, 0.0)):
        assert shown_deg(np.deg2rad(np.array([low, high])))[0] == pytest.approx(shown)

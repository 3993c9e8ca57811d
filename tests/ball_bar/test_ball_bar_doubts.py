"""Doubts about the readings themselves. Oracle: what was done to readings of an exact machine."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.metrology.ball_bar.diagnosis import diagnose
from rtec.metrology.measurement import Measurement
from rtec.report.ball_bar import ball_bar_page
from tests.support import proof
from tests.support.ball_bar_truth import THREE, TrueMachine, recordings

MACHINE = TrueMachine("tool", "XY", {"scale_a": 20.0, "lean": 15.0, "play_a": 3.0})


def changed(m: Measurement, by: NDArray[np.float64]) -> Measurement:
    """A measurement with something added to its readings, (n,) µm."""
    return replace(m, readings={k: v + by for k, v in m.readings.items()})


@pytest.mark.parametrize("seed", proof.few([1, 2, 3, 4, 5], 1))
@pytest.mark.parametrize("noise_um", [0.05, 0.5])
def test_readings_of_one_set_up_are_not_doubted(seed: int, noise_um: float) -> None:
    assert not diagnose(recordings(MACHINE, THREE, noise_um, seed)).doubts


@pytest.mark.parametrize("moved_um", [1.0, 6.0])
def test_a_ball_that_was_set_again_between_two_tests_is_doubted(moved_um: float) -> None:
    """The ball of the last test is elsewhere along X."""
    *same, last = recordings(MACHINE, THREE, 0.1)
    tests = [*same, changed(last, moved_um * np.cos(np.deg2rad(last.channels["angle_deg"])))]
    d = diagnose(tests)
    (doubt,) = d.doubts
    assert doubt.startswith("The tests do not have one centre")
    assert "--centre each" in doubt
    page = ball_bar_page(d, figures=False)
    assert page.brief is not None
    assert doubt in page.brief.text
    assert not diagnose(tests, centre="each").doubts


@pytest.mark.parametrize(("degrees", "off_um"), [((30.5,), 4.0), ((130.5, 300.5), -9.0)])
def test_readings_far_off_those_beside_are_doubted(degrees: tuple[float, ...], off_um: float) -> None:
    first, *others = recordings(MACHINE, THREE, 0.1)
    by = np.zeros(len(first))
    by[[int(v) for v in degrees]] = off_um
    d = diagnose([changed(first, by), *others])
    (doubt,) = d.doubts
    assert doubt.startswith(f"test1 has {len(degrees)} reading")
    size = float(doubt.split("the farthest by ")[1].split(" µm")[0])
    assert size == pytest.approx(abs(off_um), abs=0.4)

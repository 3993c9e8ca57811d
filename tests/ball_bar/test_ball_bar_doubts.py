"""Doubts about the readings themselves. Oracle: what was done to readings of an exact machine."""

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.metrology.ball_bar.diagnosis import diagnose
from rtec.metrology.measurement import Measurement
from rtec.report.ball_bar import ball_bar_page
from tests.support import proof
from tests.support.ball_bar_dynamic import wander
from tests.support.ball_bar_examples import recorded
from tests.support.ball_bar_truth import THREE, Bar, TrueMachine, recordings

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


def runs(machines: list[TrueMachine], bars: tuple[Bar, ...], noise_um: float, seed: int) -> list[Measurement]:
    """Each bar's test with a run on each of these machines; each run's centre drifts, and its noise has a slow part."""
    rng, out = np.random.default_rng(seed), []
    parts = [recordings(m, bars, noise_um, seed + i) for i, m in enumerate(machines)]
    for tests in zip(*parts, strict=True):
        angle = np.concatenate([t.channels["angle_deg"] for t in tests])
        place, count = np.repeat(np.arange(len(tests)), [len(t) for t in tests]), len(tests)
        centre = 2.0 * rng.standard_normal((count, 2))
        reading = np.concatenate([t.readings["reading_um"] for t in tests])
        reading += centre[place, 0] * np.cos(np.deg2rad(angle)) + centre[place, 1] * np.sin(np.deg2rad(angle))
        reading += np.concatenate([wander(rng, len(t), np.deg2rad(1.0), 0.3) for t in tests]) * 2.0 * noise_um
        out.append(recorded(tests[0].machine, tests[0].instrument, angle, reading, tests[0].name, run=place + 1))
    return out


def changing(what: str, sizes: tuple[float, ...]) -> str:
    """The doubt about tests with a run on each of some machines that differ in one number."""
    machines = [replace(MACHINE, size={**MACHINE.size, what: size}) for size in sizes]
    (doubt,) = diagnose(runs(machines, THREE[:2], 0.15, 3)).doubts
    assert "rtec diagnose" in doubt
    return doubt


def test_a_clearance_that_changes_from_run_to_run_is_doubted() -> None:
    doubt = changing("play_a", (1.5, 2.8, 4.5, 5.7, 6.9, 7.5))
    found = re.match(
        r"Clearance \(backlash\) X changes from run to run: (\S+) µm in run 1 .* and (\S+) µm in run [56] ", doubt
    )
    assert found
    assert [abs(float(v)) for v in found.groups()] == pytest.approx([1.5, 7.5], abs=0.8)


def test_a_scale_that_changes_from_run_to_run_is_either_axis() -> None:
    """A run whose radius is its own shows the difference of two scales."""
    doubt = changing("scale_b", (-30.0, -15.0, 0.0, 12.0, 25.0, 40.0))
    found = re.match(
        r"Position scale X or position scale Y changes from run to run, by (\S+) µm/m between run 1 ", doubt
    )
    assert found
    assert float(found[1]) == pytest.approx(70.0, abs=6.0)


@pytest.mark.parametrize("seed", proof.few([1, 2, 3, 4, 5, 6], 2))
@pytest.mark.parametrize("noise_um", [0.05, 0.5])
@pytest.mark.parametrize(
    "more", [{}, {"stick_a": 4.0, "stick_mm": 1.0}, {"wave_a": 2.0}, {"bend_a": 2.0, "roll": 20.0}]
)
def test_runs_of_one_machine_are_not_doubted(seed: int, noise_um: float, more: dict[str, float]) -> None:
    """Centres that drift, slow noise, and errors that the model does not have change no cause from run to run."""
    same = replace(MACHINE, size={**MACHINE.size, **more})
    assert not any("from run to run" in d for d in diagnose(runs([same] * 5, THREE[:2], noise_um, seed)).doubts)

"""Artefacts that are turned over. Oracle: readings made here of a slide, an artefact, and how the artefact lay.

An artefact that is turned over lies otherwise: it has another zero and another slope each time.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.characterise import characterise
from rtec.diagnosis.compare.compare import compare
from rtec.effects.effect_list import read_wanted
from rtec.errors import MeasurementError
from rtec.estimation.gls import held_out
from rtec.estimation.moved_zero import moved_zeros
from rtec.estimation.noise import find_noise
from rtec.estimation.readings import read
from rtec.machine import machine_from
from rtec.metrology.files.load import load_measurement, save_measurement
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.metrology.procedures.tables import straightness_of
from rtec.model import Model
from tests.support.machines import axis

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Make = Callable[[tuple[int, ...]], Measurement]
MACHINE = machine_from(
    {
        "machine": {"name": "square", "tool_chain": ["X", "tool"], "work_chain": ["Y", "table"]},
        "axis": {"X": axis("X", travel_mm=[0.0, 500.0]), "Y": axis("Y", travel_mm=[0.0, 400.0])},
        "temperature": {"T_bed": {}},
    },
    "square",
)
NOISE_UM = 0.2
TARGETS = np.linspace(13.0, 487.0, 19)
BLOCKS, ALTERNATE = (4, 5, 6), (2, 4, 6)


def slide(x: Floats) -> Floats:
    """A straightness of 3 µm, a Legendre polynomial of degree 2 over the travel of 0 to 500 mm."""
    return 3.0 * (1.5 * (x / 250.0 - 1.0) ** 2 - 0.5)


def edge(x: Floats) -> Floats:
    """A straightedge with a sag and a dent, µm, which no polynomial of low degree follows."""
    return -2.0 * np.sin(np.pi * x / 500.0) + 1.5 * np.exp(-(((x - 300.0) / 20.0) ** 2))


def lies(turned: NDArray[np.bool_], sigma: float, rng: np.random.Generator) -> Floats:
    """One normal value for each time that the artefact was laid, at its rows, (n,)."""
    laid = np.cumsum(turned != np.roll(turned, 1))
    return np.asarray((sigma * rng.standard_normal(laid.max() + 1))[laid])


def measured(
    name: str, along: str, setup: Mapping[str, Any], run: Ints, at: Floats, readings: dict[str, Floats]
) -> Measurement:
    instrument = make_instrument(name, setup, along, None, MACHINE, name)
    channels = {"x": at[0], "y": at[1], "T_bed": np.full(len(run), 20.0)}
    return Measurement(name, instrument, MACHINE, run, np.arange(0.0, 6.0 * len(run), 6.0), channels, readings)


def rows(m: Measurement, which: NDArray[np.bool_]) -> Measurement:
    """Some rows of a measurement."""
    channels, readings = ({k: v[which] for k, v in d.items()} for d in (m.channels, m.readings))
    return replace(m, run=m.run[which], time_s=m.time_s[which], channels=channels, readings=readings)


def straightedge(
    reversed_runs: tuple[int, ...], seed: int = 1, shift_mm: float = 0.0, jitter_mm: float = 0.0, more: str = "setup"
) -> Measurement:
    """Six runs there and back along X; the turned ones at targets moved by `shift_mm`, all within `jitter_mm`."""
    rng = np.random.default_rng(seed)
    run = np.repeat(np.arange(1, 7), 2 * len(TARGETS))
    turned = np.isin(run, reversed_runs)
    x = np.tile(np.r_[TARGETS, TARGETS[::-1]], 6) + shift_mm * turned + jitter_mm * rng.standard_normal(len(run))
    lie = lies(turned, 9.0, rng) + lies(turned, 40.0, rng) * x * 1e-3
    reading = slide(x) + np.where(turned, -1.0, 1.0) * edge(x) + lie + NOISE_UM * rng.standard_normal(len(x))
    setup = {"direction": "Y", "reversed_runs": reversed_runs, "zero": more}
    return measured("straightness", "X", setup, run, np.stack([x, np.full(len(x), 200.0)]), {"reading_um": reading})


def granite(
    reversed_runs: tuple[int, ...], seed: int = 1, squareness: float = 22.0, own: float = 12.0, scope: str = "setup"
) -> Measurement:
    """Six runs along both arms; the machine's EC0Y and the square's own error, both µrad, turn the arm along Y."""
    rng = np.random.default_rng(seed)
    along_x, along_y = np.linspace(10.0, 490.0, 9), np.linspace(10.0, 390.0, 9)
    one = np.concatenate([np.stack([along_x, np.full(9, 200.0)], 1), np.stack([np.full(9, 250.0), along_y], 1)])
    run, (x, y) = np.repeat(np.arange(1, 7), 18), np.tile(one, (6, 1)).T
    turned = np.isin(run, reversed_runs)
    on_x = np.tile(np.arange(18) < 9, 6)
    lie = lies(turned, 40.0, rng)
    # A turn φ of an arm moves it by φ × (along): along Y by -φ y in x; the reading is that of the tool minus the arm.
    arm_y = (-squareness + lie + np.where(turned, -1.0, 1.0) * own) * (y - 200.0) * 1e-3
    arm_x = -lie * (x - 250.0) * 1e-3
    noise = NOISE_UM * rng.standard_normal((2, len(run)))
    x_um = np.where(on_x, np.nan, arm_y + lies(turned, 9.0, rng) + noise[0])
    y_um = np.where(on_x, arm_x + lies(turned, 9.0, rng) + noise[1], np.nan)
    setup = {"reference_axis": "X", "reversed_runs": reversed_runs, "zero": scope}
    return measured("squareness", "Y", setup, run, np.stack([x, y]), {"reading_x_um": x_um, "reading_y_um": y_um})


@pytest.mark.parametrize("reversed_runs", [BLOCKS, ALTERNATE], ids=["once", "five times"])
@pytest.mark.parametrize("scope", ["setup", "run"])
@pytest.mark.parametrize("own", [12.0, -30.0])
def test_a_square_that_is_turned_over_lies_otherwise(reversed_runs: tuple[int, ...], scope: str, own: float) -> None:
    """Oracle: the squareness that the readings were made with. With the lie l of each position both arms together show
    s + e, and s - e after it was turned over: their mean is s, whatever the lies."""
    m = granite(reversed_runs, own=own, scope=scope)
    found = characterise([m], wanted=read_wanted("squareness:EC0Y", MACHINE))
    (one,) = found.coefficients
    assert one.se is not None
    assert 0.0 < one.se < 1.0
    assert one.value == pytest.approx(22.0, abs=3.0 * max(one.se, 0.2))
    assert not [w for w in found.warnings if w.code == "left_over"]


@pytest.mark.parametrize("reversed_runs", [BLOCKS, ALTERNATE], ids=["once", "five times"])
def test_the_form_of_a_straightedge_needs_no_key(reversed_runs: tuple[int, ...]) -> None:
    """Oracle: the slide's straightness that the readings were made with, and their noise."""
    m = straightedge(reversed_runs)
    found = characterise([m], wanted=read_wanted("straightness:EYX", MACHINE))
    values = {c.name: c.value for c in found.coefficients}
    assert values["c2"] == pytest.approx(3.0, abs=0.1)
    assert all(abs(v) < 0.15 for k, v in values.items() if k != "c2")
    assert not [w for w in found.warnings if w.code == "left_over"]


@pytest.mark.parametrize(("shift_mm", "jitter_mm"), [(0.0, 0.3), (13.0, 0.0), (13.0, 0.3)])
def test_the_form_is_found_between_targets_that_were_read_one_way_up(shift_mm: float, jitter_mm: float) -> None:
    """Oracle: as above. A form with a value of its own at each target would take the slide with it. A line over 26 mm
    leaves at most h²/8 times the curvature of the dent, 3 µm / (20 mm)²: 0.63 µm, over 80 of the 474 mm."""
    m = straightedge(BLOCKS, shift_mm=shift_mm, jitter_mm=jitter_mm)
    found = characterise([m], wanted=read_wanted("straightness:EYX", MACHINE))
    values = {c.name: c.value for c in found.coefficients}
    assert values["c2"] == pytest.approx(3.0, abs=0.2)


def test_a_form_that_was_read_one_way_up_is_not_estimated() -> None:
    """Oracle: reversal needs both; with one of them nothing tells the form from the slide's."""
    m = straightedge(BLOCKS)
    for which in ((1, 2, 3), (4, 5, 6)):
        part = rows(m, np.isin(m.run, which))
        assert [n.name for n in m.instrument.nuisance(part.state(), part.run)] == ["zero", "slope"]


@pytest.mark.parametrize("make", [straightedge, granite])
@pytest.mark.parametrize("reversed_runs", [BLOCKS, ALTERNATE, (3, 4)], ids=["once", "five times", "and back"])
def test_a_turned_artefact_is_no_zero_that_moved(make: Make, reversed_runs: tuple[int, ...]) -> None:
    """Oracle: nothing but the artefact was touched."""
    m = make(reversed_runs)
    assert not moved_zeros(read([m]))
    assert not compare(Model(MACHINE, (), name="none"), [m]).doubts


@pytest.mark.parametrize("make", [straightedge, granite])
def test_a_lie_that_only_one_fold_has_is_fitted_to_it(make: Make) -> None:
    """Oracle: the noise of the readings; a lie is no prediction that the other runs could make."""
    readings = read([make(ALTERNATE)])
    arm = readings.channel("y") - 200.0 if make is granite else slide(readings.channel("x"))
    columns = np.column_stack([arm * (readings.series_of == 0), readings.setup])
    assert held_out(find_noise(readings, columns), columns).rms < 1.5 * NOISE_UM


def test_a_run_there_and_back_is_one_pass() -> None:
    """Oracle: slide and edge at the targets. A reversal error of 2 µm between the ways is not in their mean."""
    m = straightedge(BLOCKS)
    way = np.tile(np.repeat([1.0, -1.0], len(TARGETS)), 6)
    x, turned = m.channels["x"], np.isin(m.run, BLOCKS)
    reading = slide(x) + np.where(turned, -1.0, 1.0) * edge(x) + way + np.where(turned, 7.0 + 0.02 * x, 1.0)
    found = straightness_of(replace(m, readings={"reading_um": reading}, channels={**m.channels, "d_x": way}))
    assert found.repeats == 3
    line = np.polyval(np.polyfit(TARGETS, slide(TARGETS), 1), TARGETS)
    np.testing.assert_allclose(found.straightness_um, slide(TARGETS) - line, atol=1e-9)
    assert found.point_se_um == pytest.approx(0.0, abs=1e-9)
    assert not any("one side" in w for w in found.words)


def test_a_place_that_was_read_from_one_side_is_told() -> None:
    """Oracle: the way back begins before the last target, so half the reversal error stays in there."""
    m = straightedge(BLOCKS)
    way = np.tile(np.repeat([1.0, -1.0], len(TARGETS)), 6)
    m = replace(m, channels={**m.channels, "d_x": way})
    part = rows(m, (way > 0) | (m.channels["x"] < TARGETS[-1]))
    assert any("487 mm" in w and "one side" in w for w in straightness_of(part).words)
    with pytest.raises(MeasurementError, match="13 mm is missing"):
        straightness_of(rows(m, (m.run != 2) | (m.channels["x"] > TARGETS[0])))


@pytest.mark.parametrize(("reversed_runs", "said"), [((7,), "none"), (tuple(range(1, 7)), "all"), (BLOCKS, "")])
def test_reversed_runs_that_do_not_reverse_are_noted(tmp_path: Path, reversed_runs: tuple[int, ...], said: str) -> None:
    """Oracle: the runs of the file are 1 to 6."""
    notes = load_measurement(save_measurement(straightedge(reversed_runs), tmp_path / "edge.csv"), MACHINE).notes
    assert [n for n in notes if "reversed_runs" in n] == (
        [f"reversed_runs names {said} of the runs: the artefact's own error is not told from the machine's"]
        * bool(said)
    )

"""What the report of a comparison shows: the stack of effects, several instruments at once, units kept apart."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.compare.result import Size
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.report.compare import compare_page
from rtec.report.compare_figures import COLOURS, OTHERS, colours, stack_along
from rtec.report.page import write_page
from rtec.sim.campaign.campaign import simulate
from rtec.sim.campaign.settings import Settings
from tests.diagnosis.test_compare import SCALE, model
from tests.support.diagnosis_examples import NOISE_UM, QUICK, effects, laser, small_machine

TILT = "scale,component=EBX,axis=X,k=30"


def angular(seed: int) -> Measurement:
    """Tilts of the X axis, µrad."""
    instrument = make_instrument("laser_angular", {}, "X", "EBX", small_machine(), "test")
    return simulate(model(TILT), instrument, Settings.model_validate(QUICK), seed, "tilt")


def tool_tip(seed: int) -> Measurement:
    """The tool tip against the work piece, three columns."""
    instrument = make_instrument("tool_tip", {}, None, None, small_machine(), "test")
    return simulate(model(SCALE), instrument, Settings.model_validate(QUICK), seed, "tip")


def test_stack_holds_the_means_of_each_stretch() -> None:
    """Oracle: means by hand; ten stretches of 20 mm, six readings each; one effect has the sign of the direction."""
    x = np.repeat(np.arange(5.0, 200.0, 10.0), 6)
    direction = np.tile([1.0, -1.0], len(x) // 2)
    parts = {"scale": 0.01 * x, "play": 1.5 * direction}
    stack = stack_along(("X, mm", x), direction, parts, parts["scale"] + parts["play"] + 0.2)
    assert stack is not None
    assert stack.ways
    middles = np.arange(10.0, 200.0, 20.0)
    np.testing.assert_allclose(stack.place, np.sort(np.concatenate([middles - 4.5, middles + 4.5])))
    np.testing.assert_allclose(stack.parts["scale"], np.repeat(0.01 * middles, 2))
    np.testing.assert_allclose(stack.parts["play"], np.tile([-1.5, 1.5], 10))
    np.testing.assert_allclose(stack.measured, stack.parts["scale"] + stack.parts["play"] + 0.2, atol=1e-12)


def test_stack_leaves_out_stretches_of_few_readings() -> None:
    """Oracle: two readings in the last of the stretches, nothing said of a channel that stands still."""
    value = np.concatenate([np.full(5, 1.0), np.full(2, 9.5)])
    stack = stack_along(("T, °C", value), None, {"a": value}, value)
    assert stack is not None
    np.testing.assert_allclose(stack.parts["a"], [1.0])
    assert stack_along(("T, °C", np.ones(9)), None, {"a": np.ones(9)}, np.ones(9)) is None


def test_each_effect_has_a_colour() -> None:
    """Oracle: those of the figures, then grey."""
    assert list(colours(2)) == list(COLOURS[:2])
    assert list(colours(len(COLOURS) + 2))[-2:] == [OTHERS, OTHERS]


def test_angles_and_lengths_are_kept_apart() -> None:
    """Oracle: a scale of 30 µrad/m over the positions; sizes told in the unit of each instrument."""
    m = angular(41)
    c = compare(model(TILT), [laser([], 41), m])
    by_name = {i.name: i for i in c.items}
    assert (by_name["tilt"].unit, by_name["laser-x-41"].unit) == ("urad", "um")
    assert by_name["tilt"].sees == ("EBX",)
    assert by_name["tilt"].predicted.rms == pytest.approx(0.03 * float(np.std(m.channels["x"])), rel=0.01)
    table = compare_page(c, figures=False).sections[0].table
    assert table is not None
    assert {row[0]: row[-1] for row in table.rows} == {"tilt": "µrad", "laser-x-41": "µm"}


def test_columns_of_one_instrument_are_told_apart() -> None:
    """Oracle: the scale of X is in the x column alone; the others are noise, with nothing to explain."""
    c = compare(model(SCALE), [tool_tip(42)])
    by_column = {i.column: i for i in c.items}
    assert by_column["reading_x_um"].predicted.rms > 1.0
    for column in ("reading_y_um", "reading_z_um"):
        assert by_column[column].predicted.rms == pytest.approx(0.0, abs=1e-9)
        assert by_column[column].explained is None
        assert by_column[column].left.rms == pytest.approx(NOISE_UM, rel=0.15)
    shown = {s.figure.name for s in compare_page(c).sections if s.figure}
    assert {"tip-reading_x_um-position.png", "tip-reading_y_um-position.png"} <= shown
    # No effect of the model shows in y.
    assert "tip-reading_y_um-effects.png" not in shown


@pytest.mark.filterwarnings("error")
def test_each_measurement_has_pictures_of_its_own(tmp_path: Path) -> None:
    """Names that differ only in a sign, in a letter's size or in signs that no font has. Oracle: the titles drawn."""
    names = ["laser X+", "laser X-", "LASER x-", "Messung Süd", "测量一", "测量二", "a/b", "a b"]
    page = compare_page(compare(model(SCALE), [replace(laser([SCALE], 40 + i), name=n) for i, n in enumerate(names)]))
    places = {s.heading: s.figure.name for s in page.sections if s.figure and "predicted" in s.heading}
    assert len({name.lower() for name in places.values()}) == len(places) == len(names)
    assert places["laser X+: measured and predicted"] == "laser-X+-position.png"
    assert places["Messung Süd: measured and predicted"] == "Messung-Süd-position.png"
    write_page(page, {}, tmp_path)
    assert {p.name for p in tmp_path.glob("*.png")} == {s.figure.name for s in page.sections if s.figure}


def test_effects_of_one_kind_have_labels_of_their_own() -> None:
    """Oracle: the same effect twice is two parts, and both count."""
    c = compare(model(SCALE, SCALE), [laser([SCALE], 43)])
    assert [p.label for p in c.items[0].parts] == ["scale(EXX, X) #1", "scale(EXX, X) #2"]
    assert effects(SCALE)[0].label == "scale(EXX, X)"


def test_a_residual_of_many_shapes_is_not_called_noise() -> None:
    """Oracle: forty times the noise, no place and no line; drift is not what it is either."""
    c = compare(model(SCALE), [laser([SCALE], 3)])
    (i,) = c.items
    many = replace(
        i, left=Size(40.0 * i.floor, 90.0 * i.floor), worst=(), shape=None, noise=replace(i.noise, drift=0.0)
    )
    said = str(compare_page(replace(c, items=(many,))).lead)
    assert "No place stands out from noise" not in said
    assert "yet it is no noise: it follows the recorded channels" in said

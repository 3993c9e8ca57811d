"""A folder that may be read and not written, with a model of temperature and speed. Oracles: its files; the model."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import rtec
from rtec.effects import effect_class
from rtec.model import FittedEffect, Model, save_model
from rtec.model.volume import cylinder
from rtec.wording import number
from tests.studio.studio_rig import MACHINE, RunningStudio, Watched, needs_browser, running_studio, simulated, tab

if TYPE_CHECKING:
    from playwright.sync_api import Browser, FilePayload

pytestmark = [needs_browser, pytest.mark.xdist_group("others")]

MAY_NOT = ("setpriv", "--bounding-set=-dac_override,-dac_read_search", "--inh-caps=-dac_override,-dac_read_search")
"""Root may write everything; without these rights it is a user like others."""


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningStudio]:
    """Of the folder; its process may not write there."""
    before = MAY_NOT if os.geteuid() == 0 else ()
    if before and shutil.which(before[0]) is None:
        pytest.skip("root may write everywhere, and setpriv, which takes that right away, is not here")
    folder = tmp_path_factory.mktemp("read-only")
    shutil.copy(MACHINE, folder)
    simulated(folder, "laser", 1)
    given = {"component": "EXX", "expression": "A*T_x_nut + C*spindle_rpm/1000", "linear": {"A": "um/K", "C": "um"}}
    effect = effect_class("expression", "test").model_validate({"effect": "expression", **given})
    model = Model(rtec.load_machine(folder / MACHINE.name), (FittedEffect(effect, {"A": 5.0, "C": 4.0}),))
    save_model(model, folder / "model.toml")
    folder.chmod(0o555)
    with running_studio(folder, before=before) as made:
        yield made
    folder.chmod(0o755)


@pytest.fixture(scope="module")
def watched(browser: "Browser", studio: RunningStudio) -> Watched:
    """A tab with the measurement chosen."""
    made = tab(browser, studio.address)
    made.page.get_by_label("use laser.csv").click()
    made.page.locator("header", has_text="1 measurement").wait_for()
    return made


def test_what_cannot_be_written_is_said_in_a_sentence_and_nothing_is_lost(
    watched: Watched, studio: RunningStudio
) -> None:
    """A dropped file, then a model whose effect was added here: it stays in the tab. Oracle: the folder."""
    page, names = watched.page, sorted(p.name for p in studio.folder.iterdir())
    dropped: FilePayload = {"name": "new.csv", "mimeType": "text/csv", "buffer": b"a;b\n1;2\n"}
    page.locator("input[type=file]").set_input_files(dropped)
    page.get_by_text("new.csv: cannot be written: Permission denied").wait_for()
    page.get_by_role("link", name="Add and watch").click()
    page.get_by_text("An effect of your own").click()
    page.get_by_label("Expression, µm or µrad").fill("B*d_x")
    page.get_by_role("button", name="Add this effect").click()
    page.get_by_label("File for the model").fill("mine.toml")
    page.get_by_role("button", name="Save", exact=True).click()
    page.get_by_text("mine.toml: cannot be written: Permission denied").wait_for()
    assert page.get_by_label("File for the model").input_value() == "mine.toml"
    page.get_by_role("button", name="Undo").wait_for()
    assert page.get_by_role("button", name="Undo").is_enabled()
    assert sorted(p.name for p in studio.folder.iterdir()) == names
    studio.folder.chmod(0o755)  # as somebody would who reads the sentence
    page.get_by_role("button", name="Save", exact=True).click()
    page.get_by_text("Saved as mine.toml.").wait_for()
    studio.folder.chmod(0o555)
    assert len(rtec.load_model(studio.folder / "mine.toml", studio.folder / MACHINE.name).effects) == 2
    page.get_by_role("button", name="Undo").click()


def test_temperature_and_spindle_speed_move_the_tip_and_the_part(watched: Watched, studio: RunningStudio) -> None:
    """By keys on the sliders. Oracle: the model in the file, at the numbers that they say."""
    page = watched.page
    page.get_by_role("link", name="Explore").click()
    headline = page.get_by_text("Here the tool tip is off by")
    headline.wait_for()
    model = rtec.load_model(Path(studio.folder / "model.toml"), studio.folder / MACHINE.name)
    state = {a.name: 0.5 * sum(a.travel_mm) for a in model.machine.axes} | {"T_x_nut": 20.0, "spindle_rpm": 0.0}
    said = set()
    for key, name in (("T_x_nut", "T_x_nut, °C"), ("spindle_rpm", "spindle speed, rpm")):
        slider = page.get_by_role("slider", name=name, exact=True)
        slider.locator("[tabindex='0']").focus()
        field = page.get_by_label(f"{name}, number").element_handle()
        for _ in range(2):  # one key at a time, until the server has it
            before = slider.get_attribute("aria-valuenow")
            shown = field.input_value()
            page.keyboard.press("PageUp")
            page.wait_for_function("([e, v]) => e.value !== v", arg=[field, shown])
            assert slider.get_attribute("aria-valuenow") != before
        state[key] = float(str(slider.get_attribute("aria-valuenow")))
        error = model.predict(state)
        part = cylinder(model, state)
        page.get_by_text(f"off by X {number(float(error[0]), 2, sign=True)},").wait_for()
        page.get_by_text(f"A turned cylinder of 200 mm would measure {200.0 + 1e-3 * part.larger_um:.4f} mm").wait_for()
        said.add(f"{part.larger_um:.1f}")
    assert len(said) == 2

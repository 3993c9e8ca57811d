"""What happens to everybody one day: Back while work goes on, a file that another program changes, an odd file name.

Oracles: the address bar, the public API of rtec on the files as they are, the command line.
"""

import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import rtec
from rtec.cli.main import status
from tests.studio.studio_rig import MACHINE, RunningStudio, foreign, needs_browser, running_studio, simulated, tab

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = [needs_browser, pytest.mark.xdist_group("others")]

DASH = "-o.csv"


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningStudio]:
    """A machine, two lasers, a model, and a table of another program whose name begins with a dash."""
    folder = tmp_path_factory.mktemp("unlucky")
    shutil.copy(MACHINE, folder)
    first = simulated(folder, "laser-a", 1)
    simulated(folder, "laser-b", 2)
    foreign(folder, "messung", 3).rename(folder / DASH)
    fitted = ["fit", str(folder / MACHINE.name), str(first), "--effects", "scale", "-o", str(folder / "model.toml")]
    assert status(fitted) == 0
    with running_studio(folder) as made:
        yield made


@pytest.fixture(scope="module")
def page(browser: "Browser", studio: RunningStudio) -> "Page":
    """A tab with one laser compared."""
    made = tab(browser, studio.address, 1280, 800).page
    made.get_by_label("use laser-b.csv").click()
    made.locator("header", has_text="1 measurement").wait_for()
    made.get_by_role("link", name="Compare").click()
    made.get_by_role("button", name="Diagnose: which effect is missing?").wait_for()
    return made


def _is(page: "Page", name: str, title: str) -> None:
    page.locator("h1", has_text=title).wait_for()
    page.wait_for_url(f"**/{name}")


def test_back_and_forward_show_the_page_of_the_address(page: "Page") -> None:
    """Also while a diagnosis runs, which goes on."""
    page.get_by_role("link", name="Diagnose").click()
    page.get_by_role("button", name="Find the missing effect").click()
    page.get_by_role("button", name="Cancel").wait_for()
    page.go_back()
    _is(page, "compare", "Compare")
    page.go_back()
    _is(page, "", "Measurements")
    page.go_forward()
    _is(page, "compare", "Compare")
    page.go_forward()
    _is(page, "diagnose", "Diagnose")
    page.get_by_role("button", name="Test again").wait_for()


def test_a_click_on_a_card_shows_its_curve_and_nothing_else_moves(page: "Page") -> None:
    """Oracles: the heading of the curve; where the window is scrolled to."""
    card = page.locator(".card.pick").nth(1)
    label = card.locator("p").first.inner_text().partition(":")[0]
    assert page.locator(".stick h2", has_text=label).count() == 0
    card.scroll_into_view_if_needed()
    before = page.evaluate("window.scrollY")
    card.locator("h2").click()
    page.locator(".stick h2", has_text=label).first.wait_for()
    page.locator(".stick .chart[data-drawn=yes]").first.wait_for()
    assert page.locator(".card.chosen h2").inner_text().startswith("2. ")
    assert page.evaluate("window.scrollY") == before


def test_a_file_that_changed_is_read_again(page: "Page", studio: RunningStudio) -> None:
    """Oracle: `rtec.compare` and the rows of the file as it is now."""
    table = studio.folder / "laser-b.csv"
    lines = table.read_text(encoding="utf-8").splitlines()
    table.write_text("\n".join(lines[: 1 + (len(lines) - 1) * 2 // 3]) + "\n", encoding="utf-8")
    page.get_by_role("link", name="Measurements").click()
    page.locator("tr", has_text="laser-b.csv").get_by_role("cell", name="108", exact=True).wait_for()
    page.get_by_role("link", name="Compare").click()
    model = rtec.load_model(studio.folder / "model.toml", studio.folder / MACHINE.name)
    page.get_by_text(rtec.compare(model, [table]).page(figures=False).lead).wait_for()


def test_an_addition_survives_a_change_of_its_file_until_one_begins_again(page: "Page", studio: RunningStudio) -> None:
    """Oracles: the sentence of the addition; the offer to bring it back."""
    page.get_by_role("link", name="Add and watch").click()
    page.get_by_text("An effect of your own").click()
    page.get_by_label("Expression, µm or µrad").fill("B*d_x")
    page.get_by_role("button", name="Add this effect").click()
    page.get_by_text("Save the model").wait_for()
    lead = page.locator(".lead").first.inner_text()
    table = studio.folder / "laser-b.csv"
    lines = table.read_text(encoding="utf-8").splitlines()
    table.write_text("\n".join(lines[:-18]) + "\n", encoding="utf-8")
    page.get_by_role("link", name="Compare").click()
    page.get_by_text("laser-b.csv was changed by another program").wait_for()
    page.get_by_role("link", name="Add and watch").click()
    _is(page, "add", "Add and watch")
    page.get_by_text("laser-b.csv was changed by another program").wait_for()
    assert page.locator(".lead").first.inner_text() == lead
    page.get_by_role("button", name="Begin again with the changed files").click()
    page.get_by_role("button", name="Save", exact=True).wait_for(state="detached")
    page.get_by_role("link", name="Measurements").click()
    page.get_by_text("Not saved, and put aside").wait_for()


def test_the_command_for_a_name_with_a_dash_is_one(page: "Page", studio: RunningStudio, tmp_path: Path) -> None:
    """Oracle: the command line, in another folder with the same files: what it writes is what the page wrote."""
    page.get_by_label(f"Import {DASH}").click()
    page.get_by_text("What it becomes").wait_for()
    name = page.get_by_label("Name of the measurement").input_value()
    assert name == "o-imported"
    shown = page.locator(".command").last.inner_text()
    page.get_by_role("button", name="Import", exact=True).click()
    page.get_by_label(f"use {name}.csv").wait_for()
    for file in (DASH, MACHINE.name):
        shutil.copy(studio.folder / file, tmp_path)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path)
        assert status(shlex.split(shown)[1:]) == 0
    assert (tmp_path / f"{name}.csv").read_bytes() == (studio.folder / f"{name}.csv").read_bytes()

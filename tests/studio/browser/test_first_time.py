"""What stumbles whoever does it the first time: no machine yet, a wrong answer, another measurement, a long page.

Oracles: the files in the folder, the boxes that the browser lays out, what the page showed before.
"""

import filecmp
import re
import resource
import shutil
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.studio.studio_rig import RunningStudio, foreign, needs_browser, running_studio, tab

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

pytestmark = [needs_browser, pytest.mark.xdist_group("others")]

TURNING = Path(__file__).parents[3] / "configs" / "machines" / "turning-centre.toml"
MB = 1 << 20
WARM_MS = 5_000
BEAM = "Where does the laser_linear read, as X, Y and Z from the tool tip (beam_offset_mm)?"


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningStudio]:
    """Of a folder with nothing but a machine in a folder below, as `rtec init lathe` leaves it."""
    folder = tmp_path_factory.mktemp("first")
    (folder / "lathe").mkdir()
    shutil.copy(TURNING, folder / "lathe" / "machine.toml")
    with running_studio(folder) as made:
        yield made


@pytest.fixture(scope="module")
def page(browser: "Browser", studio: RunningStudio, tmp_path_factory: pytest.TempPathFactory) -> "Page":
    """A table of another program is dropped and opened before there is a machine, which is chosen then."""
    made = tab(browser, studio.address, 1280, 700).page
    table = foreign(tmp_path_factory.mktemp("usb"), "messung", 1, "--set", "beam_offset_mm=[0,0,150]")
    made.locator("input[type=file]").set_input_files(table)
    made.get_by_role("button", name="Import messung.csv").click()
    made.get_by_text("Choose the machine on the page Measurements first").wait_for()
    made.get_by_role("link", name="Measurements").click()
    made.get_by_label("Machine to copy").click()
    made.get_by_role("option", name="lathe/machine.toml, one folder below").click()
    made.get_by_label("Machine file").wait_for()
    return made


def test_a_table_that_was_opened_without_a_machine_is_read_with_it(page: "Page") -> None:
    """Oracle: the picture of what it becomes, which there is only with a machine."""
    page.get_by_role("button", name="Import messung.csv").click()
    page.get_by_text("What it becomes: 162 readings").wait_for()
    assert page.get_by_text("Choose the machine").count() == 0


def test_a_wrong_answer_stays_in_its_field_with_the_reason_below(page: "Page") -> None:
    """Oracle: what was typed; the boxes of the reason and of the words below it."""
    _answer(page, "0,0,150")
    reason = page.get_by_text("is no number, list or word")
    reason.wait_for()
    assert page.get_by_label(BEAM).input_value() == "0,0,150"
    assert reason.inner_text().startswith("messung.csv: ")  # as on a command line in the folder
    below = page.get_by_text("for example 0; 0; 150")
    assert _box(reason)[1] <= _box(below)[0]


def test_three_numbers_are_typed_as_people_write_them(page: "Page", studio: RunningStudio) -> None:
    """Oracle: the measurement in the folder; the list names the table that it is from."""
    _answer(page, "0; 0; 150,5")
    page.get_by_text("Answered: setup.beam_offset_mm: [0, 0, 150.5]").wait_for()
    page.get_by_label("Name of the measurement").fill("laser")
    page.get_by_role("button", name="Import", exact=True).click()
    page.get_by_text("imported as laser.csv").wait_for()
    head = tomllib.loads((studio.folder / "laser.toml").read_text(encoding="utf-8"))
    assert head["setup"]["beam_offset_mm"] == [0, 0, 150.5]
    page.locator("summary", has_text="remarks").click()
    page.get_by_text("imported from messung.csv").wait_for()


def test_what_was_added_and_not_saved_outlives_another_choice(page: "Page") -> None:
    """A measurement is taken out of use and back. Oracle: the sentence with the error before and after."""
    page.get_by_label("Effects (empty: chosen on held-out runs)").fill("scale")
    page.get_by_role("button", name="Fit", exact=True).click()
    page.locator("header", has_text="model.toml · 1 measurement").wait_for()
    page.get_by_role("link", name="Add and watch").click()
    page.get_by_text("An effect of your own").click()
    page.get_by_label("Expression, µm or µrad").fill("B*d_x")
    page.get_by_role("button", name="Add this effect").click()
    page.get_by_text("Save the model").wait_for()
    lead = page.locator(".lead").first.inner_text()
    assert lead.startswith("With ")
    page.get_by_role("link", name="Measurements").click()
    page.get_by_label("use laser.csv").click()
    page.get_by_text("Not saved, and put aside").wait_for()
    page.locator("header", has_text="0 measurements").wait_for()
    page.get_by_role("button", name="Bring it back").click()
    page.locator("header", has_text="1 measurement").wait_for()
    assert page.get_by_text("Not saved, and put aside").count() == 0
    page.get_by_role("link", name="Add and watch").click()
    page.get_by_text("Save the model").wait_for()
    assert page.locator(".lead").first.inner_text() == lead


def test_progress_and_pages_stay_in_sight_on_a_long_page(page: "Page") -> None:
    """Whoever presses a button at its end sees that work begins. Oracle: the window, and the boxes."""
    page.evaluate("window.scrollTo(0, document.documentElement.scrollHeight)")
    assert page.evaluate("window.scrollY") > 200
    for part in (page.get_by_text("Ready."), page.get_by_role("link", name="Report")):
        top, bottom = _box(part)
        assert 0.0 <= top < bottom <= 700.0


def _answer(page: "Page", text: str) -> None:
    field = page.get_by_label(BEAM)
    field.fill(text)
    field.press("Enter")


def _box(shown: "Locator") -> tuple[float, float]:
    """Where it begins and ends in the window, from above, in px."""
    box = shown.bounding_box()
    assert box is not None
    return box["y"], box["y"] + box["height"]


def test_a_large_dropped_file_needs_no_memory_of_its_size(
    browser: "Browser", tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """The server may take 48 MB more than it has, and a file of 144 MB is dropped. Oracles: that limit; its bytes."""
    table = tmp_path_factory.mktemp("large") / "large.csv"
    line = b"12:34:56.789;100,0000;0,0012;21,50;22,75\n"
    with table.open("wb") as out:
        out.write(b"Zeit;X-Position [mm];Abweichung [mm];Temperatur 1;Temperatur 2\n")
        for _ in range(144):
            out.write(line * (MB // len(line)))
    with running_studio(tmp_path) as studio:
        made = tab(browser, studio.address).page
        made.get_by_role("link", name="Report").click()
        made.locator("h1", has_text="Report").wait_for()
        made.wait_for_timeout(WARM_MS)  # what other pages need is loaded before the limit
        made.get_by_role("link", name="Measurements").click()
        held = int(re.findall(r"VmData:\s+(\d+)", Path(f"/proc/{studio.process.pid}/status").read_text())[0]) << 10
        resource.prlimit(studio.process.pid, resource.RLIMIT_DATA, (held + 48 * MB,) * 2)
        made.locator("input[type=file]").set_input_files(table)
        made.get_by_role("button", name="Import large.csv").wait_for()
        made.context.close()
    assert filecmp.cmp(table, tmp_path / "large.csv", shallow=False)

"""The whole story in a browser: measurements, a first model, where it fails, what is missing, the error falling.

Oracles: the command line's own files, byte for byte; the hidden effect that the simulation was given; the browser's log
of its requests.
"""

import re
import shutil
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import pytest

from rtec.cli.main import status
from tests.studio.studio_rig import (
    MACHINE,
    RunningStudio,
    Watched,
    chromium,
    needs_browser,
    running_studio,
    simulated,
    tab,
)

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [needs_browser, pytest.mark.xdist_group("studio")]


@pytest.fixture(scope="module")
def browser() -> Iterator["Browser"]:
    with chromium() as made:
        yield made


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningStudio]:
    folder = tmp_path_factory.mktemp("studio")
    shutil.copy(MACHINE, folder)
    simulated(folder, "laser-a", 1)
    simulated(folder, "laser-b", 2, "--set", "beam_offset_mm=[0,0,150]")
    with running_studio(folder) as made:
        yield made


@pytest.fixture(scope="module")
def story(browser: "Browser", studio: RunningStudio) -> Watched:
    """A first model, compared, diagnosed, added to, and saved."""
    watched = tab(browser, studio.address)
    page = watched.page
    page.get_by_role("cell", name="162").nth(1).wait_for()
    page.get_by_label("use laser-a.csv").click()
    page.get_by_label("use laser-b.csv").click()
    page.get_by_label("Effects (empty: chosen on held-out runs)").fill("scale")
    page.get_by_role("button", name="Fit", exact=True).click()
    page.get_by_role("button", name="Compare the model with the measurements").click()
    page.wait_for_selector(".chart[data-drawn=yes]")
    page.get_by_role("button", name="Diagnose: which effect is missing?").click()
    page.get_by_role("button", name="Find the missing effect").click()
    page.get_by_role("button", name="Test again").wait_for()
    page.get_by_role("button", name="Add", exact=True).first.click()
    page.get_by_text("The error falling").wait_for()
    page.get_by_label("File for the model").fill("better.toml")
    page.get_by_role("button", name="Save", exact=True).click()
    page.get_by_text("Saved as better.toml.").wait_for()
    return watched


def test_the_saved_model_is_that_of_the_command_line(story: Watched, studio: RunningStudio, tmp_path: Path) -> None:
    """Oracle: `rtec fit` and the command that the page shows, run in another folder with the same files."""
    for name in ("turning-centre.toml", "laser-a.csv", "laser-a.toml", "laser-b.csv", "laser-b.toml"):
        shutil.copy(studio.folder / name, tmp_path)
    shown = story.page.locator(".command").last.inner_text()
    words = shown.split()
    assert words[:2] == ["rtec", "add"]
    files = [str(tmp_path / n) for n in ("laser-a.csv", "laser-b.csv")]
    machine, first = str(tmp_path / "turning-centre.toml"), str(tmp_path / "model.toml")
    assert status(["fit", machine, *files, "-o", first, "--effects", "scale"]) == 0
    assert (studio.folder / "model.toml").read_bytes() == (tmp_path / "model.toml").read_bytes()
    typed = [str(tmp_path / w) if re.fullmatch(r"[\w-]+\.(csv|toml)", w) else w for w in words[1:]]
    assert status(typed) == 0
    assert (studio.folder / "better.toml").read_bytes() == (tmp_path / "better.toml").read_bytes()


def test_the_hidden_effect_is_in_the_saved_model(story: Watched, studio: RunningStudio) -> None:
    """Oracle: the play of 4 µm that the simulation was given, and the staircase of the history."""
    model = tomllib.loads((studio.folder / "better.toml").read_text(encoding="utf-8"))
    play = next(e for e in model["effect"] if e["effect"] == "backlash")
    assert abs(play["coefficient"]["B"]["value"] - 4.0) < 0.3
    last = model["history"][-1]
    assert last["rms_after"] < 0.5 * last["rms_before"]
    assert story.page.locator("h1").inner_text() == "Add and watch"


def test_no_request_leaves_this_computer(story: Watched) -> None:
    """Oracle: the browser's own log of requests and sockets, and its console, where a breach of the policy is shown."""
    there = {urlsplit(url).hostname for url in story.requests if urlsplit(url).scheme not in ("data", "blob")}
    assert there == {"127.0.0.1"}
    assert story.complaints == []


def test_undo_and_redo_move_along_the_staircase(story: Watched) -> None:
    """Oracle: the lead of the page, which names the effect only while it is in the model."""
    page = story.page
    page.get_by_role("button", name="Undo").click()
    page.get_by_role("button", name="Save", exact=True).wait_for(state="detached")
    assert page.get_by_role("button", name="Undo").is_disabled()
    page.get_by_role("button", name="Redo").click()
    page.get_by_text("Saved as better.toml.").wait_for()


def test_another_tab_begins_by_itself(story: Watched, browser: "Browser", studio: RunningStudio) -> None:
    """Oracle: the measurements that are chosen: two in the first tab, none in a new one."""
    other = tab(browser, studio.address)
    other.page.get_by_text("laser-a.csv").first.wait_for()
    assert "0 measurements" in other.page.locator("header").inner_text()
    assert "2 measurements" in story.page.locator("header").inner_text()
    other.page.context.close()


def test_a_reload_loses_nothing(story: Watched) -> None:
    """Oracle: the page before the reload."""
    story.page.reload()
    story.page.get_by_text("Saved as better.toml.").wait_for()
    assert "2 measurements" in story.page.locator("header").inner_text()


def test_a_name_that_is_taken_is_refused_beside_the_field(story: Watched, studio: RunningStudio) -> None:
    """Oracle: the model file on disk, which stays as it was."""
    before = (studio.folder / "model.toml").read_bytes()
    story.page.get_by_label("File for the model").fill("model.toml")
    story.page.get_by_role("button", name="Save", exact=True).click()
    story.page.get_by_text("another file of that name is in the folder; give the model a new name").wait_for()
    assert (studio.folder / "model.toml").read_bytes() == before

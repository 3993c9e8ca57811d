"""The whole story in a browser: measurements, a first model, where it fails, what is missing, the error falling.

Oracles: the command line's own files, byte for byte; the hidden effect that the simulation was given; the browser's log
of its requests.
"""

import re
import shlex
import shutil
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import pytest

import rtec
from rtec.cli.main import status
from tests.studio.studio_rig import (
    MACHINE,
    RunningStudio,
    Watched,
    foreign,
    needs_browser,
    running_studio,
    tab,
)

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = [needs_browser, pytest.mark.xdist_group("others")]

BESIDE = "beam_offset_mm=[0,0,150]"


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningStudio]:
    """Of an empty folder."""
    with running_studio(tmp_path_factory.mktemp("studio")) as made:
        yield made


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two tables of another program, of one machine with a hidden backlash."""
    folder = tmp_path_factory.mktemp("foreign")
    return [foreign(folder, "messung-a", 1), foreign(folder, "messung-b", 2, "--set", BESIDE)]


@pytest.fixture(scope="module")
def story(browser: "Browser", studio: RunningStudio, tables: list[Path]) -> Watched:
    """Two foreign tables are dropped and imported; a model is fitted, compared, diagnosed, added to, and saved."""
    watched = tab(browser, studio.address)
    page = watched.page
    page.get_by_label("Machine to copy").click()
    page.get_by_role("option", name="turning-centre.toml").click()
    page.get_by_label("Machine file").wait_for()
    page.locator("input[type=file]").set_input_files(tables)
    for table in tables:
        page.get_by_role("button", name=f"Import {table.name}").click()
        page.get_by_text("What it becomes: 162 readings").wait_for()
        if table is tables[1]:
            beam = page.get_by_label(
                "Where does the laser_linear read, as X, Y and Z from the tool tip (beam_offset_mm)?"
            )
            beam.fill("[0, 0, 150]")
            beam.press("Enter")
            page.get_by_text("Answered: setup.beam_offset_mm").wait_for()
        page.get_by_label("Name of the measurement").fill(f"laser-{table.stem[-1]}")
        page.get_by_text(f"-o laser-{table.stem[-1]}").wait_for()
        watched.commands.append(page.locator(".command").last.inner_text())
        page.get_by_role("button", name="Import", exact=True).click()
        page.get_by_label(f"use laser-{table.stem[-1]}.csv").wait_for()
    page.get_by_role("cell", name="162").nth(1).wait_for()
    page.get_by_label("Effects (empty: chosen on held-out runs)").fill("scale")
    page.get_by_text("--effects scale").wait_for()
    watched.commands.append(page.locator(".command").last.inner_text())
    page.get_by_role("button", name="Fit", exact=True).click()
    page.get_by_role("button", name="Compare the model with the measurements").click()
    page.wait_for_selector(".chart[data-drawn=yes]")
    page.get_by_role("button", name="Diagnose: which effect is missing?").click()
    page.get_by_role("button", name="Find the missing effect").click()
    page.get_by_role("button", name="Test again").wait_for()
    watched.told.append(page.get_by_text("Fitted: B ").first.inner_text())
    page.get_by_role("button", name="Add", exact=True).first.click()
    page.get_by_text("The error falling").wait_for()
    page.get_by_label("File for the model").fill("better.toml")
    page.get_by_text("-o better.toml").wait_for()
    watched.commands.append(page.locator(".command").last.inner_text())
    page.get_by_role("button", name="Save", exact=True).click()
    page.get_by_text("Saved as better.toml.").wait_for()
    return watched


def test_the_saved_model_is_that_of_the_command_line(
    story: Watched, studio: RunningStudio, tables: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Oracle: the commands that the pages showed, run in another empty folder with the same foreign tables."""
    monkeypatch.chdir(tmp_path)
    for file in (MACHINE, *tables):
        shutil.copy(file, tmp_path)
    words = [shlex.split(line) for line in story.commands]
    assert [w[:2] for w in words] == [["rtec", c] for c in ("import", "import", "fit", "add")]
    assert [status(w[1:]) for w in words] == [0] * 4
    written = ["laser-a.csv", "laser-a.toml", "laser-a-map.toml", "laser-b.csv", "model.toml", "better.toml"]
    assert [n for n in written if (studio.folder / n).read_bytes() != (tmp_path / n).read_bytes()] == []


def test_the_hidden_effect_is_in_the_saved_model(story: Watched, studio: RunningStudio) -> None:
    """Oracle: the play of 4 µm that the simulation was given, and the staircase of the history."""
    model = tomllib.loads((studio.folder / "better.toml").read_text(encoding="utf-8"))
    play = next(e for e in model["effect"] if e["effect"] == "backlash")
    assert abs(play["coefficient"]["B"]["value"] - 4.0) < 0.3
    value, error = map(float, re.findall(r"\d+\.\d+", story.told[0]))
    assert abs(value - 4.0) < max(3.0 * error, 0.3)
    last = model["history"][-1]
    assert last["rms_after"] < 0.5 * last["rms_before"]
    assert story.page.locator("h1").inner_text() == "Add and watch"


def test_no_request_leaves_this_computer(story: Watched) -> None:
    """Oracle: the browser's own log of requests and sockets, and its console, where a breach of the policy is shown."""
    there = {urlsplit(url).hostname for url in story.requests if urlsplit(url).scheme not in ("data", "blob")}
    assert there == {"127.0.0.1"}
    assert story.complaints == []


LARGEST = """() => Math.max(...[...document.querySelectorAll(".chart")]
  .filter((e) => e._fullLayout?.yaxis?.type === "linear")
  .flatMap((e) => (e.data ?? []).flatMap((t) => [...(t.y ?? [])])))"""
HIDDEN_READINGS = """() => [...document.querySelectorAll(".chart")]
  .filter((e) => e.data?.length && e._fullLayout?.yaxis?.type === "linear")
  .map((e) => [e._fullLayout.yaxis.range, e.data.flatMap((t) => [...(t.y ?? [])])])
  .reduce((n, [[low, high], y]) => n + y.filter((v) => v < low || v > high).length, 0)"""
"""Number of readings beyond the ends of their axis."""


def test_undo_and_redo_move_along_the_staircase(story: Watched) -> None:
    """Oracle: the page's lead, which names the effect only while it is in the model. Every reading is on screen."""
    page = story.page
    page.get_by_role("button", name="Undo").click()
    page.get_by_role("button", name="Save", exact=True).wait_for(state="detached")
    assert page.get_by_role("button", name="Undo").is_disabled()
    page.get_by_text("The residual of laser-a").scroll_into_view_if_needed()
    page.wait_for_function(f"() => ({LARGEST})() > 1.0")  # the backlash of 2 µm is back; it left less
    assert page.evaluate(HIDDEN_READINGS) == 0
    page.get_by_role("button", name="Redo").click()
    page.get_by_text("Saved as better.toml.").wait_for()


def test_improve_asks_at_each_step_and_saves_what_the_command_line_saves(story: Watched, studio: RunningStudio) -> None:
    """Oracle: `rtec improve --yes` on the same files."""
    page = story.page
    page.get_by_role("button", name="Undo").click()
    page.get_by_role("button", name="Save", exact=True).wait_for(state="detached")
    page.get_by_role("button", name="Improve step by step").click()
    page.get_by_text("Step 1: add backlash(EXX, X)?").wait_for()
    offered = page.get_by_role("alertdialog").locator(".q-btn", has_text="(probability").all_inner_texts()
    effects = [text.partition(" (probability")[0] for text in offered]
    assert len(set(effects)) == len(effects) == 4  # degrees of one effect are others
    page.get_by_role("button", name="Add backlash(EXX, X) (").click()
    page.get_by_text("It ended because").wait_for()
    page.get_by_label("File for the model").fill("improved.toml")
    page.get_by_role("button", name="Save", exact=True).click()
    page.get_by_text("Saved as improved.toml.").wait_for()
    files = [str(studio.folder / n) for n in ("laser-a.csv", "laser-b.csv")]
    typed = studio.folder / "typed.toml"  # in the same folder, as a model names its machine's file from there
    assert status(["improve", str(studio.folder / "model.toml"), *files, "--yes", "-o", str(typed)]) == 0
    assert (studio.folder / "improved.toml").read_bytes() == typed.read_bytes()


def test_a_reload_loses_nothing(story: Watched) -> None:
    """Oracle: the page before the reload."""
    story.page.reload()
    story.page.get_by_text("Saved as improved.toml.").wait_for()
    assert "2 measurements" in story.page.locator("header").inner_text()


def test_a_name_that_is_taken_is_refused_beside_the_field(story: Watched, studio: RunningStudio) -> None:
    """Oracle: the model file on disk, which stays as it was."""
    before = (studio.folder / "model.toml").read_bytes()
    story.page.get_by_label("File for the model").fill("model.toml")
    story.page.get_by_role("button", name="Save", exact=True).click()
    story.page.get_by_text("another file of that name is in the folder; give the model a new name").wait_for()
    assert (studio.folder / "model.toml").read_bytes() == before


def test_what_another_wrote_meanwhile_is_not_replaced(story: Watched, studio: RunningStudio) -> None:
    """Under a name that this tab has saved before. Oracle: the file on disk, which stays the other's."""
    path = studio.folder / "improved.toml"
    mine, other = path.read_bytes(), (studio.folder / "better.toml").read_bytes()
    path.write_bytes(other)
    story.page.get_by_label("File for the model").fill("improved.toml")
    story.page.get_by_role("button", name="Save", exact=True).click()
    story.page.get_by_text("improved.toml: was changed by another tab or program since it was saved here").wait_for()
    assert path.read_bytes() == other
    path.write_bytes(mine)


def test_the_machine_and_the_part_of_the_model_are_shown(story: Watched) -> None:
    """Oracle: the model on disk through `Model.predict`; switching the play off takes its error away."""
    page = story.page
    page.get_by_role("link", name="Explore").click()
    headline = page.get_by_text("Here the tool tip is off by")
    page.get_by_text("A turned cylinder of 200 mm would measure 200.").wait_for()
    before = headline.inner_text()
    changed = "before => !document.body.innerText.includes(before)"
    page.get_by_label("Backlash, reversal value: backlash(EXX, X)").click()
    page.wait_for_function(changed, arg=before)
    before = headline.inner_text()
    field = page.get_by_label("X, mm, number")
    field.fill("12,5")
    field.press("Enter")
    page.wait_for_function(changed, arg=before)
    field.fill("999")
    field.press("Enter")
    page.get_by_text("from 0 to 200").wait_for()


def test_the_report_holds_everything_itself(story: Watched) -> None:
    """Oracle: the files that are downloaded: no address in the HTML, a PDF of several pages."""
    page = story.page
    page.get_by_role("link", name="Report").click()
    kept = {}
    for kind in ("HTML", "PDF"):
        with page.expect_download() as download:
            page.get_by_role("button", name=kind, exact=True).click()
        kept[kind] = Path(download.value.path()).read_bytes()
    html = kept["HTML"].decode()
    assert "data:image/png;base64," in html
    assert "http" not in html.replace("http-equiv", "")
    assert "<script" not in html
    assert kept["PDF"].startswith(b"%PDF-")
    assert kept["PDF"].count(b"/Type /Page ") + kept["PDF"].count(b"/Type /Page\n") > 1


def test_the_report_is_of_what_is_on_screen(story: Watched, studio: RunningStudio) -> None:
    """What Compare draws, what is set on Explore, what Measurements lists. Oracle: those pages, and the files."""
    page = story.page
    page.get_by_role("link", name="Compare").click()
    page.get_by_label("Draw over").click()
    page.get_by_role("option", name="T_x_nut, °C").click()
    page.get_by_label("Colour by").click()
    page.get_by_role("option", name="run", exact=True).click()
    page.get_by_role("button", name="Report of the page Compare").click()
    compared = _downloaded(page)
    assert "The residual over T_x_nut, °C, coloured by run" in compared
    assert "The state of the machine" not in compared
    page.get_by_role("link", name="Explore").click()
    headline = page.get_by_text("Here the tool tip is off by")
    headline.wait_for()
    assert page.get_by_label("X, mm, number").input_value() == "12.5"  # as it was left
    off = page.get_by_role("checkbox", name="Backlash, reversal value: backlash(EXX, X)")
    assert off.get_attribute("aria-checked") == "false"
    shown = headline.inner_text()
    page.get_by_role("button", name="Report of the page Explore").click()
    explored = _downloaded(page)
    assert f'<p class="lead">{shown}</p>' in explored
    assert re.search(r">Backlash, reversal value: backlash\(EXX, X\)</td><td[^>]*>off</td>", explored)
    assert re.search(r">X, mm</td><td>12.5</td>", explored)
    assert "positioning of X" in explored
    assert explored.count("data:image/png;base64,") == 3
    assert "coloured by run" not in explored

    page.get_by_role("link", name="Measurements").click()
    page.get_by_role("button", name="Report of the page Measurements").click()
    listed = _downloaded(page)
    machine = studio.folder / "turning-centre.toml"
    for name in ("laser-a.csv", "laser-b.csv"):
        m = rtec.load_measurement(studio.folder / name, machine)
        cells = f'<td class="words">laser_linear X</td><td>{len(set(m.run))}</td><td>{len(m)}</td>'
        assert f'<td class="words">{name}</td>{cells}' in listed
    assert listed.count("data:image/png;base64,") == 0


def _downloaded(page: "Page") -> str:
    with page.expect_download() as download:
        page.get_by_role("button", name="HTML", exact=True).click()
    return Path(download.value.path()).read_text(encoding="utf-8")


def test_two_tabs_of_a_browser_work_at_a_time(story: Watched, studio: RunningStudio) -> None:
    """One adds an effect while the other compares. Oracle: `rtec compare` for what the other shows; files on disk."""
    kept = {path.name: path.read_bytes() for path in studio.folder.iterdir()}
    page, other = story.page, story.page.context.new_page()
    page.goto(f"{studio.origin}/add")
    page.get_by_role("button", name="Undo").click()
    page.get_by_role("button", name="Save", exact=True).wait_for(state="detached")
    page.get_by_role("link", name="Diagnose").click()
    other.goto(f"{studio.origin}/measurements")
    other.get_by_label("use laser-b.csv").click()
    other.get_by_label("Model file").click()
    other.get_by_role("option", name="better.toml").click()
    other.locator("header", has_text="better.toml · 1 measurement").wait_for()
    page.get_by_role("button", name="Add", exact=True).first.click()
    other.get_by_role("button", name="Compare the model with the measurements").click()
    page.get_by_role("button", name="Cancel").wait_for()
    other.wait_for_selector(".chart[data-drawn=yes]")
    page.get_by_text("The error falling").wait_for()
    assert "model.toml · 2 measurements" in page.locator("header").inner_text()
    page.get_by_role("button", name="Redo").and_(page.locator("[disabled]")).wait_for()
    model = rtec.load_model(studio.folder / "better.toml", studio.folder / "turning-centre.toml")
    alone = rtec.compare(model, [studio.folder / "laser-b.csv"])
    assert other.locator(".lead").first.inner_text() == alone.page(figures=False).lead
    assert "better.toml · 1 measurement" in other.locator("header").inner_text()
    assert {path.name: path.read_bytes() for path in studio.folder.iterdir()} == kept
    other.close()

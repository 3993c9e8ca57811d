"""The live page against a real daemon of the simulated machine. Oracle: the daemon's own status over its socket."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from rtec.control.client import Client, DaemonPlace
from rtec.control.facts import um_text
from rtec.control.places import of_config
from tests.studio.studio_rig import (
    RunningStudio,
    Watched,
    live_config,
    needs_browser,
    running_daemon,
    running_studio,
    tab,
)

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = [needs_browser, pytest.mark.xdist_group("others")]


FADED = """[...document.querySelectorAll(".bar")]
  .filter((b) => b.querySelector("span").innerText === "applied")
  .every((b) => parseFloat(b.querySelector("b").innerText.replace("−", "-")) === 0)"""


GAP = """[...document.querySelectorAll(".chart")].length === 4 && [...document.querySelectorAll(".chart")]
  .every((c) => c.data?.length && c.data.every((t) => [...t.y].indexOf(null) > 0))"""
"""Whether each plot has points of the run before, and a gap behind them."""


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped run file at 50 Hz, with counts that may be late: a busy computer is no fault here."""
    return live_config(tmp_path_factory.mktemp("live") / "run")


def _found(config: Path) -> dict[str, Any]:
    (path,) = [p for p in of_config(config) if p.exists()]
    with Client(DaemonPlace(path)) as client:
        return dict(client.status())


def _mode(config: Path) -> str:
    return str(_found(config)["status"]["mode"])


@pytest.fixture(scope="module")
def watched(browser: "Browser", config: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Watched]:
    """A page of a studio that may operate; the daemon is not running yet."""
    folder = tmp_path_factory.mktemp("studio")
    with running_studio(folder, "--attach", str(config), "--role", "operate") as studio:
        yield tab(browser, studio.address)


@pytest.fixture(scope="module")
def onlooker(config: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningStudio]:
    """A studio that may not operate."""
    with running_studio(tmp_path_factory.mktemp("onlooker"), "--attach", str(config)) as studio:
        yield studio


def test_the_page_follows_a_daemon_through_a_hold_a_fault_and_a_restart(watched: Watched, config: Path) -> None:
    """It waits for the daemon; holds it by a button that asks once; shows why it holds by itself after a restart."""
    page = watched.page
    page.locator(".state.off", has_text="no answer").wait_for()
    page.get_by_text("no daemon runs with").wait_for()
    with running_daemon(config):
        page.locator(".state.on").wait_for()
        assert page.locator(".state").inner_text() == "on"
        page.get_by_role("button", name="Hold", exact=True).click()
        page.get_by_text("Hold the correction at its present value?").wait_for()
        assert _mode(config) == "on"
        page.get_by_role("alertdialog").get_by_role("button", name="Hold", exact=True).click()
        page.locator(".state.held").wait_for()
        page.get_by_text("ordered by an operator").first.wait_for()
        assert page.locator(".state").inner_text() == "held"  # one word, its reason beside it
        assert _mode(config) == "hold"
        page.get_by_role("cell", name="studio", exact=False).first.wait_for()
        page.get_by_label("Text beside the log").fill("new tool <b>4</b>")
        page.get_by_role("button", name="Mark", exact=True).click()
        page.get_by_role("cell", name="new tool <b>4</b>", exact=True).wait_for()
        assert [e["text"] for e in _found(config)["events"] if e["what"] == "mark"] == ["new tool <b>4</b>"]
        _reported(page, config)
        page.get_by_role("button", name="Fade", exact=True).click()
        page.get_by_text("Fade the correction to zero at its slew limit?").wait_for()
        page.get_by_role("alertdialog").get_by_role("button", name="Cancel").click()
        page.get_by_role("alertdialog").wait_for(state="detached")
        assert _mode(config) == "hold"
        page.get_by_role("button", name="Fade", exact=True).click()
        page.get_by_role("alertdialog").get_by_role("button", name="Fade", exact=True).click()
        page.locator(".state", has_text="off").wait_for()
        found = _found(config)["status"]
        assert found["mode"] == "off"
        page.wait_for_function(FADED)
        page.wait_for_function("!document.querySelector('.card.bad')")  # what was ordered is not wrong
        assert page.locator(".q-btn.main:visible").count() == 0
    page.locator(".state.off", has_text="no answer").wait_for()
    text = config.read_text(encoding="utf-8").replace("counts_max_age_s = 5.0", "counts_max_age_s = 0.000001")
    config.write_text(text, encoding="utf-8")
    page.get_by_role("button", name="Enable", exact=True).click()
    page.get_by_role("alertdialog").wait_for()
    with running_daemon(config):
        page.locator(".state.held").wait_for()
        page.wait_for_function(GAP)  # the plots were drawn again; the question is still asked
        page.get_by_role("alertdialog").get_by_role("button", name="Enable", exact=True).click()
        page.get_by_text("counts are stale").first.wait_for()
        page.get_by_role("cell", name="new tool <b>4</b>", exact=True).wait_for()  # of the run before
    assert watched.complaints == []


def _reported(page: "Page", config: Path) -> None:
    """A report of what is held has its state, each axis, and the mark. Oracle: the daemon's status."""
    page.get_by_role("button", name="Report of the page Live").click()
    with page.expect_download() as download:
        page.get_by_role("button", name="HTML", exact=True).click()
    html = Path(download.value.path()).read_text(encoding="utf-8")
    found = _found(config)
    assert f"Correction: held: ordered by an operator. {found['machine']}, model {found['model']}," in html
    for axis, value in found["status"]["applied_um"].items():
        assert re.search(rf">{axis}</td><td>[^<]*</td><td>[^<]*</td><td>{re.escape(um_text(value))}</td>", html)
    assert "new tool &lt;b&gt;4&lt;/b&gt;" in html
    assert html.count("data:image/png;base64,") >= 2
    assert "<script" not in html
    page.get_by_role("link", name="Live").click()
    page.locator(".state.held").wait_for()


def test_an_answer_of_the_daemon_costs_the_styles_of_what_it_changes(
    browser: "Browser", config: Path, onlooker: RunningStudio
) -> None:
    """Oracle: how many elements' styles the browser computes again, by its own trace; at each answer it was all."""
    with running_daemon(config):
        page = tab(browser, onlooker.address).page
        page.wait_for_function("[...document.querySelectorAll('.chart')].filter((c) => c.dataset.drawn).length === 4")
        elements = page.evaluate("document.querySelectorAll('*').length")
        bars = "[...document.querySelectorAll('.fill')].map((e) => e.style.cssText).join()"
        browser.start_tracing(page=page, categories=["devtools.timeline"])
        for _ in range(5):
            page.wait_for_function(f"(before) => {bars} !== before", arg=page.evaluate(bars))
        events = json.loads(browser.stop_tracing())["traceEvents"]
    computed = [e["args"]["elementCount"] for e in events if e["name"] == "UpdateLayoutTree" and "dur" in e]
    assert len(computed) >= 5
    assert sum(n > elements / 2 for n in computed) <= 1  # the tables and plots, if they are drawn again meanwhile


def test_without_the_role_there_are_no_buttons(browser: "Browser", onlooker: RunningStudio) -> None:
    """Oracle: the page's buttons, and the sentence that says how to get them."""
    page = tab(browser, onlooker.address).page
    page.get_by_text("--role operate").wait_for()
    assert page.get_by_role("button", name="Hold").count() == 0

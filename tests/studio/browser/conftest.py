"""One headless Chromium for all tests of the pages, and one studio with everything on its pages."""

import shutil
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from rtec.cli.main import status
from tests.studio.studio_rig import (
    MACHINE,
    RunningStudio,
    Watched,
    chromium,
    foreign,
    live_config,
    running_daemon,
    running_studio,
    simulated,
    tab,
)

if TYPE_CHECKING:
    from playwright.sync_api import Browser, BrowserContext

WATCH_SHIFTS = """window.shifted = 0;
new PerformanceObserver((list) => {
  for (const e of list.getEntries()) if (!e.hadRecentInput) window.shifted += e.value;
}).observe({ type: "layout-shift", buffered: true });"""

KEPT: list["BrowserContext"] = []
"""Tabs that several files share."""


@pytest.fixture(scope="package")
def browser() -> Iterator["Browser"]:
    with chromium() as made:
        yield made


@pytest.fixture(scope="module", autouse=True)
def closed(browser: "Browser") -> Iterator[None]:
    """The tabs of a file are closed behind it: a page that follows a daemon draws as long as it is open."""
    yield
    for context in browser.contexts:
        if context not in KEPT:
            context.close()


@pytest.fixture(scope="package")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningStudio]:
    """A machine with a hidden backlash, two lasers, a model without it, a foreign table; and a running daemon."""
    folder = tmp_path_factory.mktemp("workshop")
    shutil.copy(MACHINE, folder)
    first = simulated(folder, "laser-a", 1)
    simulated(folder, "laser-b", 2, "--set", "beam_offset_mm=[0,0,150]")
    foreign(folder, "messung", 3)
    model = folder / "model.toml"
    assert status(["fit", str(folder / MACHINE.name), str(first), "--effects", "scale", "-o", str(model)]) == 0
    config = live_config(tmp_path_factory.mktemp("live") / "run")
    attached = ("--attach", str(config), "--role", "operate")
    with running_daemon(config), running_studio(folder, *attached) as studio:
        yield studio


@pytest.fixture(scope="package")
def whole(browser: "Browser", workshop: RunningStudio) -> Watched:
    """A tab in which every page has something to show: compared, diagnosed, an effect added, a table to import."""
    address = f"{workshop.origin}/measurements?{workshop.address.partition('?')[2]}"
    watched = tab(browser, address, 1280, 960, WATCH_SHIFTS)
    page = watched.page
    KEPT.append(page.context)
    for name in ("laser-a", "laser-b"):
        page.get_by_label(f"use {name}.csv").click()
    page.locator("header", has_text="2 measurements").wait_for()
    page.get_by_role("button", name="Compare the model with the measurements").click()
    page.get_by_role("button", name="Diagnose: which effect is missing?").click()
    page.get_by_role("button", name="Find the missing effect").click()
    page.get_by_role("button", name="Add", exact=True).first.click()
    page.get_by_text("The error falling").wait_for()
    page.get_by_role("link", name="Diagnose").click()
    page.get_by_role("button", name="Find the missing effect").click()
    page.get_by_role("button", name="Test again").wait_for()
    watched.jumped = page.evaluate("window.shifted")
    return watched

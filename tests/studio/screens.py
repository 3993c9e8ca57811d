"""Screenshots of every page, light and dark, for the documentation: `python -m tests.studio.screens docs/figures`."""

import os
import sys
import tempfile
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image

from tests.studio.studio_rig import chromium, foreign, live_config, running_daemon, running_studio, tab

if TYPE_CHECKING:
    from playwright.sync_api import Page

WIDTH, HIGH, COLOURS = 1280, 960, 255


def shoot(page: "Page", folder: Path, name: str) -> None:
    """Both themes, with few colours, so that the files stay small, and so many that no two curves look alike."""
    for theme in ("light", "dark"):
        page.emulate_media(color_scheme=theme, reduced_motion="reduce")
        page.wait_for_timeout(1500)
        page.mouse.move(5, 5)
        with Image.open(BytesIO(page.screenshot())) as picture:
            few = picture.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
            few.save(folder / f"studio-{name}-{theme}.png", optimize=True)
    page.emulate_media(color_scheme="light", reduced_motion="reduce")


def main(out: Path) -> None:
    """Go through the story of the tutorial and keep what is seen."""
    with tempfile.TemporaryDirectory() as made, chromium() as browser:
        os.environ["HOME"] = made  # paths are shown from there
        folder = Path(made) / "workshop" / "lathe"
        folder.mkdir(parents=True)
        config = live_config(Path(made) / "workshop" / "lathe-daemon")
        with running_studio(folder) as studio:
            _story(tab(browser, studio.address, WIDTH, HIGH).page, folder, out)
        with running_daemon(config), running_studio(folder, "--attach", str(config), "--role", "operate") as studio:
            page = tab(browser, studio.address, WIDTH, HIGH).page
            page.locator(".state.on").wait_for()
            page.wait_for_timeout(20_000)
            shoot(page, out, "live")


def _story(page: "Page", folder: Path, out: Path) -> None:
    page.get_by_role("button", name="Try it with an example").click()
    page.get_by_role("button", name="Compare the model with the measurements").wait_for()
    page.get_by_role("cell", name="756").first.wait_for()
    shoot(page, out, "measurements")
    foreign(folder, "messung", 1)
    page.reload()
    page.get_by_role("button", name="Import messung.csv").click()
    page.get_by_text("What it becomes").wait_for()
    shoot(page, out, "import")
    page.get_by_role("link", name="Compare").click()
    page.get_by_role("button", name="Diagnose: which effect is missing?").wait_for()
    page.wait_for_selector(".chart[data-drawn=yes]")
    shoot(page, out, "compare")
    page.get_by_role("link", name="Diagnose").click()
    page.get_by_role("button", name="Find the missing effect").click()
    page.get_by_role("button", name="Test again").wait_for()
    page.wait_for_selector(".chart[data-drawn=yes]")
    shoot(page, out, "diagnose")
    page.get_by_role("button", name="Add", exact=True).first.click()
    page.get_by_text("The error falling").wait_for()
    shoot(page, out, "add")
    page.get_by_role("link", name="Explore").click()
    page.get_by_text("A turned cylinder").wait_for()
    shoot(page, out, "explore")
    page.get_by_role("link", name="Report").click()
    page.get_by_role("button", name="PDF").wait_for()
    shoot(page, out, "report")


if __name__ == "__main__":
    main(Path(sys.argv[1]))

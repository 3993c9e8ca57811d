"""The first page after a start, asked for while the server still loads what makes it."""

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from rtec.studio.server.front import FILES
from tests.studio.studio_rig import needs_browser, running_studio, tab

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [needs_browser, pytest.mark.xdist_group("others")]


def test_every_file_that_is_named_beforehand_is_used_and_loaded_once(browser: "Browser", tmp_path: Path) -> None:
    """Oracle: the page's own text, and the browser's list of what it loaded."""
    with running_studio(tmp_path) as studio:
        page = tab(browser, studio.address).page
        text = page.request.get(studio.origin).text()
        loaded: list[str] = page.evaluate("performance.getEntriesByType('resource').map((e) => e.name)")
        page.context.close()
    assert [name for name in FILES if f"/static/{name}" not in text] == []
    assert {name: n for name in FILES if (n := sum(url.endswith(f"/static/{name}") for url in loaded)) != 1} == {}

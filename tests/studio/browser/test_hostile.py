"""Names and cells of files are text. Oracles: the page's own text and elements, and dialogs, of which none may open."""

import shutil
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from tests.studio.studio_rig import MACHINE, RunningStudio, Watched, needs_browser, running_studio, tab

if TYPE_CHECKING:
    from playwright.sync_api import Browser, FilePayload, Route

pytestmark = [needs_browser, pytest.mark.xdist_group("others")]
ATTACK = "<img src=x onerror=alert(1)>"
HEADER = f'Zeit [s];X Soll [mm];"<b>Abweichung</b> [um]";"{ATTACK}"'


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningStudio]:
    """Of a folder with hostile names and cells, made by somebody else."""
    folder = tmp_path_factory.mktemp("hostile")
    shutil.copy(MACHINE, folder)
    rows = "\n".join(f"{k};{20 * (k % 8)};{k % 3},5;{ATTACK}" for k in range(40))
    (folder / f"{ATTACK}.csv").write_text(f"{HEADER}\n{rows}\n", encoding="utf-8")
    (folder / "a\x1b[2Jb\u202e.csv").write_text("1;2\n", encoding="utf-8")
    (folder / "{{ 7*7 }}.toml").write_bytes(MACHINE.read_bytes())
    with running_studio(folder) as made:
        yield made


def test_names_and_cells_are_shown_as_text(browser: "Browser", studio: RunningStudio) -> None:
    """No element is made of them, nothing runs, and control characters are shown as escapes."""
    watched: Watched = tab(browser, studio.address)
    page, dialogs = watched.page, list[str]()
    page.on("dialog", lambda d: dialogs.append(d.message))
    page.get_by_text(f"{ATTACK}.csv").first.wait_for()
    page.get_by_text("a\\u001b[2Jb\\u202e.csv").first.wait_for()
    page.get_by_label("Machine file").click()
    page.get_by_role("option", name="{{ 7*7 }}.toml").wait_for()
    page.get_by_role("option", name="turning-centre.toml").click()
    page.locator("header", has_text="turning-centre.toml").wait_for()
    page.locator(".q-menu").wait_for(state="detached")
    page.get_by_role("button", name=f"Import {ATTACK}.csv").click()
    page.get_by_role("cell", name="<b>Abweichung</b> [um]").first.wait_for()
    assert page.locator("img").count() == 0
    assert page.locator("td b").count() == 0
    assert dialogs == []
    assert [c for c in watched.complaints if "Security" in c or "onerror" in c] == []


def test_a_page_without_the_key_shows_nothing(browser: "Browser", studio: RunningStudio) -> None:
    """Oracle: status 403 and the sentence, in a browser that was never let in."""
    page = browser.new_context().new_page()
    answer = page.goto(f"{studio.origin}/compare")
    assert answer is not None
    assert answer.status == 403
    assert "rtec studio" in page.inner_text("body")
    assert ATTACK not in page.content()


def test_no_dropped_file_is_lost(browser: "Browser", studio: RunningStudio) -> None:
    """Five files of which one is refused; whatever follows the first request is slow. Oracle: the folder."""
    page, slow = tab(browser, studio.address).page, list["Route"]()
    names = [f"dropped-{k}.csv" for k in range(4)]
    table = b"a;b\n1;2\n"
    files: list[FilePayload] = [
        {"name": n, "mimeType": "text/csv", "buffer": table} for n in [*names[:1], MACHINE.name, *names[1:]]
    ]

    def hold(route: "Route") -> None:
        slow.append(route)
        if len(slow) == 1:
            route.continue_()

    page.route("**/upload/**", hold)
    page.locator("input[type=file]").set_input_files(files)
    page.get_by_role("button", name=f"Import {names[0]}").wait_for()
    for route in slow[1:]:
        route.continue_()
    page.get_by_text("another file of that name is in the folder").first.wait_for()
    for name in names:
        page.get_by_role("button", name=f"Import {name}").wait_for()
        assert (studio.folder / name).read_bytes() == table

"""Every page: contrast, widths, keyboard, no jump while it loads, nothing from elsewhere, a policy on each.

Oracles: WCAG 2.1's formulas, the boxes that the browser lays out, its own layout-shift entries, its log of requests.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import pytest

from rtec.report.page import Page as ReportPage
from rtec.report.page import Section, Table, render
from tests.studio.browser.checks import CONTRAST, CONTROLS, FOCUS, NUMBERED, OVERLAPS
from tests.studio.studio_rig import RunningStudio, Watched, needs_browser

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = [needs_browser, pytest.mark.xdist_group("others")]

PAGES = ("Measurements", "Import", "Compare", "Diagnose", "Add and watch", "Explore", "Live", "Report")
WIDTHS = ((820, 1180), (1180, 820), (1280, 960), (1920, 1080), (2560, 1440))
"""A tablet upright and lying, and screens."""
SETTLED_MS = 20_000
SHIFT = 0.02
"""Google's limit for a good page is 0.1."""
DRAWN = "[...document.querySelectorAll('.chart')].every((c) => c.dataset.drawn === 'yes')"
MUTED = """() => {
  const emit = window.socket.emit;
  window.unmute = () => { window.socket.emit = emit; };
  window.acts = 0;
  window.socket.emit = function (kind, ...rest) {
    if (kind !== "event") return emit.call(this, kind, ...rest);
    window.acts += 1;
  };
  window.addEventListener("click", () => { window.acts += 1; }, true);
}"""
"""What a control would tell the server is counted and not sent; the connection lives on, or the page loads again."""
TOLD = """() => {
  const e = document.activeElement;
  return [window.acts, e.getAttribute("aria-expanded"), e.value].join();
}"""


def show(page: "Page", name: str) -> None:
    """Show a page with everything unfolded, and wait until it is drawn."""
    page.get_by_role("link", name="Report" if name != "Report" else "Live", exact=True).click()
    page.locator("h1", has_text="Report" if name != "Report" else "Live").wait_for()
    page.get_by_role("link", name="Measurements" if name == "Import" else name, exact=True).click()
    if name == "Import":
        page.get_by_role("button", name="Import messung.csv").click()
        page.get_by_text("What it becomes").wait_for()
    page.locator("h1", has_text=name).wait_for()
    page.get_by_text("Ready.").wait_for()
    page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
    page.wait_for_function(DRAWN)


def faults(page: "Page", script: str, given: Any = None) -> list[str]:
    """What a check finds once the page has settled."""
    from playwright.sync_api import TimeoutError as NotInTime

    try:
        page.wait_for_function(f"(given) => !({script})(given).length", arg=given, polling=200, timeout=SETTLED_MS)
    except NotInTime:
        return list(page.evaluate(script, given)) or ["settled too late"]
    return []


@pytest.fixture(params=PAGES, scope="module")
def visited(request: pytest.FixtureRequest, whole: Watched) -> "Page":
    """A page, shown once for all tests of it."""
    show(whole.page, request.param)
    return whole.page


@pytest.fixture
def shown(visited: "Page") -> Iterator["Page"]:
    """The page, in light and at 1280 px, whatever a test does to the tab."""
    yield visited
    visited.emulate_media(color_scheme="light", reduced_motion="reduce")
    visited.set_viewport_size({"width": 1280, "height": 960})


@pytest.fixture
def muted(shown: "Page") -> Iterator["Page"]:
    """The page with its controls cut off from the server; the test after it loads the page again."""
    shown.evaluate(MUTED)
    yield shown
    shown.evaluate("window.unmute()")


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_every_text_has_contrast(shown: "Page", theme: Any) -> None:
    """Oracle: WCAG 1.4.3 and 1.4.11, from the colours of the page's own elements, plots included."""
    shown.emulate_media(color_scheme=theme)
    shown.wait_for_function("dark => document.body.classList.contains('body--dark') === dark", arg=theme == "dark")
    assert faults(shown, CONTRAST) == []


def test_the_theme_is_chosen_at_the_top(whole: Watched) -> None:
    """Oracle: the class that the styles go by, and the browser's own scheme of the page, for its bars and fields."""
    page = whole.page
    page.emulate_media(color_scheme="light")
    now = "[document.body.classList.contains('body--dark'), getComputedStyle(document.documentElement).colorScheme]"
    for theme, found in (("Dark", [True, "dark"]), ("Light", [False, "light"])):
        page.get_by_role("combobox", name="Theme").click()
        page.get_by_role("option", name=theme, exact=True).click()
        page.wait_for_function(f"(found) => ({now}).join() === found.join()", arg=found)
    page.get_by_role("combobox", name="Theme").click()
    page.get_by_role("option", name="Theme: as the system").click()
    page.wait_for_function(f"({now})[1] === 'light dark'")
    page.emulate_media(color_scheme="dark")
    page.wait_for_function(f"({now})[0]")
    page.emulate_media(color_scheme="light")
    page.wait_for_function(f"!({now})[0]")


def test_it_fits_a_tablet_and_screens(shown: "Page") -> None:
    """Oracle: the boxes of all controls: none beyond the window, over another, cut off, or too small for a finger."""
    beyond = "() => document.documentElement.scrollWidth > innerWidth ? ['reaches beyond the right edge'] : []"
    for width, height in WIDTHS:
        shown.set_viewport_size({"width": width, "height": height})
        assert (width, faults(shown, beyond)) == (width, [])
        assert (width, faults(shown, OVERLAPS, CONTROLS)) == (width, [])


def test_tab_reaches_every_control_and_keys_operate_it(muted: "Page") -> None:
    """Oracle: the list of the page's controls; a ring on each that has the focus; what it does or tells the server."""
    names: list[str] = muted.evaluate(NUMBERED, CONTROLS)
    reached: dict[int, str] = {}
    idle = []
    for _ in range(2 * len(names) + 10):
        if len(reached) == len(names):
            break
        muted.keyboard.press("Tab")
        focus = muted.evaluate(FOCUS)
        if focus is None or focus["n"] in reached:
            continue  # once around
        assert (focus["name"], focus["ring"], focus["inside"]) == (focus["name"], True, True)
        if focus["n"] < 0:
            continue  # a table that is too wide and can be moved by the arrow keys, no control
        reached[focus["n"]] = focus["name"]
        if focus["key"] and not _does(muted, focus["key"]):
            idle.append(focus["name"])
    assert [name for n, name in enumerate(names) if n not in reached] == []
    assert idle == []


def _does(page: "Page", key: str) -> bool:
    """Whether a key does something; what opened is closed again."""
    from playwright.sync_api import TimeoutError as NotInTime

    before = page.evaluate(TOLD)
    page.keyboard.press(key)
    try:
        page.wait_for_function(f"(before) => ({TOLD})() !== before", arg=before, timeout=SETTLED_MS)
    except NotInTime:
        return False
    if page.evaluate("document.activeElement?.getAttribute('aria-expanded')") == "true":
        page.keyboard.press("Escape")
        page.locator(".q-menu").wait_for(state="detached")
        page.wait_for_function("document.activeElement?.getAttribute('aria-expanded') === 'false'")
    elif page.evaluate("document.activeElement?.tagName") == "SUMMARY":
        page.keyboard.press(key)  # folded up, it would hide what is in it
    return True


def test_nothing_jumps_while_it_loads_its_data(shown: "Page") -> None:
    """Oracle: the layout-shift entries of the browser that no click caused, from the first moment of a load on."""
    heading = shown.locator("h1").inner_text()
    shown.reload()
    shown.locator("h1", has_text=heading).wait_for()
    shown.get_by_text("Ready.").wait_for()
    shown.wait_for_function(DRAWN)
    assert shown.evaluate("window.shifted") <= SHIFT


def test_nothing_jumps_while_it_compares_diagnoses_and_adds(whole: Watched) -> None:
    """Oracle: the same entries, of all that was done in the tab."""
    assert whole.jumped <= SHIFT


def test_nothing_comes_from_elsewhere_and_each_page_has_a_policy(whole: Watched, workshop: RunningStudio) -> None:
    """Oracle: the browser's log of requests and its console, where a breach of the policy would be said."""
    for name in ("measurements", "import", "compare", "diagnose", "add", "explore", "live", "report"):
        policy = whole.page.request.get(f"{workshop.origin}/{name}").headers["content-security-policy"]
        assert "default-src 'self'" in policy
        assert "://" not in policy
    there = [urlsplit(url) for url in whole.requests]
    assert {r.hostname for r in there if r.scheme not in ("data", "blob")} == {"127.0.0.1"}
    assert whole.complaints == []


BOX = "(e) => e.getBoundingClientRect().toJSON()"
WAITS = """(bar) => {
  bar.dataset.kept = bar.innerHTML;
  bar.innerHTML = "<b>Reading a long name.csv:</b><progress></progress><span>waiting for your answer</span>";
}"""


def test_a_narrow_window_cuts_nothing_and_lays_nothing_over_another(whole: Watched) -> None:
    """A telephone of 390 px. Oracle: the boxes: the field lies in its card, all words of the progress in its strip."""
    page = whole.page
    show(page, "Measurements")
    page.set_viewport_size({"width": 390, "height": 844})
    try:
        card = page.locator(".card", has=page.locator("h2", has_text="Machine")).first
        field = card.locator(".q-field").first
        page.wait_for_function("document.documentElement.scrollWidth <= 390")
        assert field.evaluate(BOX)["right"] <= card.evaluate(BOX)["right"]
        strip = page.locator(".progress")
        strip.evaluate(WAITS)
        within = strip.evaluate(BOX)
        for part in strip.locator("> *").all():
            box = part.evaluate(BOX)
            assert within["top"] <= box["top"]
            assert box["bottom"] <= within["bottom"]
        strip.evaluate("(bar) => { bar.innerHTML = bar.dataset.kept; }")
    finally:
        page.set_viewport_size({"width": 1280, "height": 960})


def test_on_a_telephone_the_bars_of_an_axis_stay_in_their_card(whole: Watched) -> None:
    """Oracle: the boxes: each number ends before its card does, and begins after its bar."""
    page = whole.page
    show(page, "Live")
    page.set_viewport_size({"width": 390, "height": 844})
    try:
        card = page.locator(".card", has=page.locator(".bar")).first
        page.wait_for_function("document.documentElement.scrollWidth <= 390")
        edge = card.evaluate(BOX)["right"]
        for bar in card.locator(".bar").all():
            track, value = bar.locator(".track").evaluate(BOX), bar.locator("b").evaluate(BOX)
            assert track["right"] <= value["left"]
            assert value["right"] <= edge
            assert track["right"] - track["left"] > 60.0
    finally:
        page.set_viewport_size({"width": 1280, "height": 960})


HIDDEN_CELLS = """() => [...document.querySelectorAll("table.stacks td")]
  .filter((e) => e.checkVisibility() && e.textContent)
  .filter((e) => { const r = e.getBoundingClientRect(); return r.left < 0 || r.right > innerWidth; })
  .map((e) => e.textContent)"""
COLUMN_BESIDE = """(column) => [...document.querySelectorAll("table.stacks td")]
  .some((e) => getComputedStyle(e, "::before").content === `"${column}"`)"""


@pytest.mark.parametrize(("name", "column"), [("Measurements", "Readings"), ("Live", "applied, µm")])
def test_on_a_telephone_no_cell_of_a_wide_table_is_out_of_sight(whole: Watched, name: str, column: str) -> None:
    """Oracle: the boxes of the cells, each with the name of its column beside it."""
    page = whole.page
    show(page, name)
    page.set_viewport_size({"width": 390, "height": 844})
    try:
        page.wait_for_function("document.documentElement.scrollWidth <= 390")
        page.locator(f"td[data-label='{column}']").first.wait_for()
        assert page.evaluate(HIDDEN_CELLS) == []
        page.wait_for_function(COLUMN_BESIDE, arg=column)  # Live rebuilds its tables
    finally:
        page.set_viewport_size({"width": 1280, "height": 960})


CUT_TITLES = """() => [...document.querySelectorAll(".chart")].flatMap((chart) => {
  const edge = chart.getBoundingClientRect();
  return [...chart.querySelectorAll(".xtitle, .x2title")].filter((e) => {
    const r = e.getBoundingClientRect();
    return r.left < edge.left - 1 || r.right > edge.right + 1;
  }).map((e) => e.textContent);
})"""


def test_on_a_telephone_titles_of_axes_are_whole(whole: Watched) -> None:
    """Oracle: the boxes of the titles and of their plots."""
    page = whole.page
    page.set_viewport_size({"width": 390, "height": 844})
    try:
        show(page, "Diagnose")
        page.wait_for_selector(".chart[data-drawn=yes]")
        assert page.evaluate(CUT_TITLES) == []
    finally:
        page.set_viewport_size({"width": 1280, "height": 960})


TEXTS_OVER_TEXTS = """(shows) => {
  const chart = document.querySelector(`.chart[aria-label^="${shows}"]`);
  const all = [...chart.querySelectorAll(".bartext, .annotation-text, .xtick text, .x2tick text, .xtitle, .x2title")]
    .map((e) => [e.textContent, e.getBoundingClientRect()]);
  const meet = ([, p], [, q]) => Math.min(p.right, q.right) - Math.max(p.left, q.left) > 1
    && Math.min(p.bottom, q.bottom) - Math.max(p.top, q.top) > 1;
  const pairs = all.flatMap((one, k) => all.slice(k + 1).filter((two) => meet(one, two))
    .map((two) => [one[0], two[0]]));
  const edge = chart.getBoundingClientRect();
  const out = all.filter(([, r]) => r.left < edge.left || r.right > edge.right).map(([text]) => text);
  return [all.length, pairs, out];
}"""


@pytest.mark.parametrize("width", [390, 1280])
def test_numbers_and_names_of_component_errors_lie_apart(whole: Watched, width: int) -> None:
    """Oracle: the boxes of all texts of the plot."""
    page = whole.page
    page.set_viewport_size({"width": width, "height": 960})
    try:
        show(page, "Explore")
        page.locator(".chart[aria-label='Component errors at this place'][data-drawn=yes]").wait_for()
        count, over, out = page.evaluate(TEXTS_OVER_TEXTS, "Component errors")
        assert count > 4
        assert (over, out) == ([], [])
    finally:
        page.set_viewport_size({"width": 1280, "height": 960})


def test_the_button_that_chooses_files_says_so_and_opens_the_dialog_once(whole: Watched) -> None:
    """Oracle: the accessible name; the browser's own event of a file dialog."""
    page = whole.page
    show(page, "Measurements")
    button = page.get_by_role("button", name="Choose files", exact=True)
    button.wait_for()
    assert page.get_by_role("button", name="add_box").count() == 0
    opened: list[object] = []
    note = lambda chooser: opened.append(chooser)  # noqa: E731, PLW0108 - playwright takes no method of a list
    page.on("filechooser", note)
    with page.expect_file_chooser():
        button.click()
    button.focus()
    with page.expect_file_chooser():
        page.keyboard.press("Enter")
    page.remove_listener("filechooser", note)
    assert len(opened) == 2


def test_a_report_fits_a_telephone(browser: "Browser") -> None:
    """Oracle: the width of the page; a wide table scrolls in its own box, which keys reach."""
    wide = Table([f"column number {k}" for k in range(9)], [["12345678.9"] * 9])
    page = browser.new_page(viewport={"width": 390, "height": 844})
    report = ReportPage("A title", "A lead", [("1.5\u00a0µm", "residual")], [Section("Table", [], wide)])
    page.set_content(render(report))
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    box = page.get_by_role("region", name="Table")
    assert box.evaluate("(e) => e.scrollWidth > e.clientWidth && e.tabIndex === 0")
    page.close()


@pytest.mark.parametrize("width", [390, 1280])
def test_the_buttons_of_a_plot_lie_above_its_legend(whole: Watched, width: int) -> None:
    """Oracle: the boxes of the buttons and of the words; and on a screen of 800 px half of the first plot is seen."""
    page = whole.page
    show(page, "Compare")
    page.set_viewport_size({"width": width, "height": 800})
    page.evaluate("window.scrollTo(0, 0)")
    try:
        if width > 1000:
            page.wait_for_function("document.querySelector('.plots > .card').getBoundingClientRect().top < 540")
        chart = page.locator(".chart").nth(1)
        page.wait_for_function(
            """() => {
              const chart = document.querySelectorAll(".chart")[1];
              const of = (name, side) => [...chart.querySelectorAll(name)].map((e) => e.getBoundingClientRect()[side]);
              return Math.max(...of(".modebar-btn", "bottom")) <= Math.min(...of(".legendtext", "top"));
            }"""
        )
        assert chart.locator(".legendtext").count() >= 2
    finally:
        page.set_viewport_size({"width": 1280, "height": 960})

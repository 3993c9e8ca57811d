"""The report shows what the pages show: the part in sight, marked readings, the camera, an import that is going on.

Oracles: the axes, the camera and the projection of the browser's own plots; the words on the pages; rtec's functions.
"""

import re
from base64 import b64encode
from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from rtec.machine import load_machine
from rtec.machine.links import link_places, room_mm
from rtec.model import load_model
from rtec.model.volume import component_errors
from rtec.report.figures import zoom_words
from rtec.report.machine_state import SIDES, MachineState
from rtec.report.machine_state_figures import HALF_VIEW_RAD, Camera, links, projection
from tests.studio.browser.test_pages import DRAWN
from tests.studio.studio_rig import MACHINE, RunningStudio, needs_browser, tab

if TYPE_CHECKING:
    from playwright.sync_api import Page

    from rtec.machine import Machine

pytestmark = [needs_browser, pytest.mark.xdist_group("others")]

ENDS = "(e) => Object.fromEntries(['x', 'y'].map((a) => [a, [...e._fullLayout[a + 'axis'].range]]))"
MARKED = "(e) => e._fullData.reduce((n, t) => n + (t.selectedpoints?.length ?? 0), 0)"
TOLD = """(e) => {
  window.told = "";
  e.on("plotly_relayout", (x) => { window.told += Object.keys(x).join(); });
}"""
"""When Plotly says what is in sight, which is later than it draws it."""
CAMERA = "(e) => { const { eye, center, up } = e.layout.scene.camera; return { eye, center, up }; }"
SEEN = """(e) => {
  const { model, view, projection } = e._fullLayout.scene._scene.glplot.cameraParams;
  const scale = e._fullLayout.scene._scene.dataScale;
  const box = e.querySelector("canvas").getBoundingClientRect();
  return { matrices: [model, view, projection].map((m) => [...m]), scale: [...scale], aspect: box.width / box.height };
}"""
"""The matrices with which WebGL draws, by columns, and the scale of its data."""
STILL = f"""async (e) => {{
  const now = () => JSON.stringify([({CAMERA})(e), ({SEEN})(e).matrices]), seen = now();
  for (let frame = 0; frame < 10; frame++) await new Promise(requestAnimationFrame);
  return now() === seen;
}}"""
"""Whether the view has come to rest: ten frames draw the same."""


@pytest.fixture(scope="module")
def page(browser: Any, workshop: RunningStudio) -> "Iterator[Page]":
    """A tab in which the residual of one laser is drawn."""
    address = f"{workshop.origin}/measurements?{workshop.address.partition('?')[2]}"
    made = tab(browser, address, 1280, 960).page
    made.get_by_label("use laser-a.csv").click()
    made.get_by_role("button", name="Compare the model with the measurements").click()
    made.get_by_role("button", name="Diagnose: which effect is missing?").wait_for()
    yield made
    made.context.close()


def _chart(page: "Page", shows: str) -> Any:
    made = page.locator(f'.chart[aria-label^="{shows}"][data-drawn=yes]').first
    made.wait_for()
    page.wait_for_function(DRAWN)
    return made


def _show(page: "Page", name: str) -> None:
    """Show a page; also that which is shown, which the server makes again."""
    page.evaluate("document.querySelector('h1').dataset.before = ''")
    page.get_by_role("link", name=name, exact=True).click()
    page.locator("h1:not([data-before])", has_text=name).wait_for()


def _drag(page: "Page", chart: Any, start: tuple[float, float], end: tuple[float, float]) -> None:
    """Drag from one place of a plot to another, in shares of its width and height."""
    chart.scroll_into_view_if_needed()
    box = chart.bounding_box()
    (x, y), (to_x, to_y) = ((box["x"] + a * box["width"], box["y"] + b * box["height"]) for a, b in (start, end))
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(to_x, to_y, steps=6)
    page.mouse.up()


def _report(page: "Page", of: str) -> str:
    page.get_by_role("button", name=f"Report of the page {of}").click()
    with page.expect_download() as download:
        page.get_by_role("button", name="HTML", exact=True).click()
    return Path(download.value.path()).read_text(encoding="utf-8")


def _zoom(page: "Page", chart: Any) -> dict[str, list[float]]:
    """Zoom into a part of a plot by the mouse; gives the part that is in sight then."""
    chart.hover()
    chart.locator(".modebar-btn[data-title=Zoom]").click()
    chart.locator(".modebar-btn.active[data-title=Zoom]").wait_for()
    chart.evaluate(TOLD)
    _drag(page, chart, (0.3, 0.4), (0.6, 0.6))
    page.wait_for_function("/axis.range/.test(window.told)")
    after: dict[str, list[float]] = chart.evaluate(ENDS)
    return after


def test_marked_readings_and_the_part_in_sight(page: "Page") -> None:
    """They are in the report in the words of the page, and still there when the page is shown again."""
    _show(page, "Compare")
    _drag(page, _chart(page, "The residual"), (0.3, 0.2), (0.6, 0.8))
    page.locator(".reading", has_text="readings marked").wait_for()
    words = page.locator(".reading").inner_text()
    ends = _zoom(page, _chart(page, "Measured and predicted"))
    html = _report(page, "Compare")
    assert html.count(f"<p>{words}</p>") == 3  # the residual, measured and predicted, and over time
    assert f"<p>{zoom_words({axis: (v[0], v[1]) for axis, v in ends.items()})}</p>" in html
    _show(page, "Compare")
    assert _chart(page, "Measured and predicted").evaluate(ENDS) == ends
    assert _chart(page, "The residual").evaluate(MARKED) == int(words.partition(" ")[0])
    assert page.locator(".reading").inner_text() == words


def test_another_channel_is_not_shown_within_the_ends_of_the_last_one(page: "Page") -> None:
    """Oracle: the temperatures, which are all in sight; a click twice shows the whole plot."""
    _show(page, "Compare")
    _zoom(page, _chart(page, "The residual"))
    page.get_by_label("Draw over").click()
    page.get_by_role("option", name="T_x_nut, °C").click()
    page.wait_for_function("document.querySelector('.chart').layout.xaxis.title.text.startsWith('T_x_nut')")
    low, high = _chart(page, "The residual").evaluate(ENDS)["x"]
    values = _chart(page, "The residual").evaluate("(e) => [...e.data[0].x]")
    assert low <= min(values) <= max(values) <= high
    assert "Zoomed in" not in _report(page, "Compare").partition("Measured and predicted over")[0]


def test_the_candidate_and_the_residual_after_it_are_cut_as_on_the_page(page: "Page") -> None:
    """On Diagnose and on Add and watch."""
    _show(page, "Diagnose")
    page.get_by_role("button", name="Find the missing effect").click()
    page.get_by_role("button", name="Test again").wait_for()
    ends = _zoom(page, _chart(page, "Residual and fitted effect"))
    assert zoom_words({axis: (v[0], v[1]) for axis, v in ends.items()}) in _report(page, "Diagnose")
    _show(page, "Diagnose")
    assert _chart(page, "Residual and fitted effect").evaluate(ENDS) == ends
    page.get_by_role("button", name="Add", exact=True).first.click()
    page.get_by_text("The error falling").wait_for()
    _drag(page, _chart(page, "The residual over position"), (0.3, 0.2), (0.6, 0.8))
    chart = _chart(page, "The residual over position")
    count = page.wait_for_function(f"(e) => ({MARKED})(e)", arg=chart.element_handle()).json_value()
    chart.evaluate("(e) => { const c = getElement(Number(e.id.slice(1))); return c.morph(c.options, 0); }")
    assert chart.evaluate(MARKED) == count  # a move that ends later leaves the marks
    ends = _zoom(page, _chart(page, "The residual over position"))
    html = _report(page, "Add and watch")
    assert f"<h2>The residual of laser-a</h2>\n<p>{count} readings marked: residual" in html
    assert zoom_words({axis: (v[0], v[1]) for axis, v in ends.items()}) in html
    _show(page, "Add and watch")
    chart = _chart(page, "The residual over position")
    chart.hover()
    chart.evaluate(TOLD)
    chart.locator(".modebar-btn[data-title='Reset axes']").click()
    page.wait_for_function(f"([e, x]) => ({ENDS})(e).x[0] !== x", arg=[chart.element_handle(), ends["x"][0]])
    page.wait_for_function("/axis.(auto)?range/.test(window.told)")
    assert "Zoomed in" not in _report(page, "Add and watch")
    _show(page, "Add and watch")


def test_an_expression_that_is_being_written(page: "Page") -> None:
    """Oracle: the page's own words."""
    _show(page, "Add and watch")
    page.get_by_text("An effect of your own").click()
    page.get_by_label("Expression, µm or µrad").fill("A*sin(2*pi*x/50)")
    words = page.get_by_text("of the mean square of the residual of all readings")
    words.wait_for()
    said = words.inner_text()
    html = _report(page, "Add and watch")
    assert "<h2>Not added yet: A*sin(2*pi*x/50)</h2>" in html
    assert f"<p>{escape(said)}</p>" in html
    _show(page, "Add and watch")
    page.get_by_label("Expression, µm or µrad").fill("")
    words.wait_for(state="hidden")
    page.get_by_text("Ready.").wait_for()
    assert "Not added yet" not in _report(page, "Add and watch")


def _camera(found: dict[str, dict[str, float]]) -> Camera:
    eye, centre, up = ((v["x"], v["y"], v["z"]) for v in (found["eye"], found["center"], found["up"]))
    return Camera(eye, centre, up)


def _picture(machine: "Machine", state: MachineState) -> str:
    errors = component_errors(state.switched, state.state)
    sides = {side: link_places(machine, errors, state.pose_mm, side) for side in SIDES}
    return b64encode(links(machine, sides, state.magnified, state.machine_from)).decode()


def test_the_machine_is_seen_from_the_same_place(page: "Page", workshop: RunningStudio) -> None:
    """Oracles: WebGL's own projection of the room's corners; the figure of the camera that the browser reports."""
    _show(page, "Measurements")
    page.get_by_label("use laser-b.csv").click()  # begins with the model as its file has it
    page.locator("header", has_text="2 measurements").wait_for()
    _show(page, "Explore")
    chart = _chart(page, "The machine's links")
    chart.evaluate(TOLD)
    _drag(page, chart, (0.5, 0.5), (0.65, 0.35))
    page.wait_for_function(f"(e) => ({CAMERA})(e).eye.x !== 1.4", arg=chart.element_handle())
    page.wait_for_function("/scene.camera/.test(window.told)")
    page.wait_for_function(STILL, arg=chart.element_handle())
    camera, seen = _camera(chart.evaluate(CAMERA)), chart.evaluate(SEEN)
    machine = load_machine(MACHINE)
    room = room_mm(machine)
    corners = np.array([[x, y, z, 1.0] for x in room[0] for y in room[1] for z in room[2]])
    model, view, lens = (np.reshape(m, (4, 4), order="F") for m in seen["matrices"])
    scaled = corners * [*seen["scale"], 1.0]
    there = (lens @ view @ model @ scaled.T).T
    here = (projection(room, camera) @ corners.T).T
    half = np.tan(HALF_VIEW_RAD)
    assert there[:, 1] / there[:, 3] == pytest.approx(here[:, 1] / here[:, 3] / half, abs=1e-3)
    assert there[:, 0] / there[:, 3] * seen["aspect"] == pytest.approx(here[:, 0] / here[:, 3] / half, abs=1e-2)

    drawn = "(e) => [...e.data[1].x, ...e.data[1].z].join()"
    before = chart.evaluate(drawn)
    page.get_by_label("magnified, times, number").fill("2000")
    page.get_by_label("magnified, times, number").press("Enter")
    page.wait_for_function(f"([e, before]) => ({drawn})(e) !== before", arg=[chart.element_handle(), before])
    html = _report(page, "Explore")
    _show(page, "Explore")
    assert _camera(_chart(page, "The machine's links").evaluate(CAMERA)) == camera
    fitted = load_model(workshop.folder / "model.toml", machine)
    at = {a.name: 0.5 * sum(a.travel_mm) for a in machine.axes} | {f"dir_{a.name}": 1.0 for a in machine.axes}
    state = MachineState(fitted, at, magnified=2000.0, machine_from=camera)
    assert _picture(machine, state) in html
    assert _picture(machine, MachineState(fitted, at, magnified=2000.0)) not in html


def test_an_import_that_is_going_on(page: "Page") -> None:
    """Columns, units and signs as they are chosen on the page, and the readings that they make."""
    _show(page, "Measurements")
    page.get_by_role("button", name="Import messung.csv").click()
    page.get_by_text("What it becomes: 162 readings").wait_for()
    last = "(e) => e?.data?.[0]?.y.at(-1)"
    before = _chart(page, "The readings").evaluate(last)
    page.get_by_label("sign of Abweichung").get_by_role("button", name="−").click()
    page.wait_for_function(f"y => ({last})(document.querySelector('.chart')) === -y", arg=before)
    page.get_by_text("Ready.").wait_for()
    cells = r"Abweichung \[um\]</td>" + r"<td[^>]*>[^<]*</td>" + r"<td[^>]*>reading_um</td><td[^>]*>um[^<]*</td>"
    html = _report(page, "Import")
    assert re.search(cells + r"<td[^>]*>−</td>", html)
    assert "What it becomes: 162 readings" in html
    assert "messung.csv is not imported yet" in html
    assert html.count("data:image/png;base64,") == 1


BREAKS = """() => ['.card', 'table.plain', 'table.plain tr']
  .map((s) => getComputedStyle(document.querySelector(s)).breakInside)
  .concat(getComputedStyle(document.querySelector('thead')).display)"""


def test_no_row_and_no_small_table_of_live_is_cut_on_paper(page: "Page") -> None:
    """Oracle: the rules with which Chromium lays the paper out."""
    _show(page, "Live")
    page.get_by_text("Inputs and their ages").wait_for()
    page.emulate_media(media="print")
    assert page.evaluate(BREAKS) == ["avoid"] * 3 + ["table-header-group"]
    assert page.locator("nav.side").is_hidden()
    page.emulate_media(media="screen")

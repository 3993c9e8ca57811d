"""What a person does in the plots and with the sliders. Oracle: the public API of rtec on the same files."""

import json
import os
import re
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import rtec
from rtec.cli.main import status
from rtec.diagnosis.search.picture import series_name
from rtec.model.history import steps_of
from rtec.wording import number
from tests.studio.browser.test_pages import show
from tests.studio.studio_rig import ROOT, WAIT_MS, RunningStudio, Watched, needs_browser, running_studio, tab

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, WebSocketRoute

    from rtec.diagnosis.compare.result import Comparison
    from rtec.model import Model

pytestmark = [needs_browser, pytest.mark.xdist_group("others")]

MILL = ROOT / "configs" / "machines" / "vertical-mill.toml"
CIRCLE = ("plane=XY", "centre_mm=[250,200,300]", "radius_mm=100", "direction=ccw", "feed_mm_min=1000")
MOST_LOOKS = 200
PLACE = """([chart, trace, k]) => {
  const plot = document.querySelectorAll(".chart")[chart], t = plot.data[trace], l = plot._fullLayout;
  const box = plot.querySelector(".nsewdrag").getBoundingClientRect();
  return { x: box.left + l.xaxis.l2p(t.x[k]), y: box.top + l.yaxis.l2p(t.y[k]), value: t.y[k],
    left: box.left, right: box.right, top: box.top, bottom: box.bottom };
}"""
POINTS = (
    "(chart) => document.querySelectorAll('.chart')[chart].data.flatMap((t, i) => (t.ids ?? []).map((_, k) => [i, k]))"
)
LATE = "([id, value]) => getElement(Number(id.slice(1))).$emit('update:model-value', value)"
"""What a slider reports once its pause of 0.15 s is over."""
MIDDLE = "(e) => { const r = e.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; }"
MARKED = """(chart) => document.querySelectorAll(".chart")[chart].data.filter((t) => t.ids && t.selectedpoints)
  .flatMap((t) => t.selectedpoints.map((k) => Number(t.ids[k]))).sort((a, b) => a - b)"""
WATCH = """() => {
  window.seen = [];
  const look = () => {
    const c = document.querySelector(".chart[data-moved]");
    if (c?.data?.[0]) window.seen.push([c.dataset.moved, c.data[0].y[0]]);
    requestAnimationFrame(look);
  };
  look();
}"""
STILL = "selected => [...document.querySelectorAll('.chart')].every((c) => c.dataset.drawn === 'yes')"


def figure(page: "Page", title: str) -> dict[str, Any]:
    """Data and layout of a plot as it is on the screen."""
    plot = page.locator(f".chart[aria-label^={json.dumps(title)}]").first
    page.wait_for_function("(e) => e.data?.length", arg=plot.element_handle())  # a text beside it may be there first
    found: dict[str, Any] = json.loads(
        plot.evaluate(
            "(e) => JSON.stringify({ data: e.data, layout: e.layout }, (k, v) => ArrayBuffer.isView(v) ? [...v] : v)"
        )
    )
    return found


@pytest.fixture
def page(whole: Watched) -> "Page":
    """The tab in which every page has something to show; `show` builds the page of a test anew."""
    return whole.page


@pytest.fixture(scope="module")
def better(workshop: RunningStudio) -> "tuple[Model, Comparison]":
    """The step that the tab shows, by the public API: the model with the effect that was added."""
    folder = workshop.folder
    files = [folder / "laser-a.csv", folder / "laser-b.csv"]
    model = rtec.load_model(folder / "model.toml", folder / "turning-centre.toml")
    added = rtec.add(model, files, "backlash", component="EXX", arguments={"axis": "X"})
    return added.model, rtec.compare(added.model, files)


@pytest.fixture
def compared(better: "tuple[Model, Comparison]") -> "Comparison":
    """The residual of that step."""
    return better[1]


def test_what_is_pointed_at_is_shown_with_its_row(page: "Page", compared: "Comparison") -> None:
    """Oracle: measured, predicted and residual of that reading in `rtec.compare`."""
    show(page, "Compare")
    place = page.evaluate(PLACE, [0, 0, 7])
    page.mouse.move(place["left"], place["top"] - 30)
    page.mouse.move(place["x"], place["y"])
    words = page.locator(".reading", has_text=re.compile(r", row \d"))
    words.wait_for()
    said = words.inner_text()
    match = re.match(r"(laser-\w), row (\d+),", said)
    assert match, said
    traces = compared.traces
    series = {series_name(traces.readings, s): s for s in traces.readings.series}[match[1]]
    i = series.start + int(np.flatnonzero(series.row == int(match[2]) - 1)[0])
    for name, values in (("measured", traces.measured), ("predicted", traces.predicted), ("residual", traces.left)):
        assert f"{name} {rtec_number(values[i])}" in said
    assert traces.left[i] == pytest.approx(place["value"], abs=0.5)


def test_arrow_keys_walk_along_the_readings(page: "Page", compared: "Comparison") -> None:
    """From left to right, those at one place from the lowest up. Oracle: positions and residuals of `rtec.compare`."""
    show(page, "Compare")
    chart = page.locator(".chart[aria-label='The residual']")
    chart.focus()
    series = {series_name(compared.traces.readings, s): s for s in compared.traces.readings.series}
    words = page.locator(".reading[aria-live=polite]")

    def says(key: str) -> tuple[str, int]:
        before = words.inner_text()
        page.keyboard.press(key)
        page.wait_for_function("(t) => document.querySelector('.reading').innerText !== t", arg=before)
        match = re.match(r"(laser-\w), row (\d+),", words.inner_text())
        assert match, words.inner_text()
        return match[1], int(match[2])

    name, first = says("Home")
    s = series[name]
    x = compared.traces.readings.states[s.source].value("x")[s.row]
    order = s.row[np.lexsort((compared.traces.left[s.part], x))] + 1
    assert first == order[0]
    assert [says(key) for key in ("ArrowRight", "ArrowRight", "End", "ArrowLeft")] == [
        (name, int(order[k])) for k in (1, 2, -1, -2)
    ]
    ring = page.locator(".ring").evaluate(MIDDLE)
    places = [page.evaluate(PLACE, [0, t, k]) for t, k in page.evaluate(POINTS, 0)]
    assert min(np.hypot(p["x"] - ring[0], p["y"] - ring[1]) for p in places) < 1.0


def rtec_number(value: float) -> str:
    """As the pages write it."""
    return number(float(value))


def test_a_brush_marks_in_every_plot_and_stays(page: "Page", compared: "Comparison") -> None:
    """Oracle: the readings in the box, and their root mean square, from `rtec.compare`; over time they stay marked."""
    show(page, "Compare")
    box = page.evaluate(PLACE, [0, 0, 0])
    page.mouse.move(box["left"] + 5, box["top"] + 5)
    page.mouse.down()
    page.mouse.move(0.5 * (box["left"] + box["right"]), box["bottom"] - 5, steps=4)
    page.mouse.up()
    words = page.locator(".reading", has_text="marked")
    words.wait_for()
    page.wait_for_function(f"[0, 1, 2].every((k) => ({MARKED})(k).length > 0)")
    marked = page.evaluate(MARKED, 0)
    assert page.evaluate(MARKED, 1) == page.evaluate(MARKED, 2) == marked
    left = compared.traces.left[marked]
    assert f"{len(marked)} readings marked" in words.inner_text()
    assert f"residual {rtec_number(np.sqrt(np.mean(left**2)))} µm root mean square" in words.inner_text()
    page.get_by_label("Draw over").click()
    page.get_by_role("option", name="time since the first reading, h").click()
    page.wait_for_function("document.querySelector('.chart').layout.xaxis.title.text.startsWith('time')")
    page.wait_for_function(f"(marked) => ({MARKED})(0).join() === marked.join()", arg=marked)


def test_many_readings_are_drawn_as_fine_as_the_screen(browser: "Browser", mill: tuple[Path, RunningStudio]) -> None:
    """Oracle: the canvas of WebGL has a dot of its own for each of the screen, and no more, which would be slow."""
    page = tab(browser, mill[1].address).page
    page.get_by_label("use bar.csv").click()
    page.get_by_role("button", name="Compare the model with the measurements").click()
    page.wait_for_selector(".chart[data-drawn=yes] canvas.gl-canvas-focus")
    dots, wide = page.locator(".chart canvas.gl-canvas-focus").first.evaluate(
        "(e) => [e.width, e.getBoundingClientRect().width * window.devicePixelRatio]"
    )
    page.context.close()
    assert dots == pytest.approx(wide, abs=1)


def test_own_expression_shows_its_curve_and_its_sliders_move_it(page: "Page") -> None:
    """Oracle: a number in German is the same number; the curve is another at another parameter."""
    show(page, "Add and watch")
    page.get_by_label("Expression, µm or µrad").fill("A*sin(2*pi*x/p)")
    page.get_by_label("Parameters with a range").fill("p=37,5:3..200")
    slider = page.get_by_role("slider", name="parameter p")
    slider.wait_for()
    page.get_by_text("p = 37.5").wait_for()
    preview = "Residual and the expression"
    page.get_by_text("of the mean square of the residual").wait_for()
    before = figure(page, preview)["data"][-1]["y"]
    slider.locator("[tabindex='0']").focus()
    page.keyboard.press("PageUp")
    page.get_by_text("p = 37.5").wait_for(state="detached")
    chart = page.locator(f".chart[aria-label='{preview}']")
    page.wait_for_function(
        "([e, y]) => [...e.data.at(-1).y].join() !== y", arg=[chart.element_handle(), ",".join(map(str, before))]
    )
    page.get_by_label("Parameters with a range").fill("p=1:2")
    page.get_by_text("write a parameter as NAME=START:LOW..HIGH").wait_for()
    of_before = page.get_by_text("of the mean square of the residual")
    of_before.wait_for(state="detached")
    page.wait_for_function("(e) => e.data.length === 0", arg=chart.element_handle())
    page.get_by_label("Parameters with a range").fill("p=37,5:3..200")
    of_before.wait_for()
    page.get_by_label("Expression, µm or µrad").fill("A*sin(2*pi*x/p +")
    of_before.wait_for(state="detached")
    page.wait_for_function("(e) => e.data.length === 0", arg=chart.element_handle())
    for field in ("Expression, µm or µrad", "Parameters with a range"):
        page.get_by_label(field).fill("")


def test_the_staircase_falls_on_a_log_axis_to_the_noise_floor(page: "Page", better: "tuple[Model, Comparison]") -> None:
    """Oracle: the history of the model that `rtec.add` gives."""
    show(page, "Add and watch")
    last = steps_of(better[0])[-1]
    shown = figure(page, "The residual on held-out runs after each step")
    assert shown["layout"]["yaxis"]["type"] == "log"
    stairs, floor = shown["data"]
    assert stairs["y"][-1] == pytest.approx(last["error"])
    assert stairs["y"][-2] == pytest.approx(last["before"], rel=0.05)
    assert floor["y"][0] < stairs["y"][-1] < 0.5 * stairs["y"][-2]


def test_explore_moves_vector_and_bars_as_the_model_says(page: "Page", better: "tuple[Model, Comparison]") -> None:
    """Oracle: `Model.predict` at the position typed in German, with and without an effect; 1234 times magnified.

    A slider that reports late, while a number is typed, does not take it away.
    """
    show(page, "Explore")
    model, _ = better
    at = {"X": 12.5, "Z": 200.0, "dir_X": 1.0, "dir_Z": 1.0, "T_x_nut": 20.0}

    def says(m: Any, state: dict[str, float]) -> None:
        error = m.predict({k: v for k, v in state.items() if k in ("X", "Z", "dir_X", "dir_Z")})
        page.get_by_text(f"off by X {float(error[0]):+.2f},").wait_for()
        sides = figure(page, "The machine's links")["data"]
        ends = {t["name"]: np.array([t[c][-1] for c in "xyz"], dtype=float) for t in sides if t["name"] != "nominal"}
        still = [np.array([t[c][-1] for c in "xyz"], dtype=float) for t in sides if t["name"] == "nominal"]
        shift = ends["tool side, with its errors"] - ends["work side, with its errors"] - (still[0] - still[1])
        assert shift == pytest.approx(error * 1e-3 * 1234.0, abs=0.02)
        bars = figure(page, "Component errors at this place")["data"]
        total = sum(abs(v) for trace in bars for v in trace["x"])
        assert (total > 0.0) == (len(m.effects) > 0)

    page.get_by_label("magnified, times, number").fill("1.234,0")  # it is then shown with two digits
    page.get_by_label("magnified, times, number").press("Enter")
    field = page.get_by_label("X, mm, number")
    field.fill("12,5")
    field.press("Enter")
    says(model, at)
    slider = page.get_by_role("slider", name="X, mm", exact=True).get_attribute("id")
    field.fill("17")
    page.evaluate(LATE, [slider, 150.0])
    says(model, at | {"X": 150.0})
    assert field.input_value() == "17"
    field.press("Enter")
    says(model, at | {"X": 17.0})
    field.fill("12,5")
    field.press("Tab")
    says(model, at)
    page.get_by_label("direction of X").get_by_role("button", name="−").click()
    says(model, at | {"dir_X": -1.0})
    play = next(f for f in model.effects if "backlash" in f.label)
    page.get_by_label(f"Backlash, reversal value: {play.label}").click()
    says(replace(model, effects=tuple(f for f in model.effects if f is not play)), at | {"dir_X": -1.0})


def test_the_server_loads_no_client_and_no_other_server(workshop: RunningStudio) -> None:
    """A third of its start. Oracle: the libraries that are mapped into the process."""
    maps = Path(f"/proc/{workshop.process.pid}/maps").read_text(encoding="utf-8")
    assert "pydantic_core" in maps
    assert "aiohttp" not in maps


def children(pid: int) -> list[int]:
    """Processes that a process began."""
    texts = [path.read_text(encoding="ascii") for path in Path(f"/proc/{pid}/task").glob("*/children")]
    return [int(word) for text in texts for word in text.split()]


def test_a_running_diagnosis_can_be_cancelled_and_the_page_answers_meanwhile(
    page: "Page", workshop: RunningStudio
) -> None:
    """Its process is stopped, so that it runs for ever. Oracle: the sentence, and another page that opens meanwhile."""
    show(page, "Diagnose")
    before = page.locator(".card h2").first.inner_text()
    page.get_by_role("button", name="Test again").click()
    page.get_by_role("button", name="Cancel").wait_for()
    workers: list[int] = []
    for _ in range(MOST_LOOKS):
        if workers:
            break
        page.wait_for_timeout(20)
        workers = [pid for server in children(workshop.process.pid) for pid in children(server)]
    assert workers
    for pid in workers:
        os.kill(pid, signal.SIGSTOP)
    page.get_by_role("link", name="Compare").click()
    page.locator("h1", has_text="Compare").wait_for()
    page.get_by_role("link", name="Diagnose").click()
    page.locator("h1", has_text="Diagnose").wait_for()
    page.get_by_role("button", name="Cancel").click()
    page.get_by_text("Diagnosis: cancelled; nothing was changed.").wait_for()
    page.get_by_text("Ready.").wait_for()
    assert page.locator(".card h2").first.inner_text() in (before, "Diagnosis: cancelled; nothing was changed.")


def list_before_its_readings(browser: "Browser", workshop: RunningStudio) -> "tuple[Page, Callable[[], None]]":
    """A tab that holds back what the server has read, and what sends it on. Tries again where both come at once."""
    page, held, ends = browser.new_context().new_page(), list[str | bytes](), list["WebSocketRoute"]()
    read, released = threading.Event(), threading.Event()

    def between(page_end: "WebSocketRoute") -> None:
        server = page_end.connect_to_server()

        def hold(message: str | bytes) -> None:
            text = message.encode() if isinstance(message, str) else message
            first = b'"text":"162"' in text and b"Import messung.csv" not in text
            if not released.is_set() and (read.is_set() or first):
                read.set()
                held.append(message)
            else:
                page_end.send(message)

        server.on_message(hold)
        ends.append(page_end)

    def send() -> None:
        while held:  # in order: others may come meanwhile
            ends[-1].send(held.pop(0))
        released.set()

    page.route_web_socket(re.compile("socket.io"), between)
    page.set_default_timeout(WAIT_MS)
    page.goto(f"{workshop.origin}/measurements?{workshop.address.partition('?')[2]}")
    page.get_by_role("button", name="Import messung.csv").wait_for()
    for _ in range(MOST_LOOKS):
        if read.is_set():
            return page, send
        if page.get_by_role("cell", name="162").count():
            break
        page.wait_for_timeout(20)
    page.context.close()
    return list_before_its_readings(browser, workshop)


def test_a_click_while_the_list_is_read_is_not_lost(browser: "Browser", workshop: RunningStudio) -> None:
    """The page knows nothing yet of what the server has read when the clicks are made. Oracle: what they are for."""
    page, send = list_before_its_readings(browser, workshop)
    page.get_by_label("use laser-a.csv").click()
    page.get_by_role("button", name="Import messung.csv").click()
    send()
    page.locator("h1", has_text="Import messung.csv").wait_for()
    page.locator("header", has_text="1 measurement").wait_for()
    page.context.close()


def test_an_addition_moves_the_residual_from_before_to_after(browser: "Browser", workshop: RunningStudio) -> None:
    """Oracle: a reading on the screen, frame by frame: never outside of where it began and where it ends."""
    page = tab(browser, f"{workshop.origin}/measurements?{workshop.address.partition('?')[2]}").page
    page.emulate_media(reduced_motion="no-preference")
    for name in ("laser-a", "laser-b"):
        page.get_by_label(f"use {name}.csv").click()
    page.get_by_role("link", name="Add and watch").click()
    page.get_by_text("An effect of your own").click()
    page.get_by_label("Expression, µm or µrad").fill("B*d_x")
    page.evaluate(WATCH)
    page.get_by_role("button", name="Add this effect").click()
    page.wait_for_function("window.seen.some(([moved]) => moved === 'no')")
    page.wait_for_function("window.seen.at(-1)[0] === 'yes' && window.seen.some(([moved]) => moved === 'no')")
    seen = page.evaluate("window.seen.map(([, y]) => y)")
    page.wait_for_function("document.querySelectorAll('.chart[data-moved=yes]').length === 2")  # of both measurements
    page.context.close()
    assert abs(seen[-1]) < abs(seen[0])
    assert min(seen) >= min(seen[0], seen[-1]) - 1e-6
    assert max(seen) <= max(seen[0], seen[-1]) + 1e-6


HOLD = """() => {
  const later = window.setTimeout;
  window.held = [];
  window.setTimeout = (f, ms, ...more) =>
    window.held && /chart/.test(new Error().stack) ? window.held.push(f) : later(f, ms, ...more);
}"""
RELEASE = "() => { const held = window.held; window.held = null; held.forEach((f) => f()); }"


def test_a_plot_that_is_told_to_move_before_it_is_drawn_moves(browser: "Browser", workshop: RunningStudio) -> None:
    """As on a slow PC. Oracle: the order; plots wait between one and the next until the server has sent the move."""
    page = tab(browser, f"{workshop.origin}/measurements?{workshop.address.partition('?')[2]}").page
    page.emulate_media(reduced_motion="no-preference")
    for name in ("laser-a", "laser-b"):
        page.get_by_label(f"use {name}.csv").click()
    with page.expect_websocket() as socket:
        page.reload()
    page.get_by_role("link", name="Add and watch").click()
    page.get_by_text("An effect of your own").click()
    page.get_by_label("Expression, µm or µrad").fill("B*d_x")
    page.evaluate(HOLD)
    with socket.value.expect_event("framereceived", lambda frame: "morph" in str(frame)):
        page.get_by_role("button", name="Add this effect").click()
    page.evaluate(RELEASE)
    page.wait_for_selector(".chart[data-drawn=yes][data-moved=yes]")
    page.context.close()


@pytest.fixture(scope="module")
def mill(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, RunningStudio]]:
    """A ball bar of a mill with a worn screw, and a model without that."""
    folder = tmp_path_factory.mktemp("mill")
    shutil.copy(MILL, folder)
    given = [word for key in CIRCLE for word in ("--set", key)]
    made = ["simulate", str(MILL), "-i", "ball_bar", *given, "--effect", "backlash,component=EXX,axis=X,B=4"]
    assert status([*made, "--cycles", "1", "--seed", "1", "-o", str(folder / "bar")]) == 0
    fitted = ["fit", str(folder / MILL.name), str(folder / "bar.csv"), "--effects", "scale"]
    assert status([*fitted, "-o", str(folder / "m.toml")]) == 0
    with running_studio(folder) as studio:
        yield folder, studio


def test_a_ball_bar_is_drawn_around_its_circle_and_as_a_map(
    browser: "Browser", mill: tuple[Path, RunningStudio]
) -> None:
    """Oracle: `rtec.compare`: the measured reading at each angle; the mean residual in the cell of the largest one."""
    folder, studio = mill
    page = tab(browser, studio.address).page
    page.get_by_label("use bar.csv").click()
    page.get_by_role("button", name="Compare the model with the measurements").click()
    page.wait_for_selector(".chart[data-drawn=yes]")
    page.wait_for_function(STILL)
    known = rtec.compare(rtec.load_model(folder / "m.toml", folder / MILL.name), [folder / "bar.csv"]).traces
    round_ = figure(page, "Deviation from the circle")["data"][0]
    ids = [int(i) for i in round_["ids"]]
    ring = np.array(round_["r"]) - known.measured[ids]
    assert np.ptp(ring) < 1e-3 * float(ring.mean())
    (cells,) = figure(page, "The residual over two positions")["data"]
    (series,) = known.readings.series
    state = known.readings.states[0]
    x, y = state.value("x")[series.row], state.value("y")[series.row]
    wide = [np.diff(cells[k])[0] for k in "xy"]
    z = np.array(cells["z"], dtype=float)
    i, j = np.unravel_index(np.nanargmax(np.abs(z)), z.shape)
    inside = (np.abs(x - cells["x"][j]) <= 0.5 * wide[0]) & (np.abs(y - cells["y"][i]) <= 0.5 * wide[1])
    assert z[i, j] == pytest.approx(float(known.left[inside].mean()), rel=0.05)

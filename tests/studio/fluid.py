"""How fluid the pages are: `python -m tests.studio.fluid` times the start, 100 000 readings, a diagnosis.

They mean something on a quiet computer only.
"""

import os
import re
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from rtec.cli.main import status
from rtec.loop.clock import RealClock
from tests.studio.studio_rig import MACHINE, ROOT, RunningStudio, chromium, running_studio, simulated, tab

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

MILL = ROOT / "configs" / "machines" / "vertical-mill.toml"
CIRCLE = ("plane=XY", "centre_mm=[250,200,300]", "radius_mm=100", "direction=ccw", "feed_mm_min=1000")
STARTS = 7
CYCLES = 70
"""Of 1441 readings each."""
LARGE = 200 << 20
SETTLED_NS = 2_000_000_000
"""Chromium loads some 400 files of its own for the address field of a new window, in its own processes."""
DRAWN = "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
MOVES = 120
FRAMES = """() => {
  window.frames_ms = []; let last = performance.now();
  const next = (now) => { window.frames_ms.push(now - last); last = now; requestAnimationFrame(next); };
  requestAnimationFrame(next);
}"""
CLICK = """(() => {
  const look = () => {
    const link = document.querySelector('.side a[href="/live"]');
    if (link && !window.clicked) { window.clicked = true; link.click(); }
    if (document.querySelector("h1")?.textContent !== "Live") requestAnimationFrame(look);
    else requestAnimationFrame(() => requestAnimationFrame(() => { window.reacted = true; }));
  };
  look();
})()"""
"""Clicks the link to a page as soon as it is there, and waits until that page's heading is drawn."""
BARE = """
import sys
from nicegui import ui

@ui.page("/")
def page():
    with ui.element("h1"):
        heading = ui.label("Bare")
    with ui.element("nav").classes("side"):
        with ui.element("a").props('href="/live"').on("click.prevent", lambda: heading.set_text("Live")):
            ui.label("Live")

ui.run(host="127.0.0.1", port=int(sys.argv[1]), show=False, reload=False)
"""
"""NiceGUI's own start with the least page that the same click can be tried on."""
BEATS = """() => {
  window.beats_ms = []; window.beating = true;
  const beat = async () => { while (window.beating) { const began = performance.now();
    await (await fetch("/favicon.ico", { cache: "no-store" })).arrayBuffer();
    window.beats_ms.push(performance.now() - began);
    await new Promise((done) => setTimeout(done, 20)); } };
  beat();
}"""
"""The server's event loop is asked again and again."""
POINTS = (
    "[...document.querySelectorAll('.chart')].map((c) => c.data.reduce((n, t) => n + (t.x ?? t.r ?? []).length, 0))"
)


def say(words: str) -> None:
    """One line, at once."""
    sys.stdout.write(f"{words}\n")
    sys.stdout.flush()


def spread(values: list[float]) -> str:
    """Median, 95 %, largest."""
    median, most, largest = (float(np.quantile(values, q)) for q in (0.5, 0.95, 1.0))
    return f"median {median:.0f} ms, 95 % {most:.0f} ms, largest {largest:.0f} ms"


def memory_mb(pid: int) -> float:
    """Memory of a process that no other shares."""
    text = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii")
    return sum(int(line.split()[1]) for line in text.splitlines() if line.startswith("Private")) / 1024


def start(browser: "Browser", folder: Path) -> None:
    """From starting the process until a control that is clicked reacts and that is drawn; then the same of a page of a
    server that is up; both beside NiceGUI with one heading and one link, in turn.

    The browser is open already, as a user's is, with an empty tab that has loaded nothing before. The page itself
    clicks, in the first frame that has the control: Playwright would look for it every half second only. Of each time
    the least of several starts is shown: others use this computer too.
    """
    names = ("address", "answer begun", "page shown", "a control reacts")
    times: dict[tuple[str, str], list[list[float]]] = {}
    for _ in range(STARTS):
        for what, serving in (("rtec studio", running_studio), ("bare NiceGUI", bare)):
            with empty_tab(browser) as page:
                began = RealClock().now_ns()
                with serving(folder) as studio:
                    cold = [since_s(began), *reacted(page, studio.address, began)]
                    times.setdefault((what, "start of the process"), []).append(cold)
                    for _ in range(2):
                        with empty_tab(browser) as later:
                            warm = [0.0, *reacted(later, studio.address, RealClock().now_ns())]
                        times.setdefault((what, "page of a server that is up"), []).append(warm)
    for (what, part), each in times.items():
        least, median = np.min(each, axis=0), np.median(each, axis=0)
        said = ", ".join(f"{name} {s:.2f} s" for name, s in zip(names, least, strict=True) if s)
        ratio = least[-1] / np.min(times["bare NiceGUI", part], axis=0)[-1]
        say(f"{what}, {part}, least of {len(each)}: {said} ({ratio:.2f} of bare); its median {median[-1]:.2f} s")


@contextmanager
def bare(folder: Path) -> Iterator[RunningStudio]:
    """A server of `BARE` on a free port, once it answers."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    process = subprocess.Popen(
        [sys.executable, "-c", BARE, str(port)], cwd=folder, stdout=subprocess.DEVNULL, text=True
    )
    try:
        while True:
            with socket.socket() as asked:
                if asked.connect_ex(("127.0.0.1", port)) == 0:
                    break
            RealClock().sleep_until_ns(RealClock().now_ns() + 5_000_000)
        yield RunningStudio(folder, f"http://127.0.0.1:{port}/", process)
    finally:
        process.terminate()
        process.wait(20)


def since_s(began_ns: int) -> float:
    """Seconds since then."""
    return 1e-9 * (RealClock().now_ns() - began_ns)


@contextmanager
def empty_tab(browser: "Browser") -> Iterator["Page"]:
    """A window with an empty tab, once the browser has loaded what it shows around the page itself."""
    page = browser.new_context(viewport={"width": 1440, "height": 1000}).new_page()
    page.add_init_script(CLICK)
    RealClock().sleep_until_ns(RealClock().now_ns() + SETTLED_NS)
    try:
        yield page
    finally:
        page.context.close()


def reacted(page: "Page", address: str, began_ns: int) -> list[float]:
    """When the answer began, the page was shown, and a control of it reacted, in seconds."""
    page.goto(address, wait_until="commit")
    times = [since_s(began_ns)]
    for what in ("window.clicked", "window.reacted"):
        page.wait_for_function(what)
        times.append(since_s(began_ns))
    return times


def many(folder: Path) -> None:
    """A hundred thousand readings of a ball bar, and a model."""
    (folder / MILL.name).write_bytes(MILL.read_bytes())
    given = [word for key in CIRCLE for word in ("--set", key)]
    made = ["simulate", str(MILL), "-i", "ball_bar", *given, "--effect", "backlash,component=EXX,axis=X,B=4"]
    assert status([*made, "--cycles", str(CYCLES), "--seed", "1", "-o", str(folder / "bar")]) == 0
    short = folder / "short"
    assert status([*made, "--cycles", "1", "--seed", "1", "-o", str(short)]) == 0
    fitted = ["fit", str(folder / MILL.name), str(short.with_suffix(".csv")), "--effects", "scale"]
    assert status([*fitted, "-o", str(folder / "m.toml")]) == 0


def opened(browser: "Browser", studio: RunningStudio) -> "Page":
    """Compare with all readings; says how long the first plot took."""
    page = tab(browser, studio.address).page
    page.get_by_label("use bar.csv").click()
    began = RealClock().now_ns()
    page.get_by_role("button", name="Compare the model with the measurements").click()
    page.wait_for_selector(".chart[data-drawn=yes]")
    say(f"first plot of {1441 * CYCLES} readings after {since_s(began):.1f} s")
    page.wait_for_function("[...document.querySelectorAll('.chart')].every((c) => c.dataset.drawn === 'yes')")
    page.get_by_role("button", name="Diagnose: which effect is missing?").wait_for()
    say(f"compared after {since_s(began):.1f} s")
    heap = page.evaluate("performance.memory.usedJSHeapSize / 1048576")
    say(f"points in the plots: {page.evaluate(POINTS)}; the page holds {heap:.0f} MB, "
        f"the server {memory_mb(studio.process.pid):.0f} MB")  # fmt: skip
    return page


def moved(page: "Page") -> None:
    """Frames while the pointer hovers and pans."""
    box: Any = page.locator(".nsewdrag").first.bounding_box()
    x, y, w, h = (box[k] for k in ("x", "y", "width", "height"))
    for name in ("hover", "pan"):
        if name == "pan":
            page.locator(".modebar-btn[data-val=pan]").first.click()
        page.mouse.move(x + 0.2 * w, y + 0.5 * h)
        page.evaluate(FRAMES)
        if name == "pan":
            page.mouse.down()
        for k in range(MOVES):
            page.mouse.move(x + (0.2 + 0.6 * k / MOVES) * w, y + (0.5 + 0.2 * np.sin(0.2 * k)) * h)
        page.mouse.up()
        say(f"{name}: frames {spread(page.evaluate('window.frames_ms'))}")


class Timed:
    """Times what a person does: until it is seen, and the processor time of browser and server for it.

    Args:
        page: where it is done.
        pid: of the server.
    """

    def __init__(self, page: "Page", pid: int) -> None:
        self._page, self._pid = page, pid
        assert page.context.browser is not None
        self._session = page.context.browser.new_browser_cdp_session()

    def do(self, name: str, act: Callable[[], object], seen: str) -> None:
        """Do it, and wait until a condition of the page holds and is drawn."""
        before = self._spent_s()
        began = RealClock().now_ns()
        act()
        self._page.wait_for_function(seen)
        self._page.evaluate(DRAWN)
        took = since_s(began)
        browser, server = (now - then for now, then in zip(self._spent_s(), before, strict=True))
        say(f"{name}: seen after {took:.2f} s; processor time: browser {browser:.2f} s, server {server:.2f} s")

    def _spent_s(self) -> tuple[float, float]:
        """So far, by all processes of the browser (without a graphics card one of them draws), and by the server."""
        given = self._session.send("SystemInfo.getProcessInfo")["processInfo"]
        fields = Path(f"/proc/{self._pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
        return sum(p["cpuTime"] for p in given), (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def used(page: "Page", studio: RunningStudio) -> None:
    """Brush, another colour, another page and back, with all readings."""
    timed = Timed(page, studio.process.pid)
    page.locator(".modebar-btn[data-val=select]").first.click()
    box: Any = page.locator(".nsewdrag").first.bounding_box()
    x, y, w, h = (box[k] for k in ("x", "y", "width", "height"))

    def brush() -> None:
        page.mouse.move(x + 0.65 * w, y + 0.1 * h)
        page.mouse.down()
        page.mouse.move(x + 0.9 * w, y + 0.9 * h, steps=5)
        page.mouse.up()

    def colour() -> None:
        page.get_by_label("Colour by").click()
        page.get_by_role("option", name="run", exact=True).click()

    timed.do("brush", brush, "document.querySelector('.reading').textContent.includes('marked: residual')")
    timed.do("colour by run", colour, "document.querySelector('.chart').data[0].marker.colorscale !== undefined")
    heading = "document.querySelector('h1').textContent === '{}'"
    timed.do("page Diagnose", page.get_by_role("link", name="Diagnose").click, heading.format("Diagnose"))
    timed.do("back to Compare", page.get_by_role("link", name="Compare").click,
             f"{heading.format('Compare')} && document.querySelector('.chart')?.dataset.drawn === 'yes'")  # fmt: skip


def dropped(browser: "Browser", studio: RunningStudio, folder: Path) -> None:
    """A table of 200 MB of another program: the server's heartbeat and memory meanwhile."""
    page = tab(browser, studio.address).page
    table = folder / "large.csv"
    line = b"12:34:56.789;100,0000;0,0012;21,50;22,75\n"
    with table.open("wb") as out:
        out.write(b"Zeit;X-Position [mm];Abweichung [mm];Temperatur 1;Temperatur 2\n")
        for _ in range(20):
            out.write(line * (LARGE // len(line) // 20))
    timed, idle = Timed(page, studio.process.pid), memory_mb(studio.process.pid)
    page.evaluate(BEATS)
    listed = "[...document.querySelectorAll('button')].some((b) => b.ariaLabel === 'Import large.csv')"
    timed.do(f"drop {LARGE >> 20} MB", lambda: page.locator("input[type=file]").set_input_files(table), listed)
    beats = page.evaluate("(window.beating = false, window.beats_ms)")
    most = int(re.findall(r"VmHWM:\s+(\d+)", Path(f"/proc/{studio.process.pid}/status").read_text())[0]) / 1024
    say(f"while it came: {len(beats)} requests, {spread(beats)}; the server held {idle:.0f} MB before, "
        f"{memory_mb(studio.process.pid):.0f} MB after, {most:.0f} MB at most, shared ones too")  # fmt: skip


def diagnosed(browser: "Browser", studio: RunningStudio) -> None:
    """The heartbeat of the server's event loop while a diagnosis runs."""
    page = tab(browser, studio.address).page
    page.get_by_label("use laser.csv").click()
    page.get_by_role("link", name="Diagnose").click()
    page.get_by_role("button", name="Find the missing effect").click()
    page.get_by_role("button", name="Cancel").wait_for()
    page.evaluate(BEATS)
    page.get_by_role("button", name="Test again").wait_for()
    beats = page.evaluate("(window.beating = false, window.beats_ms)")
    say(f"while diagnosing: {len(beats)} requests, {spread(beats)}")


def main() -> None:
    """All of it."""
    with TemporaryDirectory() as made, chromium() as browser:
        empty, large, small = (Path(made) / name for name in ("empty", "large", "small"))
        for folder in (empty, large, small):
            folder.mkdir()
        start(browser, empty)
        many(large)
        with running_studio(large) as studio:
            page = opened(browser, studio)
            moved(page)
            used(page, studio)
        with running_studio(empty) as studio:
            dropped(browser, studio, small)
            (small / "large.csv").unlink()
        (small / MACHINE.name).write_bytes(MACHINE.read_bytes())
        table = simulated(small, "laser", 1)
        assert status(["fit", str(MACHINE), str(table), "--effects", "scale", "-o", str(small / "m.toml")]) == 0
        with running_studio(small) as studio:
            diagnosed(browser, studio)


if __name__ == "__main__":
    main()

"""A studio in a process of its own, a headless Chromium, and two lasers of a machine with a hidden backlash."""

import csv
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import pytest

from rtec.cli.main import status
from rtec.control.client import Client, DaemonPlace
from rtec.control.places import of_config
from rtec.errors import RtecError
from rtec.loop.clock import RealClock

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

ROOT = Path(__file__).parents[2]
MACHINE = ROOT / "configs" / "machines" / "turning-centre.toml"
CHROMIUM = shutil.which("chromium")
TOKEN = "a-token-for-tests-only"  # noqa: S105
WAIT_MS = 90_000
START_NS = 180_000_000_000
HIDDEN = ("scale,component=EXX,axis=X,k=12", "backlash,component=EXX,axis=X,B=4")

needs_browser = pytest.mark.skipif(
    CHROMIUM is None, reason="needs chromium: apt-get install chromium fonts-dejavu-core"
)


@dataclass
class RunningStudio:
    """A studio that answers.

    Attributes:
        folder: that it opened.
        address: with its key; `origin` is without.
        process: of it.
    """

    folder: Path
    address: str
    process: "subprocess.Popen[str]"

    @property
    def origin(self) -> str:
        """Scheme, host and port."""
        return self.address.partition("/?")[0]


@contextmanager
def running_studio(folder: Path, *more: str, before: tuple[str, ...] = ()) -> Iterator[RunningStudio]:
    """A studio of a folder on a free port; what stands before its command starts it."""
    words = ["studio", str(folder), "--port", "0", "--no-browser", *more, "--token", TOKEN]
    command = [*before, sys.executable, "-m", "rtec.cli.main", *words]
    env = {**os.environ, "PYTHONUNBUFFERED": "1", "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=folder, env=env, start_new_session=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        match = re.search(r"https?://\S+", line)
        assert match, f"no address in {line!r}"
        yield RunningStudio(folder, match[0], process)
    finally:
        process.terminate()
        process.wait(20)
        if process.stdout is not None:
            process.stdout.close()


@contextmanager
def chromium() -> Iterator["Browser"]:
    """A headless browser."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--use-gl=swiftshader", "--enable-unsafe-swiftshader"]
        )
        yield browser
        browser.close()


@dataclass
class Watched:
    """A tab, what it asked for and complained of, commands and words that its pages showed, and how far they jumped."""

    page: "Page"
    requests: list[str] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)
    commands: list[str] = field(default_factory=list)
    told: list[str] = field(default_factory=list)
    jumped: float = 0.0


def tab(browser: "Browser", address: str, width: int = 1440, height: int = 1000, script: str = "") -> Watched:
    """Open a tab at an address and wait until the page is there; a script runs in every page before it loads."""
    page = browser.new_context(viewport={"width": width, "height": height}, reduced_motion="reduce").new_page()
    page.set_default_timeout(WAIT_MS)
    page.add_init_script(script)
    watched = Watched(page)
    page.on("request", lambda r: watched.requests.append(r.url))
    page.on("websocket", lambda w: watched.requests.append(w.url))
    page.on("pageerror", lambda e: watched.complaints.append(str(e)))
    page.on("console", lambda m: watched.complaints.append(m.text) if m.type == "error" else None)
    page.goto(address)
    page.wait_for_selector("h1")
    return watched


def simulated(folder: Path, name: str, seed: int, *more: str) -> Path:
    """A laser along X of the machine with the hidden backlash; small, so that it is quickly diagnosed."""
    effects = [word for e in HIDDEN for word in ("--effect", e)]
    size = ["--cycles", "1", "--step", "23.3", "--noise", "0.3", "--seed", str(seed)]
    made = [
        "simulate",
        str(MACHINE),
        "-i",
        "laser_linear",
        "--axis",
        "X",
        *effects,
        *size,
        *more,
        "-o",
        str(folder / name),
    ]
    assert status(made) == 0
    return folder / f"{name}.csv"


def foreign(folder: Path, name: str, seed: int, *more: str) -> Path:
    """The same as a German program writes it: other names, semicolons, decimal commas."""
    with TemporaryDirectory() as other:
        table = simulated(Path(other), name, seed, *more)
        with table.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
    names = {
        "run": "Lauf",
        "time_s": "Zeit [s]",
        "x_mm": "X Soll [mm]",
        "dir_x": "Richtung",
        "reading_um": "Abweichung [um]",
        "T_x_nut_degc": "T_x_nut [degC]",
    }
    lines = [";".join(names.values()), *(";".join(row[n].replace(".", ",") for n in names) for row in rows)]
    made = folder / f"{name}.csv"
    made.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return made


def live_config(folder: Path) -> Path:
    """The shipped run file at 50 Hz, with counts that may be late: a busy computer is no fault here."""
    for kind in ("models", "machines", "sim"):
        shutil.copytree(ROOT / "configs" / kind, folder / kind)
    made = folder / "run.toml"
    text = (ROOT / "configs" / "turning-centre-sim.toml").read_text(encoding="utf-8")
    text = text.replace('"../logs"', '"logs"').replace("rate_hz = 1000", "rate_hz = 50")
    made.write_text(text.replace("counts_max_age_s = 0.005", "counts_max_age_s = 5.0"), encoding="utf-8")
    return made


@contextmanager
def running_daemon(config: Path) -> Iterator[None]:
    """A daemon that has made its first rows."""
    command = [sys.executable, "-m", "rtec.cli.main", "run", config.name]
    process = subprocess.Popen(command, cwd=config.parent, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        _wait_for_rows(config)
        yield
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(30)


def _wait_for_rows(config: Path) -> None:
    clock = RealClock()
    last = clock.now_ns() + START_NS
    while clock.now_ns() < last:
        for path in of_config(config):
            if path.exists() and _cycles(path):
                return
        clock.sleep_until_ns(clock.now_ns() + 100_000_000)
    raise AssertionError("the daemon made no row")


def _cycles(path: Path) -> int:
    try:
        with Client(DaemonPlace(path)) as client:
            return int(client.status()["status"]["cycles"])
    except RtecError:
        return 0

"""Text from devices, files, clients and libraries, thrown at every way out: it is shown, and it does nothing.

Oracles: `str.isprintable` and UTF-8's own encoder; the number of lines; the standard library's HTML parser; `json`.
"""

import io
import json
import os
import re
import shutil
import sys
import tomllib
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
import tomli_w
import typer
from hypothesis import given
from hypothesis import strategies as st
from rich.live import Live
from rich.progress import Progress, TextColumn
from rich.table import Table
from rich.text import Text

from rtec import errors
from rtec.cli.control import show
from rtec.cli.main import shielded, status
from rtec.cli.run import show_report
from rtec.cli.screen import Console
from rtec.control.client import Outcome
from rtec.control.desk import Desk
from rtec.control.prometheus import metrics
from rtec.daemon.process import Notifier
from rtec.daemon.ring import Ring
from rtec.daemon.status import Report, Status
from rtec.log.recording import Event, Events
from rtec.loop.clock import VirtualClock
from rtec.loop.records import Layout
from rtec.loop.stats import LoopStats, Trouble
from rtec.machine import load_machine
from rtec.model import save_model
from rtec.report.page import Page, Section, render, write_page
from rtec.report.page import Table as PageTable
from rtec.text import clean, clean_lines
from rtec_drivers.zmq.driver import CommandAccount
from rtec_drivers.zmq.message import read_answer
from tests.support import setups
from tests.support.control_rig import FakeDaemon

ESC, LINE, BIDI, HALF, TAGS, SCRIPT = "\x1b[31;5m", "\nrtec: all is well", "\u202e", "\ud800", "[/red]", "<script>x"
HOSTILE = f"box {ESC}{LINE}{BIDI}{HALF}\x9b2J\u2028 {TAGS} {SCRIPT}"
_TIMES = {"p50_us": 1.0, "p99_us": 1.0, "p99_9_us": 1.0, "max_us": 1.0}
SUMMARY = {
    **{"cycles": 7, "deadline_misses": 0, "wake_up": _TIMES, "compute": _TIMES, "driver_errors": 1},
    "devices": {HOSTILE: {"times": 1, "last": {"output": HOSTILE}}},
}
SHOWN = r"box \u001b[31;5m\nrtec: all is well\u202e\ud800\u009b2J\u2028 [/red] <script>x"


def one_line(text: str) -> bool:
    """Printable, and of a kind that can be written."""
    text.encode()
    return text.isprintable()


@given(st.text(st.characters()))
def test_what_comes_out_is_one_printable_line(text: str) -> None:
    """Nothing is lost of what was printable, and cleaning twice changes nothing."""
    cleaned = clean(text)
    assert one_line(cleaned.replace("\xa0", " ")) or any(c.isspace() for c in cleaned)
    assert clean(cleaned) == cleaned
    assert not text.isprintable() or cleaned == text
    cleaned.encode()


@given(st.text(st.characters()))
def test_cleaned_json_means_the_same(text: str) -> None:
    assert json.loads(clean(json.dumps(text, ensure_ascii=False))) == text


def test_it_is_shown_as_its_escape() -> None:
    assert clean(HOSTILE) == SHOWN
    assert clean_lines(f"a{ESC}\nb") == "a\\u001b[31;5m\nb"


@pytest.mark.parametrize("kind", [errors.ConfigError, errors.DriverFault, errors.LogError, errors.MeasurementError])
def test_errors(kind: type[errors.RtecError]) -> None:
    assert all(one_line(line) for line in str(kind(HOSTILE)).split("\n"))
    assert errors.unforeseen(ValueError(HOSTILE)).endswith(SHOWN)


def test_a_fault_of_a_device_on_its_way_through_the_loop(tmp_path: Path) -> None:
    """Half a surrogate in it used to end the loop. Oracle: what the supervisor reads of it."""
    del tmp_path
    trouble = Trouble("box", "output")
    trouble.failed(HOSTILE)
    stats = LoopStats.empty()
    stats.troubles.append(trouble)
    with Ring.create(Layout(("X",), ()), 64) as ring:
        assert ring.note is not None
        ring.note.write(stats.reasons())
        assert ring.note.read() == {"box": [SHOWN]}


def test_what_a_peer_refuses_with() -> None:
    """The ZeroMQ link's answer, as JSON carries half a surrogate."""
    account = CommandAccount(("X",), 10, 1.0)
    account.reported("b", {"X": 0})
    account.next_command([1])
    account.answered(read_answer(json.dumps({"schema": 1, "boot": "b", "seq": 1, "refused": HOSTILE}).encode()))
    with pytest.raises(errors.DriverFault) as told:
        account.sent(0)
    assert all(one_line(line) for line in str(told.value).split("\n"))


def test_events_and_their_file(tmp_path: Path) -> None:
    event, path = Event(1, 2, "2026-01-01T00:00:00Z", "alarm", HOSTILE, HOSTILE), tmp_path / "events.jsonl"
    events = Events(path)
    events.note(event)
    events.write(event)
    line, end = path.read_bytes().decode().split("\n")
    assert (one_line(line), end) == (True, "")
    assert json.loads(line)["text"] == events.newest[0].text == SHOWN


@pytest.mark.parametrize("terminal", [True, False])
def test_what_is_drawn_and_written(terminal: bool) -> None:
    """Tables, titles, plain text, live pages, bars; on a terminal and in a pipe."""
    out = io.StringIO()
    console = Console(file=out, force_terminal=terminal, color_system=None, width=400)
    table = Table(HOSTILE, title=HOSTILE, caption=HOSTILE)
    table.add_row(HOSTILE)
    table.add_row(Text(HOSTILE))
    for what in (table, HOSTILE, Text(HOSTILE)):
        console.print(what, style="bold red")
    with Progress(TextColumn("{task.description}", markup=False), console=console) as progress:
        progress.add_task(HOSTILE)
    with Live(Text(HOSTILE), console=console, auto_refresh=False):
        console.print(HOSTILE)
    text = re.sub(r"\x1b\[(\?25[lh]|[12]?[AKG]|2K)|\r", "", out.getvalue())  # what rich itself moves the cursor with
    assert all(one_line(line) for line in text.split("\n"))
    assert text.count("[/red]") >= 8
    assert "\\u001b[31;5m" in text


def test_whatever_is_written_to_the_standard_streams(capsys: pytest.CaptureFixture[str]) -> None:
    """By any function; rich's own colours pass."""
    with shielded():
        typer.echo(HOSTILE)
        typer.echo(HOSTILE, err=True)
        sys.stdout.write(HOSTILE)
        Console(force_terminal=True, color_system="standard").print("red", style="red")
    said = capsys.readouterr()
    assert said.out.endswith("\x1b[31mred\x1b[0m\n")
    assert all(one_line(line) for line in said.out.replace("\x1b[31mred\x1b[0m", "").split("\n"))
    assert all(one_line(line) for line in said.err.split("\n"))


def test_what_a_live_display_moves_the_cursor_with_is_not_written_out(capsys: pytest.CaptureFixture[str]) -> None:
    """A display puts its own stream before the standard ones. Oracle: codes of ECMA-48, none of them as text."""
    with shielded(), Live(Text("1 %"), console=Console(force_terminal=True), auto_refresh=False) as live:
        live.update(Text(f"2 %\n{HOSTILE}"), refresh=True)
        live.refresh()
    said = capsys.readouterr().out
    assert "\x1b[2K" in said
    assert "\\u001b[2K" not in said
    assert "\\u001b[31;5m" in said


class Tags(HTMLParser):
    """Names of the tags of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.names: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: object) -> None:
        del attrs
        self.names.add(tag)


def test_reports(tmp_path: Path) -> None:
    """Page and JSON. Oracle: a page of the same form with plain words has the same tags."""

    def page(text: str) -> Page:
        table = PageTable([text], [[text]], caption=text)
        return Page(text, text, [(text, text)], [Section(text, [text], table)], [text])

    html = render(page(HOSTILE))
    assert Tags(html).names == Tags(render(page("plain"))).names
    assert all(one_line(line) for line in html.split("\n"))
    written = write_page(page(HOSTILE), {HOSTILE: HOSTILE}, tmp_path / "out")
    assert json.loads((written.parent / "result.json").read_text(encoding="utf-8"))


def test_status_json_and_prometheus(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A daemon whose devices are called so, and what the commands print of it."""
    daemon = FakeDaemon(setups.setup(tmp_path))
    daemon.status.devices = {HOSTILE: [HOSTILE]}
    daemon.note("fault", HOSTILE)
    found = Desk(daemon, VirtualClock(10), {"machine": HOSTILE, "config": HOSTILE}).status()
    assert all(one_line(line) for line in metrics(found).rstrip("\n").split("\n"))
    with shielded():
        show(found)
        typer.echo(json.dumps(Outcome(True, HOSTILE, found).status, ensure_ascii=False))
    said = capsys.readouterr().out
    assert "[/red]" in said
    assert all(one_line(line) for line in said.split("\n"))


def test_what_systemd_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """A datagram whose lines are fields of a protocol: `MAINPID=1` must not become one of them."""
    sent: list[str] = []

    def send(_: Notifier, text: str) -> bool:
        sent.append(text)
        return True

    monkeypatch.setattr(Notifier, "_send", send)
    notifier = Notifier("@x", 0, VirtualClock(10**12))
    trouble = Trouble("box", "output")
    trouble.failed("gone\nMAINPID=1\ud800")
    stats = LoopStats.empty()
    stats.troubles.append(trouble)
    notifier.look(Status(cycles=1, mode="on", devices=stats.reasons()))
    assert all("\nMAINPID" not in text and one_line(text.replace(chr(10), "")) for text in sent)
    assert sent


@pytest.mark.parametrize("where", ["name", "key", "value"])
def test_names_in_files_are_refused(tmp_path: Path, where: str, capsys: pytest.CaptureFixture[str]) -> None:
    """ESC, a line break in a name, direction marks; brackets and tags are names like any other."""
    content = setups.tables(tmp_path)
    config = setups.write(tmp_path, content)
    text = config.read_text(encoding="utf-8")
    bad = {
        "name": 'name = "a\\nb"\n' + text,
        "key": '"\\u001b[31m" = 1\n' + text,
        "value": 'x = ["\\u202E"]\n' + text,
    }[where]
    config.write_text(bad, encoding="utf-8")
    assert status(["run", str(config), "--dry-run"]) == 2
    said = capsys.readouterr().err
    assert "not printable; take them out" in said
    assert all(one_line(line) for line in said.split("\n"))


def test_a_machine_named_red_runs_to_its_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It used to end a good run in a traceback."""
    setup = setups.setup(tmp_path)
    content = tomllib.loads(setup.path.read_text(encoding="utf-8"))
    machine = tomllib.loads(Path(content["run"]["machine"]).read_text(encoding="utf-8"))
    machine["machine"]["name"] = f"{TAGS}{SCRIPT}"
    (tmp_path / "machine.toml").write_text(tomli_w.dumps(machine), encoding="utf-8")
    named = load_machine(tmp_path / "machine.toml")
    save_model(setups.small_model(named), tmp_path / "model.toml")
    content["run"]["machine"] = str(tmp_path / "machine.toml")
    assert status(["run", str(setups.write(tmp_path, content)), "--dry-run"]) == 0
    assert f"{TAGS}{SCRIPT}: dry run" in capsys.readouterr().out
    report = Report(SUMMARY, [HOSTILE], tmp_path / HOSTILE, 0, True, FakeDaemon(setup).status, {}, {"X": 1.0, "Z": 2.0})
    with shielded():
        show_report(replace(setup, machine=named), report)
    said = capsys.readouterr().out
    assert said.startswith(f"{TAGS}{SCRIPT}: 7 cycles")
    assert all(one_line(line) for line in said.split("\n"))


def test_a_measurement_whose_file_name_is_no_text(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its name goes to the table, to the report and to the figures."""
    machine = setups.CONFIGS / "machines" / "turning-centre.toml"
    assert (
        status(["simulate", str(machine), "--instrument", "laser_linear", "--axis", "X", "-o", str(tmp_path / "x")])
        == 0
    )
    hostile = os.fsdecode(b"\xff\x1b[31m$\\frac{[red] <blink>\xe2\x80\xae")
    for suffix in (".csv", ".toml"):
        shutil.copy(tmp_path / f"x{suffix}", tmp_path / f"{hostile}{suffix}")
    capsys.readouterr()
    command = ["iso230", str(tmp_path / f"{hostile}.csv"), "--machine", str(machine)]
    assert status([*command, "--report", str(tmp_path / "out")]) == 0
    assert status([*command, "--json"]) == 0
    said = capsys.readouterr().out
    assert "[red] <blink>" in said
    assert all(one_line(line) for line in said.split("\n"))
    html = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "blink" not in Tags(html).names

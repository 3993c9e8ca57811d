"""`rtec log`, run inside the test by typer's runner. Oracle: the rows that were written, formatted by hand."""

import csv
import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import rtec.cli.log as log_cli
from rtec.cli.main import status
from rtec.errors import LogError
from rtec.log.writer import LogWriter
from rtec.loop.clock import VirtualClock
from rtec.loop.records import Commands, Layout, Samples

LAYOUT = Layout(("X", "Z"), ("T_bed", "[red]T"))
HEADER = {"rtec_version": "0.1.0", "host": "pc"}
runner = CliRunner()


def rows(start: int, stop: int) -> tuple[Samples, Commands]:
    n = stop - start
    samples, commands = Samples.empty(LAYOUT, n), Commands.empty(LAYOUT, n)
    number = np.arange(start, stop)
    samples.time_ns[:] = 5_000_000_000 + number * 1_000_000
    samples.mode[:] = number % 3
    samples.counts[:] = number[:, None] * [10, -10]
    samples.degc[:] = 20.0 + number[:, None] * [0.5, 0.25]
    commands.requested_um[:] = number[:, None] * [0.1, 0.2]
    commands.applied_um[:] = number[:, None] * [0.01, 0.02]
    commands.output[:] = number[:, None] * [1, 2]
    commands.flags[:] = number
    return samples, commands


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "run.arrows"
    with LogWriter(path, LAYOUT, HEADER, batch_rows=16) as writer:
        writer.write(*rows(0, 101))
    return path


def table(text: str) -> list[list[str]]:
    return [line.split() for line in text.splitlines()]


def row_shown(i: int) -> list[str]:
    mode = ("off", "on", "hold")[i % 3]
    x = [f"{10 * i}", f"{0.1 * i:.3f}", f"{0.01 * i:.3f}", f"{i}"]
    z = [f"{-10 * i}", f"{0.2 * i:.3f}", f"{0.02 * i:.3f}", f"{2 * i}"]
    return [f"{5 + i / 1000:.6f}", mode, *x, *z, flags_shown(i)]


def flags_shown(i: int) -> str:
    names = (
        "stale_counts", "stale_temperature", "sensor_fault", "out_of_range", "over_stop_limit", "over_warning_limit",
        "ordered_hold",
    )  # fmt: skip
    return ",".join(name for bit, name in enumerate(names) if i >> bit & 1) or "-"


def test_info_json(log: Path) -> None:
    result = runner.invoke(log_cli.app, ["info", str(log), "--json"], catch_exceptions=False)
    assert result.exit_code == 0
    assert json.loads(result.stdout) == {
        "log": str(log),
        "header": HEADER,
        "axes": ["X", "Z"],
        "sensors": ["T_bed", "[red]T"],
        "rows": 101,
        "duration_s": pytest.approx(0.1),
        "bytes": log.stat().st_size,
        "torn_bytes": 0,
        "complete": True,
    }


def test_info_for_people(log: Path) -> None:
    log.write_bytes(log.read_bytes()[:-9])  # the end mark and one byte of the last batch: 101 rows are 6 * 16 + 5
    result = runner.invoke(log_cli.app, ["info", str(log)], catch_exceptions=False)
    shown = {line[0]: line[1:] for line in table(result.stdout) if line}
    assert shown["rows"] == ["96"]
    assert shown["complete"] == ["no"]
    assert int(shown["torn_bytes"][0]) > 0
    assert shown["host"] == ["pc"]
    assert shown["sensors"] == ["T_bed,", "[red]T"]


def test_info_of_an_empty_log(tmp_path: Path) -> None:
    LogWriter(tmp_path / "a", Layout(("X",), ()), {}).close()
    result = runner.invoke(log_cli.app, ["info", str(tmp_path / "a"), "--json"], catch_exceptions=False)
    facts = json.loads(result.stdout)
    assert (facts["rows"], facts["duration_s"], facts["sensors"]) == (0, 0.0, [])


def test_export(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.csv"
    result = runner.invoke(log_cli.app, ["export", str(log), str(out)], catch_exceptions=False)
    assert result.exit_code == 0
    assert result.stdout == f"101 rows written to {out}\n"
    with out.open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert [int(line["counts_Z"]) for line in lines] == [-10 * i for i in range(101)]
    assert [float(line["degc_T_bed"]) for line in lines] == [20.0 + 0.5 * i for i in range(101)]


@pytest.mark.parametrize(("options", "n"), [([], 20), (["-n", "3"], 3), (["-n", "0"], 0), (["-n", "500"], 101)])
def test_tail(log: Path, options: list[str], n: int) -> None:
    result = runner.invoke(log_cli.app, ["tail", str(log), *options], catch_exceptions=False)
    lines = table(result.stdout)
    assert lines[0][:4] == ["time", "s", "mode", "counts"]
    assert lines[1:] == [row_shown(i) for i in range(101 - n, 101)]


def test_tail_with_temperatures(log: Path) -> None:
    result = runner.invoke(log_cli.app, ["tail", str(log), "-n", "1", "--degc"], catch_exceptions=False)
    heading, row = table(result.stdout)
    assert heading[-5:] == ["T_bed", "°C", "[red]T", "°C", "flags"]
    assert row == [*row_shown(100)[:-1], "70.000", "45.000", row_shown(100)[-1]]


class _EventfulClock(VirtualClock):
    """At each sleep the next thing happens; then somebody presses Ctrl-C."""

    def __init__(self, events: list[Callable[[], None]]) -> None:
        super().__init__()
        self._events = events

    def sleep_until_ns(self, instant_ns: int) -> None:
        super().sleep_until_ns(instant_ns)
        if not self._events:
            raise KeyboardInterrupt
        self._events.pop(0)()


def test_tail_follows_a_growing_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows flushed while it waits appear once each and in order, below the first; Ctrl-C ends with status 130."""
    path = tmp_path / "run.arrows"
    with LogWriter(path, LAYOUT, {}) as writer:

        def append(start: int, stop: int) -> Callable[[], None]:
            def event() -> None:
                writer.write(*rows(start, stop))
                writer.flush()

            return event

        append(0, 10)()
        events = [append(10, 12), lambda: None, append(12, 13), append(13, 40)]
        monkeypatch.setattr(log_cli, "_clock", _EventfulClock(events))
        result = runner.invoke(log_cli.app, ["tail", str(path), "-n", "4", "--follow"])
    assert result.exit_code == 130
    lines = table(result.stdout)
    assert lines[1:] == [row_shown(i) for i in range(6, 40)]
    flags_at = {line.rstrip().rindex(" ") for line in result.stdout.splitlines()}
    assert len(flags_at) == 1, "columns stay below each other"


@pytest.mark.parametrize("command", ["info", "tail", "export"])
def test_bad_input_is_left_to_the_main_program(tmp_path: Path, command: str) -> None:
    """A LogError comes out as it is: one place prints it and sets status 2."""
    path = tmp_path / "a"
    path.write_text("no log")
    extra = [str(tmp_path / "out.csv")] if command == "export" else []
    result = runner.invoke(log_cli.app, [command, str(path), *extra])
    assert isinstance(result.exception, LogError)
    assert not (tmp_path / "out.csv").exists()


@pytest.mark.parametrize("command", ["info", "tail", "export"])
def test_help_teaches_with_an_example(command: str) -> None:
    result = runner.invoke(log_cli.app, [command, "--help"])
    assert result.exit_code == 0
    assert f"rtec log {command} run.arrows" in result.stdout


@pytest.mark.parametrize("command", [["list"], ["tail"], ["export"], ["list", "--json"]])
@pytest.mark.parametrize("what", ["nothing", "empty folder", "unreadable folder"])
def test_where_there_are_no_logs_it_is_bad_input(tmp_path: Path, command: list[str], what: str) -> None:
    """Status 2 and the reason. Oracle: the table of exit statuses in CONTRIBUTING: 2 for bad input."""
    place = tmp_path / "logs"
    if what != "nothing":
        place.mkdir()
    if what == "unreadable folder":
        place.rmdir()
        place.symlink_to(place)  # which root cannot open either
    name, *options = command
    out = [str(tmp_path / "out.csv")] if name == "export" else []
    done = status(["log", name, str(place), *out, *options])
    assert done == 2


def test_a_damaged_file_is_status_1_and_a_stretch_without_files_is_an_answer(log: Path) -> None:
    assert status(["log", "list", str(log.parent)]) == 0
    assert status(["log", "list", str(log.parent), "--from", "2000-01-01", "--to", "2000-01-02"]) == 0
    (log.parent / "bad.arrows").write_bytes(b"no log")
    assert status(["log", "list", str(log.parent)]) == 1


def test_what_is_no_file_keeps_nobody_waiting(log: Path) -> None:
    """A FIFO that is named like a log: it is shown as damaged, and looking into it is bad input."""
    os.mkfifo(log.parent / "fifo.arrows")
    assert status(["log", "list", str(log.parent)]) == 1
    assert status(["log", "info", str(log.parent / "fifo.arrows")]) == 2

"""A run's log over full disks, stalled disks and new beginnings. Oracles: the rows that were handed on, numbered."""

import errno
import threading
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from rtec.daemon.disk import DiskThread
from rtec.errors import LogError
from rtec.log.recording import RETRY_NS, Begin, Recording, free_path
from rtec.loop.clock import VirtualClock
from rtec.loop.records import Commands, Layout, Samples
from tests.support.parts import part

LAYOUT = Layout(("X",), ())


def rows(first: int, n: int) -> tuple[Samples, Commands]:
    samples, commands = Samples.empty(LAYOUT, n), Commands.empty(LAYOUT, n)
    samples.time_ns[:] = np.arange(first, first + n)
    return samples, commands


class Disk:
    """Files in memory, and whether there is room for more."""

    def __init__(self) -> None:
        self.files: dict[str, list[int]] = {}
        self.headers: dict[str, Mapping[str, str]] = {}
        self.closed: list[str] = []
        self.full = False
        self.go = threading.Event()
        self.go.set()

    def open(self, path: Path, header: Mapping[str, str]) -> "File":
        self.check()
        self.files[path.name], self.headers[path.name] = [], header
        return File(self, path.name)

    def check(self) -> None:
        assert self.go.wait(60)
        if self.full:
            raise LogError("cannot be written: No space left on device") from OSError(errno.ENOSPC, "No space left")


class File:
    def __init__(self, disk: Disk, name: str) -> None:
        self.disk, self.name, self.rows = disk, name, 0

    def write(self, samples: Samples, commands: Commands) -> None:
        del commands
        self.disk.check()
        self.disk.files[self.name] += samples.time_ns.tolist()
        self.rows += len(samples)

    def flush(self) -> None:
        self.disk.check()

    def close(self) -> None:
        self.disk.closed.append(self.name)


def recording(disk: Disk, clock: VirtualClock) -> Recording:
    made = Recording(Path("run.arrows"), clock, disk.open)
    made.begin(Begin(0, {"initial_output": "[0]"}))
    return made


def test_a_new_file_begins_exactly_where_it_is_told() -> None:
    disk = Disk()
    log = recording(disk, VirtualClock())
    log.write(*rows(0, 10), 0)
    log.cut(Begin(14, {"initial_output": "[7]"}))
    log.write(*rows(10, 10), 10)
    log.write(*rows(20, 5), 20)
    log.close()
    assert disk.files == {"run.arrows": list(range(14)), "run-2.arrows": list(range(14, 25))}
    assert disk.headers["run-2.arrows"] == {"initial_output": "[7]"}
    assert disk.closed == ["run.arrows", "run-2.arrows"]
    assert log.missed == 0


def test_a_full_disk_stops_the_log_and_says_so_and_then_goes_on() -> None:
    """One warning when it stops, one when it goes on; tried every five seconds, not in every cycle."""
    disk, clock = Disk(), VirtualClock()
    log = recording(disk, clock)
    log.write(*rows(0, 10), 0)
    disk.full = True
    log.write(*rows(10, 10), 10)
    assert not log.wants_to_try_again()
    assert "No space left" in log.trouble
    log.write(*rows(20, 10), 20)
    clock.sleep_until_ns(RETRY_NS)
    assert log.wants_to_try_again()
    log.cut(Begin(35, {}))
    log.write(*rows(30, 10), 30)
    assert not log.wants_to_try_again()
    assert list(disk.files) == ["run.arrows"]
    clock.sleep_until_ns(2 * RETRY_NS)
    disk.full = False
    assert log.wants_to_try_again()
    log.cut(Begin(43, {}))
    log.write(*rows(40, 10), 40)
    log.close()
    assert disk.files["run.arrows"] == list(range(10))
    assert disk.files["run-2.arrows"] == list(range(43, 50))
    assert log.trouble == ""
    assert [w.split(":")[0] for w in log.warnings] == [
        "logging stopped, the correction went on",
        "logging goes on in run-2.arrows; 33 rows are in no log",
    ]
    assert log.missed == 33  # rows 10 to 42; the first ten of them were in the writer's hands when it failed


def test_a_disk_that_is_all_but_full_is_told_once() -> None:
    """Room for a few rows again and again: one warning that it stopped, none that it goes on until it does.

    Oracle: the rows in the files against all that were handed on.
    """
    disk, clock = Disk(), VirtualClock()
    log = recording(disk, clock)
    for k in range(5):
        log.write(*rows(100 * k, 50), 100 * k)
        log.flush()
        disk.full = True
        log.write(*rows(100 * k + 50, 50), 100 * k + 50)
        assert "No space left" in log.trouble
        disk.full = False
        clock.sleep_until_ns(clock.now_ns() + RETRY_NS)
        assert log.wants_to_try_again()
        log.cut(Begin(100 * (k + 1), {}))
    assert len(log.warnings) == 1
    log.write(*rows(500, 50), 500)
    clock.sleep_until_ns(clock.now_ns() + RETRY_NS)
    log.flush()
    assert log.trouble == ""
    assert log.warnings[1:] == ["logging goes on in run-6.arrows; 250 rows are in no log"]
    assert 550 - sum(len(file) for file in disk.files.values()) == log.missed == 250


def test_a_run_begins_on_a_full_disk_too_and_is_logged_when_there_is_room() -> None:
    """As after a power cut: what corrects does not wait for the disk. Every row is written or counted."""
    disk, clock = Disk(), VirtualClock()
    disk.full = True
    log = recording(disk, clock)
    log.write(*rows(0, 10), 0)
    assert "No space left" in log.trouble
    assert [w.split(":")[0] for w in log.warnings] == ["logging stopped, the correction went on"]
    clock.sleep_until_ns(RETRY_NS)
    disk.full = False
    assert log.wants_to_try_again()
    log.cut(Begin(14, {"initial_output": "[7]"}))
    log.write(*rows(10, 10), 10)
    log.close()
    assert disk.files == {"run-2.arrows": list(range(14, 20))}
    assert (log.missed, log.trouble) == (14, "")


def test_a_first_file_that_cannot_be_made_is_an_error_and_no_log_is_no_fault() -> None:
    """A name that is taken, a folder that is none: something that a person mends before the run."""
    disk = Disk()

    def taken(path: Path, header: Mapping[str, str]) -> File:
        del header
        raise LogError(f"log {path}: exists already") from FileExistsError(errno.EEXIST, "File exists")

    with pytest.raises(LogError, match="exists already"):
        Recording(Path("run.arrows"), VirtualClock(), taken).begin(Begin(0, {}))
    none = Recording(None, VirtualClock(), disk.open)
    none.begin(Begin(0, {}))
    none.write(*rows(0, 10), 0)
    none.flush()
    none.close()
    assert (none.missed, none.warnings, none.wants_to_try_again()) == (0, [], False)


def test_names_of_further_files(tmp_path: Path) -> None:
    path = tmp_path / "run-20260101T000000Z.arrows"
    assert free_path(path).name == "run-20260101T000000Z-2.arrows"
    free_path(path).touch()
    assert free_path(path).name == "run-20260101T000000Z-3.arrows"
    assert free_path(free_path(path)).name == "run-20260101T000000Z-4.arrows"
    assert free_path(tmp_path / "a-20260101.arrows").name == "a-20260101-2.arrows"


def test_a_stalled_disk_keeps_nobody_waiting() -> None:
    """While the disk does nothing, rows are taken, up to a number; then dropped and counted; then it goes on."""
    disk = Disk()
    log = recording(disk, VirtualClock())
    with DiskThread(log, None, lambda: None, most_rows=100, part=part()) as thread:
        disk.go.clear()
        for k in range(30):
            thread.write(*rows(10 * k, 10), 10 * k)
        assert thread.dropped == 200
        assert "the disk is slow: 100 rows wait" in thread.trouble
        disk.go.set()
    assert disk.files["run.arrows"] == list(range(100))
    assert thread.missed == 200
    assert thread.trouble == ""


def test_rows_that_were_dropped_end_a_file() -> None:
    """A file is rows in order without a gap: behind a gap another begins, and one more where the state is known."""
    disk = Disk()
    log = recording(disk, VirtualClock())
    log.write(*rows(0, 10), 0)
    log.write(*rows(50, 10), 50)
    assert disk.files["run.arrows"] == list(range(10))
    assert log.warnings == ["40 rows came too fast and are in no log; a new file begins behind them"]
    assert disk.headers["run-2.arrows"] == {"first_row": "50", "rows_lost_before": "40"}
    assert log.wants_to_try_again()
    log.cut(Begin(65, {}))
    log.write(*rows(60, 10), 60)
    assert not log.wants_to_try_again()
    log.close()
    assert disk.files["run-2.arrows"] == list(range(50, 65))
    assert disk.files["run-3.arrows"] == list(range(65, 70))
    assert (log.missed, log.trouble) == (0, "")

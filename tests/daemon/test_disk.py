"""The thread that writes to disk, where something fails that nobody foresaw.

Oracle: the rows that were handed on, each of which is in a file or counted as missed.
"""

import errno
import os
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtec.correction.flags import MODE_HOLD, MODE_ON
from rtec.daemon.disk import DiskThread
from rtec.errors import LogError
from rtec.log.reader import LogReader
from rtec.log.recording import RETRY_NS, Begin, Event, Events, Recording
from rtec.log.writer import LogWriter
from rtec.loop.clock import VirtualClock
from rtec.loop.records import Commands, Layout, Samples
from rtec.loop.state import IMAGE_BYTES, Saved, StateWriter, newest
from rtec.loop.state_files import DiskState, read_disk
from rtec.loop.step import Step
from tests.support import setups
from tests.support.parts import part

LAYOUT = Layout(("X",), ())
PIECE = 10
LONG_S = 60.0


def rows(k: int) -> tuple[Samples, Commands, int]:
    """Piece k of the rows: each row's instant is its number."""
    samples, commands = Samples.empty(LAYOUT, PIECE), Commands.empty(LAYOUT, PIECE)
    samples.time_ns[:] = np.arange(PIECE * k, PIECE * (k + 1))
    return samples, commands, PIECE * k


class Run:
    """A recording into real files, whose n-th use fails in a way of the test's own."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder, self.clock, self.told = folder, VirtualClock(RETRY_NS), list[str]()
        self._patch = monkeypatch
        self.log = Recording(folder / "run.arrows", self.clock, self._open)
        self.log.begin(Begin(0, {}))
        self.at: Callable[[], Saved | None] = lambda: None

    def _open(self, path: Path, header: Mapping[str, str]) -> LogWriter:
        return LogWriter(path, LAYOUT, header, batch_rows=PIECE)

    def fails(self, owner: Any, name: str, error: Exception, times: int = 1) -> None:
        """Let the next calls of something fail."""
        right, left = getattr(owner, name), [times]

        def wrong(*arguments: Any, **more: Any) -> Any:
            if left[0]:
                left[0] -= 1
                raise error
            return right(*arguments, **more)

        self._patch.setattr(owner, name, wrong)

    def written(self) -> list[int]:
        """Numbers of the rows in all files."""
        found = []
        for path in sorted(self.folder.glob("*.arrows")):
            with LogReader(path) as reader:
                found += [t for samples, _ in reader.blocks() for t in samples.time_ns.tolist()]
        return sorted(found)


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    return Run(tmp_path, monkeypatch)


EIO = OSError(errno.EIO, "Input/output error")


@pytest.mark.parametrize("error", [EIO, MemoryError(), ValueError("nobody foresaw this"), RecursionError()])
@pytest.mark.parametrize("name", ["write", "flush"])
def test_any_fault_of_the_log_ends_its_file_and_the_thread_goes_on(run: Run, name: str, error: Exception) -> None:
    told: list[str] = []
    counted = part(told.append)
    with DiskThread(run.log, None, lambda: None, most_rows=1000, part=counted) as thread:
        thread.write(*rows(0))
        thread.flush()
        settle(thread)
        run.fails(LogWriter, name, error)
        thread.write(*rows(1))
        thread.flush()
        thread.write(*rows(2))
    assert counted.faults == 1
    assert type(error).__name__ in told[0]
    assert "logging stopped" in run.log.trouble
    assert thread.missed + len(run.written()) == 3 * PIECE
    assert run.written()[:PIECE] == list(range(PIECE))


def test_a_new_file_that_fails_costs_its_rows_and_they_are_counted(run: Run) -> None:
    """Also where the fault comes when the file is made: `fsync` of the folder, once."""
    run.fails(os, "fsync", EIO)
    with DiskThread(run.log, None, lambda: None, most_rows=1000, part=part()) as thread:
        thread.write(*rows(0))
        thread.cut(Begin(15, {}))
        thread.write(*rows(1))
        thread.write(*rows(2))
    assert run.written() == list(range(15))
    assert thread.missed == 15
    assert "Input/output error" in run.log.trouble
    assert len(list(run.folder.glob("*.arrows"))) == 1


@pytest.mark.parametrize("error", [LogError("known"), ZeroDivisionError("unknown")])
def test_rows_behind_a_file_that_cannot_be_made_are_counted(run: Run, error: Exception) -> None:
    run.log.write(*rows(0))
    run.log.cut(Begin(15, {}))
    run.log.open_writer = lambda *_: throw(error)
    try:
        run.log.write(*rows(1))
    except ZeroDivisionError:
        assert isinstance(error, ZeroDivisionError)
    assert run.log.missed == 5
    run.log.write(*rows(2))
    assert run.log.missed == 15


class Seen(Events):
    """Events that somebody waits for."""

    def __init__(self) -> None:
        super().__init__(None)
        self.seen = threading.Event()

    def write(self, _: Event) -> None:
        self.seen.set()


def settle(thread: DiskThread) -> None:
    """Return when the thread has done all that it was given."""
    events = Seen()
    thread.event(events, Event(0, 0, "", "mark", "", ""))
    assert events.seen.wait(LONG_S)


def throw(error: Exception) -> Any:
    raise error


def test_a_fault_at_the_very_end_closes_the_rest_all_the_same(run: Run) -> None:
    closed = part()
    run.fails(LogWriter, "close", ZeroDivisionError(), times=1)
    with DiskThread(run.log, None, lambda: None, most_rows=1000, part=closed) as thread:
        thread.write(*rows(0))
    assert closed.faults == 1
    assert run.written() == list(range(PIECE))
    assert not any("did not answer" in text for text in run.log.warnings)


@pytest.mark.parametrize("error", [EIO, ZeroDivisionError()])
def test_the_mode_on_disk_is_told_and_what_is_not_there_is_not(run: Run, tmp_path: Path, error: Exception) -> None:
    """Oracle: the file itself, read by the function that a start uses."""
    kept, image = [MODE_HOLD], np.zeros(IMAGE_BYTES, np.uint8)
    step = Step(setups.setup(tmp_path).step_settings())
    writer, place = StateWriter(image, step, MODE_ON), tmp_path / "run.state"

    def newest_one() -> Saved | None:
        writer.order = kept[0]
        writer.keep(Samples.empty(step.layout, 1), step.output_of(step.state), 0)
        return newest(image.tobytes())

    with DiskThread(run.log, DiskState(place), newest_one, most_rows=1000, part=part()) as thread:
        assert thread.kept_mode is None
        thread.flush()
        settle(thread)
        saved, _ = read_disk(place)
        assert saved is not None
        assert thread.kept_mode == saved.mode == MODE_HOLD
        kept[0] = MODE_ON
        run.fails(DiskState, "write", error)
        thread.flush()
        settle(thread)
        assert thread.kept_mode is None
        thread.flush()
        settle(thread)
        assert thread.kept_mode == MODE_ON

"""Events beside the log while the disk refuses them. Oracles: the lines of the file, read as JSON; the kernel."""

import json
import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from rtec.daemon.disk import DiskThread
from rtec.log.recording import REMEMBERED, Event, Events, Recording
from rtec.loop.clock import VirtualClock
from rtec.loop.state_files import DiskState
from tests.support.parts import part


def event(k: int) -> Event:
    return Event(k, k, "2026-01-01T00:00:00Z", "mark", f"é{k}", "root")


def rows_in(path: Path) -> list[int]:
    return [json.loads(line)["row"] for line in path.read_text(encoding="utf-8").splitlines()]


@contextmanager
def only_300_bytes_a_file() -> Iterator[None]:
    """A write over the limit is cut short by the kernel, as on a disk that becomes full.

    No fixture: pytest writes its own lines before a fixture ends, and may write them to a file.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)


def test_what_could_not_be_written_is_written_later_in_order(tmp_path: Path) -> None:
    path = tmp_path / "later" / "run.events.jsonl"
    events = Events(path)
    for k in range(3):
        with pytest.raises(FileNotFoundError):
            events.write(event(k))
    path.parent.mkdir()
    events.write(event(3))
    assert rows_in(path) == [0, 1, 2, 3]


def test_no_half_line_is_left(tmp_path: Path) -> None:
    events = Events(tmp_path / "run.events.jsonl")
    with only_300_bytes_a_file():
        for k in range(2):
            events.write(event(k))
        with pytest.raises(OSError, match="No space left"):
            events.write(event(2))
    assert rows_in(tmp_path / "run.events.jsonl") == [0, 1]


def test_no_more_wait_than_are_remembered(tmp_path: Path) -> None:
    """The newest of them: memory does not grow while a disk is full for a month."""
    path = tmp_path / "later" / "run.events.jsonl"
    events = Events(path)
    for k in range(REMEMBERED + 50):
        with pytest.raises(FileNotFoundError):
            events.write(event(k))
    path.parent.mkdir()
    events.catch_up()
    assert rows_in(path) == list(range(50, REMEMBERED + 50))


def test_the_next_flush_catches_up(tmp_path: Path) -> None:
    """Told once, though several events found no room; no further event is needed."""
    path = tmp_path / "later" / "run.events.jsonl"
    events, log = Events(path), Recording(None, VirtualClock(), lambda *_: pytest.fail("no log"))

    def newest() -> None:  # the first thing that a flush asks for: somebody makes room just then
        path.parent.mkdir(exist_ok=True)

    with DiskThread(log, DiskState(tmp_path / "run.state"), newest, most_rows=100, part=part()) as thread:
        thread.event(events, event(0))
        thread.event(events, event(1))
        thread.flush()
    assert rows_in(path) == [0, 1]
    assert len(log.warnings) == 1
    assert "events wait until they can be written: No such file or directory" in log.warnings[0]

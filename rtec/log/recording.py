"""The log of a run, in one file or several: a reload and a loss of rows begin a new file.

A disk that fails costs the rows that could not be written, never the correction. The failure is reported, logging is
tried again every few seconds, and its return is reported. Every file can be replayed by itself: its header holds the
step's whole memory before the file's first row.

Events are beside its rows: orders, marks, reloads; a line of JSON each, in a file next to the log.
"""

import errno
import json
import os
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, Protocol

from rtec.errors import LogError, unforeseen
from rtec.loop.clock import Clock
from rtec.loop.records import Commands, Samples
from rtec.loop.state import Saved, state_text
from rtec.text import clean

REMEMBERED: Final = 200


@dataclass(frozen=True)
class Event:
    """One event.

    Attributes:
        row: number of the newest row at the event; rows count from the start of the run.
        time_ns: instant of that row, monotonic clock, as in the log.
        utc: date and time of day, for people.
        what: name of the order, or "reloaded", "not reloaded".
        text: text of the order, or its result.
        who: user who gave the order.
    """

    row: int
    time_ns: int
    utc: str
    what: str
    text: str
    who: str

    def __post_init__(self) -> None:
        for name in ("what", "text", "who"):
            object.__setattr__(self, name, clean(getattr(self, name)))


class Events:
    """Keeps the newest events, and writes each event to a file.

    Args:
        path: the file, which is appended to; None: events are only kept.

    Attributes:
        newest: the newest events.
        total: number of all events.
    """

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self.newest: deque[Event] = deque(maxlen=REMEMBERED)
        self.total = 0
        self._waiting: deque[Event] = deque(maxlen=REMEMBERED)

    def note(self, event: Event) -> None:
        """Keep an event in memory."""
        self.newest.append(event)
        self.total += 1

    def write(self, event: Event) -> None:
        """Write an event to the file, after those that could not be written before.

        Raises:
            OSError: it cannot be written now; it is kept for the next attempt.
        """
        if self.path is not None:
            self._waiting.append(event)
            self.catch_up()

    def catch_up(self) -> None:
        """Write the events that could not be written before.

        Raises:
            OSError: they still cannot be written.
        """
        while self.path is not None and self._waiting:
            self._append(self.path, self._waiting[0])
            self._waiting.popleft()

    def _append(self, path: Path, event: Event) -> None:
        """Write the whole line or nothing: half a line would make the next one malformed."""
        fields: Mapping[str, object] = asdict(event)
        line = (json.dumps(fields, ensure_ascii=False) + "\n").encode()
        fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
        try:
            before = os.fstat(fd).st_size
            if os.write(fd, line) != len(line):
                os.ftruncate(fd, before)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        finally:
            os.close(fd)


def events_path(log: Path | None) -> Path | None:
    """Path of the events next to a log."""
    return None if log is None else log.with_suffix(".events.jsonl")


RETRY_NS: Final = 5_000_000_000
DISK_FAULTS: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)
"""Errors of a disk that is full, that fails, or that the system made read-only for that."""


class Writer(Protocol):
    """A file of a log, as a recording uses it: `rtec.log.writer.LogWriter` is one.

    Attributes:
        rows: number of rows in the file.
    """

    rows: int

    def write(self, samples: Samples, commands: Commands) -> None:
        """Append rows; raises LogError."""
        ...

    def flush(self) -> None:
        """Put all rows on disk; raises LogError."""
        ...

    def close(self) -> None:
        """End the file; raises LogError."""
        ...


@dataclass(frozen=True)
class Begin:
    """Beginning of a file.

    Attributes:
        row: its first row.
        header: header entries on its beginning.
    """

    row: int
    header: Mapping[str, str]

    @classmethod
    def at_start(cls, output: list[int], state: Mapping[str, Any]) -> "Begin":
        """The first file of a run; `state` is the fast path's report."""
        return cls(0, {"initial_output": json.dumps(output), "initial_state": json.dumps(state)})

    @classmethod
    def behind(cls, saved: Saved) -> "Begin":
        """A file whose first row follows the row of a saved state."""
        state = {"structure": saved.structure.hex(), **state_text(saved.state)}
        header = {"initial_output": json.dumps(saved.output.tolist()), "initial_state": json.dumps(state)}
        return cls(saved.row + 1, {**header, "first_row": str(saved.row + 1)})


Open = Callable[[Path, Mapping[str, str]], Writer]


@dataclass
class Recording:
    """Writes rows to the disk.

    Attributes:
        path: the newest file; None: nothing is recorded.
        clock: times new attempts.
        open_writer: creates a file, from its path and its beginning.
        warnings: messages for the user; new ones are appended.
        trouble: present fault; "" where there is none.
        missed: number of rows that are in no file.
    """

    path: Path | None
    clock: Clock
    open_writer: Open
    warnings: list[str] = field(default_factory=list)
    trouble: str = ""
    missed: int = 0
    _writer: Writer | None = None
    _given: int = 0
    _from: int = 0
    _next: int = 0
    _pending: Begin | None = None
    _inexact: bool = False
    _retry_ns: int = 0
    _missed_before: int = 0
    _goes_on: str = ""

    def begin(self, begin: Begin) -> None:
        """Create the first file; on a disk that is full or fails later, as the correction does not wait for it.

        Raises:
            LogError: it cannot be created for another reason, which a person mends first.
        """
        if self.path is None:
            return
        try:
            self._writer = self.open_writer(self.path, begin.header)
            self._from = self._next = begin.row
        except LogError as e:
            if not isinstance(e.__cause__, OSError) or e.__cause__.errno not in DISK_FAULTS:
                raise
            self._fail(str(e))

    def write(self, samples: Samples, commands: Commands, first_row: int) -> None:
        """Record rows; `first_row` is the number of the first of them.

        Raises:
            Exception: an unforeseen fault; as after a LogError, the file ends and the rows count as missed.
        """
        stop = first_row + len(samples)
        try:
            if self._pending is not None and stop > self._pending.row:
                at = max(0, self._pending.row - first_row)
                self._put(samples.rows(0, at), commands.rows(0, at), first_row)
                self._change(self._pending)
                self._put(samples.rows(at, len(samples)), commands.rows(at, len(samples)), first_row + at)
            else:
                self._put(samples, commands, first_row)
        except Exception:
            self.missed, self._next = self.missed + max(0, stop - self._next), max(self._next, stop)
            raise

    def flush(self) -> None:
        """Put all rows on disk."""
        self._try(lambda w: w.flush())
        if self.clock.now_ns() >= self._retry_ns:
            self._report_resumed()

    def cut(self, begin: Begin) -> None:
        """Begin a new file at that row, which is still to come."""
        if self.path is not None:
            self._pending = begin

    def wants_to_try_again(self) -> bool:
        """Is it time for a new file, after a failure or a gap? `cut` sets where it begins."""
        if self.path is None or self._pending is not None:
            return False
        return self._inexact if self._writer is not None else self.clock.now_ns() >= self._retry_ns

    def close(self) -> None:
        """End the last file."""
        self._try(lambda w: w.flush())
        self._report_resumed()
        self._try(lambda w: w.close())
        self._writer = None

    def _put(self, samples: Samples, commands: Commands, first_row: int) -> None:
        skip = min(len(samples), max(0, self._from - first_row))
        if self._writer is not None and first_row + skip > self._next:
            self._end_at_gap(first_row + skip, first_row + skip - self._next)
        self._next = max(self._next, first_row + len(samples))
        if self._writer is None:
            self.missed += len(samples) if self.path is not None else 0
        elif len(samples) > skip:
            self._given += len(samples) - skip
            self._try(lambda w: w.write(samples.rows(skip, len(samples)), commands.rows(skip, len(samples))))

    def _end_at_gap(self, row: int, lost_rows: int) -> None:
        """Rows are missing: the next rows cannot be replayed from this file's beginning, and go into another file.

        The step's memory at this row is unknown, so that file can be read but not checked; the one after it can.
        """
        self.warnings.append(f"{lost_rows} rows came too fast and are in no log; a new file begins behind them")
        self._change(Begin(row, {"first_row": str(row), "rows_lost_before": str(lost_rows)}))
        self._inexact = True

    def _report_resumed(self) -> None:
        """Report it some time after the first rows: an almost full disk would else cause a report every few seconds."""
        if self._goes_on and self._writer is not None and self._writer.rows:
            self.warnings.append(self._goes_on)
            self.trouble, self._missed_before, self._goes_on = "", self.missed, ""

    def _tell_stop(self, why: str) -> None:
        if not self.trouble:
            self.warnings.append(f"logging stopped, the correction went on: {why}")
        self.trouble, self._goes_on = f"logging stopped: {why}", ""

    def _change(self, begin: Begin) -> None:
        """End this file, begin the next."""
        if self.path is None:
            return
        self._pending, self._inexact = None, False
        self._try(lambda w: w.close())
        self._writer = None
        path = free_path(self.path)
        try:
            self._writer = self.open_writer(path, begin.header)
            self._from = self._next = begin.row
            self._given = 0
        except LogError as e:
            self._fail(str(e))
            return
        except Exception as e:
            self._fail(unforeseen(e))
            raise
        self.path = path
        if self.trouble:
            self._retry_ns = self.clock.now_ns() + RETRY_NS
            self._goes_on = f"logging goes on in {path}; {self.missed - self._missed_before} rows are in no log"

    def _try(self, action: Callable[[Writer], None]) -> None:
        if self._writer is None:
            return
        try:
            action(self._writer)
        except LogError as e:
            self._fail(str(e))
        except Exception as e:
            self._fail(unforeseen(e))
            raise

    def _fail(self, why: str) -> None:
        self._tell_stop(f"{why}; tried again every {RETRY_NS // 1_000_000_000} s")
        self._retry_ns = self.clock.now_ns() + RETRY_NS
        writer, self._writer = self._writer, None
        if writer is not None:
            self.missed += self._given - writer.rows  # rows that were still in memory
            with suppress(Exception):  # reported already
                writer.close()


def free_path(path: Path) -> Path:
    """The next free name after this one: `run.arrows`, `run-2.arrows`, `run-3.arrows`."""
    stem, k = path.stem, 1
    head, _, tail = stem.rpartition("-")
    if head and tail.isdigit() and len(tail) < len("20260101"):
        stem, k = head, int(tail)
    while True:
        k += 1
        candidate = path.with_name(f"{stem}-{k}{path.suffix}")
        if not candidate.exists():
            return candidate

"""A folder of logs: their names, the order that these give, and of each file when, how much and whether it is whole.

`mill-000012-20260309T133000Z-3.arrows` is the third file of the twelfth run logged into that folder. Files are in order
run by run, file by file as they were begun. The date is for people; where the clock was set back between two runs the
numbers still tell which came first.
"""

import fcntl
import os
import re
import stat
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Final, Literal

from rtec.errors import LogError
from rtec.log.format import Log
from rtec.log.packed import PACKED
from rtec.log.reader import LogReader, open_log
from rtec.loop.clock import Clock, wall_clock_ns
from rtec.loop.state_files import boot_id

WRITTEN: Final = ".arrows"
_NAME: Final = re.compile(r"(?P<stem>.*?)(-(?P<run>\d{6,}))?-(?P<date>\d{8}T\d{6}Z)(-(?P<file>\d{1,7}))?", re.ASCII)


@dataclass(frozen=True, order=True)
class LogPlace:
    """Where a file stands among the others.

    Attributes:
        run: number of its run; 0 for a file that has none.
        name: of its run.
        file: number within the run.
    """

    run: int
    name: str
    file: int


def place_of(path: Path) -> LogPlace:
    """Read a file's place from its name."""
    found = _NAME.fullmatch(path.stem)
    if found is None:
        return LogPlace(0, path.stem, 1)
    run, name = int(found["run"] or 0), path.stem[: found.end("date")]
    return LogPlace(run, name, int(found["file"] or 1))


def log_files(folder: Path) -> list[Path]:
    """All logs of a folder, by their names alone, oldest first; where both forms of one are there, the written one."""
    try:
        found = [p for p in folder.iterdir() if p.suffix in (WRITTEN, PACKED) and not p.name.startswith(".")]
    except OSError:
        return []
    return sorted((p for p in found if p.suffix == WRITTEN or p.with_suffix(WRITTEN) not in found), key=place_of)


def logs_at(path: Path) -> list[Path]:
    """Give the logs of a folder, oldest first; a file stands for itself.

    Raises:
        LogError: there is no such file or folder, or it cannot be read, or it has no logs.
    """
    try:
        if not stat.S_ISDIR(path.stat().st_mode):
            return [path]
        next(path.iterdir(), None)
    except OSError as error:
        raise LogError(f"log {path}: cannot be opened: {error.strerror}") from error
    if not (found := log_files(path)):
        raise LogError(f"log {path}: no logs in this folder")
    return found


def next_log(folder: Path, path: Path) -> Path | None:
    """Give the log that was begun after this one; None where there is none, or no folder."""
    return next((p for p in log_files(folder) if place_of(p) > place_of(path)), None) if folder.is_dir() else None


def first_name(folder: Path, stem: str, started: str) -> Path:
    """Name of the first file of a run.

    Args:
        folder: of the logs.
        stem: of the run file.
        started: date and time, as in `20260309T133000Z`.
    """
    run = 1 + max((place_of(path).run for path in log_files(folder)), default=0)
    return folder / f"{stem}-{run:06d}-{started}{WRITTEN}"


State = Literal["being written", "packed", "whole", "torn", "damaged"]
_READ_AT_ONCE_NS: Final = 10_000_000
_TRIES: Final = 5


@dataclass(frozen=True)
class Segment:
    """A file.

    Attributes:
        path: the file.
        state: "being written"; "packed" as Parquet; "whole" or "torn" at its end by a kill or power cut, not yet
            packed; "damaged": cannot be read, or not to its end.
        bytes: its size.
        rows: that can be read, as far as its head tells.
        from_ns, to_ns: date and time of its first and last row, ns since 1970 UTC; None where that is not known.
        offset_ns: wall clock minus monotonic clock, as they stood when the file began; None where it does not say.
        why: what is damaged; "" where nothing is.
    """

    path: Path
    state: State
    bytes: int
    rows: int = 0
    from_ns: int | None = None
    to_ns: int | None = None
    offset_ns: int | None = None
    why: str = ""

    def overlaps(self, from_ns: int | None, to_ns: int | None) -> bool:
        """Has it rows in that stretch of date and time? A file that does not tell its time may have."""
        if self.from_ns is None or self.to_ns is None:
            return True
        return (from_ns is None or self.to_ns >= from_ns) and (to_ns is None or self.from_ns < to_ns)


def time_header(clock: Clock) -> dict[str, str]:
    """What a file says of time at its beginning: both clocks at one instant, and which start of the computer it was.

    A step of the wall clock begins a new file, so what stands here holds for all of its rows.
    """
    monotonic_ns, wall_ns = both_clocks(clock)
    boot = boot_id().decode(errors="replace").strip("\0")
    return {"monotonic_ns": str(monotonic_ns), "wall_ns": str(wall_ns), "boot_id": boot}


def both_clocks(clock: Clock) -> tuple[int, int]:
    """Monotonic and wall clock at one instant, ns; read again where something came between."""
    for _ in range(_TRIES):
        before, wall_ns = clock.now_ns(), wall_clock_ns()
        if clock.now_ns() - before < _READ_AT_ONCE_NS:
            break
    return before, wall_ns


def look_at(path: Path) -> Segment:
    """Look at one file; whatever is wrong with it is told, not raised."""
    size = 0
    with suppress(OSError):
        size = path.stat().st_size
    try:
        with open_log(path) as log:
            return _found(path, log, size)
    except LogError as error:
        return Segment(path, "being written" if being_written(path) else "damaged", size, why=str(error))


def being_written(path: Path) -> bool:
    """Has somebody locked the file?"""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)  # a FIFO, too, is no log
    except OSError:
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(fd)
    return False


def _found(path: Path, log: Log, size: int) -> Segment:
    rows, span = log.rows, log.span_ns
    offset_ns = _offset_ns(log.header, span)
    from_ns = to_ns = None
    if span is not None and offset_ns is not None:
        from_ns, to_ns = span[0] + offset_ns, span[1] + offset_ns
    state, why = _state(path, log)
    return Segment(path, state, size, rows, from_ns, to_ns, offset_ns, why)


def _state(path: Path, log: Log) -> tuple[State, str]:
    if path.suffix == PACKED:
        return "packed", ""
    if log.complete:
        return "whole", ""
    if being_written(path):
        return "being written", ""
    if isinstance(log, LogReader) and (rest := log.damaged_bytes):
        return "damaged", f"log {path}: {rest} bytes behind row {log.rows} cannot be read, and they are not its end"
    return "torn", ""


def _offset_ns(header: Mapping[str, str], span_ns: tuple[int, int] | None) -> int | None:
    try:
        if "wall_ns" in header:
            return int(header["wall_ns"]) - int(header["monotonic_ns"])
        if span_ns is None:
            return None
        started = datetime.fromisoformat(header["started"])  # a log of an older version: to a few seconds
        return round(started.timestamp() * 1e9) - span_ns[0]
    except (KeyError, ValueError, OverflowError):
        return None

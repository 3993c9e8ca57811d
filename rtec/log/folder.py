"""A folder of logs: their names, their order, and of each file its time, its size and whether it is whole.

`mill-000012-20260309T133000Z-3.arrows` is the third file of the twelfth run that was logged into that folder. Files are
ordered by run, then by number. The date is for people; the numbers keep the order even where the clock was set back
between two runs.
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
REPLAYED: Final = ".replay"
"""End of the stem of what `rtec replay` writes beside a log: commands of another model, which no daemon gave."""
_NAME: Final = re.compile(r"(?P<stem>.*?)(-(?P<run>\d{6,}))?-(?P<date>\d{8}T\d{6}Z)(-(?P<file>\d{1,7}))?", re.ASCII)


@dataclass(frozen=True, order=True)
class LogPlace:
    """Place of a file in the order.

    Attributes:
        run: number of its run; 0 for a file that has none.
        name: name of its run.
        file: number within the run.
    """

    run: int
    name: str
    file: int


def place_of(path: Path) -> LogPlace:
    """Read a file's place from its name."""
    match = _NAME.fullmatch(path.stem)
    if match is None:
        return LogPlace(0, path.stem, 1)
    run, name = int(match["run"] or 0), path.stem[: match.end("date")]
    return LogPlace(run, name, int(match["file"] or 1))


def log_files(folder: Path) -> list[Path]:
    """All logs of a folder, by name, oldest first; where both forms of a log exist, the written one."""
    try:
        logs = [
            p for p in folder.iterdir()
            if p.suffix in (WRITTEN, PACKED) and not p.name.startswith(".") and not p.stem.endswith(REPLAYED)
        ]  # fmt: skip
    except OSError:
        return []
    return sorted((p for p in logs if p.suffix == WRITTEN or p.with_suffix(WRITTEN) not in logs), key=place_of)


def model_copy(folder: Path, model_hash: str) -> Path:
    """Where the copy of a model is that made logs of this folder."""
    return folder / "models" / f"{model_hash[:16]}.toml"


def logs_at(path: Path) -> list[Path]:
    """The logs of a folder, oldest first; a file stands for itself.

    Raises:
        LogError: the file or folder does not exist or cannot be read, or the folder has no logs.
    """
    try:
        if not stat.S_ISDIR(path.stat().st_mode):
            return [path]
        next(path.iterdir(), None)
    except OSError as error:
        raise LogError(f"log {path}: cannot be opened: {error.strerror}") from error
    if not (logs := log_files(path)):
        raise LogError(f"log {path}: no logs in this folder")
    return logs


def next_log(folder: Path, path: Path) -> Path | None:
    """The log that was begun after this one; None where there is none, or no folder."""
    return next((p for p in log_files(folder) if place_of(p) > place_of(path)), None) if folder.is_dir() else None


def first_name(folder: Path, stem: str, started: str) -> Path:
    """Path of the first file of a run.

    Args:
        folder: folder of the logs.
        stem: stem of the run file.
        started: date and time, as in `20260309T133000Z`.
    """
    run = 1 + max((place_of(path).run for path in log_files(folder)), default=0)
    return folder / f"{stem}-{run:06d}-{started}{WRITTEN}"


State = Literal["being written", "packed", "whole", "torn", "damaged"]
_READ_TOGETHER_NS: Final = 10_000_000
_TRIES: Final = 5


@dataclass(frozen=True)
class Segment:
    """One file of a log.

    Attributes:
        path: the file.
        state: "being written"; "packed" as Parquet; "whole", or "torn" at its end by a kill or power cut, and not yet
            packed; "damaged": cannot be read, or not to its end.
        bytes: its size.
        rows: number of readable rows, according to its header.
        from_ns, to_ns: date and time of its first and last row, ns since 1970 UTC; None where they are unknown.
        offset_ns: wall clock minus monotonic clock when the file began; None where the file does not have it.
        why: the damage; "" where there is none.
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
        """Has it rows in that stretch of date and time? A file without its time may have."""
        if self.from_ns is None or self.to_ns is None:
            return True
        return (from_ns is None or self.to_ns >= from_ns) and (to_ns is None or self.from_ns < to_ns)


def time_header(clock: Clock) -> dict[str, str]:
    """Time entries of a file's header: both clocks at one instant, and the start of the computer.

    A step of the wall clock begins a new file, so the offset holds for all rows of the file.
    """
    monotonic_ns, wall_ns = both_clocks(clock)
    boot = boot_id().decode(errors="replace").strip("\0")
    return {"monotonic_ns": str(monotonic_ns), "wall_ns": str(wall_ns), "boot_id": boot}


def both_clocks(clock: Clock) -> tuple[int, int]:
    """Monotonic and wall clock at one instant, ns; read again where the two reads were too far apart."""
    for _ in range(_TRIES):
        before, wall_ns = clock.now_ns(), wall_clock_ns()
        if clock.now_ns() - before < _READ_TOGETHER_NS:
            break
    return before, wall_ns


def look_at(path: Path) -> Segment:
    """Look at one file; its faults are in the result, not raised."""
    size = 0
    with suppress(OSError):
        size = path.stat().st_size
    try:
        with open_log(path) as log:
            return _segment(path, log, size)
    except LogError as error:
        return Segment(path, "being written" if being_written(path) else "damaged", size, why=str(error))


def being_written(path: Path) -> bool:
    """Does a process hold the file's lock?"""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)  # never blocks on a FIFO
    except OSError:
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(fd)
    return False


def _segment(path: Path, log: Log, size: int) -> Segment:
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
        started = datetime.fromisoformat(header["started"])  # a log of an older version: exact to a few seconds
        return round(started.timestamp() * 1e9) - span_ns[0]
    except (KeyError, ValueError, OverflowError):
        return None

"""Events beside the rows of a log: orders, marks, reloads; a line of JSON each, in a file next to the log."""

import errno
import json
import os
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

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

"""What happened beside the rows of a log: orders, marks, reloads; a line of JSON each, next to the log."""

import json
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

REMEMBERED: Final = 200


@dataclass(frozen=True)
class Event:
    """One thing that happened.

    Attributes:
        row: number of the newest row then; rows count from the start of the run.
        time_ns: instant of that row, monotonic clock, as in the log.
        utc: date and time of day, for people.
        what: name of the order, or "reloaded", "not reloaded".
        text: what was said with it, or what came of it.
        who: who ordered it.
    """

    row: int
    time_ns: int
    utc: str
    what: str
    text: str
    who: str


class Events:
    """Keeps the newest events, and writes each to a file.

    Args:
        path: the file, appended to; None: they are only kept.

    Attributes:
        newest: the last of them.
        total: how many there were.
    """

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self.newest: deque[Event] = deque(maxlen=REMEMBERED)
        self.total = 0

    def note(self, event: Event) -> None:
        """Keep it in memory."""
        self.newest.append(event)
        self.total += 1

    def write(self, event: Event) -> None:
        """Write it to the file.

        Raises:
            OSError: it cannot be written.
        """
        if self.path is None:
            return
        fields: Mapping[str, object] = asdict(event)
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(fields, ensure_ascii=False) + "\n")
            file.flush()


def events_path(log: Path | None) -> Path | None:
    """The file that lies next to a log."""
    return None if log is None else log.with_suffix(".events.jsonl")

"""A stretch of time as one log, over any number of files of a folder and starts of the computer.

Monotonic time begins at zero with every start of the computer; rows are in the order of the files' names. A damaged
file costs its own rows, and is reported in `troubles`. Date and time of day only select the stretch.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final, Self

import numpy as np

from rtec.errors import LogError
from rtec.log.folder import Segment, logs_at, look_at, place_of
from rtec.log.format import Block
from rtec.log.reader import open_log
from rtec.loop.records import Layout

_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_MICROSECOND: Final = timedelta(microseconds=1)
EXAMPLES: Final = "2026-03-09, '2026-03-09 14:30', 2026-03-09T13:30:00Z or 2026-03-09T14:30:00+01:00"


def instant_ns(text: str) -> int:
    """The instant of an ISO 8601 text, ns since 1970 UTC; a text without a zone is in this computer's local time.

    Raises:
        LogError: the text is no date and time.
    """
    try:
        moment = datetime.fromisoformat(text.strip())
        return (moment.astimezone(UTC) - _EPOCH) // _MICROSECOND * 1000
    except (ValueError, OverflowError) as error:
        raise LogError(f"{text!r} is no date and time; give {EXAMPLES}") from error


def utc_text(instant: int) -> str:
    """An instant, ns since 1970 UTC, as `2026-03-09 13:30:00Z`; "" where it is outside the calendar."""
    try:
        return (_EPOCH + timedelta(microseconds=instant // 1000)).strftime("%Y-%m-%d %H:%M:%SZ")
    except OverflowError:
        return ""


Progress = Callable[[int, int], None]


def segments_of(
    path: Path, from_ns: int | None = None, to_ns: int | None = None, progress: Progress | None = None
) -> list[Segment]:
    """The files of a folder that have rows in a stretch of date and time, oldest first; a file stands for itself.

    Args:
        path: folder, or one log.
        from_ns, to_ns: ns since 1970 UTC, `to_ns` not included; None: no bound.
        progress: called with the number of files done, and of all files.

    Raises:
        LogError: the file or folder does not exist or cannot be read, or the folder has no logs.
    """
    paths = logs_at(path)
    segments = []
    for k, each in enumerate(paths):
        segments.append(look_at(each))
        if progress is not None:
            progress(k + 1, len(paths))
    return [segment for segment in segments if segment.overlaps(from_ns, to_ns)]


class LogStretch:
    """Reads the rows of files one after the other.

    Attributes:
        path: folder of the files.
        header: header of the first file, and the names of all (`segments`).
        layout: names of axes and sensors, the same in all files.
        bytes: size of all files.
        troubles: faults of reading, so far.
        offset_ns: wall clock minus monotonic clock of the newest block; None where its file does not have it.
    """

    def __init__(self, path: Path, segments: Iterable[Segment], from_ns: int | None, to_ns: int | None) -> None:
        """Read the headers of all files.

        Raises:
            LogError: none of the files can be read, or their axes or sensors differ.
        """
        self.path, self._from_ns, self._to_ns = path, from_ns, to_ns
        self.troubles: list[str] = []
        self.offset_ns: int | None = None
        self._segments = [s for s in segments if s.rows]
        self.bytes = sum(s.bytes for s in self._segments)
        self.troubles += [s.why for s in segments if s.why and not s.rows]
        if not self._segments:
            raise LogError(f"log {path}: no rows {self._bounds()}" + "".join(f"\n{text}" for text in self.troubles))
        self.header, self.layout = self._heads()

    @property
    def rows(self) -> int:
        """Number of rows of all files, including those outside the stretch."""
        return sum(s.rows for s in self._segments)

    @property
    def torn_bytes(self) -> int:
        """0: only a single file has a torn end."""
        return 0

    @property
    def complete(self) -> bool:
        """Could everything be read?"""
        return not self.troubles

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """None: the files need not be of one start of the computer."""
        return None

    def blocks(self, max_rows: int = 65_536, start: int = 0) -> Iterator[Block]:
        """Rows of the stretch in blocks of `max_rows` at most; `start` must be 0."""
        del start
        for segment in self._segments:
            self.offset_ns = segment.offset_ns
            try:
                with open_log(segment.path) as log:
                    for samples, commands in log.blocks(max_rows):
                        first, stop = self._within(segment, samples.time_ns)
                        if first < stop:
                            yield samples.rows(first, stop), commands.rows(first, stop)
            except LogError as error:
                self.troubles.append(str(error))
            else:
                self.troubles += [segment.why] if segment.why else []

    def refresh(self) -> None:
        """Do nothing: the stretch does not grow."""

    def close(self) -> None:
        """Do nothing: files are open only while they are read."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _within(self, segment: Segment, time_ns: "np.ndarray[tuple[int, ...], np.dtype[np.int64]]") -> tuple[int, int]:
        """Range of a block's rows in the stretch; all rows, where the file does not have its date."""
        if segment.offset_ns is None:
            return 0, len(time_ns)
        bounds = [None if b is None else b - segment.offset_ns for b in (self._from_ns, self._to_ns)]
        first = 0 if bounds[0] is None else int(np.searchsorted(time_ns, bounds[0]))
        stop = len(time_ns) if bounds[1] is None else int(np.searchsorted(time_ns, bounds[1]))
        return first, stop

    def _heads(self) -> tuple[dict[str, str], Layout]:
        """Header of the first file, and the layout of most; a file that differs from others of its run is damaged."""
        heads = [_head(s.path) for s in self._segments]
        usual = Counter(layout for _, layout in heads).most_common(1)[0][0]
        runs = {place_of(s.path).name for s, (_, layout) in zip(self._segments, heads, strict=True) if layout == usual}
        good: list[tuple[Segment, dict[str, str]]] = []
        for segment, (header, layout) in zip(self._segments, heads, strict=True):
            if layout == usual:
                good.append((segment, header))
            elif place_of(segment.path).name in runs:
                self.troubles.append(f"log {segment.path}: its names of axes and sensors are damaged")
            else:
                raise LogError(
                    f"log {segment.path}: its axes and sensors are not those of the other logs; "
                    "choose a shorter stretch with --from and --to"
                )
        self._segments = [segment for segment, _ in good]
        return {**good[0][1], "segments": ", ".join(s.path.name for s in self._segments)}, usual

    def _bounds(self) -> str:
        parts = [f"from {utc_text(self._from_ns)}"] if self._from_ns is not None else []
        parts += [f"to {utc_text(self._to_ns)}"] if self._to_ns is not None else []
        return " ".join(parts) or "in it"


def _head(path: Path) -> tuple[dict[str, str], Layout]:
    with open_log(path) as log:
        return log.header, log.layout

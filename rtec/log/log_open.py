"""Opens a log, whichever of its two forms it has: `.arrows` as it was written, `.parquet` as it was packed."""

from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Final, Protocol, Self

from rtec.errors import LogError
from rtec.loop.records import Commands, Layout, Samples

PACKED: Final = ".parquet"


class Log(Protocol):
    """What reads one log: `LogReader`, `PackedReader`, or `LogStretch` for many files at once.

    Attributes:
        path: the file or folder.
        header: what the writer was given.
        layout: names of axes and sensors.
        bytes: size of the file.
    """

    path: Path
    header: dict[str, str]
    layout: Layout
    bytes: int

    @property
    def rows(self) -> int:
        """Whole rows."""
        ...

    @property
    def torn_bytes(self) -> int:
        """Bytes behind the last whole row."""
        ...

    @property
    def complete(self) -> bool:
        """Whether the writer closed it."""
        ...

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Instants of the first and the last row, monotonic clock; None without rows."""
        ...

    def blocks(self, max_rows: int = 65_536, start: int = 0) -> Iterator[tuple[Samples, Commands]]:
        """Rows from `start` on, in blocks of `max_rows` at most; raises LogError where they are damaged."""
        ...

    def refresh(self) -> None:
        """Look at the file again, with what was appended since."""
        ...

    def close(self) -> None:
        """Let go of the file."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


def open_log(path: Path) -> Log:
    """Open one file of a log.

    Raises:
        LogError: it is missing, or no log.
    """
    from rtec.log.log_packed import PackedReader
    from rtec.log.reader import LogReader

    if path.is_dir():
        raise LogError(f"log {path}: is a folder; `rtec log list {path}` shows the logs in it")
    return PackedReader(path) if path.suffix == PACKED else LogReader(path)

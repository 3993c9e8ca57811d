"""Says lines without ever waiting for whoever should hear them: a terminal that stands, a journal that is full."""

import queue
import threading
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import Final, Self

WAITING: Final = 200
"""Lines; what comes then is not said. It stands in the events all the same."""
END_S: Final = 1.0


class Aloud:
    """Entering starts a thread that says what it is given; leaving lets it finish, for a moment.

    Args:
        say: prints a line; may take as long as it likes.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._lines: queue.Queue[str | None] = queue.Queue(WAITING)
        self._thread = threading.Thread(target=self._work, name="rtec-aloud", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._put(None)
        self._thread.join(END_S)

    def line(self, text: str) -> None:
        """Have it said; from any thread."""
        self._put(text)

    def _put(self, text: str | None) -> None:
        try:
            self._lines.put_nowait(text)
        except queue.Full:
            return

    def _work(self) -> None:
        with suppress(OSError):  # a pipe whose reader is gone: there is nobody to tell
            while (text := self._lines.get()) is not None:
                self._say(text)

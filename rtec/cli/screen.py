"""A console of rich that shows foreign text as plain text: no markup, no escape codes, no forged lines.

Its own codes bypass the shield of standard output and error (`rtec.cli.main`).
"""

from collections.abc import Iterable
from contextlib import suppress
from typing import IO, Any

import rich.console
from rich.console import ConsoleOptions, RenderableType
from rich.segment import Segment

from rtec.text import clean_lines


class Console(rich.console.Console):
    """rich's console, where brackets in a text are no markup, and unprintable characters are shown as escapes.

    Args:
        more: further arguments of `rich.console.Console`.
    """

    def __init__(self, **more: Any) -> None:
        super().__init__(markup=False, emoji=False, **more)

    @property
    def file(self) -> IO[str]:
        """The stream to draw on: the original one, without the shield and without the proxy of a live display."""
        out = super().file
        while hasattr(out, "rich_proxied_file"):
            out = out.rich_proxied_file
        return out

    @file.setter
    def file(self, new_file: IO[str]) -> None:
        self._file = new_file

    def on_broken_pipe(self) -> None:
        """The reader of the output has ended, as `head` does: no failure, but nobody reads any more.

        Raises:
            SystemExit: status 0.
        """
        with suppress(SystemExit):
            super().on_broken_pipe()
        raise SystemExit(0)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Render as rich, with every text cleaned."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(clean_lines(segment.text), segment.style)

"""rich's console shows text from outside as text: no markup, no escape codes, no lines that nobody wrote.

Its own codes go past the shield of standard output and error (`rtec.cli.shield`).
"""

from collections.abc import Iterable
from typing import IO, Any

import rich.console
from rich.console import ConsoleOptions, RenderableType
from rich.segment import Segment

from rtec.text import clean_lines


class Console(rich.console.Console):
    """rich's console; brackets in a text are brackets, and what is not printable is shown as its escape.

    Args:
        more: as rich's.
    """

    def __init__(self, **more: Any) -> None:
        super().__init__(markup=False, emoji=False, **more)

    @property
    def file(self) -> IO[str]:
        """Where it draws: the stream itself, behind the shield and behind what a live display puts before that."""
        out = super().file
        while hasattr(out, "rich_proxied_file"):
            out = out.rich_proxied_file
        return out

    @file.setter
    def file(self, new_file: IO[str]) -> None:
        self._file = new_file

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Draw, with every text cleaned."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(clean_lines(segment.text), segment.style)

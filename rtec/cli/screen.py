"""The terminal shows text from outside as text: no markup, no escape codes, no lines that nobody wrote.

`shielded` is for everything that is written to standard output and error; `Console` for what rich draws there, whose
own codes go past the shield.
"""

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import IO, Any, TextIO, cast

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


class _Shield:
    """A stream that is written cleaned text; rich knows such proxies and writes to what is behind them."""

    def __init__(self, stream: TextIO) -> None:
        self.rich_proxied_file = stream

    def write(self, text: str) -> int:
        return self.rich_proxied_file.write(clean_lines(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.rich_proxied_file, name)


@contextmanager
def shielded() -> Iterator[None]:
    """Clean whatever is written to standard output and error inside."""
    out, err = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = cast(TextIO, _Shield(out)), cast(TextIO, _Shield(err))
    try:
        yield
    finally:
        sys.stdout, sys.stderr = out, err

"""What is written to standard output and error is text: no escape codes, no lines that nobody wrote."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO, cast

from rtec.text import clean_lines


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

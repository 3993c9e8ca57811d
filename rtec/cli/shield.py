"""Cleans standard output and error: no escape codes, no forged lines."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO, cast

from rtec.text import clean_lines


class _Shield:
    """A stream that cleans its text; rich recognises such a proxy and writes to the stream behind it."""

    def __init__(self, stream: TextIO) -> None:
        self.rich_proxied_file = stream

    def write(self, text: str) -> int:
        return self.rich_proxied_file.write(clean_lines(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.rich_proxied_file, name)


@contextmanager
def shielded() -> Iterator[None]:
    """Context in which all text to standard output and error is cleaned."""
    out, err = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = cast(TextIO, _Shield(out)), cast(TextIO, _Shield(err))
    try:
        yield
    finally:
        sys.stdout, sys.stderr = out, err

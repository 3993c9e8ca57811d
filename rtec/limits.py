"""Largest size of a file: limited by this computer's memory, and checked before anything is unpacked."""

import os
from pathlib import Path
from typing import Final

from rtec.errors import RtecError

SHARE: Final = 0.5
"""Share of the memory for one file."""


def most_bytes(expansion: int) -> int:
    """Largest size, bytes, of a file that takes `expansion` bytes of memory for each of its bytes while it is read."""
    return int(SHARE * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")) // expansion


def check_size(path: Path, size: int, expansion: int, error: type[RtecError]) -> None:
    """Refuse a file that, as read or unpacked, does not fit into memory.

    Raises:
        error: it is larger than `most_bytes`; the message has both sizes.
    """
    most = most_bytes(expansion)
    if size > most:
        raise error(f"{path}: {size:.3g} bytes, and this computer's memory holds {most:.3g} of such a file; divide it")

"""How large a file may be: what this computer's memory holds, found out before anything of the file is unpacked."""

import os
from pathlib import Path
from typing import Final

from rtec.errors import RtecError

SHARE: Final = 0.5
"""Of the memory, for one file."""


def most_bytes(expansion: int) -> int:
    """Most bytes of a file of which each takes `expansion` bytes of memory while it is read."""
    return int(SHARE * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")) // expansion


def check_size(path: Path, size: int, expansion: int, error: type[RtecError]) -> None:
    """Refuse a file, or what it unpacks to, that memory does not hold.

    Raises:
        error: it is larger than `most_bytes`; the message says both sizes.
    """
    most = most_bytes(expansion)
    if size > most:
        raise error(f"{path}: {size:.3g} bytes, and this computer's memory holds {most:.3g} of such a file; divide it")

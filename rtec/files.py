"""Files: written whole or not at all, and refused where they do not fit into this computer's memory."""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, Final

from rtec.errors import RtecError


@contextmanager
def whole(path: Path, error: type[RtecError], replace: bool = True) -> Iterator[BinaryIO]:
    """Open a file that takes its name, flushed to the disk, only when the block ends without an error.

    Several processes may write the same name at a time: each writes a file of its own, and the last one stays.

    Args:
        path: path of the file; its folder must exist.
        error: raised where it cannot be written, with the path and the reason.
        replace: replace an existing file.

    Raises:
        FileExistsError: the file exists, and `replace` is False.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_native_id()}.part")
    try:
        with part.open("wb") as out:
            yield out
            out.flush()
            os.fsync(out.fileno())
        if replace:
            part.replace(path)
        else:
            os.link(part, path)
    except FileExistsError:
        raise
    except OSError as e:
        raise error(f"{path}: cannot be written: {e.strerror or e}") from e
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def write_text(text: str, path: Path, error: type[RtecError]) -> None:
    """Write a text; the file appears whole or not at all, and replaces an existing one."""
    with whole(path, error) as out:
        out.write(text.encode())


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

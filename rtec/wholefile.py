"""A file appears under its name whole or not at all, whatever happens while it is written."""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

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

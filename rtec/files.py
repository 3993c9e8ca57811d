"""Files: written whole or not at all, and refused where they do not fit into this computer's memory.

A file takes the place of a regular file only. A symbolic link stays, and its target is written; a folder, a device, a
FIFO or a socket is refused.
"""

import errno
import os
import stat
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, Final

from rtec.errors import RtecError

_KINDS: Final = (
    (stat.S_ISDIR, "a folder; name a file"),
    (stat.S_ISFIFO, "a FIFO, no regular file; name another one"),
    (stat.S_ISSOCK, "a socket, no regular file; name another one"),
)


def check_named(path: Path, error: type[RtecError]) -> None:
    """Refuse ".", ".." and "/", which have no name that could get an end such as `.toml`.

    Raises:
        error: with the path.
    """
    if path.name in ("", ".."):
        raise error(f"{path}: cannot be written: it is {_KINDS[0][1]}")


def target_of(path: Path, error: type[RtecError]) -> Path:
    """The regular file that a file of this path becomes: the target of a symbolic link, else the path itself.

    Args:
        path: path of the file; it need not exist.
        error: raised where it is no regular file, with the path and what it is.
    """
    check_named(path, error)
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        mode = stat.S_IFREG
    except OSError as e:
        raise error(f"{path}: cannot be written: {e.strerror or e}") from e
    if not stat.S_ISREG(mode):
        kind = next((text for is_it, text in _KINDS if is_it(mode)), "a device, no regular file; name another one")
        raise error(f"{path}: cannot be written: it is {kind}")
    return Path(os.path.realpath(path)) if path.is_symlink() else path


def cannot_be_made(folder: Path) -> str:
    """Why a folder cannot be made, or no file in it; "" where it can. Makes nothing.

    A folder's permissions do not show everything: a disk may still be full, or a share refuse.
    """
    there = next((p for p in (folder, *folder.parents) if os.path.lexists(p)), Path())
    try:
        if not stat.S_ISDIR(there.stat().st_mode):
            return f"{there} is no folder"
    except OSError as e:
        return f"{there}: {e.strerror or e}"
    return "" if os.access(there, os.W_OK | os.X_OK) else f"{there} may not be written to"


def beside(base: Path, path: Path) -> Path:
    """A path that starts at a folder, or is absolute; the folder need not exist yet, even for a path out of it."""
    return base / path if base.is_dir() else Path(os.path.normpath(base.resolve() / path))


@contextmanager
def whole(path: Path, error: type[RtecError], replace: bool = True) -> Iterator[BinaryIO]:
    """Open a file that takes its name, flushed to the disk, only when the block ends without an error.

    Several processes may write the same name at a time: each writes a file of its own, and the last one stays.

    Args:
        path: path of the file; its folder must exist. A symbolic link stays one, and its target is replaced.
        error: raised where it cannot be written, with the path and the reason.
        replace: replace an existing file.

    Raises:
        FileExistsError: the file exists, and `replace` is False.
    """
    if not replace and os.path.lexists(path):
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    target = target_of(path, error)
    part = target.with_name(f".{path.name}.{os.getpid()}-{threading.get_native_id()}.part")
    try:
        with part.open("wb") as out:
            yield out
            out.flush()
            os.fsync(out.fileno())
        if replace:
            part.replace(target)
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

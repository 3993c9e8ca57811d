"""The local socket of a running daemon: where it is, how it is made so that nobody else can use it.

It lies beside the state in memory (`rtec.loop.state_files`), under its name.
"""

import os
import socket
import stat
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rtec.errors import RtecError
from rtec.loop.state_files import state_places

ORDERS: Final = ".control"
STATUS: Final = ".status"
"""Of the socket through which nobody can order anything."""
MODES: Final = {"user": 0o600, "group": 0o660}
LONGEST_PATH: Final = 107
"""Of a Unix socket's address on Linux."""
BACKLOG: Final = 128
_SHM: Final = Path("/dev/shm")  # noqa: S108 (not a temporary file: the place of shared memory on Linux)
_SERVICES: Final = Path("/run/rtec")
"""Folders that systemd gives to the services."""


@dataclass(frozen=True)
class LocalSocket:
    """A listening Unix socket.

    Attributes:
        path: its file.
        socket: whoever takes it closes it.
        inode: of the file, as long as it is this socket's.
    """

    path: Path
    socket: socket.socket
    inode: int

    def remove(self) -> None:
        """Remove the file, unless it is another daemon's by now."""
        with suppress(OSError):
            if self.path.lstat().st_ino == self.inode:
                self.path.unlink()


def socket_path(config: Path) -> Path:
    """Give the place of a daemon's local socket, for the user that calls this.

    Args:
        config: its run file.
    """
    return state_places(config, None).memory.with_suffix(ORDERS)


def status_path(config: Path) -> Path:
    """Give the place of the socket that only shows the status, as `socket_path`."""
    return socket_path(config).with_suffix(STATUS)


def listen(path: Path, access: str) -> LocalSocket:
    """Make a local socket that listens, with its permissions from its first instant.

    A file that a dead daemon left behind is replaced, that of a living one never.

    Args:
        path: where.
        access: "user" or "group".

    Raises:
        RtecError: a living daemon has it, or it cannot be made.
    """
    if len(os.fsencode(path)) > LONGEST_PATH:
        raise RtecError(
            f"{path}: longer than the {LONGEST_PATH} characters that the address of a local socket may have; "
            "name a shorter RUNTIME_DIRECTORY, or say `local = false` in [control]"
        )
    if answers(path):
        raise RtecError(f"another rtec runs with this run file ({path} answers): end that one first")
    made = socket.socket(socket.AF_UNIX)
    try:
        # Before it has a name: no instant in which somebody else could connect.
        os.fchmod(made.fileno(), MODES[access])
        path.unlink(missing_ok=True)
        made.bind(str(path))
        path.chmod(MODES[access])  # what the umask took away
        made.listen(BACKLOG)
        return LocalSocket(path, made, path.lstat().st_ino)
    except OSError as e:
        made.close()
        raise RtecError(f"control socket {path}: cannot be made: {e.strerror}") from e


def answers(path: Path) -> bool:
    """Does somebody listen at a local socket?

    Raises:
        RtecError: it may not be used by this user.
    """
    with socket.socket(socket.AF_UNIX) as trial:
        trial.setblocking(False)
        try:
            trial.connect(str(path))
        except BlockingIOError:  # alive, and busy
            return True
        except PermissionError as e:
            raise RtecError(f"{path}: not for this user; call rtec as the user that the daemon runs as") from e
        except OSError:
            return False
    return True


def of_config(config: Path) -> list[Path]:
    """Sockets for orders that a daemon with this run file would have, this user's first; they may be left behind."""
    return _like(socket_path(config))


def status_of_config(config: Path) -> list[Path]:
    """The same of the sockets that only show the status."""
    return _like(status_path(config))


def _like(own: Path) -> list[Path]:
    """Sockets that are named as one, but for the user."""
    name = own.name.split(".", maxsplit=2)[2]
    return sorted(_found(f"rtec.*.{name}"), key=lambda p: (p.name != own.name, str(p)))


def all_of() -> list[Path]:
    """Sockets for orders of every daemon of this user; for root, of every user. They may be left behind."""
    user = os.geteuid()
    return sorted(_found(f"rtec.{user}.*{ORDERS}" if user else f"rtec.*{ORDERS}"))


def _found(pattern: str) -> Iterator[Path]:
    """Files of that name whose owner is who the name says: in a folder for all, anybody can make any name."""
    for folder in {socket_path(Path()).parent, _SHM, *_service_folders()}:
        with suppress(OSError):
            for path in folder.glob(pattern):
                found = path.lstat()
                if stat.S_ISSOCK(found.st_mode) and path.name.split(".")[1] == str(found.st_uid):
                    yield path


def _service_folders() -> list[Path]:
    with suppress(OSError):
        return [p for p in _SERVICES.iterdir() if p.is_dir()]
    return []

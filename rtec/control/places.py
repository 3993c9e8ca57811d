"""The local socket of a running daemon: its path, and its creation such that no other user can use it.

It is beside the state in memory (`rtec.loop.state_files`), under the same name.
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
"""Ending of the socket that takes no orders."""
MODES: Final = {"user": 0o600, "group": 0o660}
LONGEST_PATH: Final = 107
"""Longest address of a Unix socket on Linux, bytes."""
BACKLOG: Final = 128
_SHM: Final = Path("/dev/shm")  # noqa: S108 (not a temporary file: the place of shared memory on Linux)
_SERVICES: Final = Path("/run/rtec")
"""Folder in which systemd makes those of the services."""


@dataclass(frozen=True)
class LocalSocket:
    """A listening Unix socket.

    Attributes:
        path: its file.
        socket: the socket; its user closes it.
        inode: inode of the file while it is this socket's.
    """

    path: Path
    socket: socket.socket
    inode: int

    def remove(self) -> None:
        """Remove the file, unless another daemon has it by now."""
        with suppress(OSError):
            if self.path.lstat().st_ino == self.inode:
                self.path.unlink()


def socket_path(config: Path) -> Path:
    """Path of a daemon's local socket, for the calling user.

    Args:
        config: its run file.
    """
    return state_places(config, None).memory.with_suffix(ORDERS)


def status_path(config: Path) -> Path:
    """Path of the socket that only reads the status; see `socket_path`."""
    return socket_path(config).with_suffix(STATUS)


def listen(path: Path, access: str) -> LocalSocket:
    """Make a listening local socket, with its permissions from its first instant.

    A dead daemon's file is replaced, a living daemon's never.

    Args:
        path: path of the socket.
        access: "user" or "group".

    Raises:
        RtecError: a living daemon has it, or it cannot be created.
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
        # Before it has a name: at no instant can another user connect.
        os.fchmod(made.fileno(), MODES[access])
        path.unlink(missing_ok=True)
        made.bind(str(path))
        path.chmod(MODES[access])  # restores what the umask removed
        made.listen(BACKLOG)
        return LocalSocket(path, made, path.lstat().st_ino)
    except OSError as e:
        made.close()
        raise RtecError(f"control socket {path}: cannot be made: {e.strerror}") from e


def answers(path: Path) -> bool:
    """Does a process listen at a local socket?

    Raises:
        RtecError: this user may not use it.
    """
    with socket.socket(socket.AF_UNIX) as trial:
        trial.setblocking(False)
        try:
            trial.connect(str(path))
        except BlockingIOError:  # alive, but busy
            return True
        except PermissionError as e:
            raise RtecError(f"{path}: not for this user; call rtec as the user that the daemon runs as") from e
        except OSError:
            return False
    return True


def of_config(config: Path) -> list[Path]:
    """Possible sockets for orders of a daemon with this run file, this user's first; the daemon may be dead."""
    return _like(socket_path(config))


def status_of_config(config: Path) -> list[Path]:
    """The same for the sockets that only read the status."""
    return _like(status_path(config))


def _like(own: Path) -> list[Path]:
    """Sockets with the same name for any user."""
    name = own.name.split(".", maxsplit=2)[2]
    return sorted(_owned(f"rtec.*.{name}"), key=lambda p: (p.name != own.name, str(p)))


def all_of() -> list[Path]:
    """Sockets for orders of every daemon of this user; for root, of every user. The daemons may be dead."""
    user = os.geteuid()
    return sorted(_owned(f"rtec.{user}.*{ORDERS}" if user else f"rtec.*{ORDERS}"))


def _owned(pattern: str) -> Iterator[Path]:
    """Files of that name whose owner matches the name: in a folder for all, anyone can create any name."""
    for folder in {socket_path(Path()).parent, _SHM, *_service_folders()}:
        with suppress(OSError):
            for path in folder.glob(pattern):
                status = path.lstat()
                if stat.S_ISSOCK(status.st_mode) and path.name.split(".")[1] == str(status.st_uid):
                    yield path


def _service_folders() -> list[Path]:
    with suppress(OSError):
        return [p for p in _SERVICES.iterdir() if p.is_dir()]
    return []

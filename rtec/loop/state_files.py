"""The files of the loop's state: memory that outlives the process, and a copy on disk that survives a power cut.

The first file is in a file system in memory (/dev/shm, or the run-time folder that systemd gives), so that the loop
never waits for a disk: a write to a mapped file on disk may block for any length of time. The file's
lock belongs to the loop's process; a second loop for the same run file is refused. The copy on disk is locked by the
supervisor: that refuses a second daemon where the file in memory was deleted, and another run file of the same name.
"""

import errno
import fcntl
import hashlib
import mmap
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.util import register_after_fork
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtec.errors import RtecError
from rtec.loop.clock import Clock
from rtec.loop.state import IMAGE_BYTES, SLOT_BYTES, SNAPSHOT, Saved, is_damaged, newest, read_slot

_SHM: Final = Path("/dev/shm")  # noqa: S108 (not a temporary file: the place of shared memory on Linux)
_BOOT_ID: Final = Path("/proc/sys/kernel/random/boot_id")
_TRIES: Final = 5
_LOCK_TRIES: Final = 40
_LOCK_PERIOD_NS: Final = 50_000_000


@dataclass(frozen=True)
class StatePlaces:
    """Paths of one run file's state.

    Attributes:
        memory: file in memory.
        disk: file on disk; None: nothing survives a power cut.
    """

    memory: Path
    disk: Path | None


def state_places(config: Path, folder: Path | None) -> StatePlaces:
    """The paths of a run file's state.

    Args:
        config: the run file.
        folder: for the copy on disk, where systemd gives none (STATE_DIRECTORY).
    """
    name = hashlib.sha256(str(config.resolve()).encode()).hexdigest()[:16]
    # Not "rtec-": files of that prefix are rings, and are removed with their owner.
    memory = Path(_given("RUNTIME_DIRECTORY") or _SHM) / f"rtec.{os.geteuid()}.{name}.state"
    given = _given("STATE_DIRECTORY")
    kept = Path(given) if given else folder
    return StatePlaces(memory, None if kept is None else kept / f"{config.stem}.state")


def _given(variable: str) -> str:
    """First folder of a variable that systemd sets; "" where it is not set."""
    return os.environ.get(variable, "").split(":", maxsplit=1)[0]


@contextmanager
def state_memory(path: Path, clock: Clock) -> Iterator[NDArray[np.uint8]]:
    """The image, mapped and locked; created where it does not exist.

    Raises:
        RtecError: another loop has it, another user owns it, or there is no room.
    """
    fd = _locked(path, clock)
    try:
        # Not closed here: it stays mapped until the last view of it is gone.
        yield np.frombuffer(mmap.mmap(fd, IMAGE_BYTES, flags=mmap.MAP_SHARED | mmap.MAP_POPULATE), np.uint8)
    finally:
        _remove_empty(fd, path)
        with suppress(OSError):  # the mapping has a descriptor of its own, which would keep the lock
            fcntl.flock(fd, fcntl.LOCK_UN)
        os.close(fd)


def _remove_empty(fd: int, path: Path) -> None:
    """Remove the file of a start that failed before anything was kept; never another loop's file."""
    with suppress(OSError):
        if newest(os.pread(fd, IMAGE_BYTES, 0)) is None and os.path.samestat(os.fstat(fd), path.stat()):
            path.unlink()


def _open(path: Path) -> int:
    try:
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o600)
    except OSError as error:
        raise RtecError(f"state {path}: cannot be made: {error.strerror}") from error
    try:
        if not stat.S_ISREG(os.fstat(fd).st_mode):
            raise RtecError(f"state {path}: is no ordinary file; remove it")
        if os.fstat(fd).st_uid != os.geteuid():
            raise RtecError(f"state {path}: belongs to somebody else; remove it")
        os.posix_fallocate(fd, 0, IMAGE_BYTES)
    except OSError as error:
        os.close(fd)
        raise RtecError(f"state {path}: no room for {IMAGE_BYTES} bytes: {error.strerror}") from error
    except RtecError:
        os.close(fd)
        raise
    return fd


def _locked(path: Path, clock: Clock) -> int:
    """Open and lock; waits up to two seconds for a loop that is just ending."""
    for _ in range(_LOCK_TRIES):
        fd = _open(path)
        if _take(fd, path):
            return fd
        os.close(fd)
        clock.sleep_until_ns(clock.now_ns() + _LOCK_PERIOD_NS)
    raise RtecError(f"another rtec runs with this run file ({path} is in use): end that one first")


def _take(fd: int, path: Path) -> bool:
    """Take the lock, if the file still has this name."""
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return os.path.samestat(os.fstat(fd), path.stat())
    except (BlockingIOError, FileNotFoundError):
        return False


class MemoryState:
    """The loop's state in memory, as another process reads it while the loop writes; works on a deleted file, too.

    Args:
        path: the file; opened at the first read at which it exists.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._fd = path, -1

    def newest(self) -> Saved | None:
        """The newest state; None where there is none."""
        for _ in range(_TRIES):
            if (saved := newest(self._image())) is not None:
                return saved
        return None

    def snapshot(self) -> Saved | None:
        """The third slot; None where it is not whole."""
        return read_slot(self._image(), SNAPSHOT)

    @property
    def deleted(self) -> bool:
        """Was the file deleted while the loop has it open?"""
        return self._fd >= 0 and not os.fstat(self._fd).st_nlink

    def remove(self) -> None:
        """Remove the file, unless another loop has it by now."""
        with suppress(OSError):
            fd = os.open(self.path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK)
            try:
                if _take(fd, self.path):
                    self.path.unlink()
            finally:
                os.close(fd)

    def close(self) -> None:
        """Close the file; remove one in which nothing was ever kept, as after a start that failed."""
        if self._fd >= 0:
            if os.fstat(self._fd).st_nlink and not any(os.pread(self._fd, IMAGE_BYTES, 0)):
                self.path.unlink(missing_ok=True)
            os.close(self._fd)
            self._fd = -1

    def _image(self) -> bytes:
        if self._fd < 0:
            self._fd = _open_to_read(self.path)
        return os.pread(self._fd, IMAGE_BYTES, 0) if self._fd >= 0 else b""


class DiskState:
    """The copy on disk: two slots in turns; one is on the disk before the other is written.

    The file is locked while it is open: two daemons never write one file, whatever path they reach it by.

    Args:
        path: the file; created by `lock`, or at the first `write`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._fd = self._next = -1
        self._marked = False
        register_after_fork(self, DiskState._let_go)  # a copy of this process that hangs would keep it locked

    def lock(self, clock: Clock) -> None:
        """Take the file for this process; waits up to two seconds for a daemon that is just ending.

        A disk that refuses the file is no error here: `write` raises it, and tries again.

        Raises:
            RtecError: another daemon has it, or it is not a file.
        """
        for _ in range(_LOCK_TRIES):
            try:
                self._open()
            except BlockingIOError:
                clock.sleep_until_ns(clock.now_ns() + _LOCK_PERIOD_NS)
            except OSError as error:
                if error.errno == errno.EINVAL:
                    raise RtecError(f"state {self.path}: {error.strerror}; remove it") from error
                return
            else:
                return
        raise RtecError(
            f"state {self.path}: another rtec keeps its state there; end that one first. Is it one of another run file "
            "of that name? Then give each a [run] state_folder of its own"
        )

    def write(self, saved: Saved) -> None:
        """Put a state on disk.

        Raises:
            OSError: it cannot be written; the state on disk is then the one before.
        """
        if self._fd >= 0 and not os.fstat(self._fd).st_nlink:  # a removed file: writes to it are lost
            self.close()
        if self._fd < 0:
            self._open()
        os.pwrite(self._fd, saved.words, self._next * SLOT_BYTES)
        os.fdatasync(self._fd)
        if not self._marked:  # after the first slot of this start, never before it
            os.pwrite(self._fd, boot_id(), SNAPSHOT * SLOT_BYTES)
            self._marked = True
        self._next = 1 - self._next

    def _open(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        fd = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK, 0o644)
        try:
            if not stat.S_ISREG(os.fstat(fd).st_mode):
                raise OSError(errno.EINVAL, "is no ordinary file")
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not os.fstat(fd).st_nlink:  # its owner removed it while we waited: it no longer has this name
                raise BlockingIOError(errno.EAGAIN, "was removed")
            os.posix_fallocate(fd, 0, IMAGE_BYTES)  # reserves the space, so a disk that fills up later stops nothing
        except OSError:
            os.close(fd)
            raise
        self._fd, self._next, self._marked = fd, _older(_bytes(self.path)), False

    def close(self) -> None:
        """Close the file; remove one in which nothing was ever kept, as after a start that failed."""
        if self._fd >= 0:
            if os.fstat(self._fd).st_nlink and not any(os.pread(self._fd, IMAGE_BYTES, 0)):
                self.path.unlink(missing_ok=True)
            self._let_go()

    def _let_go(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def read_disk(path: Path) -> tuple[Saved | None, bool]:
    """The newest state on disk, and whether this computer has restarted since: then its instants are of no use."""
    image = _bytes(path)
    mark = boot_id()
    at = SNAPSHOT * SLOT_BYTES
    return newest(image), image[at : at + len(mark)] != mark


def kept(places: StatePlaces) -> Saved | None:
    """The state of a run, without a lock, and whether it goes on or not; None where there is none. Changes nothing."""
    saved = newest(_bytes(places.memory))
    return read_disk(places.disk)[0] if saved is None and places.disk is not None else saved


def disk_is_damaged(path: Path) -> bool:
    """Was a state kept on disk that cannot be read any more?"""
    return is_damaged(_bytes(path))


def boot_id() -> bytes:
    """Changes with every start of the computer; zeros where the system does not give it."""
    with suppress(OSError):
        return _BOOT_ID.read_bytes().strip()[:36]
    return b"\0" * 36


def _older(image: bytes) -> int:
    """The slot to write next: one that is not whole, else the older one."""
    sequences = [-1 if (saved := read_slot(image, k)) is None else saved.sequence for k in range(2)]
    return sequences.index(min(sequences))


def _bytes(path: Path) -> bytes:
    """Content of a state's file; empty where it does not exist or is no ordinary file."""
    fd = _open_to_read(path)
    if fd < 0:
        return b""
    try:
        return os.pread(fd, IMAGE_BYTES, 0)
    finally:
        os.close(fd)


def _open_to_read(path: Path) -> int:
    """Descriptor of an ordinary file; -1 where there is none. Never blocks, as opening a FIFO would."""
    with suppress(OSError):
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        if stat.S_ISREG(os.fstat(fd).st_mode):
            return fd
        os.close(fd)
    return -1

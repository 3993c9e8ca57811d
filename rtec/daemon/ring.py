"""A ring of samples and commands in shared memory: the fast path writes, the supervisor drains.

One slot a cycle, one producer, one consumer, each in a process of its own. Memory, in this order, each part on
64-byte lines: constants, words that the producer writes, words that the consumer writes, orders among them
(`rtec.loop.orders`), a note in words (`Note`), the names of axes and sensors (JSON), then each field
of `Samples` and `Commands` as one array of `capacity` slots.

No row is ever torn. The producer owns the slot of row `head` until `publish` moves `head`; so with head at h the
rows h - capacity + 1 ... h - 1 are whole. The consumer copies rows, then reads `head` again and drops those that
may have been overwritten meanwhile. Lost rows are counted in `overruns`; the producer never waits.

The memory is a file in /dev/shm, which is what POSIX shared memory is on Linux, mapped directly.
`multiprocessing.shared_memory` (before Python 3.13) registers every attached block with a resource tracker, which
removes it when any one of the processes ends. Nor does it reserve its memory, so a full /dev/shm is a SIGBUS at some
later write; here it is an error at creation.

Nothing leaks: the owner removes the name on leaving. The kernel releases the lock of a killed owner, so the next
`create` of that name recognises the orphan and takes it over. Where both sides are attached, the owner may also call
`unlink` at once; then the memory is freed with the last process, however that ends.

`Note` is a short text in shared memory that one process writes now and then and another reads; neither waits. The
writer makes the version odd, writes, and makes it even again. A reader that meets an odd version, or a version that
changed during its copy, tries again a few times and then keeps its old copy.
"""

import fcntl
import json
import mmap
import os
import secrets
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Self, overload

import numpy as np
from numpy.typing import NDArray

from rtec.arrays import Ints
from rtec.errors import RtecError
from rtec.loop.orders import OrderWords
from rtec.loop.records import Commands, Field, Layout, Samples

NOTE_BYTES: Final = 8192
_REASON_CHARACTERS: Final = 400
_TRIES: Final = 5


class Note:
    """The loop's note in words: present faults by device.

    Args:
        version: one int64 in shared memory.
        text: `NOTE_BYTES` bytes in shared memory: the length in four bytes, then UTF-8.
        barrier: a memory barrier.
    """

    def __init__(self, version: Ints, text: NDArray[np.uint8], barrier: Callable[[], None]) -> None:
        self._version, self._text, self._barrier = version, text, barrier
        self._written: Mapping[str, list[str]] = {}
        self._read_version, self._read = 0, dict[str, list[str]]()

    def write(self, reasons: Mapping[str, list[str]]) -> None:
        """Write the faults, where they have changed; a text that is too long is cut."""
        if reasons == self._written:
            return
        self._written = reasons
        data = _encoded(reasons)
        version = int(self._version[0])
        self._version[0] = version + 1
        self._barrier()
        self._text[:4] = np.frombuffer(len(data).to_bytes(4, "little"), np.uint8)
        self._text[4 : 4 + len(data)] = np.frombuffer(data, np.uint8)
        self._barrier()
        self._version[0] = version + 2

    def read(self) -> dict[str, list[str]]:
        """The last note."""
        for _ in range(_TRIES):
            version = int(self._version[0])
            if version == self._read_version:
                break
            self._barrier()
            data = self._text.tobytes()
            self._barrier()
            if version % 2 == 0 and int(self._version[0]) == version:
                self._read_version, self._read = version, _decoded(data)
        return self._read


def _encoded(reasons: Mapping[str, list[str]]) -> bytes:
    """JSON that fits; the texts are shortened until it does."""
    most = _REASON_CHARACTERS
    while most:
        short = {name: [text[:most] for text in texts] for name, texts in reasons.items()}
        data = json.dumps(short, ensure_ascii=False).encode()
        if len(data) <= NOTE_BYTES - 4:
            return data
        most //= 2
    return b"{}"


def _decoded(data: bytes) -> dict[str, list[str]]:
    reasons: Any = json.loads(data[4 : 4 + int.from_bytes(data[:4], "little")] or b"{}")
    return {str(name): [str(text) for text in texts] for name, texts in reasons.items()}


_SHM: Final = Path("/dev/shm")  # noqa: S108 (not a temporary file: the place of shared memory on Linux)
_MAGIC: Final = int.from_bytes(b"rtecrng3", "little")
_LINE: Final = 64
_MAGIC_AT, _CAPACITY_AT, _NAMES_BYTES_AT = 0, 1, 2
_HEAD_AT, _TAIL_AT = 8, 16
_NOTE_AT: Final = 13
_ORDERS_AT: Final = slice(20, 23)
_NOTE_OFFSET: Final = 3 * _LINE
_NAMES_OFFSET: Final = _NOTE_OFFSET + NOTE_BYTES


class _Word:
    """One int64 of the control block as an attribute."""

    def __init__(self, index: int, doc: str) -> None:
        self._index = index
        self.__doc__ = doc

    @overload
    def __get__(self, ring: None, owner: type) -> Self: ...
    @overload
    def __get__(self, ring: "Ring", owner: type) -> int: ...
    def __get__(self, ring: "Ring | None", owner: type) -> "Self | int":
        return self if ring is None else int(ring._words[self._index])

    def __set__(self, ring: "Ring", value: int) -> None:
        ring._words[self._index] = value


class Ring:
    """Single-producer single-consumer ring; make it with `create`, open it elsewhere with `attach`.

    Attributes:
        name: argument of `attach`.
        layout: names of axes and sensors.
        capacity: slots; at most capacity - 1 rows wait.
        orders: orders from the consumer's side.
        note: the producer's note in words; None once closed.
    """

    head = _Word(_HEAD_AT, "Rows published so far; the number of the row that the producer owns.")
    producer_heartbeat_ns = _Word(9, "Monotonic instant at which the producer last showed life, ns.")
    cycles = _Word(10, "Cycles done by the producer.")
    deadline_misses = _Word(11, "Cycles that ended after their deadline.")
    error_code = _Word(12, "Last error of the producer; 0 none. The meaning is the loop's.")
    takeovers = _Word(14, "Orders to resume that the producer has carried out.")
    reloads = _Word(15, "Generation of the last order to reload that the producer has carried out.")
    tail = _Word(_TAIL_AT, "Rows delivered or lost so far: the number of the next row to drain.")
    overruns = _Word(17, "Rows lost because the consumer was a whole ring behind.")
    consumer_heartbeat_ns = _Word(18, "Monotonic instant at which the consumer last showed life, ns.")
    stop_requested = _Word(19, "Not 0 when the consumer's side wants the producer to end.")

    def __init__(self, name: str, fd: int, layout: Layout, capacity: int, *, owner: bool) -> None:
        self.name, self.layout, self.capacity = name, layout, capacity
        self._fd, self._owner_pid = fd, os.getpid() if owner else None
        offsets, size = _plan(layout, capacity)
        memory = mmap.mmap(fd, size, flags=mmap.MAP_SHARED | mmap.MAP_POPULATE)
        self._words = np.frombuffer(memory, np.int64, _NOTE_OFFSET // 8)
        arrays = {f.name: _array(memory, f, capacity, at) for f, at in offsets}
        self._samples = Samples(**{f.name: arrays[f.name] for f in Samples.fields_of(layout)})
        self._commands = Commands(**{f.name: arrays[f.name] for f in Commands.fields_of(layout)})
        self._published = self.head
        fence = threading.Lock()
        self._release, self._acquire = fence.release, fence.acquire
        self._acquire()
        self.orders = OrderWords(self._words[_ORDERS_AT])
        text = np.frombuffer(memory, np.uint8, NOTE_BYTES, _NOTE_OFFSET)
        self.note: Note | None = Note(self._words[_NOTE_AT : _NOTE_AT + 1], text, self._barrier)

    @classmethod
    def create(cls, layout: Layout, capacity: int = 8192, name: str | None = None) -> Self:
        """Create the memory, all zero, and own its name.

        Args:
            layout: names of axes and sensors.
            capacity: slots, at least 2.
            name: without a slash; None: a free one is chosen.

        Raises:
            RtecError: a living process owns that name, or there is no room in /dev/shm.
        """
        if capacity < 2:
            raise RtecError(f"ring capacity {capacity}: at least 2 slots are needed")
        if name is None:
            _remove_orphans()
            name = f"rtec-{os.getpid()}-{secrets.token_hex(4)}"
        fd = _create_file(_path(name), _plan(layout, capacity)[1])
        names = _names(layout)
        os.pwrite(fd, names, _NAMES_OFFSET)
        os.pwrite(fd, np.array([_MAGIC, capacity, len(names)], np.int64).tobytes(), 0)
        return cls(name, fd, layout, capacity, owner=True)

    @classmethod
    def attach(cls, name: str) -> Self:
        """Open a ring that another process created.

        Raises:
            RtecError: no ring has that name, or the file is no ring.
        """
        path = _path(name)
        try:
            fd = os.open(path, os.O_RDWR | os.O_NOFOLLOW)
        except OSError as error:
            raise RtecError(f"ring {path}: cannot be opened: {error.strerror}") from error
        try:
            layout, capacity = _read_constants(fd, path)
            return cls(name, fd, layout, capacity, owner=False)
        except BaseException:
            os.close(fd)
            raise

    @cached_property
    def slots(self) -> list[tuple[Samples, Commands]]:
        """One-row views of every slot; the first use makes them all (tens of ms), so call it before the loop starts.

        The producer fills *every* field of row `head`, in slot `head % capacity`, then publishes it. Before that, the
        slot holds the row of `capacity` cycles ago.
        """
        return list(zip(self._samples.singles(), self._commands.singles(), strict=True))

    def publish(self) -> int:
        """Pass row `head` to the consumer; give the number of the next row."""
        self._published = row = self._published + 1
        # The barriers (see `_barrier`; inline here to save its call) keep the order row, head, next row, as other
        # processors see it.
        self._release()
        self._acquire()
        self._words[_HEAD_AT] = row
        self._release()
        self._acquire()
        return row

    def drain(self, max_rows: int = 1 << 30) -> tuple[Samples, Commands]:
        """Copy and take up to `max_rows` of the oldest rows that are still whole; the block may have 0 rows."""
        head, tail = self.head, self.tail
        self._barrier()
        first = max(tail, head - self.capacity + 1)
        stop = min(head, first + max_rows)
        index = np.arange(first, stop) % self.capacity
        samples = Samples(**{k: a.take(index, axis=0) for k, a in self._samples.arrays().items()})
        commands = Commands(**{k: a.take(index, axis=0) for k, a in self._commands.arrays().items()})
        self._barrier()
        # Rows below this may have been overwritten while they were copied.
        whole = min(max(first, self.head - self.capacity + 1), stop)
        self.overruns += whole - tail
        self.tail = stop
        return samples.rows(whole - first, len(index)), commands.rows(whole - first, len(index))

    def unlink(self) -> None:
        """Remove the name; both sides keep the memory. Does nothing in another process, or a second time."""
        if self._owner_pid == os.getpid():
            self._owner_pid = None
            _path(self.name).unlink(missing_ok=True)

    def take_name(self) -> None:
        """Remove the name though another process owns it: it is no longer needed, and its owner may be killed."""
        _path(self.name).unlink(missing_ok=True)

    def close(self) -> None:
        """Release the memory, which stays mapped until the last view of it is gone; the owner removes the name."""
        self.unlink()
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
        self.__dict__.pop("slots", None)
        self.note = None
        empty = np.zeros(_NOTE_OFFSET // 8, np.int64)
        empty[:] = self._words
        self._words, self.orders = empty, OrderWords(empty[_ORDERS_AT])
        self._samples, self._commands = Samples.empty(self.layout, 0), Commands.empty(self.layout, 0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _barrier(self) -> None:
        """Full memory barrier: release, then take a lock. x86 orders stores by itself, ARM does not."""
        self._release()
        self._acquire()


def _plan(layout: Layout, capacity: int) -> tuple[list[tuple[Field, int]], int]:
    """Offset of every field and the total size, bytes."""
    at, offsets = _aligned(_NAMES_OFFSET + len(_names(layout))), []
    for field in (*Samples.fields_of(layout), *Commands.fields_of(layout)):
        offsets.append((field, at))
        at = _aligned(at + field.bytes_per_row * capacity)
    return offsets, at


def _aligned(offset: int) -> int:
    return -(-offset // _LINE) * _LINE


def _array(memory: mmap.mmap, field: Field, capacity: int, at: int) -> NDArray[Any]:
    shape = field.shape(capacity)
    count = capacity * (1 if field.width is None else field.width)
    return np.frombuffer(memory, field.dtype, count, at).reshape(shape)


def _names(layout: Layout) -> bytes:
    return json.dumps([layout.axes, layout.sensors]).encode()


def _path(name: str) -> Path:
    if not name or "/" in name or name.startswith("."):
        raise RtecError(f"ring name {name!r}: a plain name without a slash is needed")
    return _SHM / name


def _create_file(path: Path, size: int) -> int:
    """A new locked file of that many zeros; replaces one whose owner is dead."""
    _remove_dead(path)
    try:
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        raise RtecError(f"ring {path}: cannot be made: {error.strerror}") from error
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.posix_fallocate(fd, 0, size)
    except OSError as error:
        os.close(fd)
        path.unlink(missing_ok=True)
        raise RtecError(f"ring {path}: no room for {size} bytes: {error.strerror}") from error
    return fd


def _remove_orphans() -> None:
    """Remove rings of this user whose owner was killed before another process attached."""
    for path in _SHM.glob("rtec-*-*"):
        pid = path.name.split("-")[1]
        if pid.isdigit() and not Path("/proc", pid).exists():
            with suppress(RtecError, OSError):
                _remove_dead(path)


def _remove_dead(path: Path) -> None:
    """Remove a ring whose owner was killed; its lock is then free."""
    try:
        fd = os.open(path, os.O_RDWR | os.O_NOFOLLOW)
    except FileNotFoundError:
        return
    except OSError as error:
        raise RtecError(f"ring {path}: cannot be opened: {error.strerror}") from error
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # Another process may have replaced the file between the two calls above.
        if path.exists() and os.path.samestat(os.fstat(fd), path.stat()):
            path.unlink()
    except BlockingIOError as error:
        raise RtecError(f"ring {path}: in use by a running process; end that first, or choose another name") from error
    finally:
        os.close(fd)


def _read_constants(fd: int, path: Path) -> tuple[Layout, int]:
    """Layout and capacity of a ring file, checked against its size."""
    wrong = RtecError(f"ring {path}: not a ring of this version of rtec")
    words = np.frombuffer(os.pread(fd, _LINE, 0).ljust(_LINE, b"\0"), np.int64)
    capacity, names_bytes = int(words[_CAPACITY_AT]), int(words[_NAMES_BYTES_AT])
    size = os.fstat(fd).st_size
    if words[_MAGIC_AT] != _MAGIC or not 2 <= capacity <= size or not 0 < names_bytes <= size:
        raise wrong
    try:
        axes, sensors = json.loads(os.pread(fd, names_bytes, _NAMES_OFFSET))
        layout = Layout(tuple(map(str, axes)), tuple(map(str, sensors)))
    except (ValueError, TypeError) as error:
        raise wrong from error
    if _plan(layout, capacity)[1] != size:
        raise wrong
    return layout, capacity

"""A worker's readings of its device, in shared memory: values with their instants, and faults in words.

The worker writes the readings; readers never wait. The version of the readings is odd while they are written. A reader
that meets an odd version, or a version that changed during its copy, tries again a few times and then keeps its old
copy. So no reader ever has parts of two readings.

The memory has no name: other processes get its file descriptor at their start, and it is freed with the last of them,
however that ends.
"""

import mmap
import os
import threading
from collections.abc import Callable
from multiprocessing.reduction import DupFd
from typing import Any, Final

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.daemon.ring import NOTE_BYTES, Note
from rtec.errors import RtecError

NEVER: Final = -(2**63)
"""Instant of a sensor that has not been read yet; another device may read it."""
TRIES: Final = 5
_LINE: Final = 64
_WORDS: Final = 5 * _LINE // 8  # one cache line per writer, so that none slows another
_VERSION, _HEARTBEAT, _STATE, _DEVICE_NOTE, _STOP, _WORKER_NOTE, _RESUMES = 0, 8, 9, 10, 16, 17, 24
STARTING, OPEN, FAILED = 0, 1, 2


class _Word:
    """One int64 of the control block as an attribute."""

    def __init__(self, index: int, doc: str) -> None:
        self._index = index
        self.__doc__ = doc

    def __get__(self, memory: "Published", owner: type) -> int:
        return int(memory._words[self._index])

    def __set__(self, memory: "Published", value: int) -> None:
        memory._words[self._index] = value


class _Fence:
    """A memory barrier; an object of its own, so that no circle of references keeps the memory mapped."""

    def __init__(self) -> None:
        fence = threading.Lock()
        fence.acquire()
        self._release, self._acquire = fence.release, fence.acquire

    def barrier(self) -> None:
        """Full memory barrier: release, then take a lock. x86 orders stores by itself, ARM does not."""
        self._release()
        self._acquire()


class Published:
    """Shared memory of one device's readings; make it with `create`, pass it to a process that is being started.

    Args:
        fd: descriptor of the memory; this object closes it.
        sensors: number of sensors of the machine.

    Attributes:
        device_note: the worker's words on its device.
        worker_note: the supervisor's words on the worker.
        barrier: orders the writes before it and after it, as other processors see them.
    """

    version = _Word(_VERSION, "Of the readings; odd while they are written.")
    heartbeat_ns = _Word(_HEARTBEAT, "Monotonic instant at which the worker last showed life, ns; 0 before the first.")
    state = _Word(_STATE, "STARTING, OPEN, or FAILED: could not be opened.")
    stop_requested = _Word(_STOP, "Not 0 when the worker is to end.")
    resumes = _Word(_RESUMES, "Orders to resume given so far.")

    def __init__(self, fd: int, sensors: int) -> None:
        self._fd, self._sensors = fd, sensors
        at, size = _plan(sensors)
        memory = mmap.mmap(fd, size, flags=mmap.MAP_SHARED | mmap.MAP_POPULATE)
        self._words = np.frombuffer(memory, np.int64, _WORDS)
        self._degc = np.frombuffer(memory, np.float64, sensors, at["degc"])
        self._time_ns = np.frombuffer(memory, np.int64, sensors, at["time_ns"])
        self._rpm = np.frombuffer(memory, np.float64, 1, at["rpm"])
        self.barrier = _Fence().barrier
        self._device_text = np.frombuffer(memory, np.uint8, NOTE_BYTES, at["device_note"])
        self.device_note = Note(self._words[_DEVICE_NOTE : _DEVICE_NOTE + 1], self._device_text, self.barrier)
        text = np.frombuffer(memory, np.uint8, NOTE_BYTES, at["worker_note"])
        self.worker_note = Note(self._words[_WORKER_NOTE : _WORKER_NOTE + 1], text, self.barrier)

    @classmethod
    def create(cls, sensors: int) -> "Published":
        """Make the memory; nothing has been read yet.

        Raises:
            RtecError: there is no room.
        """
        fd = os.memfd_create("rtec-readings", os.MFD_CLOEXEC)
        try:
            os.posix_fallocate(fd, 0, _plan(sensors)[1])
        except OSError as e:
            os.close(fd)
            raise RtecError(f"no memory to share with a worker: {e.strerror}") from e
        made = cls(fd, sensors)
        made.forget()
        return made

    def __reduce__(self) -> tuple[Callable[..., "Published"], tuple[Any, ...]]:
        """Works only while a process is being started, which gets the descriptor."""
        return _received, (DupFd(self._fd), self._sensors)

    def publish(self, degc: Floats, time_ns: Ints, rpm: float) -> None:
        """Write one reading.

        Args:
            degc: °C, by sensor.
            time_ns: instants, ns; `NEVER` where the device has none.
            rpm: spindle speed, 1/min; NaN where it is not known.
        """
        version = self.version | 1  # a killed writer may have left it odd
        self.version = version
        self.barrier()
        self._degc[:] = degc
        self._time_ns[:] = time_ns
        self._rpm[0] = rpm
        self.barrier()
        self.version = version + 1

    def copy(self, degc: Floats, time_ns: Ints, rpm: Floats) -> bool:
        """Copy the readings; False where they were being written: the copy is then invalid."""
        version = self.version
        if version % 2:
            return False
        self.barrier()
        degc[:] = self._degc
        time_ns[:] = self._time_ns
        rpm[:] = self._rpm
        self.barrier()
        return self.version == version

    def forget(self) -> None:
        """Clear the memory before a worker begins: readings, notes, and what a killed worker left half written."""
        self._words[_DEVICE_NOTE] |= 1
        self.barrier()
        self._device_text[:4] = 0
        self.barrier()
        self._words[_DEVICE_NOTE] += 1
        nothing = np.full(self._sensors, np.nan)
        self.publish(nothing, np.full(self._sensors, NEVER), float("nan"))
        self.heartbeat_ns, self.state = 0, STARTING

    def close(self) -> None:
        """Close the descriptor; the memory stays mapped until this object is gone."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


class PublishedReader:
    """The newest whole reading of a `Published`; keeps the one before where none can be copied. Allocates nothing.

    Attributes:
        degc, time_ns: °C and instants, ns, by sensor.
        read: which sensors the device has read so far.
        rpm: one element, 1/min.
    """

    def __init__(self, memory: Published, sensors: int) -> None:
        self._memory, self._read_version = memory, -1
        self.degc, self.time_ns = np.full(sensors, np.nan), np.full(sensors, NEVER)
        self.rpm, self.read = np.full(1, np.nan), np.zeros(sensors, dtype=np.bool_)
        self._new_degc, self._new_time_ns, self._new_rpm = self.degc.copy(), self.time_ns.copy(), self.rpm.copy()

    def look(self) -> bool:
        """Copy the newest reading; False where it was being written at each attempt."""
        memory = self._memory
        for _ in range(TRIES):
            version = memory.version
            if version == self._read_version:
                return True
            if memory.copy(self._new_degc, self._new_time_ns, self._new_rpm):
                self._read_version = version  # the copy is at least this new; a newer one is copied the next time
                self.degc[:], self.time_ns[:], self.rpm[:] = self._new_degc, self._new_time_ns, self._new_rpm
                np.not_equal(self.time_ns, NEVER, out=self.read)
                return True
        return False


def _received(fd: Any, sensors: int) -> Published:
    return Published(fd.detach(), sensors)


def _plan(sensors: int) -> tuple[dict[str, int], int]:
    """Offset of every part and the total size, bytes."""
    at, offsets = _WORDS * 8, {}
    for name, size in (
        ("degc", 8 * sensors),
        ("time_ns", 8 * sensors),
        ("rpm", 8),
        ("device_note", NOTE_BYTES),
        ("worker_note", NOTE_BYTES),
    ):
        offsets[name] = at
        at += -(-size // _LINE) * _LINE
    return offsets, max(at, mmap.PAGESIZE)

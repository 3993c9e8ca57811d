"""Writes a log; `rtec.log.reader` describes the file.

The file is locked (`flock`) while it is written, so that no other process packs or removes it; the lock ends with the
process, however that ends.
"""

import fcntl
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from rtec.errors import LogError
from rtec.log.format import END_MARK, schema_of
from rtec.loop.records import Commands, Layout, Samples


class LogWriter:
    """Appends to a new log; holds at most one batch in memory.

    Attributes:
        path: the file.
        rows: number of rows in the file.
    """

    def __init__(self, path: Path, layout: Layout, header: Mapping[str, str], batch_rows: int = 8192) -> None:
        """Create the file with its header; it is on disk when this returns.

        Args:
            path: must not exist.
            layout: names of axes and sensors.
            header: free text by key: versions, hashes, host, start; keys starting with `rtec.` are the format's own.
            batch_rows: rows held in memory before a batch is written.

        Raises:
            LogError: the file exists or cannot be written, or a key is not allowed.
        """
        if taken := [key for key in header if key.startswith("rtec.")]:
            raise LogError(f"log {path}: header key {taken[0]!r}: keys starting with 'rtec.' are the format's own")
        self.path, self.rows = path, 0
        self._schema, self._end, self._filled, self._fault = schema_of(layout, header), 0, 0, ""
        self._samples, self._commands = Samples.empty(layout, batch_rows), Commands.empty(layout, batch_rows)
        try:
            self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        except FileExistsError as error:
            raise LogError(f"log {path}: exists already; a log is never overwritten, choose another name") from error
        except OSError as error:
            raise LogError(f"log {path}: cannot be made: {error.strerror}") from error
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX)  # waits shortly: others lock an empty file only to look at it
            self._append(self._schema.serialize())
            self._sync()
            _sync_folder(path)
        except LogError:  # a file without its header is no log
            self._remove()
            raise
        except OSError as error:  # a file system without locks, or a disk that fails
            self._remove()
            raise LogError(f"log {path}: cannot be locked or brought to the disk: {error.strerror}") from error

    def write(self, samples: Samples, commands: Commands) -> None:
        """Append n rows (copied); each full batch goes into the file.

        Raises:
            LogError: the file cannot be written, now or before; it is then readable up to `rows`.
        """
        done, n = 0, len(samples)
        while done < n:
            take = min(n - done, len(self._samples) - self._filled)
            into = slice(self._filled, self._filled + take)
            for mine, theirs in ((self._samples, samples), (self._commands, commands)):
                for name, array in mine.arrays().items():
                    array[into] = getattr(theirs, name)[done : done + take]
            self._filled, done = self._filled + take, done + take
            if self._filled == len(self._samples):
                self._append_batch()

    def flush(self) -> None:
        """Put all rows on disk; from here on they survive a power cut.

        Raises:
            LogError: as for `write`.
        """
        self._fail_if_removed()
        if self._filled:
            self._append_batch()
        self._sync()

    def close(self) -> None:
        """Flush, mark the end, close; does nothing the second time. After a fault it only closes.

        Raises:
            LogError: as for `write`; the file is closed all the same.
        """
        if self._fd < 0:
            return
        try:
            if not self._fault:
                self.flush()
                self._append(END_MARK)
                self._sync()
        finally:
            if self._fault and not self.rows:  # on a full disk each attempt would leave an empty file behind
                self._remove()
            else:
                os.close(self._fd)
                self._fd = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _fail_if_removed(self) -> None:
        """Fail where the file was removed: it would accept rows as before, and lose all of them when it is closed."""
        if self._fault or self._fd < 0 or os.fstat(self._fd).st_nlink:
            return
        self._fault = f"log {self.path}: somebody removed it while it was written; its {self.rows} rows are lost"
        self.rows = 0
        raise LogError(self._fault)

    def _append_batch(self) -> None:
        n = self._filled
        arrays = self._samples.rows(0, n).arrays() | self._commands.rows(0, n).arrays()
        columns = [_column(arrays[f.name], f.type) for f in self._schema]
        self._append(pa.RecordBatch.from_arrays(columns, schema=self._schema).serialize())
        self.rows += n
        self._filled = 0

    def _append(self, message: pa.Buffer | bytes) -> None:
        """Write the whole message, or nothing: other Arrow programs refuse a file with a part of one."""
        if self._fault or self._fd < 0:
            raise LogError(self._fault or f"log {self.path}: closed")
        rest = memoryview(message)
        try:
            while rest:
                rest = rest[os.write(self._fd, rest) :]
        except OSError as error:
            with suppress(OSError):
                os.ftruncate(self._fd, self._end)
            self._fail(error)
        self._end += len(memoryview(message))

    def _remove(self) -> None:
        os.close(self._fd)
        self._fd = -1
        with suppress(OSError):
            self.path.unlink()

    def _sync(self) -> None:
        try:
            os.fdatasync(self._fd)
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        kept = f"; its {self.rows} rows are kept and readable, later rows are not in it" if self.rows else ""
        self._fault = f"log {self.path}: cannot be written: {error.strerror}{kept}"
        raise LogError(self._fault) from error


def _column(array: NDArray[Any], kind: pa.DataType) -> "pa.Array[Any]":
    flat: pa.Array[Any] = pa.Array.from_buffers(  # pa.array would import an installed pandas before the first row
        pa.from_numpy_dtype(array.dtype), array.size, [None, pa.py_buffer(np.ascontiguousarray(array).data)]
    )
    return flat if array.ndim == 1 else pa.Array.from_buffers(kind, len(array), [None], children=[flat])


def _sync_folder(path: Path) -> None:
    """Put the folder's entry of a new file on disk; without it a power cut removes the whole file."""
    fd = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)

"""Reads the written form of a log: an Arrow IPC stream (`.arrows`) that any Arrow program opens. Opens either form.

One column a field of `Samples`, then of `Commands`; vectors are fixed-size lists, and their axis or sensor names are in
the column's metadata (`names`), units in `unit`. The schema is written first and has the header (versions, hashes,
host, start) as metadata. Batches are uncompressed, so that a reader maps the file and copies nothing. A vector of
length 0 (a machine without sensors) has no column.

The file is only ever appended to, a whole batch at a time. The reader ignores a part of a batch at the end, as after a
kill or power cut, and counts it in `torn_bytes`.
"""

import mmap
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from rtec.errors import LogError, first_line
from rtec.log.format import END_MARK, Log, check_columns, read_layout, read_metadata
from rtec.log.packed import PACKED, PackedReader
from rtec.loop.records import Commands, Field, Samples

_MAX_PLANS: Final = 256
_MESSAGE: Final = b"\xff\xff\xff\xff"
"""First bytes of every message of a stream."""
_FRAME: Final = b"\xff\xff\xff\xff"
"""First bytes of every message of an Arrow stream."""
_NOTHING: Final = pa.py_buffer(b"")
_Broken = (pa.ArrowException, OSError, EOFError, ValueError, TypeError, KeyError, OverflowError)


class LogReader:
    """Reads a log by mapping it; memory does not grow with its length, and nothing is copied.

    Attributes:
        path: the file.
        header: header as the writer got it.
        layout: names of axes and sensors.
    """

    def __init__(self, path: Path) -> None:
        """Open and check the header.

        Raises:
            LogError: missing, not an Arrow stream, not a log of rtec, or its columns are wrong.
        """
        self.path = path
        self._map()
        try:
            self._schema = pa.ipc.read_schema(pa.ipc.read_message(self._source))
            metadata = read_metadata(self._schema)
            self.layout = read_layout(path, metadata)
            check_columns(path, self._schema, self.layout)
        except _Broken as error:
            why = first_line(error) if self._memory[:4] == _FRAME else "a table of rtec log export is none"
            raise LogError(f"log {path}: not an Arrow IPC stream: {why}") from error
        self.header = {k: v for k, v in metadata.items() if not k.startswith("rtec.")}
        self._sample_fields, self._command_fields = Samples.fields_of(self.layout), Commands.fields_of(self.layout)
        self._first = self._source.tell()
        self._ends, self._rows_at_end = [self._first], [0]
        self._plans: dict[bytes, tuple[int, tuple[int, ...]]] = {}

    @property
    def rows(self) -> int:
        """Number of whole rows in the mapped file; reads the header of each batch, not the rows."""
        self._index()
        return self._rows_at_end[-1]

    @property
    def torn_bytes(self) -> int:
        """Number of bytes after the last whole batch that are not the mark of a clean end."""
        self._index()
        return 0 if self.complete else self.bytes - self._ends[-1]

    @property
    def complete(self) -> bool:
        """Did the writer close the file, with the end mark after the last batch?"""
        self._index()
        self._source.seek(self._ends[-1])
        return self._source.read(len(END_MARK) + 1) == END_MARK

    @property
    def damaged_bytes(self) -> int:
        """Bytes after the last readable row, where a whole batch follows them: damage, not a torn end; else 0."""
        at = self._ends[-1] if self.torn_bytes else self.bytes  # the search for the ends has read all headers
        while (at := self._memory.find(_MESSAGE, at + 1)) >= 0:
            if at % 8 == 0 and any(True for _ in self._batches(at)):
                return self.bytes - self._ends[-1]
        return 0

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Instants of the first and the last row, monotonic clock; None without rows."""
        last = self.rows - 1
        return None if last < 0 else (self._time_ns(0), self._time_ns(last))

    def blocks(self, max_rows: int = 65_536, start: int = 0) -> Iterator[tuple[Samples, Commands]]:
        """The rows from `start` on, in blocks of `max_rows` at most, as views of the mapped file.

        The mapping is private: writing to a view changes no file. Blocks end where the batches of the file do. Views
        stay valid after the reader is closed.

        Raises:
            LogError: a batch is whole in length but contradicts the header.
        """
        at, row = self._seek(start) if start else (self._first, 0)
        for _, n, offsets, body in self._batches(at):
            samples, commands = self._views(n, offsets, body)
            if start <= row and 0 < n <= max_rows:
                yield samples, commands
            else:
                for first in range(max(0, start - row), n, max_rows):
                    yield samples.rows(first, first + max_rows), commands.rows(first, first + max_rows)
            row += n

    def refresh(self) -> None:
        """Map the file again, to include what was appended since; earlier views stay valid."""
        self._map()

    def close(self) -> None:
        """Close the file; it stays mapped until the last view is gone."""
        self._source.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _map(self) -> None:
        try:
            with self.path.open("rb") as file:
                # Private: its arrays are ordinary writable ones, and writing to them changes no file.
                self._memory = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
            whole = pa.py_buffer(self._memory)
            self._source, self._address, self.bytes = pa.BufferReader(whole), whole.address, whole.size
        except OSError as error:
            raise LogError(f"log {self.path}: cannot be opened: {error.strerror or error}") from error
        except ValueError as error:  # an empty file cannot be mapped
            raise LogError(f"log {self.path}: is empty") from error

    def _time_ns(self, row: int) -> int:
        samples, _ = next(self.blocks(1, row))
        return int(samples.time_ns[0])

    def _index(self) -> None:
        """Find end and row count of every batch that is not in the index yet."""
        for end, n, _, _ in self._batches(self._ends[-1]):
            self._ends.append(end)
            self._rows_at_end.append(self._rows_at_end[-1] + n)

    def _seek(self, row: int) -> tuple[int, int]:
        """Offset of the batch that holds a row, and its first row."""
        self._index()
        i = max(0, int(np.searchsorted(self._rows_at_end, row, side="right")) - 1)
        return self._ends[i], self._rows_at_end[i]

    def _batches(self, at: int) -> Iterator[tuple[int, int, tuple[int, ...], pa.Buffer]]:
        """Each whole batch from an offset on: offset of its end, rows, offsets of the columns in its body, body."""
        while True:
            self._source.seek(at)
            try:
                message = pa.ipc.read_message(self._source)
                end = self._source.tell()
                n, offsets = self._plan(message, at)
            except _Broken:
                return  # the end, or a part of a batch after a kill or power cut
            yield end, n, offsets, message.body or _NOTHING
            at = end

    def _plan(self, message: pa.Message, at: int) -> tuple[int, tuple[int, ...]]:
        """Rows of a batch, and offset of each column's numbers in its body.

        Equal headers mean equal plans; parsing each batch again would take most of the reading time.
        """
        head = message.metadata.to_pybytes()
        if head not in self._plans:
            if len(self._plans) >= _MAX_PLANS:
                self._plans.clear()
            batch = pa.ipc.read_record_batch(message, self._schema)
            self._plans[head] = batch.num_rows, self._offsets(batch, message.body or _NOTHING, at)
        return self._plans[head]

    def _offsets(self, batch: pa.RecordBatch, body: pa.Buffer, at: int) -> tuple[int, ...]:
        try:
            batch.validate()
        except pa.ArrowInvalid as error:
            raise LogError(f"log {self.path}: batch at byte {at} is damaged: {first_line(error)}") from error
        offsets = [values.address - body.address if (values := c.buffers()[-1]) else 0 for c in batch.columns]
        # Compressed numbers are not in the body.
        if any(offset % 8 or not 0 <= offset <= body.size for offset in offsets) or body.address % 8:
            raise LogError(f"log {self.path}: batch at byte {at} is compressed or not aligned to 8 bytes")
        return tuple(offsets)

    def _views(self, n: int, offsets: tuple[int, ...], body: pa.Buffer) -> tuple[Samples, Commands]:
        start = body.address - self._address
        at = (start + offset for offset in offsets)
        samples = Samples(*[_view(f, n, self._memory, at) for f in self._sample_fields])
        return samples, Commands(*[_view(f, n, self._memory, at) for f in self._command_fields])


def _view(field: Field, n: int, memory: mmap.mmap, offsets: Iterator[int]) -> NDArray[Any]:
    """An array at the next offset; a vector of length 0 has no column, a batch without rows has no body."""
    if field.width == 0 or n == 0:
        return np.zeros((n, 0), field.dtype)
    return np.ndarray(field.shape(n), field.dtype, memory, next(offsets))


def open_log(path: Path) -> Log:
    """Open one file of a log.

    Raises:
        LogError: it is missing, or is not a log.
    """
    if path.is_dir():
        raise LogError(f"log {path}: is a folder; `rtec log list {path}` shows the logs in it")
    if path.exists() and not path.is_file():  # opening a FIFO would wait for a writer
        raise LogError(f"log {path}: is no ordinary file")
    return PackedReader(path) if path.suffix == PACKED else LogReader(path)

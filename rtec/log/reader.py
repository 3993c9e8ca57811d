"""The log: every sample as read and every command as sent, an Arrow IPC stream that any Arrow program opens.

One column a field of `Samples`, then of `Commands`; vectors are fixed-size lists, and their axis or sensor names
stand in the column's metadata (`names`), units in `unit`. The schema, written first, carries the header (versions,
hashes, host, start) as metadata. Batches are uncompressed, so that a reader maps the file and copies nothing.
A vector of no entries (a machine without sensors) has no column.

The file is only ever appended to, a whole batch at a time. What a kill or power cut leaves after the last whole batch
is ignored by the reader, and counted in `torn_bytes`.

Opens a log, whichever of its two forms it has: `.arrows` as it was written, `.parquet` as it was packed.

Reads a closed log that was packed as zstd Parquet (`rtec.log.packed`).

The columns are those of an export (`counts_X`, `degc_T_spindle`, …), for any program that opens Parquet. One thing
is special: `applied_um_X` is empty (null) in every row where it is the same number, bit for bit, as `requested_um_X`,
which is almost all of them. Each page carries a checksum. The file's metadata is the header of the log, and beside it
the format's own entries (`rtec.…`).

The rows of a log as a flat table, one column a number: what both an export and a packed log hold.
"""

import json
import mmap
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Protocol, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from rtec.errors import LogError
from rtec.log.format import END_MARK, check_columns, columns_of, entry_names, read_layout, read_metadata
from rtec.log.writer import LogWriter
from rtec.loop.records import Commands, Field, Layout, Samples

__all__ = ["LogReader", "LogWriter"]

_MAX_PLANS: Final = 256
_MESSAGE: Final = b"\xff\xff\xff\xff"
"""What every message of a stream begins with."""
_NOTHING: Final = pa.py_buffer(b"")
_Broken = (pa.ArrowException, OSError, EOFError, ValueError, TypeError, KeyError, OverflowError)


class LogReader:
    """Reads a log by mapping it; memory does not grow with its length, and nothing is copied.

    Attributes:
        path: the file.
        header: what the writer was given.
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
            raise LogError(f"log {path}: not an Arrow IPC stream: {_first_line(error)}") from error
        self.header = {k: v for k, v in metadata.items() if not k.startswith("rtec.")}
        self._sample_fields, self._command_fields = Samples.fields_of(self.layout), Commands.fields_of(self.layout)
        self._first = self._source.tell()
        self._ends, self._rows_at_end = [self._first], [0]
        self._plans: dict[bytes, tuple[int, tuple[int, ...]]] = {}

    @property
    def rows(self) -> int:
        """Whole rows in the file as it was mapped; reads the head of each batch, not the rows."""
        self._index()
        return self._rows_at_end[-1]

    @property
    def torn_bytes(self) -> int:
        """Bytes after the last whole batch that are not the mark of a clean end."""
        self._index()
        return 0 if self.complete else self.bytes - self._ends[-1]

    @property
    def complete(self) -> bool:
        """Whether the writer closed the file: the end mark stands after the last batch."""
        self._index()
        self._source.seek(self._ends[-1])
        return self._source.read(len(END_MARK) + 1) == END_MARK

    @property
    def damaged_bytes(self) -> int:
        """Bytes behind the last readable row, where a whole batch follows them: damage, not a torn end; else 0."""
        at = self._ends[-1] if self.torn_bytes else self.bytes  # looking for the ends has read all heads before
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
        """Give the rows from `start` on, in blocks of `max_rows` at most, as views of the mapped file.

        The mapping is private: writing to a view changes no file. Blocks end where the batches of the file do. Views
        stay good after the reader is closed.

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
        """Map the file again, with what was appended since; earlier views stay good."""
        self._map()

    def close(self) -> None:
        """Let go of the file; it stays mapped until the last view is gone."""
        self._source.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _map(self) -> None:
        try:
            with self.path.open("rb") as file:
                # Private: arrays of it are ordinary writable ones, and writing to them would change no file.
                self._memory = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
            whole = pa.py_buffer(self._memory)
            self._source, self._address, self.bytes = pa.BufferReader(whole), whole.address, whole.size
        except OSError as error:
            raise LogError(f"log {self.path}: cannot be opened: {error.strerror or error}") from error
        except ValueError as error:  # nothing to map
            raise LogError(f"log {self.path}: is empty") from error

    def _time_ns(self, row: int) -> int:
        samples, _ = next(self.blocks(1, row))
        return int(samples.time_ns[0])

    def _index(self) -> None:
        """Find the end and row count of every batch not seen yet."""
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
                return  # the end, or what a kill or power cut left
            yield end, n, offsets, message.body or _NOTHING
            at = end

    def _plan(self, message: pa.Message, at: int) -> tuple[int, tuple[int, ...]]:
        """Rows of a batch, and offset of each column's numbers in its body.

        Equal heads mean equal plans; looking at each batch anew would take most of the time of reading.
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
            raise LogError(f"log {self.path}: batch at byte {at} is damaged: {_first_line(error)}") from error
        offsets = [values.address - body.address if (values := c.buffers()[-1]) else 0 for c in batch.columns]
        # Compressed numbers lie elsewhere than in the body.
        if any(offset % 8 or not 0 <= offset <= body.size for offset in offsets) or body.address % 8:
            raise LogError(f"log {self.path}: batch at byte {at} is compressed or not aligned to 8 bytes")
        return tuple(offsets)

    def _views(self, n: int, offsets: tuple[int, ...], body: pa.Buffer) -> tuple[Samples, Commands]:
        start = body.address - self._address
        at = (start + offset for offset in offsets)
        samples = Samples(*[_view(f, n, self._memory, at) for f in self._sample_fields])
        return samples, Commands(*[_view(f, n, self._memory, at) for f in self._command_fields])


def _view(field: Field, n: int, memory: mmap.mmap, offsets: Iterator[int]) -> NDArray[Any]:
    """An array at the next offset; a vector of no entries has no column, a batch of no rows no body."""
    if field.width == 0 or n == 0:
        return np.zeros((n, 0), field.dtype)
    return np.ndarray(field.shape(n), field.dtype, memory, next(offsets))


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


CHUNK_ROWS: Final = 131_072
Block = tuple[Samples, Commands]
Columns = list[NDArray[Any]]


def flat_names(layout: Layout) -> list[str]:
    """Column names of the table: `counts_X`, `degc_T_spindle`, `applied_um_X`, …; scalars keep their name.

    Raises:
        LogError: two columns would have the same name.
    """
    names: list[str] = []
    for f in columns_of(layout):
        names += [f.name] if f.width is None else [f"{f.name}_{entry}" for entry in entry_names(f, layout)]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise LogError(f"log: the names of axes and sensors give two columns {twice[0]!r}; it cannot be exported")
    return names


def flatten(samples: Samples, commands: Commands) -> Columns:
    """Every column by itself, in the order of `flat_names`."""
    flat: Columns = []
    for array in (*samples.arrays().values(), *commands.arrays().values()):
        flat += [array] if array.ndim == 1 else list(array.T)
    return flat


def chunks(log: "Log") -> Iterator[list[Block]]:
    """Blocks of a log in lists of some `CHUNK_ROWS` rows, so that a table does not depend on the flushes of the log."""
    waiting: list[Block] = []
    n = 0
    for block in log.blocks(CHUNK_ROWS):
        waiting.append(block)
        n += len(block[0])
        if n >= CHUNK_ROWS:
            yield waiting
            waiting, n = [], 0
    if waiting:
        yield waiting


_BrokenPack = (pa.ArrowException, OSError, ValueError, KeyError, OverflowError)
SAME_AS: Final = {"applied_um": "requested_um"}
"""Column that is empty where it equals another."""


def same_columns(layout: Layout) -> dict[str, str]:
    """By flat name: the column whose number an empty cell stands for."""
    return {f"{a}_{axis}": f"{b}_{axis}" for a, b in SAME_AS.items() for axis in layout.axes}


class PackedReader:
    """Reads a packed log, a group of rows (some 10^5) at a time.

    Attributes:
        path: the file.
        header: what the writer was given.
        layout: names of axes and sensors.
        bytes: size of the file.
        rows: rows in it.
        torn_bytes: what was torn from the end of the log before it was packed.
        complete: whether the writer had closed it.
    """

    def __init__(self, path: Path) -> None:
        """Open and check columns and header.

        Raises:
            LogError: missing, damaged, or no packed log.
        """
        self.path = path
        try:
            self.bytes = path.stat().st_size
            self._file = pq.ParquetFile(str(path), page_checksum_verification=True)
            schema = self._file.schema_arrow
            metadata = {
                k.decode(errors="replace"): v.decode(errors="replace") for k, v in (schema.metadata or {}).items()
            }
            self.rows: int = self._file.metadata.num_rows
        except FileNotFoundError as error:
            raise LogError(f"log {path}: cannot be opened: {error.strerror}") from error
        except _BrokenPack as error:
            raise LogError(f"log {path}: not a packed log: {_first_line(error)}") from error
        self.layout = read_layout(path, metadata)
        self.header = {k: v for k, v in metadata.items() if not k.startswith("rtec.")}
        self._check(schema)
        first_ns, last_ns = _numbers(metadata.get("rtec.span_ns", ""), 2)
        self.span_ns = (first_ns, last_ns) if self.rows else None
        self.torn_bytes = _numbers(f"[{metadata.get('rtec.torn_bytes', '0')}]", 1)[0]
        self.complete = metadata.get("rtec.complete") == "true"

    def blocks(self, max_rows: int = 65_536, start: int = 0) -> Iterator[Block]:
        """Give the rows from `start` on, in blocks of `max_rows` at most.

        Raises:
            LogError: a group of rows is damaged; those before it were given.
        """
        row = 0
        for k in range(self._file.metadata.num_row_groups):
            n = self._file.metadata.row_group(k).num_rows
            if row + n > start:
                samples, commands = self._group(k)
                for first in range(max(0, start - row), n, max_rows):
                    yield samples.rows(first, first + max_rows), commands.rows(first, first + max_rows)
            row += n

    def refresh(self) -> None:
        """Do nothing: a packed log does not grow."""

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _check(self, found: pa.Schema) -> None:
        wanted = flat_names(self.layout)
        if found.names != wanted:
            raise LogError(f"log {self.path}: columns {found.names} found, {wanted} are needed")
        empty = flatten(Samples.empty(self.layout, 0), Commands.empty(self.layout, 0))
        for field, column in zip(found, empty, strict=True):
            if field.type != pa.from_numpy_dtype(column.dtype):
                raise LogError(f"log {self.path}: column {field.name}: type {field.type} found")

    def _group(self, k: int) -> Block:
        try:
            table = self._file.read_row_group(k, use_threads=False)
            flat = self._flat(table)
        except _BrokenPack as error:
            raise LogError(f"log {self.path}: group {k} of its rows is damaged: {_first_line(error)}") from error
        n = table.num_rows
        samples = Samples(*[_array(f, n, flat, self.layout) for f in Samples.fields_of(self.layout)])
        return samples, Commands(*[_array(f, n, flat, self.layout) for f in Commands.fields_of(self.layout)])

    def _flat(self, table: pa.Table) -> dict[str, NDArray[Any]]:
        same = same_columns(self.layout)
        flat = {name: table[name].to_numpy() for name in table.column_names if name not in same}
        for name, other in same.items():
            column = table[name]
            empty = column.is_null().to_numpy()
            flat[name] = np.where(empty, flat[other], column.to_numpy())
        return flat


def _array(field: Field, n: int, flat: dict[str, NDArray[Any]], layout: Layout) -> NDArray[Any]:
    """A field of a record; a vector of no entries has no column."""
    if field.width is None:
        return np.array(flat[field.name], field.dtype)
    out = np.zeros(field.shape(n), field.dtype)
    if field in columns_of(layout):
        for k, name in enumerate(entry_names(field, layout)):
            out[:, k] = flat[f"{field.name}_{name}"]
    return out


def _numbers(text: str, n: int) -> list[int]:
    """So many integers, of JSON that nobody vouches for."""
    try:
        found = [int(x) for x in json.loads(text)]
    except (ValueError, TypeError, RecursionError):
        found = []
    return found if len(found) == n else [0] * n


PACKED: Final = ".parquet"


class Log(Protocol):
    """What reads one log: `LogReader`, `PackedReader`, or `LogStretch` for many files at once.

    Attributes:
        path: the file or folder.
        header: what the writer was given.
        layout: names of axes and sensors.
        bytes: size of the file.
    """

    path: Path
    header: dict[str, str]
    layout: Layout
    bytes: int

    @property
    def rows(self) -> int:
        """Whole rows."""
        ...

    @property
    def torn_bytes(self) -> int:
        """Bytes behind the last whole row."""
        ...

    @property
    def complete(self) -> bool:
        """Whether the writer closed it."""
        ...

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Instants of the first and the last row, monotonic clock; None without rows."""
        ...

    def blocks(self, max_rows: int = 65_536, start: int = 0) -> Iterator[tuple[Samples, Commands]]:
        """Rows from `start` on, in blocks of `max_rows` at most; raises LogError where they are damaged."""
        ...

    def refresh(self) -> None:
        """Look at the file again, with what was appended since."""
        ...

    def close(self) -> None:
        """Let go of the file."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


def open_log(path: Path) -> Log:
    """Open one file of a log.

    Raises:
        LogError: it is missing, or no log.
    """
    if path.is_dir():
        raise LogError(f"log {path}: is a folder; `rtec log list {path}` shows the logs in it")
    return PackedReader(path) if path.suffix == PACKED else LogReader(path)

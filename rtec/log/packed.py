"""The packed form of a closed log: zstd Parquet, every bit of every row; written once, read a group of rows at a time.

The columns are those of an export (`counts_X`, `degc_T_spindle`, …), for any program that opens Parquet, with one
exception: `applied_um_X` is empty (null) in every row where it is the same number, bit for bit, as `requested_um_X`,
which is almost all rows. Each page has a checksum. The file's metadata is the header of the log, with the format's
own entries (`rtec.…`).
"""

import json
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from rtec.arrays import Bools
from rtec.errors import LogError, first_line
from rtec.log.format import (
    CHUNK_ROWS,
    FORMAT_VERSION,
    Block,
    Log,
    chunks,
    columns_of,
    element_names,
    flat_names,
    flatten,
    read_layout,
)
from rtec.loop.records import Commands, Field, Layout, Samples

PACKED: Final = ".parquet"

SAME_AS: Final = {"applied_um": "requested_um"}
"""Column that is empty where it equals another."""
_DELTA: Final = ("time_ns", "counts_time_ns", "counts_", "output_")
"""Columns that change by little from row to row."""
_SPLIT: Final = ("requested_um_", "applied_um_")
"""Columns whose first bytes change slowly, while the last ones are noise."""
_LEVEL: Final = 3
_BROKEN: Final = (pa.ArrowException, OSError, ValueError, KeyError, OverflowError)


def same_columns(layout: Layout) -> dict[str, str]:
    """By flat name: the column that has the number of an empty cell."""
    return {f"{a}_{axis}": f"{b}_{axis}" for a, b in SAME_AS.items() for axis in layout.axes}


def pack(log: Log, path: Path) -> int:
    """Write a log as Parquet; the file appears whole or not at all, and never replaces another.

    Returns:
        Number of rows written.

    Raises:
        LogError: the file exists or cannot be written, or the log is damaged.
    """
    part = part_of(path)
    try:
        if path.exists():
            raise LogError(f"log {path}: exists already")
        rows = _write(log, part)
        part.rename(path)
        _sync(path.parent, os.O_DIRECTORY)
    except OSError as error:
        raise LogError(f"log {path}: cannot be written: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            part.unlink()
    return rows


def part_of(path: Path) -> Path:
    """Path of a packed log while it is being written."""
    return path.with_name(f".{path.name}.part")


def _write(log: Log, part: Path) -> int:
    names = flat_names(log.layout)
    schema = _schema(log, names)
    rows = 0
    delta = {name: "DELTA_BINARY_PACKED" for name in names if name.startswith(_DELTA)}
    split = {name: "BYTE_STREAM_SPLIT" for name in names if name.startswith(_SPLIT)}
    with pq.ParquetWriter(
        str(part),
        schema,
        compression="zstd",
        compression_level=_LEVEL,
        use_dictionary=[n for n in names if n not in delta and n not in split],  # type: ignore[arg-type] # the stubs lack it
        column_encoding=delta | split,
        data_page_version="2.0",
        write_page_checksum=True,
        write_statistics=False,
    ) as writer:
        for blocks in chunks(log):
            table = _table(blocks, schema, log.layout)
            writer.write_table(table, row_group_size=2 * CHUNK_ROWS)
            rows += table.num_rows
    _sync(part, os.O_RDONLY)
    return rows


def _schema(log: Log, names: list[str]) -> pa.Schema:
    empty = flatten(Samples.empty(log.layout, 0), Commands.empty(log.layout, 0))
    fields = [
        pa.field(name, pa.from_numpy_dtype(column.dtype), nullable=name.startswith(tuple(SAME_AS)))
        for name, column in zip(names, empty, strict=True)
    ]
    first_ns, last_ns = log.span_ns or (0, 0)
    metadata: dict[bytes | str, bytes | str] = {
        "rtec.log": FORMAT_VERSION,
        "rtec.axes": json.dumps(log.layout.axes),
        "rtec.sensors": json.dumps(log.layout.sensors),
        "rtec.span_ns": json.dumps([first_ns, last_ns]),
        "rtec.complete": json.dumps(log.complete),
        "rtec.torn_bytes": json.dumps(log.torn_bytes),
    }
    metadata.update(log.header)
    return pa.schema(fields, metadata=metadata)


def _table(blocks: list[Block], schema: pa.Schema, layout: Layout) -> pa.Table:
    batches = []
    same = same_columns(layout)
    for samples, commands in blocks:
        flat = dict(zip(schema.names, flatten(samples, commands), strict=True))
        columns = [
            pa.array(flat[name], mask=_equal(flat[name], flat[same[name]]) if name in same else None)
            for name in schema.names
        ]
        batches.append(pa.RecordBatch.from_arrays(columns, schema=schema))
    return pa.Table.from_batches(batches, schema=schema)


def _equal(a: NDArray[Any], b: NDArray[Any]) -> Bools:
    """Bitwise equality: a NaN equals itself, and -0 does not equal 0."""
    return np.asarray(np.ascontiguousarray(a).view(np.int64) == np.ascontiguousarray(b).view(np.int64))


def _sync(path: Path, how: int) -> None:
    fd = os.open(path, os.O_RDONLY | how)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


class PackedReader:
    """Reads a packed log, a group of rows (some 10^5) at a time.

    Attributes:
        path: the file.
        header: header as the writer got it.
        layout: names of axes and sensors.
        bytes: size of the file.
        rows: number of rows.
        torn_bytes: bytes that were torn from the end of the log before it was packed.
        complete: had the writer closed it?
    """

    def __init__(self, path: Path) -> None:
        """Open and check columns and header.

        Raises:
            LogError: missing, damaged, or not a packed log.
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
        except _BROKEN as error:
            raise LogError(f"log {path}: not a packed log: {first_line(error)}") from error
        self.layout = read_layout(path, metadata)
        self.header = {k: v for k, v in metadata.items() if not k.startswith("rtec.")}
        self._check(schema)
        first_ns, last_ns = _numbers(metadata.get("rtec.span_ns", ""), 2)
        self.span_ns = (first_ns, last_ns) if self.rows else None
        self.torn_bytes = _numbers(f"[{metadata.get('rtec.torn_bytes', '0')}]", 1)[0]
        self.complete = metadata.get("rtec.complete") == "true"

    def blocks(self, max_rows: int = 65_536, start: int = 0) -> Iterator[Block]:
        """The rows from `start` on, in blocks of `max_rows` at most.

        Raises:
            LogError: a group of rows is damaged; the rows before it were given.
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
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _check(self, actual: pa.Schema) -> None:
        needed = flat_names(self.layout)
        if actual.names != needed:
            raise LogError(f"log {self.path}: columns {actual.names} found, {needed} are needed")
        empty = flatten(Samples.empty(self.layout, 0), Commands.empty(self.layout, 0))
        for field, column in zip(actual, empty, strict=True):
            if field.type != pa.from_numpy_dtype(column.dtype):
                raise LogError(f"log {self.path}: column {field.name}: type {field.type} found")

    def _group(self, k: int) -> Block:
        try:
            table = self._file.read_row_group(k, use_threads=False)
            flat = self._flat(table)
        except _BROKEN as error:
            raise LogError(f"log {self.path}: group {k} of its rows is damaged: {first_line(error)}") from error
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
    """A field of a record; a vector of length 0 has no column."""
    if field.width is None:
        return np.array(flat[field.name], field.dtype)
    out = np.zeros(field.shape(n), field.dtype)
    if field in columns_of(layout):
        for k, name in enumerate(element_names(field, layout)):
            out[:, k] = flat[f"{field.name}_{name}"]
    return out


def _numbers(text: str, n: int) -> list[int]:
    """Exactly `n` integers from JSON that may be malformed; zeros where it is."""
    try:
        numbers = [int(x) for x in json.loads(text)]
    except (ValueError, TypeError, RecursionError):
        numbers = []
    return numbers if len(numbers) == n else [0] * n

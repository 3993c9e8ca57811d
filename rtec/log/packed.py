"""Packs a closed log as zstd Parquet: every bit of every row; see `rtec.log.reader` for the file."""

import json
import os
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from rtec.errors import LogError
from rtec.log.format import FORMAT_VERSION
from rtec.log.reader import CHUNK_ROWS, SAME_AS, Block, Log, chunks, flat_names, flatten, same_columns
from rtec.loop.records import Commands, Layout, Samples

_DELTA: Final = ("time_ns", "counts_time_ns", "counts_", "output_")
"""Columns that change by little from row to row."""
_SPLIT: Final = ("requested_um_", "applied_um_")
"""Columns whose first bytes change slowly, and whose last ones are noise."""
_LEVEL: Final = 3


def pack(log: Log, path: Path) -> int:
    """Write a log as Parquet; the file appears whole or not at all, and never in place of another.

    Returns:
        Rows written.

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
    """The name under which a packed log is written until it is whole."""
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


def _equal(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.bool_]:
    """Bit for bit: a NaN equals itself, and -0 is not 0."""
    return np.asarray(np.ascontiguousarray(a).view(np.int64) == np.ascontiguousarray(b).view(np.int64))


def _sync(path: Path, how: int) -> None:
    fd = os.open(path, os.O_RDONLY | how)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)

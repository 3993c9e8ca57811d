"""A log as a flat table, one column a number, time in seconds first: Parquet (zstd), CSV, or MCAP (JSON messages)."""

import json
import math
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Protocol

import pyarrow as pa
import pyarrow.compute
import pyarrow.csv
import pyarrow.parquet

from rtec.errors import LogError
from rtec.log.format import CHUNK_ROWS, Log, flat_names, flatten
from rtec.loop.records import Commands, Samples

__all__ = ["export", "flat_names"]

_UTC: Final = pa.timestamp("ns", tz="UTC")
_ENDINGS: Final = (".parquet", ".csv", ".mcap")
_TIME: Final = "time_s"


class _Sink(Protocol):
    def write_table(self, table: pa.Table) -> None: ...

    def close(self) -> None: ...


def export(reader: Log, out_path: Path, progress: Callable[[int], None] | None = None, *, utc: bool = False) -> int:
    """Write all rows as a table; the file appears whole or not at all, and replaces one of that name.

    Args:
        reader: the log; it is streamed, memory does not grow with its length.
        out_path: ends in `.parquet`, `.mcap` (both keep the header as metadata) or `.csv`.
        progress: called with the number of rows written, from time to time.
        utc: add a first column `utc` with date and time of each row; needs a `LogStretch`, which has them.

    Returns:
        Number of rows written.

    Raises:
        LogError: another ending, the log itself as target, the file cannot be written, or `mcap` is not installed.
    """
    if out_path.suffix not in _ENDINGS:
        raise LogError(f"export to {out_path}: ending {out_path.suffix!r}; '.parquet', '.csv' or '.mcap' is needed")
    if out_path.exists() and out_path.samefile(reader.path):
        raise LogError(f"export to {out_path}: that is the log itself")
    try:
        fd, part = tempfile.mkstemp(prefix=f".{out_path.name}.", suffix=out_path.suffix, dir=out_path.parent)
    except OSError as error:
        raise LogError(f"export to {out_path}: cannot be made: {error.strerror}") from error
    os.close(fd)
    try:
        done = _write(reader, Path(part), progress, utc)
        Path(part).chmod(0o644)
        Path(part).replace(out_path)
    except OSError as error:
        raise LogError(f"export to {out_path}: cannot be written: {error}") from error
    finally:
        with suppress(FileNotFoundError):
            Path(part).unlink()
    return done


def _write(reader: Log, part: Path, progress: Callable[[int], None] | None, utc: bool) -> int:
    names = flat_names(reader.layout)
    empty = flatten(Samples.empty(reader.layout, 0), Commands.empty(reader.layout, 0))
    types = [pa.from_numpy_dtype(column.dtype) for column in empty]
    metadata: dict[bytes | str, bytes | str] = {}
    metadata.update(reader.header)
    columns: list[tuple[str, pa.DataType]] = [(_TIME, pa.float64()), *([("utc", _UTC)] if utc else [])]
    schema = pa.schema([*columns, *zip(names, types, strict=True)], metadata=metadata)
    sink, done = _open(part, schema), 0
    try:
        for table in _tables(reader, schema):
            sink.write_table(table)
            done += table.num_rows
            if progress:
                progress(done)
    finally:
        sink.close()
    with part.open("rb") as file:
        os.fsync(file.fileno())
    return done


def _open(part: Path, schema: pa.Schema) -> _Sink:
    if part.suffix == ".csv":
        return pyarrow.csv.CSVWriter(str(part), schema)
    if part.suffix == ".mcap":
        return _McapFile(part, schema)
    return pyarrow.parquet.ParquetWriter(str(part), schema, compression="zstd")


class _McapFile:
    """One channel `rtec`, a JSON message a row; a number that is not finite is null.

    The time of a message is its `utc`, else the loop's own clock.
    """

    def __init__(self, part: Path, schema: pa.Schema) -> None:
        try:
            from mcap.writer import Writer
        except ImportError as error:
            raise LogError("export to MCAP needs the package mcap: pip install 'rtec[mcap]'") from error
        self._writer = Writer(str(part))
        self._writer.start(library="rtec")
        self._writer.add_metadata("rtec", {k.decode(): v.decode() for k, v in (schema.metadata or {}).items()})
        numbers = {name: {"type": ["number", "null"]} for name in schema.names if name != "utc"}
        kind = json.dumps({"type": "object", "properties": numbers}).encode()
        self._channel = self._writer.register_channel(
            "rtec", "json", self._writer.register_schema("rtec", "jsonschema", kind)
        )

    def write_table(self, table: pa.Table) -> None:
        instants, numbers = table["time_ns"], table
        if "utc" in table.column_names:
            numbers = table.drop_columns(["utc"])
            instants = pyarrow.compute.coalesce(table["utc"].cast(pa.int64()), instants)
        for row, at_ns in zip(numbers.to_pylist(), instants.to_numpy().tolist(), strict=True):
            known = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}
            self._writer.add_message(self._channel, at_ns, json.dumps(known).encode(), at_ns)

    def close(self) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call]


def _tables(reader: Log, schema: pa.Schema) -> Iterator[pa.Table]:
    """Tables of some `CHUNK_ROWS` rows, so that the row groups of Parquet do not depend on the flushes of the log."""
    batches: list[pa.RecordBatch] = []
    begin_ns: int | None = None
    for samples, commands in reader.blocks(CHUNK_ROWS):
        instants_ns = samples.time_ns + (getattr(reader, "offset_ns", None) or 0)
        begin_ns = int(instants_ns[0]) if begin_ns is None and len(samples) else begin_ns
        columns: list[pa.Array[Any]] = [pa.array((instants_ns - (begin_ns or 0)) * 1e-9)]
        columns += [_utc(reader, samples)] if "utc" in schema.names else []
        columns += [pa.array(column) for column in flatten(samples, commands)]
        batches.append(pa.RecordBatch.from_arrays(columns, schema=schema))
        if sum(batch.num_rows for batch in batches) >= CHUNK_ROWS:
            yield pa.Table.from_batches(batches)
            batches = []
    if batches:
        yield pa.Table.from_batches(batches)


def _utc(reader: Log, samples: Samples) -> "pa.Array[Any]":
    """Date and time of rows; empty where their file does not have it."""
    offset_ns = getattr(reader, "offset_ns", None)
    if offset_ns is None:
        return pa.nulls(len(samples), _UTC)
    utc: pa.Array[Any] = pa.array(samples.time_ns + offset_ns).cast(_UTC)
    return utc

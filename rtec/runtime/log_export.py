"""A log as a flat table, one column a number: Parquet (zstd) or CSV."""

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Protocol

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from numpy.typing import NDArray

from rtec.errors import LogError
from rtec.runtime.log import LogReader
from rtec.runtime.log_format import columns_of, entry_names
from rtec.runtime.records import Commands, Layout, Samples

_CHUNK_ROWS: Final = 131_072


class _Sink(Protocol):
    def write_table(self, table: pa.Table) -> None: ...

    def close(self) -> None: ...


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


def export(reader: LogReader, out_path: Path, progress: Callable[[int], None] | None = None) -> int:
    """Write all rows as a table; the file appears whole or not at all, and replaces one of that name.

    Args:
        reader: the log; it is streamed, memory does not grow with its length.
        out_path: ends in `.parquet` (keeps the header as metadata) or `.csv`.
        progress: told the number of rows done, from time to time.

    Returns:
        Rows written.

    Raises:
        LogError: another ending, the log itself as target, or the file cannot be written.
    """
    if out_path.suffix not in (".parquet", ".csv"):
        raise LogError(f"export to {out_path}: ending {out_path.suffix!r}; '.parquet' or '.csv' is needed")
    if out_path.exists() and out_path.samefile(reader.path):
        raise LogError(f"export to {out_path}: that is the log itself")
    try:
        fd, part = tempfile.mkstemp(prefix=f".{out_path.name}.", suffix=out_path.suffix, dir=out_path.parent)
    except OSError as error:
        raise LogError(f"export to {out_path}: cannot be made: {error.strerror}") from error
    os.close(fd)
    try:
        done = _write(reader, Path(part), progress)
        Path(part).chmod(0o644)
        Path(part).replace(out_path)
    except OSError as error:
        raise LogError(f"export to {out_path}: cannot be written: {error}") from error
    finally:
        with suppress(FileNotFoundError):
            Path(part).unlink()
    return done


def _write(reader: LogReader, part: Path, progress: Callable[[int], None] | None) -> int:
    names = flat_names(reader.layout)
    empty = _flatten(Samples.empty(reader.layout, 0), Commands.empty(reader.layout, 0))
    types = [pa.from_numpy_dtype(column.dtype) for column in empty]
    metadata: dict[bytes | str, bytes | str] = {}
    metadata.update(reader.header)
    schema = pa.schema(list(zip(names, types, strict=True)), metadata=metadata)
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
    return pyarrow.parquet.ParquetWriter(str(part), schema, compression="zstd")


def _tables(reader: LogReader, schema: pa.Schema) -> Iterator[pa.Table]:
    """Tables of about `_CHUNK_ROWS` rows, so that the row groups of Parquet do not depend on the flushes of the log."""
    batches: list[pa.RecordBatch] = []
    for samples, commands in reader.blocks(_CHUNK_ROWS):
        columns = [pa.array(column) for column in _flatten(samples, commands)]
        batches.append(pa.RecordBatch.from_arrays(columns, schema=schema))
        if sum(batch.num_rows for batch in batches) >= _CHUNK_ROWS:
            yield pa.Table.from_batches(batches)
            batches = []
    if batches:
        yield pa.Table.from_batches(batches)


def _flatten(samples: Samples, commands: Commands) -> list[NDArray[Any]]:
    """Every column by itself, in the order of `flat_names`."""
    flat: list[NDArray[Any]] = []
    for array in (*samples.arrays().values(), *commands.arrays().values()):
        flat += [array] if array.ndim == 1 else list(array.T)
    return flat

"""Reads a closed log that was packed as zstd Parquet (`rtec.log.packed`).

The columns are those of an export (`counts_X`, `degc_T_spindle`, …), for any program that opens Parquet. One thing
is special: `applied_um_X` is empty (null) in every row where it is the same number, bit for bit, as `requested_um_X`,
which is almost all of them. Each page carries a checksum. The file's metadata is the header of the log, and beside it
the format's own entries (`rtec.…`).
"""

import json
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from rtec.errors import LogError
from rtec.log.format import columns_of, entry_names, read_layout
from rtec.log.log_table import Block, flat_names, flatten
from rtec.loop.records import Commands, Field, Layout, Samples

_Broken = (pa.ArrowException, OSError, ValueError, KeyError, OverflowError)
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
        except _Broken as error:
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
        except _Broken as error:
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


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]

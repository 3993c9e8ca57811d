"""The format of a log: the interface of its readers (`Log`), its Arrow schema, and its rows as a flat table.

The Arrow schema is that of the written form (`rtec.log.reader`). The table, one column a number, is that of a packed
log (`rtec.log.packed`) and of an export.
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Protocol, Self

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from rtec.errors import LogError
from rtec.loop.records import Commands, Field, Layout, Samples

FORMAT_VERSION: Final = "1"
END_MARK: Final = b"\xff\xff\xff\xff\0\0\0\0"
"""Bytes that Arrow writes after the last batch of a stream."""
_MAX_NAMES: Final = 4096
_UNITS: Final = {
    "time_ns": "ns",
    "mode": "0 off, 1 on, 2 hold, 3 taken over",
    "counts_time_ns": "ns",
    "counts": "counts",
    "degc": "degC",
    "degc_time_ns": "ns",
    "spindle_rpm": "1/min",
    "requested_um": "um",
    "applied_um": "um",
    "output": "sink units",
    "flags": "bits",
}
CHUNK_ROWS: Final = 131_072

Block = tuple[Samples, Commands]
Columns = list[NDArray[Any]]


class Log(Protocol):
    """Reader of one log: `LogReader`, `PackedReader`, or `LogStretch` for many files at once.

    Attributes:
        path: the file or folder.
        header: header as the writer got it.
        layout: names of axes and sensors.
        bytes: size of the file.
    """

    path: Path
    header: dict[str, str]
    layout: Layout
    bytes: int

    @property
    def rows(self) -> int:
        """Number of whole rows."""
        ...

    @property
    def torn_bytes(self) -> int:
        """Number of bytes after the last whole row."""
        ...

    @property
    def complete(self) -> bool:
        """Did the writer close it?"""
        ...

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Instants of the first and the last row, monotonic clock; None without rows."""
        ...

    def blocks(self, max_rows: int = 65_536, start: int = 0) -> Iterator[tuple[Samples, Commands]]:
        """Rows from `start` on, in blocks of `max_rows` at most; raises LogError where they are damaged."""
        ...

    def refresh(self) -> None:
        """Read the size of the file again, to include what was appended since."""
        ...

    def close(self) -> None:
        """Close the file."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


def columns_of(layout: Layout) -> tuple[Field, ...]:
    """Fields with columns, in the order of the columns."""
    return tuple(f for f in (*Samples.fields_of(layout), *Commands.fields_of(layout)) if f.width != 0)


def element_names(field: Field, layout: Layout) -> tuple[str, ...]:
    """Names of a vector's elements; none for a scalar."""
    if field.width is None:
        return ()
    return layout.sensors if field.name.startswith("degc") else layout.axes


def schema_of(layout: Layout, header: Mapping[str, str]) -> pa.Schema:
    """Arrow schema of a log; names, units and header are its metadata."""
    columns = []
    for f in columns_of(layout):
        element: pa.DataType = pa.from_numpy_dtype(np.dtype(f.dtype))
        kind = element if f.width is None else pa.list_(pa.field("item", element, nullable=False), f.width)
        about: dict[bytes | str, bytes | str] = {"unit": _UNITS[f.name], "names": json.dumps(element_names(f, layout))}
        columns.append(pa.field(f.name, kind, nullable=False, metadata=about))
    metadata: dict[bytes | str, bytes | str] = {
        "rtec.log": FORMAT_VERSION,
        "rtec.axes": json.dumps(layout.axes),
        "rtec.sensors": json.dumps(layout.sensors),
    }
    metadata.update(header)
    return pa.schema(columns, metadata=metadata)


def read_metadata(schema: pa.Schema) -> dict[str, str]:
    """Header and the format's own entries (`rtec.…`) as text."""
    entries = (schema.metadata or {}).items()
    return {key.decode(errors="replace"): value.decode(errors="replace") for key, value in entries}


def read_layout(path: Path, metadata: Mapping[str, str]) -> Layout:
    """The names of axes and sensors.

    Raises:
        LogError: not a log, a format of another version, or names that are not allowed.
    """
    version = metadata.get("rtec.log")
    if version != FORMAT_VERSION:
        content = (
            "Arrow, but not a log of rtec; a table of rtec log export is none"
            if version is None
            else f"log format {version!r}"
        )
        raise LogError(f"log {path}: {content}; format {FORMAT_VERSION!r} is needed")
    return Layout(_read_names(path, metadata, "rtec.axes"), _read_names(path, metadata, "rtec.sensors"))


def _read_names(path: Path, metadata: Mapping[str, str], key: str) -> tuple[str, ...]:
    try:
        names = json.loads(metadata.get(key, ""))
    except (ValueError, RecursionError):
        names = None
    if not isinstance(names, list) or not all(isinstance(n, str) for n in names) or len(set(names)) != len(names):
        raise LogError(f"log {path}: header {key}: a list of different names is needed")
    if len(names) > _MAX_NAMES:
        raise LogError(f"log {path}: header {key}: {len(names)} names; at most {_MAX_NAMES} are allowed")
    return tuple(names)


def check_columns(path: Path, actual: pa.Schema, layout: Layout) -> None:
    """Refuse columns other than those of the layout.

    Raises:
        LogError: names what is missing or different.
    """
    needed = schema_of(layout, {})
    if missing := [name for name in needed.names if name not in actual.names]:
        raise LogError(f"log {path}: columns missing: {', '.join(missing)}")
    if actual.names != needed.names:
        raise LogError(f"log {path}: columns {actual.names} found, {needed.names} are needed")
    for mine, theirs in zip(needed, actual, strict=True):
        if mine.type != theirs.type:
            raise LogError(f"log {path}: column {mine.name}: type {theirs.type} found, {mine.type} is needed")


def flat_names(layout: Layout) -> list[str]:
    """Column names of the table: `counts_X`, `degc_T_spindle`, `applied_um_X`, …; scalars keep their name.

    Raises:
        LogError: two columns would have the same name.
    """
    names: list[str] = []
    for f in columns_of(layout):
        names += [f.name] if f.width is None else [f"{f.name}_{element}" for element in element_names(f, layout)]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise LogError(f"log: the names of axes and sensors give two columns {twice[0]!r}; it cannot be exported")
    return names


def flatten(samples: Samples, commands: Commands) -> Columns:
    """Every column by itself, in the order of `flat_names`."""
    flat: Columns = []
    for array in (*samples.arrays().values(), *commands.arrays().values()):
        flat += [array] if array.ndim == 1 else list(array.T)
    return flat


def chunks(log: Log) -> Iterator[list[Block]]:
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

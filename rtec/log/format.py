"""What a log file must look like: the Arrow schema of a layout, and the layout of an Arrow schema."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa

from rtec.errors import LogError
from rtec.loop.records import Commands, Field, Layout, Samples

FORMAT_VERSION: Final = "1"
END_MARK: Final = b"\xff\xff\xff\xff\0\0\0\0"
"""What Arrow writes after the last batch of a stream."""
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


def columns_of(layout: Layout) -> tuple[Field, ...]:
    """Fields that have a column, in the order of the columns."""
    return tuple(f for f in (*Samples.fields_of(layout), *Commands.fields_of(layout)) if f.width != 0)


def entry_names(field: Field, layout: Layout) -> tuple[str, ...]:
    """Names of a vector's entries; none for a scalar."""
    if field.width is None:
        return ()
    return layout.sensors if field.name.startswith("degc") else layout.axes


def schema_of(layout: Layout, header: Mapping[str, str]) -> pa.Schema:
    """Arrow schema of a log; names, units and header are its metadata."""
    columns = []
    for f in columns_of(layout):
        entry: pa.DataType = pa.from_numpy_dtype(np.dtype(f.dtype))
        kind = entry if f.width is None else pa.list_(pa.field("item", entry, nullable=False), f.width)
        about: dict[bytes | str, bytes | str] = {"unit": _UNITS[f.name], "names": json.dumps(entry_names(f, layout))}
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
    found = (schema.metadata or {}).items()
    return {key.decode(errors="replace"): value.decode(errors="replace") for key, value in found}


def read_layout(path: Path, metadata: Mapping[str, str]) -> Layout:
    """Give the names of axes and sensors.

    Raises:
        LogError: not a log, a format of another version, or names that cannot be.
    """
    version = metadata.get("rtec.log")
    if version != FORMAT_VERSION:
        found = "an Arrow stream, but not a log of rtec" if version is None else f"log format {version!r}"
        raise LogError(f"log {path}: {found}; format {FORMAT_VERSION!r} is needed")
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


def check_columns(path: Path, found: pa.Schema, layout: Layout) -> None:
    """Refuse columns other than those of the layout.

    Raises:
        LogError: names what is missing or different.
    """
    wanted = schema_of(layout, {})
    if missing := [name for name in wanted.names if name not in found.names]:
        raise LogError(f"log {path}: columns missing: {', '.join(missing)}")
    if found.names != wanted.names:
        raise LogError(f"log {path}: columns {found.names} found, {wanted.names} are needed")
    for mine, theirs in zip(wanted, found, strict=True):
        if mine.type != theirs.type:
            raise LogError(f"log {path}: column {mine.name}: type {theirs.type} found, {mine.type} is needed")

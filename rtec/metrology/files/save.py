"""Writing a measurement: every number comes back as it was, bit for bit."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from numpy.typing import NDArray

from rtec.errors import MeasurementError
from rtec.metrology.files.toml import TABLES
from rtec.metrology.measurement import Measurement
from rtec.tomlfile import nearest
from rtec.wholefile import whole, write_text

Column = NDArray[np.float64] | NDArray[np.int64]


def save_measurement(measurement: Measurement, path: Path) -> Path:
    """Write table and TOML.

    Args:
        measurement: what to write.
        path: NAME.csv or NAME.parquet; the TOML is written beside it.

    Returns:
        Path of the table.

    Raises:
        MeasurementError: a channel has no column, a value cannot be written, or the folder cannot be created.
    """
    if path.suffix not in TABLES:
        raise MeasurementError(f"{path}: a measurement is written as NAME.csv or NAME.parquet")
    of_channel = {channel: column for column, channel in measurement.machine.columns.items()}
    columns: dict[str, Column] = {"run": measurement.run, "time_s": measurement.time_s}
    for channel, values in measurement.channels.items():
        if channel not in of_channel:
            raise MeasurementError(f"{path}: channel {channel!r} has no column{nearest(channel, of_channel)}")
        columns[of_channel[channel]] = values
    columns |= measurement.readings
    instrument = measurement.instrument
    head = {
        "instrument": instrument.name,
        "axis": instrument.axis,
        "component": instrument.component,
        "machine": measurement.machine.name,
        "notes": list(measurement.notes) or None,
    }
    write_files(path, columns, head, instrument.setup.model_dump(mode="json", exclude_none=True))
    return path


def write_files(
    path: Path,
    columns: Mapping[str, Column],
    head: Mapping[str, Any],
    setup: Mapping[str, Any],
    accepted: Mapping[str, Any] | None = None,
) -> None:
    """Write a table and the TOML beside it; each appears whole or not at all.

    Args:
        path: path of the table; its suffix decides the format.
        columns: (n,) each; NaN becomes an empty cell.
        head: `[measurement]`; values that are None are omitted.
        setup: `[setup]`.
        accepted: `[table]`; omitted where None.
    """
    for name, values in columns.items():
        if np.isinf(values).any():
            raise MeasurementError(f"{path}: {name} is infinite in row {int(np.argmax(np.isinf(values))) + 1}")
    tables = {"measurement": head, "setup": setup, "table": accepted or {}}
    content = {name: {k: v for k, v in table.items() if v is not None} for name, table in tables.items()}
    content = {name: table for name, table in content.items() if table or name != "table"}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise MeasurementError(f"{path}: cannot be written: {e.strerror}") from e
    _write_table(path, columns)
    write_text(tomli_w.dumps(content), path.with_name(path.stem + ".toml"), MeasurementError)


def _write_table(path: Path, columns: Mapping[str, Column]) -> None:
    import pyarrow as pa
    from pyarrow import csv, parquet

    table = pa.table({name: pa.array(values, from_pandas=True) for name, values in columns.items()})
    with whole(path, MeasurementError) as out:
        if path.suffix == ".csv":
            # Names of columns are plain words; arrow would put them in quotes.
            out.write((",".join(columns) + "\n").encode())
            csv.write_csv(table, out, csv.WriteOptions(include_header=False))
        else:
            parquet.write_table(table, out, compression="zstd")

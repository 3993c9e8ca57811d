"""Measurement files: a CSV or Parquet table and a TOML of the same stem (form in `docs/measurements.md`).

Nothing is repaired silently: all faults are reported together, by row and with a remedy. What the user accepts is
under `[table]` of the TOML, or given as options, and is listed in the measurement's notes.
"""

import hashlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from rtec.errors import MeasurementError
from rtec.machine import Machine
from rtec.metrology.files.checks import CheckedRows, check_order, remarks
from rtec.metrology.files.columns import check_columns, on_circle, still_right
from rtec.metrology.files.directions import approached, by_velocity, on_the_run
from rtec.metrology.files.faults import Faults
from rtec.metrology.files.save import save_measurement
from rtec.metrology.files.table import Raw, header_of, look_over, parquet_names, read_csv, read_parquet
from rtec.metrology.files.toml import Leniency, find_files, read_measurement_toml
from rtec.metrology.instruments.base import Instrument
from rtec.metrology.measurement import Measurement

__all__ = ["Leniency", "load_measurement", "load_measurements", "save_measurement"]


def load_measurements(
    paths: Iterable[Path], machine: Machine, leniency: Leniency | None = None
) -> tuple[Measurement, ...]:
    """Read several measurements; the faults of all of them are reported together.

    Raises:
        MeasurementError: as `load_measurement`.
    """
    read, faults = [], []
    for path in paths:
        try:
            read.append(load_measurement(path, machine, leniency))
        except MeasurementError as e:
            faults.append(str(e))
    if faults:
        raise MeasurementError("\n".join(faults))
    return tuple(read)


def load_measurement(path: Path, machine: Machine, leniency: Leniency | None = None) -> Measurement:
    """Read a measurement.

    Args:
        path: table, TOML, or their common stem.
        machine: the measured machine.
        leniency: what the user accepts, in addition to the TOML.

    Returns:
        The measurement; `sha256` is that of the table's bytes followed by those of the TOML.

    Raises:
        MeasurementError: the table has faults: all by row, each with a remedy (the first 20; the rest is counted).
    """
    from rtec.metrology.instruments.registry import make_instrument

    table, toml = find_files(path)
    file = read_measurement_toml(toml, machine.name, table)
    head = file.measurement
    instrument = make_instrument(head.instrument, file.setup, head.axis, head.component, machine, str(toml))
    accepted = file.table.with_(leniency)
    raw, notes, digest = _read(table, toml, instrument, machine, accepted)
    digest.update(toml.read_bytes())
    columns = machine.columns
    run = raw.columns["run"].astype(np.int64)
    channels = {columns[c]: v for c, v in raw.columns.items() if c in columns}
    written = {channel: column for column, channel in columns.items()}
    runs = on_the_run(instrument, machine, channels, run, raw.columns["time_s"])
    notes += [
        f"no column {written[c]}: by its positions and times the axis went at its feed while it was read" for c in runs
    ]
    channels |= runs
    channels |= by_velocity(machine, channels, run)
    sides = approached(machine, channels, run)
    notes += [f"no column {written[c]}: the axis is taken to go past both ends of each way" for c in sides]
    return Measurement(
        name=table.stem,
        instrument=instrument,
        machine=machine,
        run=run,
        time_s=raw.columns["time_s"],
        channels=on_circle(instrument, machine, channels | sides, run, str(table)),
        readings={c: raw.columns[c] for c in instrument.columns()},
        sha256=digest.hexdigest(),
        notes=tuple(dict.fromkeys([*head.notes, *still_right(instrument, notes)])),
    )


def _read(
    table: Path, toml: Path, instrument: Instrument, machine: Machine, accepted: Leniency
) -> tuple[Raw, list[str], "hashlib._Hash"]:
    """Numbers, notes, and the running hash of the table."""
    is_text = table.suffix == ".csv"
    where = f"under [table] of {toml.name}"
    faults = Faults(str(table), "line" if is_text else "row")
    text = look_over(table, accepted.encoding if is_text else "latin-1", where, text=is_text)
    names = header_of(table, text, accepted, where) if is_text else parquet_names(table)
    used, unread = check_columns(names, machine, instrument, accepted.ignore_columns, faults)
    once = [name for name in used if names.count(name) == 1 or is_text]
    raw = read_csv(table, text, accepted, names, once, faults, where) if is_text else read_parquet(table, once, faults)
    rows = CheckedRows(raw, instrument.columns(), machine, accepted, faults, where)
    kept = rows.checked()
    if not len(raw):
        faults.whole("no rows under the header" if is_text else "no rows")
    elif not len(kept):
        faults.whole(f"every one of its {len(raw)} rows is bad; no usable row remains")
    if {"run", "time_s"} <= set(kept.columns):
        check_order(kept, faults)
    for name in instrument.columns():
        if len(kept) and name in kept.columns and np.isnan(kept.columns[name]).all():
            faults.whole(f"column {name!r} has no reading at all")
    faults.raise_if_any()
    notes = list(text.notes) if is_text else []
    return kept, [*notes, *unread, *rows.notes, *remarks(kept, instrument.columns(), machine)], text.digest

"""Measurement files: a CSV or Parquet table and a TOML of the same stem (form in `docs/measurements.md`).

Nothing is repaired silently: all faults are reported together, by row and with a remedy. What the user accepts is
under `[table]` of the TOML, or given as options, and is listed in the measurement's notes.

A column of an axis' motion that the table lacks follows from the others: the direction of approach, and the velocity
where it was read in motion. Writing gives every number back as it was, bit for bit.
"""

import hashlib
import itertools
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from rtec.arrays import Bools, Floats, Ints
from rtec.effects.derived import direction_track, direction_update
from rtec.errors import MeasurementError
from rtec.files import whole, write_text
from rtec.machine import Axis, Machine
from rtec.metrology.files.checks import CheckedRows, check_motion, check_order, remarks
from rtec.metrology.files.columns import check_columns, on_circle, still_right
from rtec.metrology.files.faults import Faults
from rtec.metrology.files.table import Raw, Text, header_of, look_over, parquet_names, read_csv, read_own, read_parquet
from rtec.metrology.files.toml import TABLES, Leniency, find_files, read_measurement_toml
from rtec.metrology.instruments.ball_bar import BallBar
from rtec.metrology.instruments.base import Instrument
from rtec.metrology.instruments.squareness import SquarenessProbe
from rtec.metrology.measurement import Measurement
from rtec.metrology.unread import is_rotary, varies
from rtec.tomlfile import nearest

Column = Floats | Ints


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
    columns |= {**measurement.unread, **measurement.readings}
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


LIKE, MOST = 0.05, 0.8
"""An axis moved at its feed if its speed agrees within the first share, in the second share of readings."""
LEAST = 3
"""Fewest targets between two ends whose number of readings shows an order."""


def not_in_order(instrument: Instrument, machine: Machine, channels: Mapping[str, Floats]) -> dict[str, Floats]:
    """Directions that the order of readings does not tell, by channel: 0 in every row, (n,)."""
    given = {} if instrument.in_order else {a: channels[a.channel] for a in machine.axes if a.channel in channels}
    moved = [a for a, at in given.items() if a.direction_channel not in channels and len(at) and np.ptp(at) > 0.0]
    return {a.direction_channel: np.zeros(len(given[a])) for a in moved}


@np.errstate(over="ignore", invalid="ignore")  # huge numbers give no direction
def on_the_run(
    instrument: Instrument, machine: Machine, channels: Mapping[str, Floats], run: Ints, time_s: Floats, read: Bools
) -> dict[str, Floats]:
    """Velocity, by channel, of an axis that was read in motion: its positions and times agree with its feed.

    An axis that stops at its targets takes longer from one to the next than at its feed. Another axis may have moved
    between the runs. In a log that goes on between the runs, the rows with a reading decide.

    Args:
        instrument, machine: what was measured with, and on.
        channels, run, time_s: the table, (n,) each.
        read: whether each row has a reading, (n,).

    Returns:
        mm/s with the sign of the motion, 0 in rows that were left out, (n,); empty where the feed was not recorded or a
        velocity was, and for a ball bar.
    """
    found = _on_the_run(instrument, machine, channels, run, time_s)
    if found or read.all():
        return found
    part = _on_the_run(instrument, machine, _rows(channels, read), run[read], time_s[read])
    return {channel: _put(values, read) for channel, values in part.items()}


def _rows(channels: Mapping[str, Floats], read: Bools) -> dict[str, Floats]:
    return {channel: values[read] for channel, values in channels.items()}


def _put(values: Floats, read: Bools) -> Floats:
    """Values of the marked rows, and 0 in the others."""
    out = np.zeros(len(read))
    out[read] = values
    return out


def _on_the_run(
    instrument: Instrument, machine: Machine, channels: Mapping[str, Floats], run: Ints, time_s: Floats
) -> dict[str, Floats]:
    moving = _moving(machine, channels, run)
    if isinstance(instrument, BallBar) or "feed_mm_min" not in channels or len(moving) != 1:
        return {}
    if moving[0].velocity_channel in channels:
        return {}
    feed = np.abs(channels["feed_mm_min"])
    position = channels[moving[0].channel]
    way = np.sign(np.diff(position))
    # Ways: consecutive readings in one direction at one feed. The axis may have been at rest before the first of them.
    new = np.concatenate([[True], (way[1:] != way[:-1]) | (feed[2:] != feed[1:-1]), [False]])
    out, like = np.zeros(len(feed)), 0
    edges = [*np.flatnonzero(new).tolist(), len(feed) - 1]
    for a, b in itertools.pairwise(edges):
        first = a + 1 if a else 0
        lasted, went = time_s[b] - time_s[first], abs(position[b] - position[first])
        if lasted > 0.0 and abs(60.0 * went - lasted * feed[b]) < LIKE * lasted * feed[b]:
            like += b - first
            out[first if out[a] else a : b + 1] = way[a] * feed[b] / 60.0
    return {moving[0].velocity_channel: out} if like >= max(LEAST, MOST * (len(feed) - 2 * len(edges))) else {}


def at_feed(
    instrument: Instrument, machine: Machine, channels: Mapping[str, Floats], run: Ints, read: Bools, where: str
) -> dict[str, Floats]:
    """Velocity, by channel, of the one axis that moves within runs, as the user says: the feed in its direction.

    The direction is the given one, else that of `approached`, else that of the positions; before the first motion it is
    that of the first motion.

    Returns:
        mm/s with the sign of the motion, (n,); empty for a ball bar, whose circle gives velocities.

    Raises:
        MeasurementError: there is no feed, a velocity was recorded, or not exactly one axis moves within runs.
    """
    if isinstance(instrument, BallBar):
        return {}
    moving = _moving(machine, _rows(channels, read), run[read])
    said = f"{where}: [table] moves_at_feed = true"
    if "feed_mm_min" not in channels:
        raise MeasurementError(f"{said} needs the column feed_mm_min; add it, or leave the key out")
    if len(moving) != 1:
        names = " and ".join(a.name for a in moving) or "no axis"
        raise MeasurementError(
            f"{said} is for one axis that moves within the runs, here {names} moved; give the column v{{axis}}_mm_s of "
            "each in its place, such as vx_mm_s"
        )
    axis = moving[0]
    if axis.velocity_channel in channels:
        raise MeasurementError(
            f"{said}, but the velocity of {axis.name} has a column; leave the key out, or the column"
        )
    way = channels.get(axis.direction_channel)
    if way is None:
        way = approached(machine, channels, run, read).get(axis.direction_channel)
    if way is None:
        way = direction_track(np.ascontiguousarray(channels[axis.channel]), axis.dead_band_mm)
    known = np.flatnonzero(way)
    first = float(way[known[0]]) if len(known) else 0.0
    way = np.where(np.arange(len(way)) < (known[0] if len(known) else 0), first, way)
    return {axis.velocity_channel: np.sign(way) * np.abs(channels["feed_mm_min"]) / 60.0}


def _moving(machine: Machine, channels: Mapping[str, Floats], run: Ints) -> list[Axis]:
    """Axes that move within a run."""
    if not len(run):
        return []
    order = np.argsort(run, kind="stable")
    first = np.flatnonzero(np.diff(run[order], prepend=run[order[0]] - 1))

    def moves(axis: Axis) -> bool:
        at = channels[axis.channel][order]
        return bool(np.any(np.maximum.reduceat(at, first) - np.minimum.reduceat(at, first) > axis.dead_band_mm))

    return [a for a in machine.axes if a.channel in channels and moves(a)]


@np.errstate(over="ignore", invalid="ignore")  # huge numbers give no direction
def by_velocity(machine: Machine, channels: Mapping[str, Floats], run: Ints, read: Bools) -> dict[str, Floats]:
    """Directions by the sign of the recorded velocity, by direction channel, of the one axis that moves within runs.

    A reading at velocity zero has the direction of `approached`, else of the last motion. A velocity without a sign, or
    with the wrong one, contradicts the positions between two turns, and gives no result.

    Returns:
        -1 or +1 for each reading, 0 before the first motion, (n,), of the axis if it has no direction of its own.
    """
    moving = _moving(machine, _rows(channels, read), run[read])
    if len(moving) != 1 or moving[0].direction_channel in channels or moving[0].velocity_channel not in channels:
        return {}
    axis = moving[0]
    position, sign = channels[axis.channel], np.sign(channels[axis.velocity_channel])
    way = np.where(np.abs(np.diff(position)) > axis.dead_band_mm, np.sign(np.diff(position)), 0.0)
    agrees = (np.where(way[1:] == way[:-1], way[1:], 0.0) * sign[1:-1]).astype(np.int64)
    if not sign.any() or np.count_nonzero(agrees > 0) < MOST * np.count_nonzero(agrees):
        return {}
    at_rest = _approach(axis, position, read)
    last = _last(axis, position, sign) if at_rest is None else at_rest
    return {axis.direction_channel: np.where(sign == 0.0, last, sign)}


def _last(axis: Axis, position_mm: Floats, sign: Floats) -> Floats:
    """Last direction of motion at each reading, by its velocity, or by the positions where that is zero, (n,)."""
    out, direction, extreme = np.zeros(len(sign)), 0.0, float(position_mm[0])
    for i, (at, way) in enumerate(zip(position_mm.tolist(), sign.tolist(), strict=True)):
        if way:
            direction, extreme = way, at
        else:
            direction, extreme = direction_update(direction, extreme, at, axis.dead_band_mm)
        out[i] = direction
    return out


@np.errstate(over="ignore", invalid="ignore")  # huge numbers give no direction
def approached(machine: Machine, channels: Mapping[str, Floats], run: Ints, read: Bools) -> dict[str, Floats]:
    """Directions of approach of an axis that is read at targets, by direction channel.

    Between two readings of the target at the end of a way the axis has gone past it and returned (ISO 230-2). An axis
    that jumps back to repeat the same way has gone past the first target. The positions alone show neither: by them the
    axis has not moved, or moved the other way. Both cases are recognised where each end is read exactly twice as often
    as a target between them, or where every way has the same direction. Any other order gives no result. Another axis
    may have moved between the runs. A log that goes on between the runs has further rows at an end, without a reading:
    where they hide the order, the rows with a reading decide.

    Returns:
        -1 or +1 for each reading, (n,), of the one axis that moves within runs, if it has no direction of its own and
        no velocity but zero.
    """
    moving = _moving(machine, _rows(channels, read), run[read])
    if len(moving) != 1 or moving[0].direction_channel in channels:
        return {}
    axis = moving[0]
    if axis.velocity_channel in channels and channels[axis.velocity_channel].any():
        return {}
    found = _approach(axis, channels[axis.channel], read)
    return {} if found is None else {axis.direction_channel: found}


@np.errstate(over="ignore", invalid="ignore")  # huge numbers give no direction
def on_arms(
    instrument: Instrument, machine: Machine, channels: Mapping[str, Floats], run: Ints, readings: Mapping[str, Floats]
) -> dict[str, Floats]:
    """Directions of the two axes on the arms of a square, by direction channel.

    An axis goes to the place of the other arm between the arms: that motion tells the arm, not the direction of a
    reading. On its own arm the axis has the direction of its positions there, from the first one on; while the other
    axis travels it keeps the last one.

    Returns:
        -1 or +1 for each reading, (n,), of each axis without a direction and a velocity of its own; empty for any other
        instrument, and where the readings do not show the arms.
    """
    if not isinstance(instrument, SquarenessProbe) or instrument.component is not None:
        return {}
    read = np.stack([np.isfinite(readings[c]) for c in instrument.columns()])
    out = {}
    for axis in (machine.axis(name) for name in instrument.axes()):
        known = {axis.direction_channel, axis.velocity_channel} & channels.keys()
        mine = (read == np.array(instrument.reads_while(axis.name))[:, None]).all(axis=0)
        if known or axis.channel not in channels or not mine.any():
            continue
        way = np.zeros(len(run))
        other_arm, other_run = mine[1:] != mine[:-1], run[1:] != run[:-1]
        edges = (np.flatnonzero(other_arm | other_run) + 1).tolist()
        for a, b in itertools.pairwise([0, *edges, len(run)]):
            if mine[a]:
                way[a:b] = _filled(
                    direction_track(np.ascontiguousarray(channels[axis.channel][a:b]), axis.dead_band_mm)
                )
        if way.any():
            out[axis.direction_channel] = _filled(way)
    return out


def _filled(way: Floats) -> Floats:
    """Directions, where a zero is the direction before it; the zeros before the first motion are the first one."""
    last = np.maximum.accumulate(np.where(way != 0.0, np.arange(len(way)), -1))
    known = np.flatnonzero(way)
    return np.where(last >= 0, way[last], way[known[0]] if len(known) else 0.0)


def _approach(axis: Axis, position_mm: Floats, read: Bools) -> Floats | None:
    """Directions by all rows, by those without the pauses of a log, or by the read ones; a lost reading is a stop."""
    gone = np.concatenate([[False], ~read, [False]])
    pause = gone[1:-1] & (gone[:-2] | gone[2:])
    for rows in (np.ones_like(read), ~pause, read):
        found = _by_order(axis, position_mm[rows])
        if found is not None:
            return found if rows.all() else _last(axis, position_mm, _put(found, rows))
    return None


def _by_order(axis: Axis, position_mm: Floats) -> Floats | None:
    first = np.flatnonzero(np.append(True, np.abs(np.diff(position_mm)) > axis.dead_band_mm))
    count = np.diff(np.append(first, len(position_mm)))
    way = np.sign(np.diff(position_mm[first]))
    turns = np.flatnonzero(way[1:] != way[:-1]) + 1  # stops at which the axis reverses
    between = np.setdiff1d(np.arange(1, len(first) - 1), turns)
    if len(between) < LEAST or len(set(count[between])) > 1:
        return None
    once = int(count[between[0]])
    if len(turns) and np.all(count[turns] == 2 * once):
        arriving = np.append(way[0], way)
        out = np.repeat(arriving, count)
        for stop in turns:
            out[first[stop] + once : first[stop] + 2 * once] = way[stop]
        return out
    side = way[between[0]]
    if np.all(count == once) and np.all(way[between] == side) and np.all(way[between - 1] == side):
        return np.full(len(position_mm), side)
    return None


__all__ = ["Leniency", "load_measurement", "load_measurements", "save_measurement"]


def load_measurements(paths: Iterable[Path], machine: Machine) -> tuple[Measurement, ...]:
    """Read several measurements; the faults of all of them are reported together.

    Raises:
        MeasurementError: as `load_measurement`.
    """
    read, faults = [], []
    for path in paths:
        try:
            read.append(load_measurement(path, machine))
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
    raw, own, notes, digest = _read(table, toml, instrument, machine, accepted)
    digest.update(toml.read_bytes())
    columns = machine.columns
    run = raw.columns["run"].astype(np.int64)
    channels = {columns[c]: v for c, v in raw.columns.items() if c in columns}
    written = {channel: column for column, channel in columns.items()}
    read = np.logical_or.reduce([np.isfinite(raw.columns[c]) for c in instrument.columns()])
    cut = not_in_order(instrument, machine, channels)
    notes += [f"no column {written[c]}: nothing tells the direction of the cut, so no reversal is read" for c in cut]
    channels |= cut
    runs = on_the_run(instrument, machine, channels, run, raw.columns["time_s"], read)
    notes += [
        f"no column {written[c]}: by its positions and times the axis went at its feed while it was read" for c in runs
    ]
    channels |= runs
    if accepted.moves_at_feed and not runs:
        found = at_feed(instrument, machine, channels, run, read, str(table))
        notes += [f"no column {written[c]}: the feed in the direction of motion, as moves_at_feed says" for c in found]
        channels |= found
    channels |= by_velocity(machine, channels, run, read)
    arms = on_arms(instrument, machine, channels, run, raw.columns)
    notes += [f"no column {written[c]}: taken from its own arm of the square" for c in arms]
    channels |= arms
    turned = instrument.turned(run)
    if getattr(instrument.setup, "reversed_runs", ()) and turned.all() == turned.any():
        which = "all" if turned.any() else "none"
        notes.append(
            f"reversed_runs names {which} of the runs: the artefact's own error is not told from the machine's"
        )
    sides = approached(machine, channels, run, read)
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
        unread=own,
    )


def _read(
    table: Path, toml: Path, instrument: Instrument, machine: Machine, accepted: Leniency
) -> tuple[Raw, dict[str, Floats], list[str], "hashlib._Hash"]:
    """Numbers, those that nothing reads and that vary, notes, and the running hash of the table."""
    is_text = table.suffix == ".csv"
    where = f"under [table] of {toml.name}"
    faults = Faults(str(table), "line" if is_text else "row")
    text = look_over(table, accepted.encoding if is_text else "latin-1", where, text=is_text)
    names = header_of(table, text, accepted, where) if is_text else parquet_names(table)
    used, unread = check_columns(names, machine, instrument, accepted.ignore_columns, faults)
    once = [name for name in used if names.count(name) == 1 or is_text]
    raw = read_csv(table, text, accepted, names, once, faults, where) if is_text else read_parquet(table, once, faults)
    read = raw.columns.get("reading_um")
    if isinstance(instrument, BallBar) and read is not None and (fault := instrument.length_fault(read)):
        faults.whole(fault)
        faults.raise_if_any()
    rows = CheckedRows(raw, instrument.columns(), machine, accepted, faults, where)
    kept = rows.checked()
    if not len(raw):
        faults.whole("no rows under the header" if is_text else "no rows")
    elif not len(kept):
        faults.whole(f"every one of its {len(raw)} rows is bad; no usable row remains")
    if {"run", "time_s"} <= set(kept.columns):
        check_order(kept, faults)
    if len(kept):
        check_motion(kept, instrument, machine, faults)
    for name in instrument.columns():
        if len(kept) and name in kept.columns and np.isnan(kept.columns[name]).all():
            faults.whole(f"column {name!r} has no reading at all")
    faults.raise_if_any()
    own = _own(table, text if is_text else None, accepted, unread, np.isin(raw.numbers, kept.numbers))
    angle = kept.columns.get("angle_deg")  # of a circle, which only a ball bar has
    if angle is not None and not isinstance(instrument, BallBar) and varies("angle_deg", angle):
        own["angle_deg"] = angle
    notes = list(text.notes) if is_text else []
    notes += [f"columns not read: {', '.join(map(repr, unread))}"] if unread else []
    return kept, own, [*notes, *rows.notes, *remarks(kept, instrument.columns(), machine)], text.digest


def _own(table: Path, text: Text | None, accepted: Leniency, unread: list[str], kept: Bools) -> dict[str, Floats]:
    """The user's own columns that vary, in the kept rows; of those that are ignored on purpose the angles alone."""
    asked = [n for n in unread if n not in accepted.ignore_columns or is_rotary(n)]
    found = read_own(table, text, accepted, asked) if asked else {}
    return {n: v[kept] for n, v in found.items() if len(v) == len(kept) and varies(n, v[kept])}

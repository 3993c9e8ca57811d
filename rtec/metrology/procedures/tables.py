"""Input of the procedures: plain tables (CSV, one line of names), measurements, and `*_ISO230.dat` of ecmc."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rtec.arrays import Bools, Floats, Ints
from rtec.errors import MeasurementError
from rtec.metrology.instruments.spindle_drift import SpindleDriftSetup
from rtec.metrology.instruments.straightness import StraightnessSetup
from rtec.metrology.measurement import Measurement
from rtec.metrology.procedures.drift import Drift, spindle_drift
from rtec.metrology.procedures.iso230_2 import Visits
from rtec.metrology.procedures.straightness import (
    ParallelismResult,
    StraightnessResult,
    artefact,
    face,
    pair,
    parallelism,
    reversal,
)
from rtec.metrology.readers import delimited, ecmc_iso230
from rtec.metrology.readers.base import SourceOptions
from rtec.metrology.units import UNITS
from rtec.tomlfile import nearest
from rtec.wording import listed

Table = dict[str, Floats]
LENGTHS = ("nm", "mm", "m", "inch", "mil", "urad", "mrad", "deg")
"""Suffixes of other units, which a column of µm may have by mistake."""


def read_table(path: Path) -> Table:
    """Columns by name, (n,) each; an empty cell is NaN, a line that begins with # is ignored.

    Raises:
        MeasurementError: not readable, no text, no rows, a repeated name, a row too short or long, or a cell that is no
            number; the message names file, line and column.
    """
    (table,) = delimited.read(path, SourceOptions(comment="#"), where="")
    return {name: table.numbers(name, str(path)) for name in table.columns}


def need(path: Path, table: Table, names: Sequence[str]) -> list[Floats]:
    """Some columns, (n,) each.

    Raises:
        MeasurementError: one is missing; the message has the nearest existing name.
    """
    for name in names:
        if name not in table:
            other = next((n for n in table if n.partition("_")[0] == name.partition("_")[0]), None)
            unit = name.rpartition("_")[2]
            hint = f"; there is {other!r}: convert its numbers to {unit}" if other else nearest(name, table)
            raise MeasurementError(f"{path}: column {name!r} is missing{hint}")
    return [table[n] for n in names]


def in_um(path: Path, names: Sequence[str]) -> None:
    """Refuse columns of probes whose names have a unit other than µm.

    Raises:
        MeasurementError: there is one; the message names the first.
    """
    for name in names:
        unit = name.rpartition("_")[2]
        if unit in LENGTHS:
            raise MeasurementError(f"{path}: column {name!r} is in {unit}; convert its numbers to µm, and call it …_um")


def position_of(path: Path, table: Table) -> tuple[str, Floats]:
    """The one column of positions, `x_mm` and so on: axis name and values.

    Raises:
        MeasurementError: there is no such column, or several; a cell in it is empty; or a probe's column is not in µm.
    """
    in_um(path, [n for n in table if n.startswith("probe")])
    found = [n for n in table if n.endswith("_mm") and not n.startswith("probe")]
    if len(found) != 1:
        raise MeasurementError(
            f"{path}: needs one column of positions, named by its axis, such as x_mm; "
            f"found {', '.join(found) or 'none'}"
        )
    values = table[found[0]]
    if np.isnan(values).any():
        raise MeasurementError(f"{path}: row {int(np.argmax(np.isnan(values))) + 2}: {found[0]} is empty")
    return found[0].removesuffix("_mm").upper(), values


METHODS = ("reversal", "pair", "face")
HALF_TURN_DEG = 180.0
ANGLE_TOLERANCE_DEG = 1.0


def straightness_table(path: Path, method: str | None = None) -> StraightnessResult:
    """Straightness from a CSV: `x_mm` (or `z_mm`, …), `spindle_deg` (0 or 180), `probe1_um`, and by method more.

    reversal: `probe1_um` at 0°, `probe2_um` at 180°. pair: both at both. face: `probe1_um` at both; with
    `profile_um` the calibrated face under the probe. `run`, where given, numbers repeated sets.

    Args:
        path: path of the table.
        method: one of `METHODS`; None: the one for which there are columns.

    Raises:
        MeasurementError: the table lacks something that the method needs; the message names file and place.
    """
    table = read_table(path)
    axis, position = position_of(path, table)
    (angle,) = need(path, table, ["spindle_deg"])
    sets = {k: _sets(path, table, position, angle, *k) for k in ((p, h) for p in (1, 2) for h in (0, 1))}
    chosen = method or _method(sets)
    if chosen not in METHODS:
        raise MeasurementError(f"method {chosen!r} is not known{nearest(chosen, METHODS)}")
    places = np.unique(position)
    try:
        result = _measured(chosen, places, sets, _profile(table, position, angle, places))
    except MeasurementError as e:
        raise MeasurementError(f"{path}: {chosen}: {e}") from e
    return replace(result, name=path.name, axis=axis)


def parallelism_table(path: Path) -> ParallelismResult:
    """Parallelism from a CSV: `z_mm` (place along the motion), `angle_deg`, `probe1_um`, `probe2_um`.

    Raises:
        MeasurementError: as `parallelism`, with the file.
    """
    table = read_table(path)
    axis, position = position_of(path, table)
    angle, probe1, probe2 = need(path, table, ["angle_deg", "probe1_um", "probe2_um"])
    try:
        result = parallelism(position, angle, probe1, probe2)
    except MeasurementError as e:
        raise MeasurementError(f"{path}: {e}") from e
    return replace(result, name=path.name, axis=axis)


def drift_table(path: Path, columns: Mapping[str, str], distance_mm: float | None) -> Drift:
    """Spindle drift from a CSV: `time_s`, `spindle_rpm`, columns of probes, temperatures.

    Args:
        path: path of the table.
        columns: column by probe name ("radial1", "radial2", "axial"); empty: `radial1_um`, … if they exist.
        distance_mm: distance between the radial probes.

    Raises:
        MeasurementError: as `spindle_drift`, with the file.
    """
    table = read_table(path)
    wanted = dict(columns) or {n: f"{n}_um" for n in ("radial1", "radial2", "axial") if f"{n}_um" in table}
    if not wanted:
        raise MeasurementError(
            f"{path}: no column radial1_um, radial2_um or axial_um; name others with --radial1, --radial2, --axial "
            f"(there are {', '.join(n for n in table if n.endswith('_um')) or 'no columns in µm'})"
        )
    in_um(path, list(wanted.values()))
    time_s, rpm, *values = need(path, table, ["time_s", "spindle_rpm", *wanted.values()])
    warm = {n: v for n, v in table.items() if n.endswith(("_degc", "_C"))}
    return spindle_drift(path.name, time_s, rpm, dict(zip(wanted, values, strict=True)), distance_mm, warm)


def _measured(
    method: str, places: Floats, sets: Mapping[tuple[int, int], Floats | None], profile: Floats | None
) -> StraightnessResult:
    if method == "reversal":
        return reversal(places, *_both(_there(sets, 1, 0), _there(sets, 2, 1)))
    if method == "face":
        return face(places, *_both(_there(sets, 1, 0), _there(sets, 1, 1)), profile)
    probes = [_both(_there(sets, p, 0), _there(sets, p, 1)) for p in (1, 2)]
    return pair(places, np.stack(probes[0]), np.stack(probes[1]))


def _both(before: Floats, after: Floats) -> tuple[Floats, Floats]:
    if len(before) != len(after):
        raise MeasurementError(f"{len(before)} sets before and {len(after)} after the turn; each needs its partner")
    return before, after


def _there(sets: Mapping[tuple[int, int], Floats | None], probe: int, half: int) -> Floats:
    found = sets[probe, half]
    if found is None:
        raise MeasurementError(f"probe{probe}_um has no readings at spindle_deg = {half * HALF_TURN_DEG:.0f}")
    return found


def _method(sets: Mapping[tuple[int, int], Floats | None]) -> str:
    if sets[2, 0] is None and sets[2, 1] is None:
        return "face"
    return "pair" if all(s is not None for s in sets.values()) else "reversal"


def _at(angle_deg: Floats, half: int) -> Bools:
    return np.abs(np.mod(angle_deg - half * HALF_TURN_DEG + 180.0, 360.0) - 180.0) <= ANGLE_TOLERANCE_DEG


def _sets(path: Path, table: Table, position: Floats, angle: Floats, probe: int, half: int) -> Floats | None:
    """Readings of one probe at one spindle position, (repeats, places); None where there are none."""
    odd = ~(_at(angle, 0) | _at(angle, 1))
    if odd.any():
        row = int(np.argmax(odd))
        raise MeasurementError(f"{path}: row {row + 2}: spindle_deg is {angle[row]:g}, allowed are 0 and 180")
    reading = table.get(f"probe{probe}_um")
    if reading is None:
        return None
    run = table.get("run", np.zeros(len(position)))
    rows = _at(angle, half) & ~np.isnan(reading)
    if not rows.any():
        return None
    places = np.unique(position)
    return np.stack([_one_set(path, r, places, position, reading, rows & (run == r)) for r in np.unique(run[rows])])


def _one_set(path: Path, run: float, places: Floats, position: Floats, reading: Floats, rows: Bools) -> Floats:
    out = np.full(len(places), np.nan)
    for row in np.flatnonzero(rows):
        place = int(np.searchsorted(places, position[row]))
        if not np.isnan(out[place]):
            raise MeasurementError(
                f"{path}: row {row + 2}: run {run:g} reads {position[row]:g} mm twice; "
                "give a repeated set another number in the column run"
            )
        out[place] = reading[row]
    return out


def _profile(table: Table, position: Floats, angle: Floats, places: Floats) -> Floats | None:
    """Calibrated face under the probe before and after the turn, (2, places)."""
    if "profile_um" not in table:
        return None
    out = np.full((2, len(places)), np.nan)
    for half in (0, 1):
        rows = _at(angle, half)
        out[half, np.searchsorted(places, position[rows])] = table["profile_um"][rows]
    return out


def drift_of(
    measurement: Measurement, distance_mm: float | None = None, columns: Mapping[str, str] | None = None
) -> Drift:
    """Drift from a measurement of instrument spindle_drift; positive as the tool moves in the probe's direction.

    Args:
        measurement: with `spindle_rpm`; probes "radial1" and "radial2" give the tilt.
        distance_mm: distance between the radial probes, instead of that of the set-up.
        columns: must be empty: only a table without a TOML needs them.

    Raises:
        MeasurementError: the instrument is another one, there are no speeds, or `columns` is not empty.
    """
    name, setup = measurement.name, measurement.instrument.setup
    if columns:
        raise MeasurementError(
            f"{name}: [setup.probe] of its TOML names the probes; leave {' and '.join(f'--{n}' for n in columns)} out"
        )
    if not isinstance(setup, SpindleDriftSetup):
        raise MeasurementError(f"{name}: instrument is {measurement.instrument.name}; drift needs spindle_drift")
    if "spindle_rpm" not in measurement.channels:
        raise MeasurementError(f"{name}: column spindle_rpm is missing; without speeds there are no phases")
    probes = {n: p.sign * measurement.readings[f"reading_{n}_um"] for n, p in setup.probe.items()}
    sensors = {n: measurement.channels[n] for n in measurement.machine.sensor_names if n in measurement.channels}
    known = distance_mm if distance_mm is not None else setup.distance_mm
    result = spindle_drift(name, measurement.time_s, measurement.channels["spindle_rpm"], probes, known, sensors)
    return replace(result, notes={name: measurement.notes})


def straightness_of(measurement: Measurement, method: str | None = None) -> StraightnessResult:
    """Straightness by reversal from a measurement of instrument straightness with reversed runs.

    The probe's sign is the same in all runs, so readings are s + a, and s - a with the artefact turned over. A run
    there and back is one pass, the mean of both ways.

    Args:
        measurement: the measurement.
        method: "artefact" or None: a measurement has no other method.

    Raises:
        MeasurementError: the instrument or method is another one, there are no reversed runs, or runs have different
            places.
    """
    name, setup, axis = measurement.name, measurement.instrument.setup, measurement.instrument.axis
    if method not in (None, "artefact"):
        raise MeasurementError(
            f"{name}: method {method!r} needs a table with spindle_deg, probe1_um, probe2_um and no TOML beside it; "
            "a measurement is that of an artefact which is turned over (reversed_runs)"
        )
    if not isinstance(setup, StraightnessSetup) or axis is None:
        raise MeasurementError(
            f"{name}: instrument is {measurement.instrument.name}; this needs straightness of an axis"
        )
    if not setup.reversed_runs:
        raise MeasurementError(f"{name}: [setup] reversed_runs is missing; without reversal the artefact stays in")
    position = measurement.channels[measurement.machine.axis(axis).channel]
    places = np.unique(position)
    reading = setup.sign * measurement.readings["reading_um"]
    way = np.sign(measurement.state().value(measurement.machine.axis(axis).direction_channel))
    runs, once = {}, np.zeros(len(places), dtype=np.bool_)
    for r in np.unique(measurement.run).tolist():
        rows = (measurement.run == r) & np.isfinite(reading)
        ways = _ways(np.searchsorted(places, position[rows]), reading[rows], way[rows], len(places))
        read = np.isfinite(ways).sum(axis=0)
        runs[r] = np.nansum(ways, axis=0) / np.where(read > 0, read, np.nan)
        once |= (read == 1) & (read.max() > 1)
    turned = [x for r, x in runs.items() if r in setup.reversed_runs]
    plain = [x for r, x in runs.items() if r not in setup.reversed_runs]
    if len(turned) != len(plain) or not turned:
        raise MeasurementError(
            f"{name}: {len(plain)} runs before and {len(turned)} after reversal; each needs its partner"
        )
    try:
        found = artefact(places, np.stack(plain), np.stack(turned))
    except MeasurementError as e:
        raise MeasurementError(f"{name}: {e}") from e
    words = found.words
    if once.any():
        where = listed([f"{x:g} mm" for x in places[once]])
        words = (*words, f"Read from one side only, so that half the reversal error stays in: {where}.")
    return replace(found, name=name, axis=axis, words=words, notes={name: measurement.notes})


def _ways(at: Ints, reading: Floats, way: Floats, places: int) -> Floats:
    """Mean reading of a run at each place, for each direction of motion there, (3, places); NaN where there is none.

    Args:
        at: number of the place of each reading, (n,).
        reading: (n,).
        way: direction of motion, -1, 0 (before the first) or +1, (n,).
        places: number of places.
    """
    cell = at + places * (way.astype(np.int64) + 1)
    read, total = (np.bincount(cell, w, minlength=3 * places) for w in (None, reading))
    return np.where(read > 0, total / np.maximum(read, 1), np.nan).reshape(3, places)


def read_dat(path: Path, swap: bool = False) -> Visits:
    """Read the visits of one `.dat` file of ecmc.

    Args:
        path: path of the `.dat`.
        swap: take FWD as backward, as the published reports of its makers do.

    Raises:
        MeasurementError: the reader finds a fault, by line, or the axis is not linear.
    """
    if not path.is_file():
        raise MeasurementError(f"{path}: no such file")
    table = ecmc_iso230.read(path, SourceOptions(swap_directions=swap))[0]
    unit = UNITS[table.units["target"]]
    if unit.kind != "length":
        raise MeasurementError(f"{path}: UNIT={table.units['target']}: only linear axes are known here")
    column = {n: np.asarray(v, dtype=np.float64) for n, v in table.columns.items()}
    target, place = np.unique(column["target"], return_inverse=True)
    cycle = column["cycle"].astype(np.int64) - 1
    grids = {way: np.full((len(target), int(cycle.max()) + 1), np.nan) for way in (1, -1)}
    for way, grid in grids.items():
        rows = column["direction"] == way
        grid[place[rows], cycle[rows]] = column["deviation"][rows] * unit.factor * 1e3
    return Visits(path.name, target * unit.factor, grids[1], grids[-1])

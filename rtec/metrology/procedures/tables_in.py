"""What the tables of straightness, parallelism and drift hold, and how they become arrays."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtec.errors import MeasurementError
from rtec.metrology.procedures.drift import Drift, spindle_drift
from rtec.metrology.procedures.parallelism import Parallelism, parallelism
from rtec.metrology.procedures.straightness import Straightness, face, pair, reversal
from rtec.metrology.procedures.tables import Table, in_um, need, position_of, read_table
from rtec.tomlfile import nearest

Floats = NDArray[np.float64]
METHODS = ("reversal", "pair", "face")
HALF_TURN_DEG = 180.0
ANGLE_TOLERANCE_DEG = 1.0


def straightness_table(path: Path, method: str | None = None) -> tuple[str, Straightness]:
    """Straightness from a CSV: `x_mm` (or `z_mm`, …), `spindle_deg` (0 or 180), `probe1_um`, and by method more.

    reversal: `probe1_um` at 0°, `probe2_um` at 180°. pair: both at both. face: `probe1_um` at both; with
    `profile_um` the calibrated face under the probe. `run`, where given, numbers repeated sets.

    Args:
        path: of the table.
        method: one of `METHODS`; None: what the columns allow.

    Returns:
        Axis name and result.

    Raises:
        MeasurementError: the table does not hold what the method needs; the message names file and place.
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
        return axis, _measured(chosen, places, sets, _profile(table, position, angle, places))
    except MeasurementError as e:
        raise MeasurementError(f"{path}: {chosen}: {e}") from e


def parallelism_table(path: Path) -> tuple[str, Parallelism]:
    """Parallelism from a CSV: `z_mm` (place along the motion), `angle_deg`, `probe1_um`, `probe2_um`.

    Raises:
        MeasurementError: as `parallelism`, with the file.
    """
    table = read_table(path)
    axis, position = position_of(path, table)
    angle, probe1, probe2 = need(path, table, ["angle_deg", "probe1_um", "probe2_um"])
    try:
        return axis, parallelism(position, angle, probe1, probe2)
    except MeasurementError as e:
        raise MeasurementError(f"{path}: {e}") from e


def drift_table(path: Path, columns: Mapping[str, str], distance_mm: float | None) -> Drift:
    """Spindle drift from a CSV: `time_s`, `spindle_rpm`, columns of probes, temperatures.

    Args:
        path: of the table.
        columns: probe name ("radial1", "radial2", "axial") to column; empty: `radial1_um`, … as far as they are there.
        distance_mm: between the radial probes.

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
) -> Straightness:
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


def _at(angle_deg: Floats, half: int) -> NDArray[np.bool_]:
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


def _one_set(
    path: Path, run: float, places: Floats, position: Floats, reading: Floats, rows: NDArray[np.bool_]
) -> Floats:
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

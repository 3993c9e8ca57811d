"""`rtec iso230`, `straightness`, `parallelism`, `drift`: from readings to the figures of a report."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtec.cli.common import Json, Report

if TYPE_CHECKING:
    from collections.abc import Callable

    from rtec.metrology.measurement import Measurement
    from rtec.metrology.procedures.iso230_2 import Visits
    from rtec.report.page import Page

_Machine = Annotated[
    Path | None, typer.Option("--machine", "-m", help="Machine file; needed for measurements with a TOML beside.")
]
_Table = Annotated[Path, typer.Argument(metavar="TABLE", help="CSV with one line of names.", show_default=False)]

_Notes = dict[str, list[str]]


def iso230(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...", help="ecmc .dat, or measurements of instrument laser_linear.", show_default=False
        ),
    ],
    machine: _Machine = None,
    pitch_mm: Annotated[
        float | None, typer.Option("--pitch", min=1e-6, help="Pitch, mm.  [default: of the machine file]")
    ] = None,
    swap: Annotated[bool, typer.Option("--swap", help="In a .dat take FWD as backward.")] = False,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """Evaluates positioning after ISO 230-2: A, R, E, M and B in each direction and together, coverage factor 2.

    Example: `rtec iso230 x-axis_ISO230.dat --pitch 5 --report out/x`

    `rtec iso230 laser-x.csv --machine configs/machines/turning-centre.toml --json`

    Drift between the cycles is separated from repeatability. Warns if the targets are multiples of the pitch, which
    hide an error that repeats with the pitch.
    """
    from rtec.metrology.procedures.iso230_2 import positioning
    from rtec.report.procedures import iso230_page

    results, notes = [], _Notes()
    for file in files:
        visits, own_pitch_mm = _visits(file, machine, swap, notes)
        results.append(positioning(visits, pitch_mm or own_pitch_mm))
    _give(lambda figures: iso230_page(results, figures), {"tests": results}, report, as_json, notes)


def straightness(
    table: _Table,
    machine: _Machine = None,
    method: Annotated[
        str | None, typer.Option("--method", help="reversal, pair or face.  [default: by the columns]")
    ] = None,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """Evaluates straightness: with an arbor and its reversal, a pair of probes, or a turned face with orthogonality.

    Example: `rtec straightness z-arbor.csv --report out/z`

    Columns: x_mm (or z_mm, ...), spindle_deg (0 or 180), probe1_um, probe2_um; run numbers repeated sets. Probes read
    positive as the gap closes; probe 1 is on the positive side. Or a measurement of instrument straightness with
    reversed_runs.
    """
    from rtec.metrology.procedures.tables import straightness_table
    from rtec.report.procedures import straightness_page

    notes = _Notes()
    if _is_measurement(table):
        from rtec.metrology.procedures.tables import straightness_of

        axis, result = straightness_of(_measurement(table, machine, notes))
    else:
        axis, result = straightness_table(table, method)
    _give(lambda figures: straightness_page(table.name, axis, result, figures), result, report, as_json, notes)


def parallelism(table: _Table, report: Report = None, as_json: Json = False) -> None:
    """Evaluates parallelism of a motion to the spindle axis, from best-fit circles of two probes on a turning arbor.

    Columns: z_mm (place along the motion, two or more), angle_deg, probe1_um, probe2_um.

    Example: `rtec parallelism z-circles.csv --json`
    """
    from rtec.metrology.procedures.tables import parallelism_table
    from rtec.report.procedures import parallelism_page

    axis, result = parallelism_table(table)
    _give(lambda figures: parallelism_page(table.name, axis, result, figures), result, report, as_json)


def drift(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="CSV, or a measurement of instrument spindle_drift.", show_default=False),
    ],
    machine: _Machine = None,
    radial1: Annotated[str | None, typer.Option("--radial1", help="Column of the first radial probe.")] = None,
    radial2: Annotated[str | None, typer.Option("--radial2", help="Column of the second one.")] = None,
    axial: Annotated[str | None, typer.Option("--axial", help="Column of the axial probe.")] = None,
    distance_mm: Annotated[
        float | None, typer.Option("--distance", min=1e-6, help="Distance between the radial probes, mm, for the tilt.")
    ] = None,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """Evaluates thermal drift of the spindle: radial, axial and tilt, with a time constant for each constant speed.

    Columns: time_s, spindle_rpm, probes in um, temperatures (..._degc). Run 8 h, off overnight, at several speeds.

    Example: `rtec drift spindle.csv --radial1 ch1_um --radial2 ch2_um --axial ch5_um --distance 100`
    """
    from rtec.metrology.procedures.tables import drift_table
    from rtec.report.procedures import drift_page

    columns = {n: c for n, c in (("radial1", radial1), ("radial2", radial2), ("axial", axial)) if c}
    notes = _Notes()
    if _is_measurement(file):
        from rtec.metrology.procedures.tables import drift_of

        result = drift_of(_measurement(file, machine, notes), distance_mm)
    else:
        result = drift_table(file, columns, distance_mm)
    _give(lambda figures: drift_page(result, figures), result, report, as_json, notes)


def _visits(file: Path, machine: Path | None, swap: bool, notes: _Notes) -> "tuple[Visits, float | None]":
    """Deviations of one file, and the pitch of its axis where the machine file knows it."""
    if file.suffix == ".dat":
        from rtec.metrology.procedures.tables import read_dat

        return read_dat(file, swap), None
    from rtec.metrology.procedures.iso230_2 import visits_of

    measurement = _measurement(file, machine, notes)
    visits = visits_of(measurement)
    return visits, measurement.machine.axis(str(measurement.instrument.axis)).pitch_mm


def _measurement(file: Path, machine: Path | None, notes: _Notes) -> "Measurement":
    """Read one, and add its notes."""
    from rtec.errors import ConfigError
    from rtec.machine import load_machine
    from rtec.metrology.files.load import load_measurement

    if machine is None:
        raise ConfigError(f"{file}: is a measurement; name the machine that it was made on with --machine")
    measurement = load_measurement(file, load_machine(machine))
    notes[measurement.name] = list(measurement.notes)
    return measurement


def _is_measurement(file: Path) -> bool:
    return file.suffix in (".toml", ".parquet") or file.with_suffix(".toml").is_file()


def _give(
    page_of: "Callable[[bool], Page]", facts: object, report: Path | None, as_json: bool, notes: _Notes | None = None
) -> None:
    """Write and print a result with the notes of its measurements."""
    from rtec.cli.common import give
    from rtec.report.page import with_notes
    from rtec.result import plain

    kept = notes or {}
    give(
        lambda figures: with_notes(page_of(figures), kept),
        plain(facts) | {"notes": kept},
        as_json=as_json,
        report=report,
    )

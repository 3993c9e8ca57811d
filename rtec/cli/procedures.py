"""`rtec iso230`, `straightness`, `parallelism`, `drift`: from readings to characteristics and a report."""

from pathlib import Path
from typing import Annotated

import typer

from rtec.cli.common import Json, Report

_Machine = Annotated[
    Path | None, typer.Option("--machine", "-m", help="Machine file; needed for a measurement with its TOML file.")
]
_Table = Annotated[Path, typer.Argument(metavar="TABLE", help="CSV with one line of names.", show_default=False)]


def iso230(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...", help="ecmc .dat, or measurements of instrument laser_linear.", show_default=False
        ),
    ],
    machine: _Machine = None,
    pitch_mm: Annotated[
        float | None, typer.Option("--pitch", min=1e-6, help="Pitch, mm.", show_default="of the machine file")
    ] = None,
    swap: Annotated[bool, typer.Option("--swap", help="In a .dat file FWD is the negative direction.")] = False,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """Evaluates positioning after ISO 230-2: A, R, E, M and B in each direction and together, coverage factor 2.

    Example: `rtec iso230 x-axis_ISO230.dat --pitch 5 --report out/x`

    `rtec iso230 laser-x.csv --machine configs/machines/turning-centre.toml --json`

    Drift between the cycles is separated from repeatability. Warns if the targets are multiples of the pitch, which
    hide an error that repeats with the pitch.
    """
    from rtec import api
    from rtec.cli.common import show

    show(api.iso230(files, machine=machine, pitch_mm=pitch_mm, swap=swap, report=report), as_json=as_json)


def straightness(
    table: _Table,
    machine: _Machine = None,
    method: Annotated[
        str | None, typer.Option("--method", help="reversal, pair or face, of a table.", show_default="by the columns")
    ] = None,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """Evaluates straightness: with an arbor and its reversal, a pair of probes, or a turned face with orthogonality.

    Example: `rtec straightness z-arbor.csv --report out/z`

    Columns: x_mm (or z_mm, ...), spindle_deg (0 or 180), probe1_um, probe2_um; repeated sets have numbers in a column
    run. A probe's reading rises as its gap closes; probe 1 is on the positive side. A measurement of instrument
    straightness with reversed_runs is taken, too.
    """
    from rtec import api
    from rtec.cli.common import show

    show(api.straightness(table, machine=machine, method=method, report=report), as_json=as_json)


def parallelism(table: _Table, report: Report = None, as_json: Json = False) -> None:
    """Evaluates parallelism of a motion to the spindle axis, from best-fit circles of two probes on a turning arbor.

    Columns: z_mm (place along the motion, two or more), angle_deg, probe1_um, probe2_um.

    Example: `rtec parallelism z-circles.csv --json`
    """
    from rtec import api
    from rtec.cli.common import show

    show(api.parallelism(table, report=report), as_json=as_json)


def drift(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="CSV, or a measurement of instrument spindle_drift.", show_default=False),
    ],
    machine: _Machine = None,
    radial1: Annotated[str | None, typer.Option("--radial1", help="Column of the first radial probe.")] = None,
    radial2: Annotated[str | None, typer.Option("--radial2", help="Column of the second radial probe.")] = None,
    axial: Annotated[str | None, typer.Option("--axial", help="Column of the axial probe.")] = None,
    distance_mm: Annotated[
        float | None,
        typer.Option("--distance", min=1e-6, help="Distance between the radial probes, mm; the tilt needs it."),
    ] = None,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """Evaluates thermal drift of the spindle: radial, axial and tilt, with a time constant for each constant speed.

    Columns: time_s, spindle_rpm, probes (..._um), temperatures (..._degc). Run the spindle for 8 h at several speeds,
    then stop it overnight.

    Example: `rtec drift spindle.csv --radial1 ch1_um --radial2 ch2_um --axial ch5_um --distance 100`
    """
    from rtec import api
    from rtec.cli.common import show

    columns = {n: c for n, c in (("radial1", radial1), ("radial2", radial2), ("axial", axial)) if c}
    result = api.drift(file, machine=machine, columns=columns, distance_mm=distance_mm, report=report)
    show(result, as_json=as_json)

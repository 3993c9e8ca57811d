"""`rtec plan`, `iso230`, `straightness`, `parallelism`, `drift`, `ballbar`, `grid`: tests planned, and evaluated."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

import typer

from rtec.cli.common import Full, Json, MachineFile, Report


def plan(
    machine: Annotated[Path, typer.Argument(metavar="MACHINE", help="Machine file.", show_default=False)],
    tests: Annotated[
        list[Path],
        typer.Argument(metavar="TEST...", help="Measurements, or TOML files of planned tests.", show_default=False),
    ],
    effects: Annotated[
        str | None,
        typer.Option(help="Effects to separate, as scale:EXX,backlash:EXX."),
    ] = None,
    model: Annotated[Path | None, typer.Option(metavar="MODEL", help="Take the effects of this model instead.")] = None,
    rivals: Annotated[str | None, typer.Option(help="Rank tests by how well they separate these effects.")] = None,
    ball_bar: Annotated[
        Literal["linear", "non-linear"] | None,
        typer.Option(
            "--ball-bar", help="Separate the parameters of `rtec ballbar`, with straight guides (linear) or bent ones."
        ),
    ] = None,
    centre: Annotated[
        Literal["shared", "each"],
        typer.Option(help="Ball bar: one centre of the table-side ball for all tests, or one for each."),
    ] = "shared",
    noise: Annotated[float, typer.Option(min=1e-4, help="White noise of a reading, µm or µrad.")] = 0.5,
    suggest: Annotated[bool, typer.Option("--suggest/--no-suggest", help="Search for tests to add.")] = True,
    full: Full = False,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """Plans tests: which parameters a set of tests separates, which stay confounded, and which test to add.

    Example: `rtec plan configs/machines/turning-centre.toml laser-x.toml --effects scale:EXX,guide_curvature:EBX`

    `rtec plan machine.toml circle-ccw.toml circle-cw.toml --ball-bar non-linear`

    `rtec plan machine.toml laser-x.csv --rivals backlash:EXX,servo_lag:EXX`

    Nothing needs to be measured yet. A planned test is a TOML file: [measurement] and [setup] as in the file beside a
    measurement; [targets], [path] and [[phase]] as in `rtec simulate --settings`.
    """
    from rtec import api
    from rtec.cli.common import show, stages

    with stages() as stage:
        answer = api.plan(
            machine,
            tests,
            effects=effects,
            model=model,
            rivals=rivals,
            ball_bar=ball_bar,
            centre=centre,
            noise=noise,
            suggest=suggest,
            report=report,
            progress=stage,
        )
    show(answer, as_json=as_json, full=full)


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


class _Model(StrEnum):
    auto = "auto"
    linear = "linear"
    bent = "non-linear"


class _Phase(StrEnum):
    auto = "auto"
    angle = "angle"
    time = "time"


class _Centre(StrEnum):
    shared = "shared"
    each = "each"


def ballbar(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="Tests of one plane together.", show_default=False)
    ],
    machine: MachineFile,
    model: Annotated[_Model, typer.Option(help="Guides that are straight (linear), or bent.")] = _Model.auto,
    window_deg: Annotated[
        float,
        typer.Option(
            "--window",
            min=0.0,
            max=40.0,
            help="Readings this near to a quadrant, in degrees, are fitted with dynamic effects only.",
        ),
    ] = 5.0,
    centre: Annotated[
        _Centre, typer.Option(help="One centre of the table-side ball for all tests, or one for each.")
    ] = _Centre.shared,
    phase: Annotated[
        _Phase,
        typer.Option(help="Servo phase: one angle in all tests, or one delay; it matters where feed/radius differs."),
    ] = _Phase.auto,
    dynamic: Annotated[bool, typer.Option("--dynamic/--no-dynamic", help="Test dynamic effects, too.")] = True,
    orders: Annotated[int, typer.Option(min=3, max=60, help="Harmonics in the table.")] = 15,
    full: Full = False,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """Diagnoses ball-bar tests: scales, squareness, clearance, servo, bent and twisted guides, with intervals.

    Example: `rtec ballbar flat-ccw.csv high-cw.csv high-ccw.csv --machine mill.toml --report out/ballbar`

    Straight guides have ten parameters. Two tests separate them: counter-clockwise at height 0, clockwise at another
    height. Bent guides have fifteen. They need a third test: counter-clockwise at the other height, too.

    Then it tests dynamic effects: reversal spikes, servo gain and delay, lateral play, cyclic and indexing error of the
    screw, clearance that changes along its axis, master-slave change-over. A test at a second feed separates gain and
    delay from scale and phase.

    Where the tests do not separate parameters, only the combination that they determine is shown. It also gives G,
    G(b), F, H and D of ISO 230-4, and harmonics.
    """
    from rtec import api
    from rtec.cli.common import show, stages

    with stages() as stage:
        diagnosis = api.ballbar(
            machine,
            files,
            model=model.value,
            window_deg=window_deg,
            centre=centre.value,
            phase=phase.value,
            dynamic=dynamic,
            orders=orders,
            report=report,
            progress=stage,
        )
    show(diagnosis, as_json=as_json, full=full)


def grid(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="Each file is one set-up.", show_default=False)
    ],
    machine: MachineFile,
    corner_mm: Annotated[
        tuple[float, float] | None,
        typer.Option(
            "--corner", metavar="A B", help="Report on the edges that meet here, mm.", show_default="first corner"
        ),
    ] = None,
    trim_mm: Annotated[
        float, typer.Option("--trim", min=0.0, help="Length that is skipped at both ends of each straight piece, mm.")
    ] = 2.0,
    magnification: Annotated[
        float | None,
        typer.Option(min=1.0, help="Magnification in the figures.", show_default="a round one"),
    ] = None,
    full: Full = False,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """Evaluates grid-encoder paths: squareness, linear deviation, straightness and pitch, each with its uncertainty.

    Example: `rtec grid yz-low.csv yz-high.csv --machine bridge.toml --magnification 10000 --report out/grid`

    Several set-ups are compared with each other: roll, cross-talk between axes. Paths of one set-up are compared, too:
    directions, feeds, Ls from both sides. Squares, straight lines and Ls are recognised in the commanded positions.
    """
    from rtec import api
    from rtec.cli.common import show

    result = api.grid(machine, files, corner_mm=corner_mm, trim_mm=trim_mm, magnification=magnification, report=report)
    show(result, as_json=as_json, full=full)

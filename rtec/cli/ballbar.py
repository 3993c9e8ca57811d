"""`rtec ballbar`: ball-bar tests to causes."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from rtec.cli.common import Full, Json, MachineFile, Report


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

"""`rtec ballbar`: ball-bar tests to causes."""

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


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
    machine: Annotated[Path, typer.Option("--machine", "-m", help="Machine file.", show_default=False)],
    model: Annotated[_Model, typer.Option(help="Guides taken as straight, or as bent.")] = _Model.auto,
    window_deg: Annotated[
        float,
        typer.Option(
            "--window",
            min=0.0,
            max=40.0,
            help="So near to a quadrant readings are not used in the fit, degrees; with dynamic effects they are.",
        ),
    ] = 5.0,
    centre: Annotated[
        _Centre, typer.Option(help="Does the table-side ball stay where it is from test to test, or not?")
    ] = _Centre.shared,
    phase: Annotated[
        _Phase, typer.Option(help="Servo phase: one angle in all tests, or one time? Matters if feed/radius differs.")
    ] = _Phase.auto,
    dynamic: Annotated[
        bool, typer.Option("--dynamic/--no-dynamic", help="Look for dynamic effects and those of the drive, too.")
    ] = True,
    orders: Annotated[int, typer.Option(min=3, max=60, help="Harmonics in the table.")] = 15,
    report: Annotated[
        Path | None, typer.Option("--report", metavar="DIR", help="Write figures, report.html and result.json here.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Say what makes a ball-bar circle what it is: scales, squareness, clearance, servo, bent and twisted guides.

    Two tests separate the ten parameters of straight guides: height 0 ccw, and another height cw. Bent guides have
    fifteen and need a third: that height ccw. Then dynamic effects: reversal spikes, servo gain and delay (a second
    feed tells them from scale and phase), lateral play, cyclic and indexing error of the screw, clearance that changes
    along its axis, master-slave change-over. Also G, G(b), F, H, D of ISO 230-4, and harmonics.

    Example: `rtec ballbar flat-ccw.csv high-cw.csv high-ccw.csv --machine mill.toml --report out/ballbar`
    """
    from rtec.cli.common import bar, show_page
    from rtec.machine import load_machine
    from rtec.metrology.ball_bar.diagnosis import diagnose
    from rtec.metrology.files.load import load_measurements
    from rtec.report.ball_bar import ball_bar_facts, ball_bar_page
    from rtec.report.page import plain, write_page

    measurements = load_measurements(files, load_machine(machine))
    with bar(f"{len(measurements)} tests"):
        found = diagnose(
            measurements, model.value, window_deg, centre.value, orders, dynamic=dynamic, phase=phase.value
        )
    facts = ball_bar_facts(found)
    path = write_page(ball_bar_page(found), facts, report) if report else None
    if as_json:
        typer.echo(json.dumps(plain(facts) | {"report": str(path) if path else None}, indent=2, ensure_ascii=False))
        return
    show_page(ball_bar_page(found, figures=False))
    if path:
        typer.echo(f"Report: {path}")

"""`rtec plan`: which parameters planned tests separate, and which test to add."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from rtec.cli.common import Full, Json, Report


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

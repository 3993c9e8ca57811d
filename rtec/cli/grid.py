"""`rtec grid`: grid-encoder paths to error motions."""

from pathlib import Path
from typing import Annotated

import typer

from rtec.cli.common import Full, Json, MachineFile, Report


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

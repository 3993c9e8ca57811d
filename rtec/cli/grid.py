"""`rtec grid`: grid-encoder paths to error motions."""

import json
from pathlib import Path
from typing import Annotated

import typer


def grid(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="One set-up a file.", show_default=False)],
    machine: Annotated[Path, typer.Option("--machine", "-m", help="Machine file.", show_default=False)],
    corner_mm: Annotated[
        tuple[float, float] | None,
        typer.Option(
            "--corner", metavar="A B", help="Report on the edges that meet here, mm.  [default: first corner]"
        ),
    ] = None,
    trim_mm: Annotated[
        float, typer.Option("--trim", min=0.0, help="Left out at both ends of each straight piece, mm.")
    ] = 2.0,
    magnification: Annotated[
        float | None, typer.Option(min=1.0, help="Of the deviations in the figures.  [default: a round one]")
    ] = None,
    report: Annotated[
        Path | None, typer.Option("--report", metavar="DIR", help="Write figures, report.html and result.json here.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Squareness, linear deviation, straightness and pitch from paths on a 2D digital scale, each with its uncertainty.

    Set-ups given together are compared: roll, cross-talk between axes. Paths of one set-up are, too: directions, Ls
    from both sides, feeds. Squares, straight lines and Ls are found in the commanded positions.

    Example: `rtec grid yz-low.csv yz-high.csv --machine bridge.toml --magnification 10000 --report out/grid`
    """
    from rtec.cli.common import show_page
    from rtec.machine import load_machine
    from rtec.metrology.files.load import load_measurements
    from rtec.report.grid import grid_facts, grid_page, grid_report
    from rtec.report.page import plain, write_page

    measurements = load_measurements(files, load_machine(machine))
    found = grid_report(measurements, corner_mm, trim_mm, magnification)
    facts = grid_facts(found)
    path = write_page(grid_page(found), facts, report) if report else None
    if as_json:
        typer.echo(json.dumps(plain(facts) | {"report": str(path) if path else None}, indent=2, ensure_ascii=False))
        return
    show_page(grid_page(found, figures=False))
    if path:
        typer.echo(f"Report: {path}")

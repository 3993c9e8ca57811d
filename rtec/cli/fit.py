"""`rtec fit`: measurements in, geometric-thermal model out."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rtec.characterise.run import Stage


def fit(
    machine: Annotated[Path, typer.Argument(metavar="MACHINE", help="Machine file.", show_default=False)],
    files: Annotated[
        list[Path],
        typer.Argument(metavar="MEASUREMENT...", help="Measurements made on it, any instruments.", show_default=False),
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="MODEL", help="Write the model here.", show_default=False)
    ],
    effects: Annotated[
        str | None,
        typer.Option("--effects", help="Fit these and no others: scale,backlash or mount_expansion:EXX:sensor=T_bed."),
    ] = None,
    leave_out_h: Annotated[
        float | None, typer.Option("--leave-out", min=1e-3, help="Leave out stretches of so many hours, not runs.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option("--report", metavar="DIR", help="Write figures, report.html and result.json here.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Characterise a machine: choose effects and temperatures on runs left out of the fit, then fit them.

    Correlates each component error with every temperature, difference and lag; warns in words where sensors are
    collinear, choices undecided, ranges not visited, or the model over-fitted. `rtec effects` names the effects.

    Example: `rtec fit configs/machines/turning-centre.toml laser-x.csv laser-z.csv -o model.toml --report out/fit`

    `rtec fit machine.toml laser-x.csv -o model.toml --effects scale,backlash,axis_expansion`

    `rtec fit machine.toml drift.csv -o model.toml --effects mount_expansion:EX0spindle:sensor=*`
    """
    from rtec.characterise import characterise, read_wanted
    from rtec.machine import load_machine
    from rtec.metrology.files.load import load_measurements
    from rtec.model import save_model
    from rtec.report.fit import fit_page
    from rtec.report.page import plain, write_page

    known = load_machine(machine)
    _check_out(out, [machine, *files])
    wanted = read_wanted(effects, known) if effects else None
    from rtec.cli.common import told_when_stopped

    with told_when_stopped(), _stages() as stage:
        stage("reading", 0, 1)
        measurements = load_measurements(files, known)
        result = characterise(measurements, wanted=wanted, leave_out_h=leave_out_h, name=out.stem, stage=stage)
    save_model(result.model, out)
    page = write_page(fit_page(result), result.facts(), report) if report else None
    if as_json:
        facts = {**result.facts(), "model_file": str(out), "report": str(page) if page else None}
        typer.echo(json.dumps(plain(facts), indent=2, ensure_ascii=False))
        return
    from rtec.cli.common import show_page

    show_page(fit_page(result, figures=False))
    typer.echo(f"Model: {out}")
    if page:
        typer.echo(f"Report: {page}")


def _check_out(out: Path, inputs: list[Path]) -> None:
    """Before a long fit rather than after it: a model takes the place of no input, and its folder is there."""
    from rtec.errors import ModelError

    read = {p.resolve() for path in inputs for p in (path, path.with_suffix(".toml"))}
    if out.resolve() in read:
        raise ModelError(f"{out}: is read by this fit (a table's TOML counts); name another file with -o")
    out.parent.mkdir(parents=True, exist_ok=True)


@contextmanager
def _stages() -> "Iterator[Stage]":
    """One bar, which names the stage that it is of; on standard error, so that results can be piped."""
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    from rtec.cli.screen import Console

    columns = (SpinnerColumn(), TextColumn("{task.description:<32}", markup=False), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("getting ready", total=None)

        def tell(what: str, done: int, total: int) -> None:
            progress.update(task, description=what, completed=done, total=total if done else None)

        yield tell

"""`rtec fit`: measurements in, geometric-thermal model out."""

from pathlib import Path
from typing import Annotated

import typer

from rtec.cli.common import Full, Json, Report


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
        float | None, typer.Option("--leave-out", min=1e-3, help="Hold out stretches of so many hours, not runs.")
    ] = None,
    full: Full = False,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """Characterises a machine: chooses effects and temperatures on held-out runs, fits them, and writes a model.

    Correlates each component error with every temperature, difference and lag. Warns if sensors are collinear,
    choices undecided, ranges not visited, or the model over-fitted. `rtec effects` lists the effects.

    Example: `rtec fit configs/machines/turning-centre.toml laser-x.csv laser-z.csv -o model.toml --report out/fit`

    `rtec fit machine.toml laser-x.csv -o model.toml --effects scale,backlash,axis_expansion`

    `rtec fit machine.toml drift.csv -o model.toml --effects mount_expansion:EX0spindle:sensor=*`
    """
    from rtec.characterise import characterise, read_wanted
    from rtec.cli.common import give, interruptible, stages
    from rtec.machine import load_machine
    from rtec.metrology.files.load import load_measurements
    from rtec.model import save_model
    from rtec.report.fit import fit_page

    known = load_machine(machine)
    _check_out(out, [machine, *files])
    wanted = read_wanted(effects, known) if effects else None
    with interruptible(), stages() as stage:
        stage("reading", 0, 1)
        measurements = load_measurements(files, known)
        result = characterise(measurements, wanted=wanted, leave_out_h=leave_out_h, name=out.stem, stage=stage)
    save_model(result.model, out)
    give(
        lambda figures: fit_page(result, figures, [out, *files]),
        {**result.facts(), "model_file": str(out)},
        as_json=as_json,
        report=report,
        full=full,
        written={"Model": out},
    )


def _check_out(out: Path, inputs: list[Path]) -> None:
    """Before a long fit rather than after it: a model takes the place of no input, and its folder is there."""
    from rtec.errors import ModelError

    read = {p.resolve() for path in inputs for p in (path, path.with_suffix(".toml"))}
    if out.resolve() in read:
        raise ModelError(f"{out}: is read by this fit (a table's TOML counts); name another file with -o")
    out.parent.mkdir(parents=True, exist_ok=True)

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
        float | None,
        typer.Option("--leave-out", min=1e-3, help="Hold out stretches of this many hours instead of runs."),
    ] = None,
    full: Full = False,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """Characterises a machine: chooses effects and temperatures on held-out runs, fits them, and writes a model.

    Example: `rtec fit configs/machines/turning-centre.toml laser-x.csv laser-z.csv -o model.toml --report out/fit`

    `rtec fit machine.toml laser-x.csv -o model.toml --effects scale,backlash,axis_expansion`

    `rtec fit machine.toml drift.csv -o model.toml --effects mount_expansion:EX0spindle:sensor=*`

    It tries every temperature, temperature difference and lag for each component error. It warns of sensors that are
    collinear, choices that are undecided, ranges that were not visited, and a model that is over-fitted. `rtec effects`
    lists the effects.
    """
    from rtec import api
    from rtec.cli.common import interruptible, show, stages

    with interruptible(), stages() as stage:
        result = api.fit(
            machine, files, effects=effects, leave_out_h=leave_out_h, out=out, report=report, progress=stage
        )
    show(result, as_json=as_json, full=full, written={"Model": out})

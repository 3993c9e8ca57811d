"""`rtec replay`: a log or a capture through the same step."""

from pathlib import Path
from typing import Annotated

import typer

from rtec.cli.common import Json, print_json


def replay(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="Run file: machine, model, limits.")],
    log: Annotated[
        Path,
        typer.Argument(metavar="LOG", help="A log of `rtec run`, a folder of logs, or a capture (.sr)."),
    ],
    check: Annotated[
        bool,
        typer.Option("--check", help="Compare with the commands in the log, bit for bit; status 1 if any differs."),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Write here; by default beside the log, with 'replay' in its name."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Replays a log, or a logic-analyser capture, through the same step as the daemon, as fast as it can.

    Example: `rtec replay configs/turning-centre-sim.toml logs/run.arrows --check`

    `rtec replay configs/capture.toml scale.sr --out corrected.sr`

    A log gives a new log with recomputed commands; `--check` compares them with the logged ones. In a folder every log
    is checked, each from its own beginning, packed ones (.parquet) too. A capture (sigrok `.sr`) gives a capture with
    corrected A/B lines that sigrok opens, and a table of counts; `[capture]` in the run file names the channels.
    Neither needs `[role]` or `[device]` there.
    """
    from rtec import api
    from rtec.cli.common import stages
    from rtec.report.playback import replay_lines

    with stages(log.name) as stage:
        result = api.replay(config, log, check=check, out=out, progress=stage)
    if as_json:
        print_json(result.to_dict())
    else:
        typer.echo("\n".join(replay_lines(result)))
    if not result.identical:
        raise typer.Exit(1)

"""`rtec status`: how a running daemon does."""

import json
from typing import Annotated

import typer

from rtec.cli.control_options import At, Config, Json, KeyFile


def status(
    config: Config = None,
    watch: Annotated[bool, typer.Option("--watch", "-w", help="Keep showing, until Ctrl-C.")] = False,
    as_json: Json = False,
    at: At = None,
    key: KeyFile = None,
) -> None:
    """How a running daemon does: correction of each axis, inputs and their ages, what is wrong, missed deadlines.

    Exit status 1 where a device is in trouble, rows do not reach the log now, or the loop does not move on.

    Example: rtec status configs/turning-centre-sim.toml --watch
    """
    from rtec.cli.status_screen import show, watched
    from rtec.control.client import Client, find
    from rtec.control.facts import well
    from rtec.loop.clock import RealClock

    with Client(find(config, at, key)) as client:
        if watch:
            watched(client, RealClock(), as_json)
            return
        found = client.status()
    if as_json:
        typer.echo(json.dumps(found, indent=2, ensure_ascii=False))
    else:
        show(found)
    if not well(found):
        raise typer.Exit(1)

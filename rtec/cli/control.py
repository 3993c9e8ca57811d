"""`rtec ctl`: orders to a running daemon."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtec.cli.control_options import At, Config, Json, KeyFile

if TYPE_CHECKING:
    from rtec.loop.orders import Order

app = typer.Typer(no_args_is_help=True, help="Order a running daemon about: enable, hold, fade, resume, reload, mark.")


@app.command()
def enable(config: Config = None, at: At = None, key: KeyFile = None, as_json: Json = False) -> None:
    """Let the correction follow the model, from where it stands, within its limits.

    Exit status 1 where it stays where it is all the same, with the reason.

    Example: rtec ctl enable
    """
    _give("enable", "", config, at, key, as_json)


@app.command()
def hold(config: Config = None, at: At = None, key: KeyFile = None, as_json: Json = False) -> None:
    """Let the correction stay where it is.

    Example: rtec ctl hold configs/turning-centre-sim.toml
    """
    _give("hold", "", config, at, key, as_json)


@app.command()
def fade(config: Config = None, at: At = None, key: KeyFile = None, as_json: Json = False) -> None:
    """Let the correction go to nothing at its slew limit.

    Example: rtec ctl fade
    """
    _give("fade", "", config, at, key, as_json)


@app.command()
def resume(config: Config = None, at: At = None, key: KeyFile = None, as_json: Json = False) -> None:
    """Let devices that stopped by themselves go on: a box that started anew, a position that was lost.

    Exit status 1 where a device is still in trouble.

    Example: rtec ctl resume
    """
    _give("resume", "", config, at, key, as_json)


@app.command()
def reload(config: Config = None, at: At = None, key: KeyFile = None, as_json: Json = False) -> None:
    """Read run file and model again; limits and model change without a jump.

    Exit status 1 where the old ones stay, with the reason.

    Example: rtec ctl reload
    """
    _give("reload", "", config, at, key, as_json)


@app.command()
def mark(
    text: Annotated[str, typer.Argument(metavar="TEXT", help="What to write beside the log.")],
    config: Config = None,
    at: At = None,
    key: KeyFile = None,
    as_json: Json = False,
) -> None:
    """Write a text beside the log, at this instant.

    Example: rtec ctl mark "new tool, first part"
    """
    _give("mark", text, config, at, key, as_json)


def _give(name: str, text: str, config: Path | None, at: str | None, key: Path | None, as_json: bool) -> None:
    from rtec.control.client import Client, carry_out, find
    from rtec.loop.clock import RealClock
    from rtec.loop.orders import order_named

    order: Order = order_named(name)
    with Client(find(config, at, key)) as client:
        outcome = carry_out(client, order, text, RealClock())
    if as_json:
        found = {"done": outcome.done, "text": outcome.text, "status": outcome.status}
        typer.echo(json.dumps(found, indent=2, ensure_ascii=False))
    else:
        typer.echo(outcome.text)
    if not outcome.done:
        raise typer.Exit(1)

"""`rtec init`: the first files of a machine."""

from pathlib import Path
from typing import Annotated

import typer


def init(
    folder: Annotated[Path, typer.Argument(metavar="[FOLDER]", help="Where the files go.")] = Path(),
    example: Annotated[
        bool, typer.Option("--example", help="Copy the shipped example: simulated machine, model, tutorial.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace files that are there already.")] = False,
) -> None:
    """Writes the first files of a machine.

    Example, a simulated turning centre to try everything with, in the folder configs: `rtec init --example`
    """
    from rtec.commission.example import FOLDER, write_example
    from rtec.errors import ConfigError
    from rtec.wording import counted

    if not example:
        raise ConfigError("rtec init: say --example")
    files = write_example(folder, overwrite=force)
    at = folder / FOLDER
    typer.echo(f"{counted(len(files), 'file')} in {at}: a simulated turning centre, its model, the tutorial's data.")
    go_there = f"cd {folder} && " if folder != Path() else ""
    for command in ("rtec run configs/turning-centre-sim.toml --duration 10", "rtec demo"):
        typer.echo(f"Next: {go_there}{command}")

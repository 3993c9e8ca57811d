"""`rtec machine`: a machine file as rtec reads it."""

from pathlib import Path
from typing import Annotated

import typer

from rtec.cli.common import Json, print_json
from rtec.cli.help import App

app = App(help="Shows and checks a machine file, and gives its hash.")

MachinePath = Annotated[Path, typer.Argument(metavar="FILE", help="Machine file.", show_default=False)]


@app.command("hash")
def machine_hash(file: MachinePath) -> None:
    """Prints the machine's hash, as `[model] machine_hash` holds it.

    It covers everything that the file says, not how it is written.

    Example: `rtec machine hash configs/machines/turning-centre.toml`
    """
    from rtec.machine import load_machine

    typer.echo(load_machine(file).hash)


@app.command()
def check(
    file: MachinePath,
    models: Annotated[
        list[Path] | None, typer.Argument(metavar="[MODEL]...", help="Models, run by this machine.", show_default=False)
    ] = None,
) -> None:
    """Checks a machine file, and models against it. Exit status 2 and all faults if something is wrong.

    Example: `rtec machine check configs/machines/turning-centre.toml configs/models/turning-centre.toml`
    """
    from rtec.machine import load_machine
    from rtec.model import load_model
    from rtec.wording import counted

    machine = load_machine(file)
    typer.echo(
        f"{file}: good: machine {machine.name!r}, {counted(len(machine.axes), 'axis', 'axes')}, "
        f"{counted(len(machine.sensors), 'sensor')}"
    )
    for path in models or []:
        model = load_model(path, machine)
        typer.echo(f"{path}: good: model {model.name!r} of this machine, {counted(len(model.effects), 'effect')}")


@app.command()
def show(file: MachinePath, as_json: Json = False) -> None:
    """Shows axes, chain, sensors, component errors and channels of a machine file.

    Example: `rtec machine show configs/machines/vertical-mill.toml`
    """
    from rtec.cli.common import show_page
    from rtec.machine import load_machine
    from rtec.report.overview import machine_page

    machine = load_machine(file)
    if as_json:
        names = {"components": machine.components, "channels": machine.channel_names}
        print_json({**machine.content(), "machine_hash": machine.hash, **names})
        return
    show_page(machine_page(machine))

"""`rtec effects`, `drivers`, `explain`: what may be written into the files; `rtec machine`: a machine file as read."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from rtec.cli.common import Json, completes, print_json
from rtec.cli.help import App


def _effects() -> list[str]:
    from rtec.effects import all_effects

    return list(all_effects())


def _drivers() -> list[str]:
    from rtec.loop.driver_info import installed

    return list(installed())


def effects(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="[NAME]", help="One effect, in full.", show_default=False, autocompletion=completes(_effects)
        ),
    ] = None,
    figure: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Write the figure of its shape here.", show_default=False)
    ] = None,
    as_json: Json = False,
) -> None:
    """Lists the effects that a model can hold; with a NAME, its equation, usual size, shape and what shows it.

    With a NAME it also lists what the effect may be confounded with, and the experiment that separates the two.

    Example: `rtec effects lost_motion --figure lost-motion.png`
    """
    from rtec.cli.common import show_page
    from rtec.errors import ConfigError
    from rtec.report import effects as pages
    from rtec.report.effects_figures import sketch_of, write_figure

    if figure is not None and name is None:
        raise ConfigError("rtec effects: --figure draws one effect; name it: rtec effects lost_motion --figure out.png")
    facts = pages.all_facts(name)
    if figure is not None and name is not None:
        write_figure(name, figure)
    if as_json:
        print_json(facts)
        return
    show_page(pages.effect_page(name) if name is not None else pages.catalogue_page())
    if name is not None:
        typer.echo("\n".join(sketch_of(name)))
    if figure is not None:
        typer.echo(f"Figure: {figure}")


def drivers(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="[NAME]", help="One driver, in full.", show_default=False, autocompletion=completes(_drivers)
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Lists the installed drivers and what each can do; with a NAME, its options and an example to copy.

    Drivers of other packages are listed too, and drivers that lack a package, with what to install.

    Example: `rtec drivers serial_box`
    """
    from rtec.cli.common import show_page
    from rtec.loop.driver_info import all_drivers, driver_facts
    from rtec.report.devices import driver_page, drivers_page

    found = all_drivers() if name is None else [driver_facts(name)]
    if as_json:
        plain = [driver.plain() for driver in found]
        print_json(plain if name is None else plain[0])
        return
    if name is None:
        show_page(drivers_page(found))
        return
    show_page(driver_page(found[0]))
    if found[0].example:
        typer.echo(f"An example:\n\n{found[0].example.rstrip()}")


MOST = 8


def explain(
    key: Annotated[
        str | None, typer.Argument(metavar="[KEY]", help="Key, table or kind of file.", show_default=False)
    ] = None,
    everything: Annotated[bool, typer.Option("--all", help="Print the whole reference, as Markdown.")] = False,
    as_json: Json = False,
) -> None:
    """Explains a key of any file: unit, limits, default, an example.

    Without a KEY it lists the tables of machine, run, model, measurement and map files, and of the drivers.

    Example: `rtec explain stop_um`

    Example, by its place in the file: `rtec explain axis.X.travel_mm`

    Example, all keys of a table: `rtec explain guard`

    Example, a driver's key: `rtec explain modbus.timeout_s`
    """
    from rtec.reference import all_keys, explained, matching, overview, reference, tables

    if as_json:
        print_json([asdict(k) | {"path": k.path} for k in (all_keys() if key is None else matching(key))])
    elif everything:
        typer.echo(reference(all_keys()), nl=False)
    elif key is None:
        typer.echo(overview(tables()))
    else:
        found = matching(key)
        typer.echo("\n\n".join(explained(k) for k in found[:MOST]))
        if len(found) > MOST:
            typer.echo(f"\n{len(found) - MOST} more: " + ", ".join(dict.fromkeys(k.path for k in found[MOST:])))


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
        list[Path] | None, typer.Argument(metavar="MODEL...", help="Models, run by this machine.", show_default=False)
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

"""`rtec effects`, `drivers`, `explain`: what may be written into the files, looked up."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from rtec.cli.common import Json, print_json


def effects(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="One effect, in full.", show_default=False)
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
        str | None, typer.Argument(metavar="[NAME]", help="One driver, in full.", show_default=False)
    ] = None,
    as_json: Json = False,
) -> None:
    """Lists the installed drivers and what each can do; with a NAME, its options and an example to copy.

    Drivers of other packages are listed too, and drivers that lack a package, with what to install.

    Example: `rtec drivers serial_box`
    """
    from rtec.cli.common import show_page
    from rtec.loop.driver_info import all_drivers, driver_facts
    from rtec.report.drivers import driver_page, drivers_page

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

"""`rtec drivers`: what the drivers are."""

import json
from typing import Annotated

import typer


def drivers(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="One driver, in full.", show_default=False)
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for programs.")] = False,
) -> None:
    """List the drivers that are installed and what each can do; with a name: its options, and an example to copy.

    Drivers of other packages are listed too, and those that lack something, with what to install.

    Example: rtec drivers serial_box
    """
    from rtec.cli.common import show_page
    from rtec.loop.driver_info import all_drivers, driver_facts
    from rtec.report.drivers import driver_page, drivers_page

    found = all_drivers() if name is None else [driver_facts(name)]
    if as_json:
        plain = [driver.plain() for driver in found]
        typer.echo(json.dumps(plain if name is None else plain[0], indent=2, ensure_ascii=False))
        return
    if name is None:
        show_page(drivers_page(found))
        return
    show_page(driver_page(found[0]))
    if found[0].example:
        typer.echo(f"An example:\n\n{found[0].example.rstrip()}")

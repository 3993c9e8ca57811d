"""`rtec drivers`: the installed drivers."""

from typing import Annotated

import typer

from rtec.cli.common import Json, print_json


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

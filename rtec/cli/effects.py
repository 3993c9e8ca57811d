"""`rtec effects`: the catalogue of effects."""

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

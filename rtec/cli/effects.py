"""`rtec effects`: what the effects are."""

import json
from pathlib import Path
from typing import Annotated

import typer


def effects(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="One effect, in full.", show_default=False)
    ] = None,
    figure: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Write the picture of its shape here.", show_default=False)
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for programs.")] = False,
) -> None:
    """Name the effects that a model can be made of; with a name: equation, usual size, shape, what shows it.

    With a name it also tells what looks like the effect, and the experiment that tells the two apart.

    Example: rtec effects lost_motion --figure lost-motion.png
    """
    from rtec.cli.common import show_page
    from rtec.errors import ConfigError
    from rtec.report import effects as told
    from rtec.report.effects_figures import sketch_of, write_figure

    if figure is not None and name is None:
        raise ConfigError("rtec effects: --figure draws one effect; name it: rtec effects lost_motion --figure out.png")
    facts = told.all_facts(name)
    if figure is not None and name is not None:
        write_figure(name, figure)
    if as_json:
        typer.echo(json.dumps(facts, indent=2, ensure_ascii=False))
        return
    show_page(told.effect_page(name) if name is not None else told.catalogue_page())
    if name is not None:
        typer.echo("\n".join(sketch_of(name)))
    if figure is not None:
        typer.echo(f"Figure: {figure}")

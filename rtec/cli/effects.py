"""`rtec effects`: what the effects are."""

import dataclasses
import json
from typing import Annotated

import typer


def effects(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="One effect, in full.", show_default=False)
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for programs.")] = False,
) -> None:
    """Name the effects that a model can be made of; with a name: equation, size, what shows it, what looks alike.

    Example: rtec effects axis_expansion
    """
    from rtec.effects import EFFECTS, effect_class

    wanted = {name: effect_class(name, "rtec effects")} if name else EFFECTS
    facts = {key: dataclasses.asdict(kind.about) for key, kind in wanted.items()}
    if as_json:
        typer.echo(json.dumps(facts, indent=2, ensure_ascii=False))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(show_header=not name)
    if name:
        for key, text in facts[name].items():
            table.add_row(key.replace("_", " "), text)
    else:
        for column in ("effect", "what", "equation"):
            table.add_column(column)
        for key, about in facts.items():
            table.add_row(key, about["title"], about["equation"])
    Console().print(table)

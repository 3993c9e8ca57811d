"""`rtec explain`: the meaning of a key of a file."""

from dataclasses import asdict
from typing import Annotated

import typer

from rtec.cli.common import Json, print_json

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

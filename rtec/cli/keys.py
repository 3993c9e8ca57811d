"""`rtec keys`: keys for control over the network, and the list of clients that are let in."""

import json
from pathlib import Path
from typing import Annotated, Literal

import typer

from rtec.cli.control import Json

app = typer.Typer(no_args_is_help=True, help="Keys for control over the network, and who is let in.")

_Folder = Annotated[Path, typer.Argument(metavar="FOLDER", help="Key folder of the daemon.", show_default=False)]
_Name = Annotated[str, typer.Argument(metavar="NAME", help="Of the client; stands in the events.", show_default=False)]


@app.command()
def server(folder: _Folder, as_json: Json = False) -> None:
    """Make the daemon's keys, and an empty list of clients. Name the folder in the run file: [control] keys.

    Example: rtec keys server keys
    """
    from rtec.control.keys import make_server

    public = make_server(folder)
    if as_json:
        typer.echo(json.dumps({"folder": str(folder), "public": public}))
        return
    typer.echo(f"{folder}: keys made; nobody is on the list yet: `rtec keys client {folder} NAME`")


@app.command()
def client(
    folder: _Folder,
    name: _Name,
    role: Annotated[
        Literal["read", "operate"], typer.Option("--role", help="read: status only; operate: orders, too.")
    ] = "read",
    key: Annotated[
        str | None, typer.Option("--key", help="Its public key, if it made its pair itself.", show_default=False)
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="The client's own file; else NAME.key.", show_default=False)
    ] = None,
    as_json: Json = False,
) -> None:
    """Put a client on the list; make its own file, which goes to its computer and nowhere else.

    A daemon that runs lets it in from now on.

    Example: rtec keys client keys office --role read
    """
    from rtec.control.keys import add_client

    made = add_client(folder, name, role, key, out or Path(f"{name}.key"))
    if as_json:
        typer.echo(json.dumps({"name": name, "role": role, "file": str(made) if made else None}))
        return
    typer.echo(f"{name} is on the list ({role})")
    if made is not None:
        typer.echo(f"{made}: take it to the client's computer, and remove it here; whoever has it is {name}")


@app.command("list")
def list_(folder: _Folder, as_json: Json = False) -> None:
    """Who is on the list, and what each may.

    Example: rtec keys list keys
    """
    from rtec.control.keys import CLIENTS, read_clients

    clients = read_clients(folder / CLIENTS)
    if as_json:
        typer.echo(json.dumps({name: c.model_dump() for name, c in clients.items()}, indent=2))
        return
    for name, found in clients.items():
        typer.echo(f"{name}: {found.role}, public key {found.key}")
    if not clients:
        typer.echo("nobody is on the list")


@app.command()
def remove(folder: _Folder, name: _Name, as_json: Json = False) -> None:
    """Take a client off the list; a daemon that runs refuses it from now on.

    Example: rtec keys remove keys office
    """
    from rtec.control.keys import remove_client

    remove_client(folder, name)
    if as_json:
        typer.echo(json.dumps({"name": name, "removed": True}))
        return
    typer.echo(f"{name} is off the list")

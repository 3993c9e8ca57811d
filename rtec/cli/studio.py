"""`rtec studio`: the pages in the browser."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from rtec.errors import RtecError

LOOPBACK = ("127.0.0.1", "::1", "localhost")
PORT = 8371
SHORTEST_TOKEN = 16


def studio(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of measurements and models.")] = Path(),
    host: Annotated[str, typer.Option(help="Address to listen at.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 takes a free one.")] = PORT,
    token: Annotated[
        str | None,
        typer.Option(help="Key of this start, 16 characters or more.", show_default="a new one"),
    ] = None,
    tls_cert: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Certificate for TLS (PEM).", show_default=False)
    ] = None,
    tls_key: Annotated[Path | None, typer.Option(metavar="FILE", help="Its key (PEM).", show_default=False)] = None,
    attach: Annotated[
        Path | None,
        typer.Option(metavar="CONFIG", help="Run file of a running daemon, to show it live.", show_default=False),
    ] = None,
    role: Annotated[
        Literal["read", "operate"], typer.Option(help="With --attach: read shows the status; operate controls, too.")
    ] = "read",
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the browser.")] = True,
) -> None:
    """Opens the pages in the browser: compare, diagnose, add an effect, and watch the error fall.

    Example: `rtec studio out/tutorial`

    `rtec studio --attach configs/turning-centre-sim.toml --role operate`

    Reads and writes files in FOLDER only, and listens on this computer only. Another address needs TLS or a key of
    your own. Needs `pip install rtec[studio]`.
    """
    _check_installed()
    from rtec.studio.server.address import Address, new_token, open_port

    if (tls_cert is None) != (tls_key is None):
        raise RtecError("--tls-cert and --tls-key belong together: give both")
    if host not in LOOPBACK and tls_cert is None and token is None:
        raise RtecError(
            f"--host {host}: others on the network could read along; give --tls-cert and --tls-key, or, where nobody "
            "listens in, a --token of your own. From another computer, ssh -L is simplest: see docs/studio.md"
        )
    for file in (tls_cert, tls_key):
        if file is not None and not file.is_file():
            raise RtecError(f"{file}: is no file")
    if token is not None and (len(token) < SHORTEST_TOKEN or not token.isascii() or not token.isprintable()):
        raise RtecError(f"--token: needs at least {SHORTEST_TOKEN} printable ASCII characters")

    if not folder.is_dir():
        raise RtecError(f"{folder}: is no folder; make it first, or name another")
    if attach is not None and not attach.is_file():
        raise RtecError(f"{attach}: no such file; --attach takes the run file of a running daemon")
    opened = open_port(Address(host, port, token or new_token(), tls_cert, tls_key))
    typer.echo(f"rtec studio: {opened.url}")
    typer.echo("Ctrl-C ends it.", err=True)
    if browser:
        import webbrowser

        # The browser starts in parallel with the server and waits at the open port.
        webbrowser.open(opened.url)
    from rtec.studio.server.front import serve

    serve(folder, opened, attach, role)


def _check_installed() -> None:
    from importlib.util import find_spec

    if find_spec("nicegui") is None:
        raise RtecError("rtec studio needs NiceGUI: pip install 'rtec[studio]'; in a clone of the project: make studio")

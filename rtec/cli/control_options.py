"""What `rtec status` and `rtec ctl` have in common: how a daemon is named."""

from pathlib import Path
from typing import Annotated

import typer

Config = Annotated[
    Path | None,
    typer.Argument(metavar="[CONFIG]", help="Run file of the daemon; without it, the only one.", show_default=False),
]
At = Annotated[
    str | None, typer.Option("--at", metavar="HOST:PORT", help="A daemon on the network.", show_default=False)
]
KeyFile = Annotated[
    Path | None, typer.Option("--key", help="For the network: this client's own file.", show_default=False)
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for programs.")]

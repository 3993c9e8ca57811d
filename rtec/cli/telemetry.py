"""`rtec telemetry`: the status of a running daemon in the network of a shop."""

from pathlib import Path
from typing import Annotated

import typer


def telemetry(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="Run file with [telemetry]; that of the daemon.")],
) -> None:
    """Publishes the status of a running daemon: MQTT. It only reads, and the daemon may start later.

    Ctrl-C ends it.

    Example: `rtec telemetry configs/turning-centre-sim.toml`

    What it publishes, and to whom, is in `[telemetry]` of the run file; without it nothing is published. Each protocol
    is a process of its own, started again when it fails. The correction does not depend on any of them.
    """
    from rtec.loop.clock import RealClock
    from rtec.loop.run_file import load_setup
    from rtec.telemetry.processes import Processes, tasks

    wanted = tasks(load_setup(config.resolve(), needs_model=False, needs_devices=False))
    with Processes(wanted, RealClock()) as processes:
        processes.run()
    raise typer.Exit(130)

"""`rtec telemetry`: the status of a running daemon in the network of a shop."""

import platform
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rtec.loop.run_file import Setup


def telemetry(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="Run file with [telemetry]; that of the daemon.")],
    devices: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the device file of an MTConnect agent, and end.", show_default=False),
    ] = None,
) -> None:
    """Publishes the status of a running daemon: MQTT, MTConnect, OPC UA. It only reads, and the daemon may start later.

    Ctrl-C ends it.

    Example: `rtec telemetry configs/turning-centre-sim.toml`

    What it publishes, and where, is in `[telemetry]` of the run file; without that nothing is published. Each protocol
    is a process of its own, restarted when it fails. The correction does not depend on any of them.
    """
    from rtec.loop.clock import RealClock
    from rtec.loop.run_file import load_setup
    from rtec.telemetry.processes import Processes, tasks

    setup = load_setup(config.resolve(), needs_model=False, needs_devices=False)
    if devices is not None:
        _write_devices(setup, devices)
        return
    wanted = tasks(setup)
    with Processes(wanted, RealClock()) as processes:
        processes.run()
    raise typer.Exit(130)


def _write_devices(setup: "Setup", out: Path) -> None:
    from rtec.errors import ConfigError
    from rtec.telemetry.mtconnect import device_file
    from rtec.wholefile import write_text

    machine = setup.machine
    identity = f"{platform.node()}{setup.path}"
    write_text(device_file(machine.name, machine.axis_names, machine.sensor_names, identity), out, ConfigError)
    typer.echo(f"device file: {out}")

"""`rtec status` shows the state of a running daemon, `rtec telemetry` publishes it, `rtec ctl` controls it."""

import platform
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import typer

from rtec.cli.common import Json, print_console, print_json
from rtec.cli.help import App
from rtec.control.facts import AXIS_COLUMNS, axis_rows, footer, headline, input_rows, troubles, well
from rtec.errors import ConfigError

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table

    from rtec.control.client import Client
    from rtec.loop.clock import Clock
    from rtec.loop.orders import Order
    from rtec.loop.run_file import Setup

Config = Annotated[
    Path | None,
    typer.Argument(metavar="[CONFIG]", help="Run file of the daemon.", show_default="the only one"),
]
At = Annotated[
    str | None,
    typer.Option("--at", metavar="USER@HOST", help="A daemon on another computer, by ssh.", show_default=False),
]
KeyFile = Annotated[
    Path | None, typer.Option("--key", help="For --at: the key file that ssh shows there.", show_default=False)
]
app = App(help="Controls a running daemon: enable, hold, fade, resume, home, reload, mark.")


@app.command()
def enable(config: Config = None, at: At = None, key: KeyFile = None, as_json: Json = False) -> None:
    """Enables the correction: it follows the model from its present value, within its limits.

    Exit status 1 if it does not, with the reason.

    Example: `rtec ctl enable`
    """
    _give("enable", "", config, at, key, as_json)


@app.command()
def hold(config: Config = None, at: At = None, key: KeyFile = None, as_json: Json = False) -> None:
    """Holds the correction at its present value.

    Example: `rtec ctl hold configs/turning-centre-sim.toml`
    """
    _give("hold", "", config, at, key, as_json)


@app.command()
def fade(config: Config = None, at: At = None, key: KeyFile = None, as_json: Json = False) -> None:
    """Fades the correction to zero at its slew limit.

    Example: `rtec ctl fade`
    """
    _give("fade", "", config, at, key, as_json)


@app.command()
def resume(config: Config = None, at: At = None, key: KeyFile = None, as_json: Json = False) -> None:
    """Resumes devices that stopped by themselves: a box that restarted, a position that was lost.

    Exit status 1 if a device is still in trouble.

    Example: `rtec ctl resume`
    """
    _give("resume", "", config, at, key, as_json)


@app.command()
def home(
    positions: Annotated[
        list[str],
        typer.Argument(metavar="AXIS=MM", help="Where the axes stand. The run file of the daemon may follow."),
    ],
    at: At = None,
    key: KeyFile = None,
    as_json: Json = False,
) -> None:
    """Tells where the axes stand, for incremental encoders: after the encoder box got its supply.

    Example: `rtec ctl home X=0 Z=120.5`

    Reference the axes with the controller, let them stand, and give the positions that it shows. The correction holds
    until then, if the run file has `[run] zero = "ordered"`. The positions hold for as long as the box has its supply.
    Exit status 1 if an axis moves or its counts cannot be read.
    """
    config = None if "=" in positions[-1] else Path(positions.pop())
    if not positions:
        raise ConfigError("rtec ctl home: name where the axes stand, such as X=0 Z=120.5, before the run file")
    _give("home", " ".join(positions), config, at, key, as_json)


@app.command()
def reload(
    config: Config = None,
    at: At = None,
    key: KeyFile = None,
    as_json: Json = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="Accept a model that reverses the correction or moves it by much.")
    ] = False,
) -> None:
    """Reloads run file and model; limits and model change without a jump.

    Example: `rtec ctl reload`

    Exit status 1 if the old ones stay, with the reason. A model that differs much from the running one (a reversed
    sign, a step of more than a fifth of warning_um) is taken with --yes only.
    """
    from rtec.loop.orders import YES

    _give("reload", YES if yes else "", config, at, key, as_json)


@app.command()
def mark(
    text: Annotated[str, typer.Argument(metavar="TEXT", help="What to write beside the log.")],
    config: Config = None,
    at: At = None,
    key: KeyFile = None,
    as_json: Json = False,
) -> None:
    """Writes a text beside the log, with this instant.

    Example: `rtec ctl mark "new tool, first part"`
    """
    if config is None and Path(text).is_file():
        raise ConfigError(f"rtec ctl mark: {text} is a file; write the text before it: rtec ctl mark TEXT {text}")
    _give("mark", text, config, at, key, as_json)


@app.command()
def relay(
    config: Config = None,
    role: Annotated[
        Literal["read", "operate"], typer.Option(help="read shows the status; operate controls, too.")
    ] = "read",
    name: Annotated[str, typer.Option(help="Name of the client in the events.")] = "ssh",
) -> None:
    """Connects standard input and output to a daemon: what sshd runs for a client on the network.

    Example, a line of authorized_keys: `restrict,command="rtec ctl relay /etc/rtec/mill.toml --name office" ssh-…`
    """
    from rtec.control.client import find, relay

    path = find(config, None, None).path
    if path is not None:
        relay(path, name, role)


def _give(name: str, text: str, config: Path | None, at: str | None, key: Path | None, as_json: bool) -> None:
    from rtec.control.client import Client, carry_out, find
    from rtec.loop.clock import RealClock
    from rtec.loop.orders import order_named

    order: Order = order_named(name)
    with Client(find(config, at, key)) as client:
        outcome = carry_out(client, order, text, RealClock())
    if as_json:
        found = {"done": outcome.done, "text": outcome.text, "status": outcome.status}
        print_json(found)
    else:
        typer.echo(outcome.text)
    if not outcome.done:
        raise typer.Exit(1)


PERIOD_NS: Final = 250_000_000
PAGE_NS: Final = 1_000_000_000


def show(found: dict[str, Any]) -> None:
    """Print a status."""
    print_console().print(page(found))


def watched(client: "Client", clock: "Clock", as_json: bool) -> None:
    """Show the status repeatedly: in place on a terminal, else page below page; with `as_json` a line each time."""
    from rich.live import Live

    from rtec.cli.screen import Console

    console = Console(highlight=False)
    while as_json or not console.is_terminal:
        if as_json:
            print_json(client.status(), on_one_line=True)
        else:
            show(client.status())
        clock.sleep_until_ns(clock.now_ns() + (PERIOD_NS if as_json else PAGE_NS))
    with Live(page(client.status()), console=console, auto_refresh=False) as live:
        while True:
            clock.sleep_until_ns(clock.now_ns() + PERIOD_NS)
            live.update(page(client.status()), refresh=True)


def page(found: dict[str, Any]) -> "RenderableType":
    """The whole status as one renderable."""
    from rich.console import Group
    from rich.text import Text

    axes = _table(AXIS_COLUMNS, axis_rows(found))
    inputs = _table(("input", "value", "age"), input_rows(found) if found["status"]["cycles"] else [])
    return Group(
        *(Text(line) for line in headline(found)),
        *(Text(line, style="bold red") for line in troubles(found)),
        *(Text(f"why: {reason}", style="yellow") for reason in found["status"]["reasons"]),
        axes,
        inputs,
        *(Text(line) for line in footer(found)),
    )


def _table(head: tuple[str, ...], rows: list[list[str]]) -> "Table":
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for k, name in enumerate(head):
        table.add_column(Text(name), justify="right" if k else "left")
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    return table


def status(
    config: Config = None,
    watch: Annotated[bool, typer.Option("--watch", "-w", help="Keep showing, until Ctrl-C.")] = False,
    as_json: Json = False,
    at: At = None,
    key: KeyFile = None,
) -> None:
    """Shows the state of a running daemon: corrections, inputs and their ages, faults, missed deadlines.

    Exit status 1 if a device or input is in trouble, the correction holds without an order, rows reach no log, or the
    loop stands.

    Example: `rtec status configs/turning-centre-sim.toml --watch`
    """
    from rtec.control.client import Client, find
    from rtec.loop.clock import RealClock

    with Client(find(config, at, key)) as client:
        if watch:
            watched(client, RealClock(), as_json)
            return
        found = client.status()
    if as_json:
        print_json(found)
    else:
        show(found)
    if not well(found):
        raise typer.Exit(1)


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
    from rtec.files import write_text
    from rtec.telemetry.mtconnect import device_file

    machine = setup.machine
    identity = f"{platform.node()}{setup.path}"
    write_text(device_file(machine.name, machine.axis_names, machine.sensor_names, identity), out, ConfigError)
    typer.echo(f"device file: {out}")

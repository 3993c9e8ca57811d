"""`rtec doctor`: are the devices well, and is this computer fit for real time?

The live table of `rtec doctor`: on standard error, if that is a terminal.
"""

import json
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Annotated, Self

import typer
from rich.live import Live

from rtec.cli.common import grid
from rtec.cli.screen import Console
from rtec.doctor.found import DeviceFound
from rtec.report.doctor import doctor_table

if TYPE_CHECKING:
    from rtec.doctor.found import Examination, PcFound


class Screen:
    """Shows what devices read while they are read; gone afterwards."""

    def __init__(self, quiet: bool) -> None:
        console = Console(stderr=True)
        self._on = console.is_terminal and not quiet
        self._live = Live(console=console, refresh_per_second=5, transient=True)

    def __enter__(self) -> Self:
        if self._on:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._on:
            self._live.stop()

    def update(self, devices: list[DeviceFound]) -> None:
        """Show them."""
        if self._on:
            self._live.update(grid(doctor_table(devices)))


def doctor(
    config: Annotated[
        Path | None,
        typer.Argument(metavar="[CONFIG]", help="Run file whose devices are looked at.", show_default=False),
    ] = None,
    seconds: Annotated[
        float, typer.Option("--seconds", "-s", min=0.1, max=3600, help="How long to read, and to measure wake-ups.")
    ] = 3.0,
    pc: Annotated[bool, typer.Option("--pc/--no-pc", help="Look at this computer too.")] = True,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for programs.")] = False,
) -> None:
    """Look at this computer, and with a run file at its devices: what each reads, what is wrong, how to mend it.

    All devices are opened at once. None is told to apply anything. Exit status 1 where something is wrong.

    Example: rtec doctor configs/turning-centre-sim.toml
    """
    from rtec.errors import ConfigError

    if config is None and not pc:
        raise ConfigError("rtec doctor: nothing to look at; name a run file, or leave --no-pc out")
    devices = _devices(config, seconds, as_json) if config is not None else None
    computer = _computer(config, seconds, as_json) if pc else None
    well = all(part.well for part in (devices, computer) if part is not None)
    if as_json:
        parts = {"devices": devices and devices.plain(), "pc": computer and computer.plain()}
        typer.echo(json.dumps({"well": well, **parts}, indent=2, ensure_ascii=False))
    if not well:
        raise typer.Exit(1)


def _devices(config: Path, seconds: float, quiet: bool) -> "Examination":
    from rtec.cli.common import show_page
    from rtec.doctor.devices import examine
    from rtec.report.doctor import doctor_page

    with Screen(quiet) as screen:
        found = examine(config, seconds, screen.update)
    if not quiet:
        show_page(doctor_page(found))
    return found


def _computer(config: Path | None, seconds: float, quiet: bool) -> "PcFound":
    from rtec.cli.common import bar, show_page
    from rtec.doctor.pc import look_at, wanted_of
    from rtec.report.doctor import pc_page

    with bar("measuring wake-ups") as tell:
        found = look_at(*wanted_of(config), seconds, tell)
    if not quiet:
        show_page(pc_page(found))
    return found

"""`rtec doctor`: the state of devices and computer, with a live table on standard error if that is a terminal."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self

import typer
from rich.live import Live

from rtec.cli.common import Json, grid, print_json
from rtec.cli.screen import Console

if TYPE_CHECKING:
    from rtec.doctor.found import DeviceFound, Examination, PcFound


class DoctorScreen:
    """A live table of the devices' values; it disappears at the end."""

    def __init__(self, quiet: bool) -> None:
        console = Console(stderr=True)
        self._on = console.is_terminal and not quiet
        self._live = Live(console=console, refresh_per_second=5, transient=True)

    def __enter__(self) -> Self:
        if self._on:
            self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._on:
            self._live.stop()

    def update(self, devices: "list[DeviceFound]") -> None:
        """Show the present values."""
        from rtec.report.devices import doctor_table

        if self._on:
            self._live.update(grid(doctor_table(devices)))


def doctor(
    config: Annotated[
        Path | None,
        typer.Argument(metavar="[CONFIG]", help="Run file whose devices are checked.", show_default=False),
    ] = None,
    seconds: Annotated[
        float, typer.Option("--seconds", "-s", min=0.1, max=3600, help="Seconds to read, and to measure wake-ups.")
    ] = 3.0,
    pc: Annotated[bool, typer.Option("--pc/--no-pc", help="Check this computer too.")] = True,
    as_json: Json = False,
) -> None:
    """Checks this computer and the devices of a run file: what each reads, what is wrong, how to mend it.

    All devices are opened at once; no correction is applied. Exit status 1 if something is wrong.

    Example: `rtec doctor configs/turning-centre-sim.toml`
    """
    from rtec.errors import ConfigError

    if config is None and not pc:
        raise ConfigError("rtec doctor: nothing to check; name a run file, or omit --no-pc")
    devices = _devices(config, seconds, as_json) if config is not None else None
    computer = _computer(config, seconds, as_json) if pc else None
    well = all(part.well for part in (devices, computer) if part is not None)
    if as_json:
        parts = {"devices": devices and devices.plain(), "pc": computer and computer.plain()}
        print_json({"well": well, **parts})
    if not well:
        raise typer.Exit(1)


def _devices(config: Path, seconds: float, quiet: bool) -> "Examination":
    from rtec.cli.common import show_page
    from rtec.doctor.devices import examine
    from rtec.report.devices import doctor_page

    with DoctorScreen(quiet) as screen:
        found = examine(config, seconds, screen.update)
    if not quiet:
        show_page(doctor_page(found))
    return found


def _computer(config: Path | None, seconds: float, quiet: bool) -> "PcFound":
    from rtec.cli.common import bar, show_page
    from rtec.doctor.pc import look_at, wanted_of
    from rtec.report.devices import pc_page

    with bar("measuring wake-ups") as tell:
        found = look_at(*wanted_of(config), seconds, tell)
    if not quiet:
        show_page(pc_page(found))
    return found

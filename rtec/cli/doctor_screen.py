"""The live table of `rtec doctor`: on standard error, if that is a terminal."""

from types import TracebackType
from typing import Self

from rich.console import Console
from rich.live import Live

from rtec.cli.show import grid
from rtec.doctor.found import DeviceFound
from rtec.report.doctor import doctor_table


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

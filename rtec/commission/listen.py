"""Live values before there are files: to see which axis moves, and which sensor warms up."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from rtec.errors import DriverError, RtecError
from rtec.loop.clock import Clock
from rtec.loop.devices import make_device
from rtec.loop.ports import CountSource, TemperatureSource
from rtec.loop.run_file import Roles
from rtec.machine import Machine

LOOK_NS: Final = 100_000_000
Shown = Callable[[Mapping[str, float], Mapping[str, float]], None]
"""Called with the newest values and their changes since the start, by name."""


class LiveSource(Protocol):
    """A source of live values."""

    def read(self) -> dict[str, float]:
        """Newest values by name."""
        ...


class LiveValues:
    """Positions and temperatures of open devices.

    Attributes:
        troubles: present faults by device.
    """

    def __init__(self, machine: Machine, devices: Mapping[str, Any], role: Roles) -> None:
        self.troubles: dict[str, str] = {}
        self._machine, self._devices, self._role = machine, devices, role
        self._counts = np.zeros(len(machine.axes), np.int64)
        self._counted = False
        self._degc = np.full(len(machine.sensors), np.nan)
        self._degc_ns = np.zeros(len(machine.sensors), np.int64)

    def read(self) -> dict[str, float]:
        """Newest values by axis (mm) and sensor (°C), as far as there are any."""
        self.troubles.clear()
        for name in dict.fromkeys([self._role.counts, *self._role.temperatures]):
            try:
                self._read(name)
            except DriverError as e:
                self.troubles[name] = str(e)
        axes = zip(self._machine.axes, self._counts.tolist(), strict=True)
        out = {a.name: n / a.counts_per_mm for a, n in axes} if self._counted else {}
        known = zip(self._machine.sensor_names, self._degc.tolist(), strict=True)
        return out | {name: degc for name, degc in known if np.isfinite(degc)}

    def _read(self, name: str) -> None:
        device = self._devices[name]
        if name == self._role.counts and isinstance(device, CountSource):
            device.read_counts(self._counts)
            self._counted = True
        if name in self._role.temperatures and isinstance(device, TemperatureSource):
            device.read_temperatures(self._degc, self._degc_ns)


@contextmanager
def live(
    machine: Machine, tables: Mapping[str, Mapping[str, Any]], role: Roles, clock: Clock, base: Path
) -> Iterator[LiveValues]:
    """Open only the devices that read: nothing is commanded.

    Raises:
        RtecError: a device's table is at fault, or the device cannot be opened.
    """
    devices: dict[str, Any] = {}
    try:
        for name in dict.fromkeys([role.counts, *role.temperatures]):
            device = make_device(name, tables[name], machine, clock, base / "run.toml")
            devices[name] = device.__enter__()
        yield LiveValues(machine, devices, role)
    finally:
        for device in devices.values():
            with suppress(RtecError):
                device.__exit__(None, None, None)


def watch(values: LiveSource, clock: Clock, seconds: float, shown: Shown) -> dict[str, float]:
    """Show values for a while; return the change of each from its first to its last value."""
    first: dict[str, float] = {}
    end_ns = clock.now_ns() + round(seconds * 1e9)
    while True:
        now = values.read()
        first = {**now, **first}
        change = {name: value - first[name] for name, value in now.items()}
        shown(now, change)
        if clock.now_ns() >= end_ns:
            return change
        clock.sleep_until_ns(clock.now_ns() + LOOK_NS)

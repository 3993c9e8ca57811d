"""Live values before there are files: what a serial port prints, which axis moves, which sensor warms up."""

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtec.errors import DriverError, RtecError
from rtec.loop.clock import Clock
from rtec.loop.devices import make_device
from rtec.loop.ports import CountSource, TemperatureSource
from rtec.loop.run_file import Roles
from rtec.machine import Machine
from rtec.text import clean

BAUDS: Final = (9600, 115200, 19200, 38400, 57600)
LISTEN_S: Final = 0.6
LOOK_NS: Final = 100_000_000
PRINTABLE: Final = 0.95
NUMBER: Final = re.compile(r"[+-]?\d+(?:[.,]\d+)?")
ANY_NUMBER: Final = r"[+-]?[\d.,]+"
Shown = Callable[[Mapping[str, float], Mapping[str, float]], None]
"""Is given the newest values and their changes since the start, mm and °C, by axis and sensor."""


@dataclass(frozen=True)
class Heard:
    """What a port prints.

    Attributes:
        baud: at this rate.
        lines: whole lines, newest last.
    """

    baud: int
    lines: tuple[str, ...]


def listen(port: str, clock: Clock, bauds: tuple[int, ...] = BAUDS) -> Heard | None:
    """Listen to a serial port at usual rates, sending nothing; None where nothing that is text comes.

    Raises:
        RtecError: it cannot be opened.
    """
    import serial

    for baud in bauds:
        try:
            with serial.Serial(port, baud, timeout=0, exclusive=True) as line:
                received = _received(line, clock)
        except (OSError, ValueError) as e:
            raise RtecError(f"{port}: cannot be listened to: {getattr(e, 'strerror', None) or e}") from e
        lines = [text for raw in received.splitlines()[1:-1] if (text := _text(raw))]
        if lines:
            return Heard(baud, tuple(lines[-3:]))
    return None


def _received(line: Any, clock: Clock) -> bytes:
    end_ns, received = clock.now_ns() + round(LISTEN_S * 1e9), b""
    while clock.now_ns() < end_ns:
        received += line.read(4096)
        clock.sleep_until_ns(clock.now_ns() + LOOK_NS // 4)
    return received


def _text(raw: bytes) -> str:
    text = raw.decode("latin-1").strip()
    good = sum(c.isascii() and c.isprintable() for c in text)
    return clean(text) if text and good >= PRINTABLE * len(text) else ""


def pattern_of(line: str, names: tuple[str, ...]) -> str | None:
    """A pattern for lines like this one, whose numbers are these names in order; None where it has fewer numbers.

    A number behind its own name (`X=12.5`) is that name's, wherever it is in the line.
    """
    glued = ((m, re.search(r"[A-Za-z_]+$", line[: m.start()])) for m in NUMBER.finditer(line))
    numbers = [m for m, word in glued if word is None or word[0] in names]  # the 1 of T1 is part of a word
    places = {name: _behind(name, line, numbers) for name in names}
    if None in places.values():
        if len(numbers) < len(names):
            return None
        places = dict(zip(names, numbers, strict=False))
    named = {match.start(): name for name, match in places.items() if match is not None}
    out, at = "", 0
    for match in numbers:
        name = named.get(match.start())
        group = f"(?P<{name}>{ANY_NUMBER})" if name else ANY_NUMBER
        out += _literal(line[at : match.start()]) + group
        at = match.end()
    return out + _literal(line[at:])


def _behind(name: str, line: str, numbers: list[re.Match[str]]) -> re.Match[str] | None:
    return next((m for m in numbers if re.search(rf"\b{re.escape(name)}\s*[=:]?\s*$", line[: m.start()])), None)


def _literal(text: str) -> str:
    """Fixed text, with blanks of any length."""
    return r"\s*".join(re.escape(part) for part in re.split(r"\s+", text))


class LiveValues:
    """Positions and temperatures of devices that are open.

    Attributes:
        troubles: what is wrong now, by device.
    """

    def __init__(self, machine: Machine, devices: Mapping[str, Any], role: Roles) -> None:
        self.troubles: dict[str, str] = {}
        self._machine, self._devices, self._role = machine, devices, role
        self._counts = np.zeros(len(machine.axes), np.int64)
        self._counted = False
        self._degc = np.full(len(machine.sensors), np.nan)
        self._degc_ns = np.zeros(len(machine.sensors), np.int64)

    def read(self) -> dict[str, float]:
        """Newest values by axis (mm) and sensor (°C), those that there are."""
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
    """Open the devices that read, and no other: nothing is commanded.

    Raises:
        RtecError: a device's table is wrong, or it cannot be opened.
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


def watch(values: LiveValues, clock: Clock, seconds: float, shown: Shown) -> dict[str, float]:
    """Show values for a while; give the change of each from its first to its last value."""
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

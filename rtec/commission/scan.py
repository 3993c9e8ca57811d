"""Which number on a port or bus belongs to which axis or sensor: by a driver's scan, and by changes on request.

Live values before there are files show which axis moves, and which sensor warms up.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from rtec.commission.answers import template_tables, with_answers
from rtec.errors import ConfigError, DriverError, RtecError
from rtec.loop.clock import Clock
from rtec.loop.devices import driver_class, make_device
from rtec.loop.ports import CountSource, Scanner, TemperatureSource
from rtec.loop.run_file import Roles
from rtec.machine import Machine
from rtec.wording import counted, significant

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


Tables = dict[str, Any]
Watched = Callable[[LiveSource], Mapping[str, float]]
"""Shows live values for a while; returns the change of each."""
UNITS_DEGC: Final = (1.0, 0.1, 0.01)
ROOM_DEGC: Final = (10.0, 45.0)
CLEARLY: Final = 3.0
"""A number counts as changed if it changes by this many times more than at rest."""
SMALL_SHARE: Final = {"axis": 0.01, "sensor": 0.005}
"""Changes that are ignored: below this share of the largest change of any number, or of a temperature's own value."""
ACTION: Final = {
    "axis": "Move axis {} by hand in its positive direction",
    "sensor": "Warm {} with your hand",
}


class Talk(Protocol):
    """Dialogue with the user."""

    def ask(self, question: str, default: str) -> str:
        """Ask, and return the answer; the default where that is empty."""
        ...

    def say(self, text: str) -> None:
        """Show a line."""
        ...

    def progress(self, title: str) -> AbstractContextManager[Callable[[int, int], None]]:
        """Show a bar; gives a function of the amount done and the total."""
        ...


def scanner_of(driver: str, table: Mapping[str, Any], clock: Clock, where: str) -> Scanner | None:
    """The scanner of a device's port or bus; None where its driver has none.

    Raises:
        RtecError: the driver does not exist, or refuses the table.
    """
    kind = driver_class(driver, where)
    scanner: Scanner | None = kind.scanner(table, clock) if hasattr(kind, "scanner") else None
    return scanner


def search(scanner: Scanner, talk: Talk, title: str) -> list[str]:
    """Scan with a progress bar; return the matches, in words. Ctrl-C ends the scan, and keeps its matches.

    Raises:
        DriverUnavailable: the port or bus is gone.
    """
    matches: list[str] = []
    try:
        with talk.progress(title) as show:
            for share, words in scanner.search():
                show(round(1000 * share), 1000)
                matches += [words] if words else []
    except KeyboardInterrupt:
        talk.say("The search was ended early; what it found is kept, and so are your answers.")
    for words in matches:
        talk.say(f"  {words}")
    return matches


def by_changes(scanner: Scanner, names: Sequence[str], kind: str, talk: Talk, watched: Watched) -> dict[str, str]:
    """Ask to move each axis, or to warm each sensor; return the place of each one that reacted.

    Args:
        scanner: scanner that has searched.
        names: axes or sensors.
        kind: "axis" or "sensor".
        talk: asks the user.
        watched: shows live values.
    """
    talk.say("Leave everything at rest for a moment: what changes all the same is no " + kind + ".")
    rest = watched(scanner)
    out: dict[str, str] = {}
    for name in names:
        if talk.ask(f"{ACTION[kind].format(name)} while the values are shown; ready (y), skip (n)", "y") != "y":
            continue
        change = {place: x for place, x in watched(scanner).items() if place not in out.values()}
        place = loudest(change, rest, scanner.read(), kind)
        if place is None:
            talk.say(f"nothing changed more than at rest; {name} has no number yet")
            continue
        talk.say(f"{place} changed by {significant(change[place], sign=True)}: that is {name}")
        if kind == "axis" and change[place] < 0:
            talk.say(counts_down(name))
        out[name] = place
    return out


def counts_down(axis: str) -> str:
    """Advice for an axis that counts in the wrong direction."""
    return f"{axis} counts down where the axis goes up: exchange A and B of its encoder, or its sign there"


def loudest(change: Mapping[str, float], rest: Mapping[str, float], now: Mapping[str, float], kind: str) -> str | None:
    """The place that changed most, relative to its changes at rest; None where none changed clearly."""
    largest = max((abs(x) for x in change.values()), default=0.0)
    small = {p: SMALL_SHARE[kind] * (largest if kind == "axis" else abs(now.get(p, 0.0)) or 1.0) for p in change}
    score = {p: abs(x) / (abs(rest.get(p, 0.0)) + small[p]) for p, x in change.items() if small[p] > 0.0}
    best = max(score, key=lambda p: score[p], default=None)
    return best if best is not None and score[best] > CLEARLY else None


def unit_of(numbers: Sequence[float]) -> float:
    """°C per unit of bare numbers: the unit in which all of them are room temperatures; 1 without such a unit."""
    low, high = ROOM_DEGC
    return next((u for u in UNITS_DEGC if numbers and all(low <= n * u <= high for n in numbers)), 1.0)


def fill_in(tables: Tables, talk: Talk, clock: Clock, source: str) -> Tables:
    """Scan for the devices with `scan = true`, and replace that key by the result.

    Args:
        tables: tables of an answers file.
        talk: called with each line on the scan's matches.
        clock: clock of the deadlines.
        source: path of the file, for messages.

    Raises:
        ConfigError: the matches do not show which number is which; the message lists them.
        DriverUnavailable: a port cannot be opened.
    """
    out = dict(tables)
    for device, table in (tables.get("device") or {}).items():
        if isinstance(table, Mapping) and table.get("scan") is not None:
            given = {key: value for key, value in table.items() if key != "scan"}
            scanned = _scan_result(tables, device, given, talk, clock, source) if table["scan"] else {}
            out["device"] = {**out["device"], device: with_answers(scanned, given)}
    return out


def _scan_result(tables: Tables, device: str, given: Tables, talk: Talk, clock: Clock, source: str) -> Tables:
    where = f"{source}: [device.{device}]"
    scanner = scanner_of(str(given.get("driver")), given, clock, where)
    if scanner is None:
        raise ConfigError(f"{where} scan: driver {given.get('driver')!r} cannot look for numbers; take the key out")
    axes, sensors = _names(tables, device)
    with scanner:
        talk.say(f"{device}: looking; this only reads, and takes {scanner.duration}")
        matches = search(scanner, talk, f"looking for {device}")
        now, places = scanner.read(), scanner.proposed([*axes, *sensors])
        if not places:
            there = "\n  ".join([*matches, *(f"{place}: {number:g}" for place, number in now.items())])
            raise ConfigError(
                f"{where} scan: what is there does not say which number is {', '.join([*axes, *sensors])}; "
                f"write it down yourself, or run rtec init without --answers, which asks:\n  {there}"
            )
        unit = unit_of([now[places[name]] for name in sensors])
    for name, place in places.items():
        number = now[place] * (unit if name in sensors else 1.0)
        talk.say(f"  {name}: {place}, now {significant(number, 4)}{' °C' if name in sensors else ''}")
    talk.say(f"  {counted(len(places), 'name')} in the order in which they are there: check them with rtec doctor.")
    return scanner.table(places, unit)


def _names(tables: Tables, device: str) -> tuple[list[str], list[str]]:
    """Axes and sensors that a device reads, by its roles."""
    whole = with_answers(template_tables(str(tables.get("template"))), tables)
    role = whole.get("role") or {}
    axes = list(whole["axis"]) if role.get("counts") == device else []
    return axes, list(whole.get("sensors") or ()) if device in (role.get("temperatures") or ()) else []

"""The questions of `rtec init`, in the order in which a machine is wired: axes, encoders, sensors, output, limits."""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Final

from rtec.commission.answers import TEMPLATES, template_tables
from rtec.commission.scan import ACTION, Talk, Watched, by_changes, counts_down, scanner_of, search, unit_of
from rtec.doctor.ports import can_interfaces, serial_ports
from rtec.errors import RtecError
from rtec.loop.clock import Clock
from rtec.loop.driver_info import DriverFacts, all_drivers
from rtec.loop.ports import Scanner
from rtec.tomlfile import nearest

Tables = dict[str, Any]
ANY_NUMBER: Final = r"[+-]?[\d.,]+"
TCP: Final = re.compile(r"(?P<host>[^/:\s]+):(?P<port>\d{1,5})")
OWN_BITRATE: Final = ("socketcan", "virtual", "udp_multicast")
"""Interfaces of python-can that take no bit rate."""


class Interview:
    """Asks what `Answers` needs, with the template's own values as defaults.

    Args:
        talk: asks the user.
        clock: clock of the scans.
        watched: shows live values for a while; returns the change of each.

    Attributes:
        sure: axes and sensors that were recognised by their changes.
    """

    def __init__(self, talk: Talk, clock: Clock, watched: Watched) -> None:
        self._talk, self._clock, self._watched = talk, clock, watched
        self.sure: set[str] = set()

    def tables(self) -> Tables:
        """Ask everything; the tables of an answers file, without `role` and `device` if there are no devices yet."""
        say = self._talk.say
        say("Which machine? " + "; ".join(f"{name}: {what}" for name, what in TEMPLATES.items()))
        template = self._one_of("template", list(TEMPLATES), "lathe")
        base = template_tables(template)
        out: Tables = {"template": template, "name": self._talk.ask("name of the machine", template)}
        say("\nAxes")
        out["axis"] = {name: self._axis(name, axis) for name, axis in base["axis"].items()}
        say("\nTemperature sensors, letters, digits and _, with blanks between; - for none")
        sensors = self._talk.ask("sensors", " ".join(base["sensors"]))
        out["sensors"] = [] if sensors == "-" else sensors.replace(",", " ").split()
        say("\nDevices: the encoders, the sensors and the control, as this PC reads and writes them")
        if self._talk.ask("name them now (y), or only measure with files for the time being (n)", "y") != "y":
            return out
        out["device"], out["role"] = {}, {}
        self._ports()
        axes = tuple(base["axis"])
        counts = self._device(out, "counts", "encoders", "Encoders: which driver reads the counts?", "serial_box", axes)
        if out["sensors"]:
            names = tuple(out["sensors"])
            question = "Sensors: which driver reads them?"
            device = self._device(out, "temperatures", "thermocouples", question, "modbus", names)
            out["role"]["temperatures"] = [device]
        out["role"]["counts"] = counts
        question = "Correction: which driver takes it?"
        out["role"]["actuator"] = self._device(out, "actuator", "offsets", question, "ascii_offset", axes)
        say("\nLimits of the correction")
        out["limits"] = {
            "stop_um": self._number("stop: more than this is never applied, µm", 50.0),
            "slew_um_s": self._number("slew: fastest change, µm/s", 20.0),
        }
        return out

    def _axis(self, name: str, axis: Mapping[str, Any]) -> Tables:
        low, high = axis["travel_mm"]
        out: Tables = {
            "travel_mm": [
                self._number(f"{name}: lowest position, mm", low),
                self._number(f"{name}: highest position, mm", high),
            ],
            "resolution_um": self._number(
                f"{name}: one count of its scale or encoder, after x4, µm", axis["resolution_um"]
            ),
        }
        pitch_mm = self._number(f"{name}: pitch of its screw, mm; 0 for none", axis.get("pitch_mm", 0.0))
        return out | ({"pitch_mm": pitch_mm} if pitch_mm else {})

    def _ports(self) -> None:
        """List the serial ports, and the text that they print."""
        there = serial_ports()
        self._talk.say("\nSerial ports here: " + ("; ".join(p.words() for p in there) or "none"))
        if not there or self._talk.ask("listen to them? Nothing is sent (y/n)", "y") != "y":
            return
        for port in there:
            self._search("ascii_lines", {"port": port.device})

    def _search(self, driver: str, table: Tables, names: Sequence[str] = (), kind: str = "") -> Tables:
        """Keys of a device's table that a driver's scan gives, if each of these names has a place."""
        way = {**table, **table.get("serial", {}), **table.get("tcp", {})}
        place = way.get("host") or way.get("port") or way.get("channel")
        try:
            scanner = scanner_of(driver, table, self._clock, "rtec init")
            if scanner is None:
                return {}
            with scanner:
                search(scanner, self._talk, f"looking at {place}")
                return self._placed(scanner, names, kind) if names and scanner.read() else {}
        except RtecError as e:
            self._talk.say(str(e))
            return {}

    def _placed(self, scanner: Scanner, names: Sequence[str], kind: str) -> Tables:
        talk, places = self._talk, {}
        if talk.ask(f"find out which is which: {ACTION[kind].format(names[0])}, and so on (y/n)", "y") == "y":
            places = by_changes(scanner, names, kind, talk, self._watched)
            self.sure |= set(places)
        proposed = scanner.proposed(names)
        for name in (n for n in names if n not in places):
            free = [place for place in proposed.values() if place not in places.values()]
            if not free:
                talk.say(f"no number was found for {name}")
                return {}
            places[name] = proposed[name] if proposed[name] in free else free[0]
            talk.say(f"{name}: {places[name]}, a guess")
        now = scanner.read()
        unit = 1.0
        if kind == "sensor":
            unit = self._number("one unit of these numbers, °C", unit_of([now[places[n]] for n in names]))
        return scanner.table({name: places[name] for name in names}, unit)

    def _scanned(self, driver: str, table: Tables, names: Sequence[str], kind: str) -> Tables:
        """As `_search`, if the user agrees."""
        try:
            scanner = scanner_of(driver, table, self._clock, "rtec init")
        except RtecError as e:
            self._talk.say(str(e))
            return {}
        if scanner is None:
            return {}
        self._talk.say("It can look what is there. That only reads; Ctrl-C ends it and keeps your answers.")
        self._talk.say(f"It takes {scanner.duration}.")
        question = "look (y/n)"
        return self._search(driver, table, names, kind) if self._talk.ask(question, "y") == "y" else {}

    def _device(self, out: Tables, role: str, name: str, question: str, default: str, names: tuple[str, ...]) -> str:
        """Ask for a device that serves a role; give its name. A device that exists already may serve it, too."""
        self._talk.say(f"\n{question}")
        drivers = {d.name: d for d in all_drivers() if role in d.roles and not d.trouble}
        there = [n for n, table in out["device"].items() if table["driver"] in drivers]
        for driver in drivers.values():
            self._talk.say(f"  {driver.name}: {driver.summary}")
        for known in there:
            self._talk.say(f"  {known}: the device from above")
        chosen = self._one_of("driver", [*drivers, *there], default)
        if chosen in there:
            return chosen
        out["device"][name] = {"driver": chosen, **self._options(drivers[chosen], out, names)}
        return name

    def _options(self, driver: DriverFacts, out: Tables, names: tuple[str, ...]) -> Tables:
        special: dict[str, Callable[[Tables, tuple[str, ...]], Tables]] = {
            "ascii_lines": self._lines,
            "ascii_offset": self._offset,
            "modbus": self._modbus,
            "serial_box": self._box,
            "can": self._can,
            "can_encoders": self._can_encoders,
        }
        if driver.name in special:
            return special[driver.name](out, names)
        self._talk.say(f"An example of its table, to be changed in the file:\n{driver.example}")
        options = [o for o in driver.options if o.required and "." not in o.name]
        return {o.name: self._value_of_kind(f"{o.name}: {o.meaning}", o.kind) for o in options}

    def _box(self, out: Tables, names: tuple[str, ...]) -> Tables:
        del out
        table = {"port": self._port()}
        scanned = self._scanned("serial_box", table, names, "axis")
        return {**table, **scanned, "max_speed_mm_s": self._speeds(names)}

    def _lines(self, out: Tables, names: tuple[str, ...]) -> Tables:
        table: Tables = {"port": self._port()}
        of_axes = set(names) <= set(out["axis"])
        scanned = self._scanned("ascii_lines", table, names, "axis" if of_axes else "sensor")
        table |= scanned or self._rate(9600)
        proposed = table.get("patterns", [r"\s+".join(rf"{n}\s*=\s*(?P<{n}>{ANY_NUMBER})" for n in names)])[0]
        self._talk.say("A regular expression of a whole line; each named group is an axis or a sensor.")
        table["patterns"] = [self._talk.ask("pattern", proposed)]
        if of_axes:
            unit = self._one_of("unit of the positions", ["mm", "um", "inch", "counts"], "mm")
            table |= {"units": dict.fromkeys(names, unit), "max_speed_mm_s": self._speeds(names)}
        return table

    def _modbus(self, out: Tables, names: tuple[str, ...]) -> Tables:
        del out
        way = self._way(19200, "even")
        scanned = self._scanned("modbus", way, names, "sensor")
        if scanned:
            return way | scanned
        slave = int(self._number("number of the module on the line", 1))
        first = int(self._number(f"address of {names[0]} on the line, from 0; the others follow", 0))
        scale = self._number("one unit of a register, °C", 0.1)
        function = self._one_of("registers are", ["input", "holding"], "input")
        register = {n: {"address": first + k, "scale": scale, "function": function} for k, n in enumerate(names)}
        return way | {"slave": {"module": {"id": slave, "register": register}}}

    def _can(self, out: Tables, names: tuple[str, ...]) -> Tables:
        del out
        way = self._can_way()
        scanned = self._scanned("can", way, names, "sensor")
        if scanned:
            return way | scanned
        node = int(self._number("CANopen number of the device", 1))
        scale = self._number("one unit of its numbers, °C", 0.1)
        self._talk.say("Four numbers of 16 bits in each of its process data, in order; change it in the file.")
        return way | {"temperature": {name: _pdo_item(node, k) | {"scale": scale} for k, name in enumerate(names)}}

    def _can_encoders(self, out: Tables, names: tuple[str, ...]) -> Tables:
        del out
        way = self._can_way()
        scanned = self._scanned("can_encoders", way, names, "axis")
        bits = int(self._number("bits of the encoders' counters; they wrap there", 32))
        if not scanned:
            nodes = {n: int(self._number(f"CANopen number of {n}'s encoder", k + 1)) for k, n in enumerate(names)}
            scanned = {"axis": {name: {"node": node, "map": ["u32"]} for name, node in nodes.items()}}
        speeds = self._speeds(names)
        axes = {name: {**table, "max_speed_mm_s": speeds[name]} for name, table in scanned["axis"].items()}
        return {**way, **scanned, "bits": bits, "axis": axes}

    def _can_way(self) -> Tables:
        there = can_interfaces()
        self._talk.say("CAN interfaces here: " + (", ".join(there) or "none of the kernel; slcan is a serial port"))
        interface = self._talk.ask("kind of interface, by python-can's name", "socketcan")
        channel = self._talk.ask("channel", there[0] if there else "can0")
        way: Tables = {"interface": interface, "channel": channel}
        return way if interface in OWN_BITRATE else way | {"bitrate": int(self._number("bit rate, bit/s", 500000))}

    def _offset(self, out: Tables, names: tuple[str, ...]) -> Tables:
        del out
        unit = self._one_of("unit of the offsets", ["mm", "um", "inch", "counts"], "mm")
        resolution_um = self._number("smallest step that the controller takes, µm", 1.0)
        digits = ":.4f" if unit == "mm" else ":.5f" if unit == "inch" else ":.1f" if unit == "um" else ":d"
        self._talk.say("The line that sets the offsets; {X" + digits + "} is the number of axis X.")
        line = self._talk.ask("line", "OFS " + " ".join(f"{n}={{{n}{digits}}}" for n in names))
        acknowledge = self._talk.ask("its acknowledgement, a regular expression; - for none", "OK")
        table = {**self._way(19200), "command": [line], "unit": unit, "resolution_um": resolution_um}
        return table | ({} if acknowledge == "-" else {"acknowledge": acknowledge})

    def _way(self, baud: int, parity: str = "none") -> Tables:
        """Ask for `serial` or `tcp`."""
        port = self._port("port, or HOST:PORT over TCP")
        if place := TCP.fullmatch(port):
            return {"tcp": {"host": place["host"], "port": int(place["port"])}}
        return {"serial": {"port": port, **self._rate(baud, parity)}}

    def _rate(self, baud: int, parity: str = "none") -> Tables:
        rate = int(self._number("baud", baud))
        return {"baud": rate, "parity": self._one_of("parity", ["none", "even", "odd"], parity)}

    def _port(self, question: str = "port") -> str:
        there = [p.device for p in serial_ports()]
        return self._talk.ask(question, there[0] if there else "/dev/ttyUSB0")

    def _speeds(self, names: Sequence[str]) -> Tables:
        speed = self._number("fastest speed of the axes, mm/s; faster readings are errors", 400.0)
        return dict.fromkeys(names, speed)

    def _value_of_kind(self, question: str, kind: str) -> Any:
        if kind.startswith(("number", "whole")):
            number = self._number(question, 0.0)
            return int(number) if kind.startswith("whole") else number
        return self._talk.ask(question, "")

    def _one_of(self, question: str, allowed: Sequence[str], default: str) -> str:
        default = default if default in allowed else allowed[0]
        while True:
            given = self._talk.ask(f"{question} ({', '.join(allowed)})", default)
            if given in allowed:
                return given
            self._talk.say(f"{given!r} is none of them{nearest(given, allowed)}")

    def _number(self, question: str, default: float) -> float:
        while True:
            given = self._talk.ask(question, f"{default:g}")
            try:
                return float(given.replace(",", "."))
            except ValueError:
                self._talk.say(f"{given!r} is no number")


def _pdo_item(node: int, k: int) -> Tables:
    """The k-th number of 16 bits in the process data of a CANopen device."""
    return {"node": node, "pdo": k // 4 + 1, "map": ["i16"] * 4, "item": k % 4 + 1}


def swapped(value: Any, a: str, b: str) -> Any:
    """A device's table with two names exchanged, as keys and as named groups of patterns."""
    names = {a: b, b: a}
    if isinstance(value, Mapping):
        return {names.get(k, k): swapped(v, a, b) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [swapped(v, a, b) for v in value]
    if isinstance(value, str) and f"(?P<{a}>" in value and f"(?P<{b}>" in value:
        return value.replace(f"(?P<{a}>", "(?P<>").replace(f"(?P<{b}>", f"(?P<{a}>").replace("(?P<>", f"(?P<{b}>")
    return value


def check_names(
    talk: Talk, tables: Tables, watched: Callable[[], Mapping[str, float]], recognised: Collection[str] = ()
) -> Tables:
    """Ask to move each axis and to warm each sensor; exchange the names of those that react in another's place.

    Args:
        talk: asks the user.
        tables: tables of the answers so far.
        watched: shows live values for a while; returns the change of each.
        recognised: names that need no check.

    Returns:
        the tables with the names exchanged.
    """
    for role, kind, names, unit in (
        ("counts", "axis", list(tables["axis"]), "mm"),
        ("temperatures", "sensor", list(tables["sensors"]), "°C"),
    ):
        for name in (n for n in names if n not in recognised):
            if talk.ask(f"{ACTION[kind].format(name)} while the values are shown; ready (y), skip (n)", "y") != "y":
                continue
            change = {n: x for n, x in watched().items() if n in names}
            if not change or max(map(abs, change.values())) == 0.0:
                talk.say(f"nothing changed; {name} stays as it is")
                continue
            most = max(change, key=lambda n: abs(change[n]))
            talk.say(f"{most} changed by {change[most]:+.3f} {unit}")
            if change[most] < 0 and role == "counts":
                talk.say(counts_down(most))
            if most != name and talk.ask(f"is that {name}? exchange {most} and {name} (y/n)", "y") == "y":
                device = tables["role"][role] if role == "counts" else tables["role"][role][0]
                tables["device"][device] = swapped(tables["device"][device], most, name)
    return tables

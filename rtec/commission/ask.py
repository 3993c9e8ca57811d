"""The questions of `rtec init`, in the order in which a machine is wired: axes, encoders, sensors, output, limits."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from rtec.commission.answers import TEMPLATES, template_tables
from rtec.commission.listen import ANY_NUMBER, listen, pattern_of
from rtec.doctor.ports import serial_ports
from rtec.errors import RtecError
from rtec.loop.clock import Clock
from rtec.loop.driver_info import DriverFacts, all_drivers
from rtec.tomlfile import nearest

Tables = dict[str, Any]


class Talk(Protocol):
    """Whom it asks."""

    def ask(self, question: str, default: str) -> str:
        """Give the answer; the default where that is empty."""
        ...

    def say(self, text: str) -> None:
        """Tell something."""
        ...


class Interview:
    """Asks what `Answers` needs, with the template's own values as defaults.

    Args:
        talk: whom it asks.
        clock: for listening to ports.
    """

    def __init__(self, talk: Talk, clock: Clock) -> None:
        self._talk, self._clock = talk, clock

    def tables(self) -> Tables:
        """Ask everything; the tables of an answers file."""
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
        """List the serial ports, and what they print."""
        there = serial_ports()
        self._talk.say("\nSerial ports here: " + ("; ".join(p.words() for p in there) or "none"))
        if not there or self._talk.ask("listen to them? Nothing is sent (y/n)", "y") != "y":
            return
        for port in there:
            self._heard(port.device)

    def _heard(self, port: str) -> tuple[int, str] | None:
        try:
            heard = listen(port, self._clock)
        except RtecError as e:
            self._talk.say(str(e))
            return None
        if heard is None:
            self._talk.say(f"{port}: silent; encoder boxes and Modbus modules speak only when they are asked")
            return None
        self._talk.say(f"{port}: prints lines at {heard.baud} baud: {heard.lines[-1]}")
        return heard.baud, heard.lines[-1]

    def _device(self, out: Tables, role: str, name: str, question: str, default: str, names: tuple[str, ...]) -> str:
        """Ask for a device that plays a role; its name. One that is there already may play it, too."""
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
        }
        if driver.name in special:
            return special[driver.name](out, names)
        self._talk.say(f"An example of its table, to be changed in the file:\n{driver.example}")
        options = [o for o in driver.options if o.required and "." not in o.name]
        return {o.name: self._typed(f"{o.name}: {o.meaning}", o.kind) for o in options}

    def _box(self, out: Tables, names: tuple[str, ...]) -> Tables:
        del out
        return {"port": self._port(), "max_speed_mm_s": self._speeds(names)}

    def _lines(self, out: Tables, names: tuple[str, ...]) -> Tables:
        table = self._line(9600)
        heard = self._heard(table["port"])
        table["baud"] = heard[0] if heard else table["baud"]
        proposed = pattern_of(heard[1], names) if heard else None
        if proposed is None:
            proposed = r"\s+".join(rf"{n}\s*=\s*(?P<{n}>{ANY_NUMBER})" for n in names)
        self._talk.say("A regular expression of a whole line; each named group is an axis or a sensor.")
        table["patterns"] = [self._talk.ask("pattern", proposed)]
        if set(names) <= set(out["axis"]):
            unit = self._one_of("unit of the positions", ["mm", "um", "inch", "counts"], "mm")
            table |= {"units": dict.fromkeys(names, unit), "max_speed_mm_s": self._speeds(names)}
        return table

    def _modbus(self, out: Tables, names: tuple[str, ...]) -> Tables:
        del out
        serial = self._line(19200, "even")
        slave = int(self._number("number of the module on the line", 1))
        first = int(self._number(f"address of {names[0]} on the line, from 0; the others follow", 0))
        scale = self._number("one unit of a register, °C", 0.1)
        register = {n: {"address": first + k, "scale": scale, "function": "input"} for k, n in enumerate(names)}
        function = self._one_of("registers are", ["input", "holding"], "input")
        register = {n: {**r, "function": function} for n, r in register.items()}
        return {"serial": serial, "slave": {"module": {"id": slave, "register": register}}}

    def _offset(self, out: Tables, names: tuple[str, ...]) -> Tables:
        del out
        unit = self._one_of("unit of the offsets", ["mm", "um", "inch", "counts"], "mm")
        resolution_um = self._number("smallest step that the controller takes, µm", 1.0)
        digits = ":.4f" if unit == "mm" else ":.5f" if unit == "inch" else ":.1f" if unit == "um" else ":d"
        self._talk.say("The line that sets the offsets; {X" + digits + "} is the number of axis X.")
        line = self._talk.ask("line", "OFS " + " ".join(f"{n}={{{n}{digits}}}" for n in names))
        acknowledge = self._talk.ask("its acknowledgement, a regular expression; - for none", "OK")
        table = {"serial": self._line(19200), "command": [line], "unit": unit, "resolution_um": resolution_um}
        return table | ({} if acknowledge == "-" else {"acknowledge": acknowledge})

    def _line(self, baud: int, parity: str = "none") -> Tables:
        port = self._port()
        rate = int(self._number("baud", baud))
        return {"port": port, "baud": rate, "parity": self._one_of("parity", ["none", "even", "odd"], parity)}

    def _port(self) -> str:
        there = [p.device for p in serial_ports()]
        return self._talk.ask("port", there[0] if there else "/dev/ttyUSB0")

    def _speeds(self, names: Sequence[str]) -> Tables:
        speed = self._number("fastest speed of the axes, mm/s; faster readings are errors", 400.0)
        return dict.fromkeys(names, speed)

    def _typed(self, question: str, kind: str) -> Any:
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


def swapped(value: Any, a: str, b: str) -> Any:
    """A device's table with two names exchanged, where they are keys and named groups of patterns."""
    names = {a: b, b: a}
    if isinstance(value, Mapping):
        return {names.get(k, k): swapped(v, a, b) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [swapped(v, a, b) for v in value]
    if isinstance(value, str) and f"(?P<{a}>" in value and f"(?P<{b}>" in value:
        return value.replace(f"(?P<{a}>", "(?P<>").replace(f"(?P<{b}>", f"(?P<{a}>").replace("(?P<>", f"(?P<{b}>")
    return value


def check_names(talk: Talk, tables: Tables, watched: Callable[[str], Mapping[str, float]]) -> Tables:
    """Have each axis moved and each sensor warmed; exchange the names of those that answer in the place of others.

    Args:
        talk: whom it asks.
        tables: of the answers so far.
        watched: shows live values for a while; gives the change of each.

    Returns:
        the tables with the names exchanged.
    """
    for role, names, unit, action in (
        ("counts", list(tables["axis"]), "mm", "Move axis {} by hand in its positive direction"),
        ("temperatures", list(tables["sensors"]), "°C", "Warm {} with your hand"),
    ):
        todo = list(names)
        while todo:
            name = todo.pop(0)
            if talk.ask(f"{action.format(name)} while the values are shown; ready (y), skip (n)", "y") != "y":
                continue
            change = {n: x for n, x in watched(name).items() if n in names}
            if not change or max(map(abs, change.values())) == 0.0:
                talk.say(f"nothing changed; {name} stays as it is")
                continue
            most = max(change, key=lambda n: abs(change[n]))
            talk.say(f"{most} changed by {change[most]:+.3f} {unit}")
            if change[most] < 0 and role == "counts":
                talk.say(
                    f"{most} counts down where the axis goes up: exchange A and B of its encoder, or its sign there"
                )
            if most != name and talk.ask(f"is that {name}? exchange {most} and {name} (y/n)", "y") == "y":
                device = tables["role"][role] if role == "counts" else tables["role"][role][0]
                tables["device"][device] = swapped(tables["device"][device], most, name)
    return tables

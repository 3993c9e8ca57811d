"""Readouts and thermocouple boards that print lines of text on a serial port: counts, temperatures, spindle speed.

A scan finds the rate of a port, the lines that it prints unasked, and the numbers that change. It sends nothing.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Self

from rtec.arrays import Floats, Ints
from rtec.errors import DriverError, DriverFault, DriverTimeout, DriverUnavailable
from rtec.loop.clock import Clock
from rtec.loop.ports import Scanner
from rtec.machine import Machine
from rtec.text import clean
from rtec.tomlfile import validated
from rtec_drivers.ascii.text import SPINDLE, AsciiOptions, LineParser, LineReader
from rtec_drivers.count_tracker import CountTracker, max_counts_per_s
from rtec_drivers.reopen import Reopener
from rtec_drivers.serial_line import PortFinder, PortOptions, Ports, SerialLine
from rtec_drivers.temperatures import StuckWatch

BAUDS: Final = (9600, 115200, 19200, 38400, 57600)
LISTEN_NS: Final = 600_000_000
LOOK_NS: Final = 25_000_000
PRINTABLE: Final = 0.95
KEPT: Final = 4096
NUMBER: Final = re.compile(r"[+-]?\d+(?:[.,]\d+)?")
ANY_NUMBER: Final = r"[+-]?[\d.,]+"
AXES: Final = "XYZABCUVW"
UNITS: Final = {0.1: "0.1degc", 0.01: "0.01degc"}
PLACE: Final = "number {} of the line"


class AsciiScanner:
    """Listens at a serial port at usual rates.

    Args:
        options: the port; its rate is ignored.
        clock: clock of the durations.

    Attributes:
        duration: duration of the search, in words.
        baud: the rate at which text came; 0 where none came.
        line: the newest whole line.
    """

    def __init__(self, options: PortOptions, clock: Clock) -> None:
        self.duration = f"up to {len(BAUDS) * LISTEN_NS * 1e-9:g} s"
        self.baud, self.line = 0, ""
        self._options, self._clock = options, clock
        self._device = ""
        self._port: SerialLine | None = None
        self._received = b""

    def __enter__(self) -> Self:
        """Open the port.

        Raises:
            DriverUnavailable: it cannot be opened.
        """
        self._device = PortFinder(self._options).find()
        self._open(BAUDS[0])
        return self

    def __exit__(self, *error: object) -> None:
        """Close the port."""
        if self._port is not None:
            self._port.close()
            self._port = None

    def search(self) -> Iterator[tuple[float, str]]:
        """Try one rate after the other, until lines of text arrive."""
        for k, baud in enumerate(BAUDS):
            yield k / len(BAUDS), ""
            if k:
                self._open(baud)
            end_ns = self._clock.now_ns() + LISTEN_NS
            while self._clock.now_ns() < end_ns:
                self._take()
                self._clock.sleep_until_ns(self._clock.now_ns() + LOOK_NS)
                yield (k + 0.5) / len(BAUDS), ""
            if self.line:
                self.baud = baud
                yield 1.0, f"prints lines at {baud} baud: {self.line}"
                return
        yield 1.0, "prints nothing by itself; encoder boxes and Modbus modules speak only when they are asked"

    def read(self) -> dict[str, float]:
        """Numbers of the newest line, by their place in it."""
        self._take()
        return {PLACE.format(k + 1): float(m[0].replace(",", ".")) for k, m in enumerate(numbers_of(self.line))}

    def proposed(self, names: Sequence[str]) -> dict[str, str]:
        """The number behind the own name (`X=12.5`), wherever it is; else by order."""
        return {name: PLACE.format(k + 1) for name, k in places_of(self.line, tuple(names)).items()}

    def table(self, places: Mapping[str, str], unit: float) -> dict[str, Any]:
        """Rate, pattern, unit, decimal sign and line end."""
        at = {name: int(place.split()[1]) - 1 for name, place in places.items()}
        numbers = [m[0] for m in numbers_of(self.line)]
        comma = {"decimal": ","} if any("," in n for n in numbers) and not any("." in n for n in numbers) else {}
        end = {} if b"\n" in self._received else {"line_end": "cr"}
        units = {"units": dict.fromkeys(places, UNITS[unit])} if unit in UNITS else {}
        return {"baud": self.baud, "patterns": [pattern(self.line, at)], **units, **comma, **end}

    def _open(self, baud: int) -> None:
        if self._port is not None:
            self._port.close()
        self._received = b""
        self._port = SerialLine(self._options.model_copy(update={"baud": baud}), self._device)

    def _take(self) -> None:
        if self._port is None:
            return
        self._received = (self._received + self._port.read())[-KEPT:]
        lines = [text for raw in re.split(rb"[\r\n]+", self._received)[1:-1] if (text := _text(raw))]
        self.line = lines[-1] if lines else self.line


def numbers_of(line: str) -> list[re.Match[str]]:
    """The numbers of a line; not those within a word, as the 1 of T1, except behind an axis' letter."""
    words = ((m, re.search(r"[A-Za-z_]+$", line[: m.start()])) for m in NUMBER.finditer(line))
    return [m for m, word in words if word is None or word[0] in AXES]


def places_of(line: str, names: Sequence[str]) -> dict[str, int]:
    """Index, from 0, of each name's number; empty where the line has too few."""
    numbers = numbers_of(line)
    behind = {
        name: next((k for k, m in enumerate(numbers) if re.search(rf"\b{name}\s*[=:]?\s*$", line[: m.start()])), None)
        for name in map(re.escape, names)
    }
    if None not in behind.values():
        return {name: k for name, k in zip(names, behind.values(), strict=True) if k is not None}
    return {name: k for k, name in enumerate(names)} if len(numbers) >= len(names) else {}


def pattern(line: str, places: Mapping[str, int]) -> str:
    """A regular expression for lines like this one; each named number is a group of that name."""
    named = {k: name for name, k in places.items()}
    out, at = "", 0
    for k, match in enumerate(numbers_of(line)):
        group = f"(?P<{named[k]}>{ANY_NUMBER})" if k in named else ANY_NUMBER
        out += _literal(line[at : match.start()]) + group
        at = match.end()
    return out + _literal(line[at:])


def _text(raw: bytes) -> str:
    text = raw.decode("latin-1").strip()
    good = sum(c.isascii() and c.isprintable() for c in text)
    return clean(text) if text and good >= PRINTABLE * len(text) else ""


def _literal(text: str) -> str:
    """Fixed text, with blanks of any length."""
    return r"\s*".join(re.escape(part) for part in re.split(r"\s+", text))


class ReadingBook:
    """The newest reading of every group, and the present faults.

    Attributes:
        values: reading and its instant, ns, by group: °C, counts, 1/min.
        faults: present faults by group; "" for malformed lines, "axes" for positions.

    Raises:
        ConfigError: a pattern names the axes, but not every axis has its highest speed.
    """

    def __init__(self, parser: LineParser, options: AsciiOptions, machine: Machine) -> None:
        self.values: dict[str, tuple[float, int]] = {}
        self.faults: dict[str, str] = {}
        self._parser, self._axes = parser, machine.axis_names
        self._stuck = StuckWatch(options.stuck_after_s)
        self._tracker: CountTracker | None = None
        if self._axes[0] in parser.groups:
            self._tracker = CountTracker(self._axes, 64, max_counts_per_s(options.max_speed_mm_s, machine))

    @property
    def has_axes(self) -> bool:
        """Do the patterns name the axes?"""
        return self._tracker is not None

    @property
    def lost(self) -> str:
        """Why the positions are unknown; "" where they are known."""
        return "" if self._tracker is None else self._tracker.lost

    def restart(self) -> None:
        """Forget everything."""
        self.values.clear()
        self.faults.clear()
        if self._tracker is not None:
            self._tracker.restart()

    def take(self, line: bytes, instant_ns: int, now_ns: int) -> bool:
        """Process a line that arrived between two instants; return whether it held a reading."""
        printed = self._parser.parse(line)
        if printed is None:
            return False
        if printed.values:
            self.faults.pop("", None)
        for name, value in printed.values.items():
            if name not in self._axes:
                self._take_one(name, value, instant_ns, now_ns)
        if self._tracker is not None and all(name in printed.values for name in self._axes):
            for name in self._axes:
                self.faults.pop(name, None)
            self._take_axes(self._tracker, [round(printed.values[name]) for name in self._axes], instant_ns, now_ns)
        self.faults.update(printed.faults)
        return bool(printed.values)

    def _take_one(self, name: str, value: float, instant_ns: int, now_ns: int) -> None:
        stuck = "" if name == SPINDLE else self._stuck.look(name, value, now_ns)
        if stuck:
            self.faults[name] = stuck
        else:
            self.faults.pop(name, None)
            self.values[name] = (value, instant_ns)

    def _take_axes(self, tracker: CountTracker, counts: list[int], instant_ns: int, now_ns: int) -> None:
        """Accept positions in counts that the machine can have reached: a line of text has no check sum of its own."""
        try:
            values = tracker.update(counts, instant_ns, now_ns)
        except DriverFault as e:
            self.faults["axes"] = str(e)
            return
        self.faults.pop("axes", None)
        for name, value in zip(self._axes, values, strict=True):
            self.values[name] = (value, instant_ns)


SHOWN: Final = 60
"""Received bytes that a message shows."""
READS_PER_POLL = 4
"""Reads of up to 4 kB; a device that floods the line is read on at the next call."""


class AsciiLinesDriver:
    """Readout or thermocouple board that prints lines.

    Never waits: each call processes the bytes that have arrived. A reading's instant is that of the call before, after
    which it arrived: so it is never younger than its instant. Calls fill in the good readings before they raise a
    fault.

    Args:
        options: options of the run file.
        machine: machine with the axes and sensors of the arrays.
        clock: clock of the instants.
        base: not used, as there are no files.
        ports: lists the serial ports; None: pyserial's list.

    Raises:
        ConfigError: patterns or units do not fit the machine.
    """

    options_model = AsciiOptions
    EXAMPLE = """\
[device.thermocouples]
driver = "ascii_lines"
usb_serial = "AB0JQ2X7"                       # found by it, whatever its port is called today
baud = 9600
parity = "even"
bytesize = 7
decimal = ","
patterns = ['T1=(?P<T_bed>\\S+) T2=(?P<T_air>\\S+)']   # T1= 21,4 is then T_bed, by the machine's names
units = {T_air = "degf"}
"""

    @classmethod
    def scanner(cls, table: Mapping[str, Any], clock: Clock) -> Scanner:
        """A scanner that listens at the port."""
        way = {key: value for key, value in table.items() if key in PortOptions.model_fields}
        return AsciiScanner(validated(PortOptions, way, "ascii_lines"), clock)

    def __init__(
        self, options: AsciiOptions, machine: Machine, clock: Clock, base: Path = Path(), ports: Ports | None = None
    ) -> None:
        del base
        self.options, self._machine, self._clock = options, machine, clock
        self._parser = LineParser(options, machine)
        self._book = ReadingBook(self._parser, options, machine)
        self._finder = PortFinder(options, ports)
        self._reopener = Reopener(self._connect, _close, clock, options.first_retry_s, options.longest_retry_s)
        self._line: SerialLine | None = None
        self._entered = False
        self._reader: LineReader = self._parser.reader()
        self._polled_ns = self._heard_ns = self._requested_ns = 0
        self._received = b""

    def __enter__(self) -> Self:
        """Open the port.

        Raises:
            DriverUnavailable: it does not exist, and the options have `at_start = "required"`.
        """
        self.resume()
        self._entered = True
        self._reopener.start()
        try:
            self._adopt(self._connect())
        except DriverError as e:
            if self.options.at_start == "required":
                self._leave()
                raise
            self._lose(str(e))
        return self

    def __exit__(self, *error: object) -> None:
        """Close."""
        self._leave()

    @property
    def must_resume(self) -> str:
        """Why it waits for an order to resume; "" where it does not."""
        return self._book.lost

    def resume(self) -> None:
        """Go on after a lost position: the next printed position is accepted as it is."""
        self._book.restart()

    def read_temperatures(self, degc: Floats, time_ns: Ints) -> None:
        """Fill in what was printed since, °C and instants; then raise the faults.

        Raises:
            DriverFault: text that is no number, garbage, a stuck reading.
            DriverTimeout: the device is silent.
            DriverUnavailable: the port is gone; it is being reopened.
        """
        trouble = self._poll()
        for i, name in enumerate(self._machine.sensor_names):
            if name in self._book.values:
                degc[i], time_ns[i] = self._book.values[name]
        self._tell(trouble)

    def read_counts(self, counts: Ints) -> int:
        """Fill in the newest printed positions, in counts; give their instant, ns.

        Raises:
            DriverFault, DriverTimeout, DriverUnavailable: as `read_temperatures`; or no pattern names the axes.
        """
        self._tell(self._poll())
        names = self._machine.axis_names
        if not self._book.has_axes:
            raise DriverFault(f"{self.options.place}: no pattern names the axes {', '.join(names)}")
        if names[0] not in self._book.values:
            raise DriverTimeout(f"{self.options.place}: no line with the axes' positions yet{self._came()}")
        for i, name in enumerate(names):
            counts[i] = int(self._book.values[name][0])
        return self._book.values[names[0]][1]

    def read_spindle(self) -> float:
        """The newest printed spindle speed, 1/min.

        Raises:
            DriverFault, DriverTimeout, DriverUnavailable: as `read_temperatures`; or it is older than the silence after
                which the port is reopened.
        """
        self._tell(self._poll())
        value, instant_ns = self._book.values.get(SPINDLE, (0.0, -(2**62)))
        if self._clock.now_ns() - instant_ns > self.options.silent_reopen_s * 1e9:
            raise DriverTimeout(f"{self.options.place}: no spindle speed was printed{self._came()}")
        return value

    def _connect(self) -> SerialLine:
        device = self._finder.find()
        line = SerialLine(self.options, device)
        self._finder.remember(device)
        return line

    def _adopt(self, line: SerialLine) -> SerialLine:
        self._line, self._reader, self._received = line, self._parser.reader(), b""
        now_ns = self._clock.now_ns()
        self._polled_ns = self._heard_ns = now_ns
        self._requested_ns = now_ns - round(self.options.request_period_s * 1e9)
        return line

    def _live(self) -> SerialLine:
        if not self._entered:
            raise DriverUnavailable("ascii_lines: not entered, so its port is not open")
        if self._line is not None:
            return self._line
        line = self._reopener.poll()
        if line is None:
            raise DriverUnavailable(f"{self._reopener.error}; trying again")
        return self._adopt(line)

    def _poll(self) -> DriverError | None:
        """Process the bytes that have arrived; give the error that prevents it. Raises if the driver is not entered."""
        if not self._entered:
            raise DriverUnavailable("ascii_lines: not entered, so its port is not open")
        try:
            line = self._live()
            try:
                self._listen(line)
            except DriverUnavailable as e:
                self._lose(str(e))
                raise
        except DriverError as e:
            return e
        return None

    def _listen(self, line: SerialLine) -> None:
        now_ns, before_ns = self._clock.now_ns(), self._polled_ns
        for _ in range(READS_PER_POLL):
            received = line.read()
            if not received:
                break
            self._received = (self._received + received)[-SHOWN:]
            for text in self._reader.feed(received):
                if self._book.take(text, before_ns, now_ns):
                    self._heard_ns, self._received = now_ns, b""
        self._polled_ns = now_ns
        self._request(line, now_ns)
        silent_s = (now_ns - self._heard_ns) * 1e-9
        if silent_s > self.options.silent_reopen_s:
            raise DriverUnavailable(f"{line.device}: nothing to be understood for {silent_s:.1f} s{self._came()}")

    def _came(self) -> str:
        """The newest bytes received since the last reading, for a message; "" where none came."""
        if not self._received:
            return ""
        return f"; received: {self._received.decode(self.options.encoding, 'replace')!r}"

    def _request(self, line: SerialLine, now_ns: int) -> None:
        if self.options.request is None or now_ns - self._requested_ns < self.options.request_period_s * 1e9:
            return
        self._requested_ns = now_ns
        line.write(self.options.request.encode(self.options.encoding))

    def _tell(self, trouble: DriverError | None) -> None:
        if trouble is not None:
            raise trouble
        if self._book.faults:
            raise DriverFault(f"{self.options.place}: {'; '.join(self._book.faults.values())}")

    def _lose(self, error: str) -> None:
        if self._line is not None:
            self._line.close()
            self._line = None
        self._reopener.lost(error)

    def _leave(self) -> None:
        self._entered = False
        self._reopener.close()
        if self._line is not None:
            self._line.close()
            self._line = None


def _close(line: SerialLine) -> None:
    line.close()

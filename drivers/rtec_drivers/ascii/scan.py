"""Scans a serial port: its rate, the lines that it prints unasked, and the numbers that change. Sends nothing."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, Self

from rtec.loop.clock import Clock
from rtec.text import clean
from rtec_drivers.serial_line import PortFinder, PortOptions, SerialLine

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

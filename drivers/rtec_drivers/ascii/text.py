"""From bytes to lines, and from lines to readings."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

from rtec.machine import Machine
from rtec_drivers.ascii.options import LINE_ENDS, AsciiOptions, compiled

TO_DEGC = {
    "degc": (1.0, 0.0),
    "degf": (5.0 / 9.0, -160.0 / 9.0),
    "kelvin": (1.0, -273.15),
    "0.1degc": (0.1, 0.0),
    "0.01degc": (0.01, 0.0),
}
MM = {"mm": 1.0, "um": 1e-3, "inch": 25.4}
LARGEST = 1e15
"""°C, counts or 1/min. Up to here a count keeps its last digit; a position beyond would wrap to a believable one."""


class LineReader:
    """Bytes in, whole lines out.

    What stands before the first line end is thrown away: it may be the second half of a line, and half a number is a
    wrong number. So is a line longer than allowed.

    Attributes:
        too_long: how many lines were.
    """

    def __init__(self, end: bytes, longest: int) -> None:
        self.too_long = 0
        self._end, self._longest = end, longest
        self._rest, self._skip = b"", True

    def feed(self, received: bytes) -> list[bytes]:
        """Give the lines that these bytes complete."""
        *lines, rest = (self._rest + received).split(self._end)
        out = []
        for line in lines:
            if self._skip:
                self._skip = False
            elif len(line) > self._longest:
                self.too_long += 1
            else:
                out.append(line)
        if len(rest) > self._longest + 1:  # one more for the return before the line feed
            self.too_long += not self._skip
            self._skip, rest = True, b""
        self._rest = rest
        return out


@dataclass(frozen=True)
class Line:
    """What one line says.

    Attributes:
        values: by group: °C, counts, or 1/min.
        faults: what is wrong with it, by group; "" for the line as a whole.
    """

    values: Mapping[str, float]
    faults: Mapping[str, str]


class LineParser:
    """Reads lines by the options' patterns.

    Args:
        options: patterns, units, decimal sign.
        machine: names of sensors and axes; counts per mm.

    Raises:
        ConfigError: the options do not fit the machine.
    """

    def __init__(self, options: AsciiOptions, machine: Machine) -> None:
        self._options = options
        self.patterns = compiled(options, machine)
        self.groups = tuple(dict.fromkeys(g for p in self.patterns for g in p.groupindex))
        self._scales = {name: _scale(name, options.units.get(name), machine) for name in self.groups}

    def reader(self) -> LineReader:
        """Give a reader for a line that has just been opened."""
        return LineReader(LINE_ENDS[self._options.line_end], self._options.longest_line)

    def parse(self, line: bytes) -> Line | None:
        """Give what a line says; None for an empty one."""
        try:
            text = line.decode(self._options.encoding).strip()
        except UnicodeDecodeError:
            return Line({}, {"": f"a line that is not {self._options.encoding} text"})
        if not text:
            return None
        for pattern in self.patterns:
            match = pattern.fullmatch(text)
            if match:
                return self._read(match)
        return Line({}, {"": f"a line that fits no pattern: {text[:60]!r}"})

    def _read(self, match: re.Match[str]) -> Line:
        values, faults = {}, {}
        for name, text in match.groupdict().items():
            if text is None:
                continue
            number = _number(text, self._options.decimal)
            if number is None:
                faults[name] = f"{name}: {text[:20]!r} is no number"
            else:
                factor, offset = self._scales[name]
                value = factor * number + offset
                if abs(value) > LARGEST:
                    faults[name] = f"{name}: {text.strip()[:20]!r} is too large to be true"
                else:
                    values[name] = value
        return Line(values, faults)


def _number(text: str, decimal: str) -> float | None:
    """A number with that decimal sign and no other; None where it is none."""
    text = text.strip()
    if decimal == ",":
        if "." in text:
            return None
        text = text.replace(",", ".")
    try:
        number = float(text.replace("_", "?"))
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _scale(name: str, unit: str | None, machine: Machine) -> tuple[float, float]:
    if name in machine.sensor_names:
        return TO_DEGC[unit or "degc"]
    if name in machine.axis_names and unit not in (None, "counts"):
        return MM[str(unit)] * machine.axis(name).counts_per_mm, 0.0
    return 1.0, 0.0

"""From the bytes of a device that prints lines to readings, by the patterns and units of its run file."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from rtec.errors import ConfigError
from rtec.machine import Machine
from rtec.quantities import MillimetresPerSecond, SecondsPositive
from rtec.tomlfile import nearest
from rtec_drivers.serial_line import PortOptions

SPINDLE = "spindle_rpm"
LINE_ENDS = {"lf": b"\n", "cr": b"\r", "crlf": b"\n"}
"""The byte that ends a line; white space around it is stripped."""
TEMPERATURE_UNITS = ("degc", "degf", "kelvin", "0.1degc", "0.01degc")
LENGTH_UNITS = ("counts", "mm", "um", "inch")


class AsciiOptions(PortOptions):
    r"""Options of a readout or thermocouple board that prints lines of text.

    Attributes:
        patterns: regular expressions, each for one kind of whole line. A named group gives a reading: the name of one
            of the machine's sensors, of one of its axes (a position; one line must then hold all of them), or
            `spindle_rpm`.
        units: of the groups: degc (not set: this), degf, kelvin, 0.1degc, 0.01degc for sensors; counts (not set:
            this), mm, um, inch for axes.
        max_speed_mm_s: highest speed of each axis, where a pattern names the axes; faster positions are refused.
        decimal: the decimal sign.
        line_end: how lines end.
        encoding: of the text.
        request: text to send to get a line, for devices that do not print unasked. `\r` and `\n` as in TOML.
        request_period_s: period of the request.
        silent_reopen_s: after this time without any matching line, the port is closed and reopened.
        stuck_after_s: a temperature that is constant to its last digit for this time counts as a broken sensor; a
            device that prints coarse steps needs a longer time.
        longest_line: longer lines are garbage.
    """

    baud: Annotated[int, Field(ge=50, le=20_000_000)] = 9600
    at_start: Literal["required", "later"] = "later"
    patterns: Annotated[tuple[str, ...], Field(min_length=1)]
    units: dict[str, str] = Field(default_factory=dict)
    max_speed_mm_s: dict[str, MillimetresPerSecond] = Field(default_factory=dict)
    decimal: Literal[".", ","] = "."
    line_end: Literal["lf", "cr", "crlf"] = "lf"
    encoding: Literal["ascii", "latin-1", "utf-8"] = "latin-1"
    request: str | None = None
    request_period_s: Annotated[float, Field(ge=0.001, le=3600)] = 1.0
    silent_reopen_s: Annotated[float, Field(ge=1e-3, le=3600)] = 10.0
    stuck_after_s: SecondsPositive = 3600.0
    longest_line: Annotated[int, Field(ge=1, le=4096)] = 256

    @model_validator(mode="after")
    def _patterns_compile(self) -> Self:
        for pattern in self.patterns:
            try:
                groups = re.compile(pattern).groupindex
            except re.error as e:
                raise ValueError(f"patterns: {pattern!r} is no regular expression: {e}") from e
            if not groups:
                raise ValueError(f"patterns: {pattern!r} has no named group, as in '(?P<T_bed>\\S+)'")
        return self


def compiled(options: AsciiOptions, machine: Machine) -> tuple[re.Pattern[str], ...]:
    """The patterns, checked against the machine.

    Raises:
        ConfigError: groups or units that the machine or the driver does not have.
    """
    patterns = tuple(re.compile(p) for p in options.patterns)
    axes, sensors = machine.axis_names, machine.sensor_names
    groups = {name for p in patterns for name in p.groupindex}
    known = (*sensors, *axes, SPINDLE)
    faults = [
        f"patterns: group {g!r} is no sensor or axis of machine {machine.name!r}{nearest(g, known)}"
        for g in sorted(groups - set(known))
    ]
    for p in patterns:
        some = [a for a in axes if a in p.groupindex]
        if some and len(some) < len(axes):
            faults.append(f"patterns: {p.pattern!r} gives axis {some[0]}; one line must give all: {', '.join(axes)}")
    faults += [f"units: no group {n!r}{nearest(n, groups)}" for n in options.units if n not in groups]
    for name, unit in options.units.items():
        allowed = LENGTH_UNITS if name in axes else TEMPERATURE_UNITS if name in sensors else ("1/min",)
        if unit not in allowed:
            faults.append(f"units: {name} = {unit!r}{nearest(unit, allowed)}")
    if faults:
        raise ConfigError("\n".join(faults))
    return patterns


TO_DEGC = {
    "degc": (1.0, 0.0),
    "degf": (5.0 / 9.0, -160.0 / 9.0),
    "kelvin": (1.0, -273.15),
    "0.1degc": (0.1, 0.0),
    "0.01degc": (0.01, 0.0),
}
MM_OF = {"mm": 1.0, "um": 1e-3, "inch": 25.4}
LARGEST = 1e15
"""°C, counts or 1/min. Up to here a count keeps its last digit; a position beyond would wrap to a plausible one."""


class LineReader:
    """Bytes in, whole lines out.

    Bytes before the first line end are dropped: they may be the second half of a line, and half a number is a wrong
    number. So is a line longer than allowed.

    Args:
        end: the byte that ends a line.
        longest: longer lines are garbage.
        from_start: the first byte begins a line, as with a device that only answers.

    Attributes:
        too_long: number of lines that were too long.
    """

    def __init__(self, end: bytes, longest: int, *, from_start: bool = False) -> None:
        self.too_long = 0
        self._end, self._longest = end, longest
        self._rest, self._skip = b"", not from_start

    def feed(self, received: bytes) -> list[bytes]:
        """The lines that these bytes complete."""
        *lines, rest = (self._rest + received).split(self._end)
        out = []
        for line in lines:
            if self._skip:
                self._skip = False
            elif len(line) > self._longest:
                self.too_long += 1
            else:
                out.append(line)
        if len(rest) > self._longest + 1:  # one more for the carriage return before the line feed
            self.too_long += not self._skip
            self._skip, rest = True, b""
        self._rest = rest
        return out


@dataclass(frozen=True)
class PrintedLine:
    """Content of one line.

    Attributes:
        values: by group: °C, counts, or 1/min.
        faults: faults by group; "" for the line as a whole.
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
        """A reader for a line that has just been opened."""
        return LineReader(LINE_ENDS[self._options.line_end], self._options.longest_line)

    def parse(self, line: bytes) -> PrintedLine | None:
        """The content of a line; None for an empty one."""
        try:
            text = line.decode(self._options.encoding).strip()
        except UnicodeDecodeError:
            return PrintedLine({}, {"": f"a line that is not {self._options.encoding} text"})
        if not text:
            return None
        for pattern in self.patterns:
            match = pattern.fullmatch(text)
            if match:
                return self._read(match)
        return PrintedLine({}, {"": f"a line that fits no pattern: {text[:60]!r}"})

    def _read(self, match: re.Match[str]) -> PrintedLine:
        values, faults = {}, {}
        for name, text in match.groupdict().items():
            if text is None:
                continue
            number = number_in(text, self._options.decimal)
            if number is None:
                faults[name] = f"{name}: {text[:20]!r} is no number"
            else:
                factor, offset = self._scales[name]
                value = factor * number + offset
                if abs(value) > LARGEST:
                    faults[name] = f"{name}: {text.strip()[:20]!r} is too large to be true"
                else:
                    values[name] = value
        return PrintedLine(values, faults)


def number_in(text: str, decimal: str) -> float | None:
    """A number with that decimal sign and no other; None where the text is none."""
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
        return MM_OF[str(unit)] * machine.axis(name).counts_per_mm, 0.0
    return 1.0, 0.0

"""Options of a controller that accepts offsets as lines of text, and the text of its lines."""

import math
import re
import string
from collections.abc import Sequence
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from rtec.errors import ConfigError
from rtec.machine import Machine
from rtec.quantities import Factor, MicrometresPositive
from rtec.tomlfile import Strict, nearest
from rtec_drivers.ascii.text import MM_OF, number_in
from rtec_drivers.byte_line import TcpPlace
from rtec_drivers.serial_line import PortOptions

SPEC = re.compile(r"[+ ]?0?\d{0,2}(\.\d{1,2})?[df]?")
ENDS = {"lf": b"\n", "cr": b"\r", "crlf": b"\r\n"}
NEAR = 0.01
"""A printed number may be off by this share of one unit of output."""
UNITS_TRIED = (1, -1, 7, 1234, -999)


class OffsetOptions(Strict):
    r"""Options of a controller that accepts offsets as lines of text.

    Attributes:
        serial: a serial line; either this or `tcp`.
        tcp: a connection over TCP; either this or `serial`.
        command: the lines that set the offsets, in this order. `{X:.4f}` stands for the number of axis X, printed with
            four decimals; `{X:+d}` for an integer with its sign. Every corrected axis must be in one of them.
        unit: unit of these numbers: mm, um, inch; counts are those of the axis' encoder.
        resolution_um: one unit of output, µm: the smallest step that the controller accepts. `[output.X]` must have the
            same.
        factor: by axis, multiplies the number: -1 where the controller counts the offset the other way, 2 where it
            needs a diameter.
        actuator: what the controller does with the offsets; the kind of `[output.X]`.
        decimal: the decimal sign.
        line_end: how lines end, both ways.
        encoding: encoding of the text.
        acknowledge: regular expression of the whole line by which the controller accepts a command. Not set: it sends
            none, and a line that was sent counts as accepted.
        refuse: regular expression of a line by which it refuses one.
        restarted: regular expression of a line that it prints after a restart. The correction then holds until it is
            ordered to resume, since the controller's offsets are unknown.
        keeps_offsets: the controller keeps its offsets through a restart. Otherwise it begins at zero, and so does the
            correction when it is ordered to resume.
        ask: line that asks for the offsets that are in force. Not set: they cannot be read back, and rtec keeps account
            of them itself.
        answer: regular expression of the whole line of the answer; a named group for every axis of `command`.
        ask_period_s: period of asking; it also asks before and after every command.
        timeout_s: longest wait for an acknowledgement or answer.
        longest_line: longer lines are garbage.
    """

    serial: PortOptions | None = None
    tcp: TcpPlace | None = None
    command: Annotated[tuple[str, ...], Field(min_length=1)]
    unit: Literal["um", "mm", "inch", "counts"]
    resolution_um: MicrometresPositive
    factor: dict[str, Factor] = Field(default_factory=dict)
    actuator: Literal["origin_offset", "following_error"] = "origin_offset"
    decimal: Literal[".", ","] = "."
    line_end: Literal["lf", "cr", "crlf"] = "lf"
    encoding: Literal["ascii", "latin-1", "utf-8"] = "latin-1"
    acknowledge: str | None = None
    refuse: str | None = None
    restarted: str | None = None
    keeps_offsets: bool = False
    ask: str | None = None
    answer: str | None = None
    ask_period_s: Annotated[float, Field(ge=0.01, le=3600)] = 1.0
    timeout_s: Annotated[float, Field(ge=0.005, le=2)] = 0.2
    longest_line: Annotated[int, Field(ge=1, le=4096)] = 256

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (self.serial is None) == (self.tcp is None):
            raise ValueError("give either serial or tcp")
        if (self.ask is None) != (self.answer is None):
            raise ValueError("ask and answer go together")
        if self.refuse is not None and self.acknowledge is None:
            raise ValueError("refuse needs acknowledge: without it nothing is waited for")
        for key in ("acknowledge", "refuse", "restarted", "answer"):
            pattern = getattr(self, key)
            try:
                re.compile(pattern or "")
            except re.error as e:
                raise ValueError(f"{key}: {pattern!r} is no regular expression: {e}") from e
        return self

    @property
    def place(self) -> str:
        """Name of the line, for people."""
        return self.serial.place if self.serial else f"{self.tcp.host}:{self.tcp.port}" if self.tcp else ""


class OffsetText:
    """Turns units of output into the controller's lines, and its answer into units.

    Args:
        options: options of the device.
        machine: machine with the axes of the units.

    Raises:
        ConfigError: axes do not exist or are missing, or numbers are printed too coarsely.
    """

    def __init__(self, options: OffsetOptions, machine: Machine) -> None:
        self._options, self._axes = options, machine.axis_names
        self._lines = [list(string.Formatter().parse(line)) for line in _parsed(options.command)]
        self.named = tuple(a for a in self._axes if a in {field for line in self._lines for _, field, _, _ in line})
        self._answer = re.compile(options.answer) if options.answer is not None else None
        self._check_names(machine)
        self._scales = {a: _scale(a, options, machine) for a in self.named}
        self._check_digits()

    def lines(self, output: Sequence[int]) -> list[bytes]:
        """The lines that command these units, one an axis of the machine; without their ends."""
        return [self._line(line, output).encode(self._options.encoding) for line in self._lines]

    def units(self, line: str) -> dict[str, int] | None:
        """Units by axis, from an answer; None where the line is no answer.

        Raises:
            ValueError: it is an answer with a malformed number.
        """
        match = self._answer.fullmatch(line) if self._answer is not None else None
        if match is None:
            return None
        out = {}
        for axis in self.named:
            number = number_in(match[axis] or "", self._options.decimal)
            if number is None or abs(number / self._scales[axis]) > 2**52:
                raise ValueError(f"{axis}: {(match[axis] or '')[:20]!r} is no number")
            out[axis] = round(number / self._scales[axis])
        return out

    def _line(self, parts: Sequence[tuple[str, str | None, str | None, str | None]], output: Sequence[int]) -> str:
        text = ""
        for literal, axis, spec, _ in parts:
            text += literal + ("" if axis is None else self._number(axis, spec or "", output[self._axes.index(axis)]))
        return text

    def _number(self, axis: str, spec: str, units: int) -> str:
        value = units * self._scales[axis]
        return format(round(value) if spec.endswith("d") else value, spec).replace(".", self._options.decimal)

    def _check_names(self, machine: Machine) -> None:
        fields = {field for line in self._lines for _, field, _, _ in line if field is not None}
        faults = [f"command: {f!r} is no axis{nearest(f, self._axes)}" for f in sorted(fields - set(self._axes))]
        faults += [f"factor: {f!r} is no axis{nearest(f, self._axes)}" for f in self._options.factor if f not in fields]
        faults += [
            f"command: axis {a.name} is corrected, and {{{a.name}}} is in no line"
            for a in machine.axes
            if a.compensate and a.name not in fields
        ]
        groups = set(self._answer.groupindex) if self._answer is not None else set(self.named)
        faults += [f"answer: no group (?P<{a}>…) for axis {a}" for a in self.named if a not in groups]
        if faults:
            raise ConfigError("\n".join(faults))

    def _check_digits(self) -> None:
        """Has every unit of output a printed number of its own?"""
        options = self._options
        for line in self._lines:
            for axis, spec in ((f, s or "") for _, f, s, _ in line if f is not None):
                one = self._scales[axis]
                for units in UNITS_TRIED:
                    printed = number_in(self._number(axis, spec, units), options.decimal)
                    if printed is None or not math.isclose(printed, units * one, abs_tol=NEAR * abs(one), rel_tol=0):
                        raise ConfigError(
                            f"command: {{{axis}:{spec}}} prints {self._number(axis, spec, units)} for "
                            f"{units * one:g} {options.unit}, which is {units} × resolution_um "
                            f"{options.resolution_um:g}: give it more decimals, or make resolution_um larger"
                        )


def _parsed(lines: Sequence[str]) -> Sequence[str]:
    """The lines, after a check that only numbers are put into them."""
    for line in lines:
        try:
            parts = list(string.Formatter().parse(line))
        except ValueError as e:
            raise ConfigError(f"command: {line!r}: {e}; a brace of the text itself is written twice, {{{{") from e
        for _, field, spec, conversion in parts:
            if field is not None and (conversion or not field.isidentifier() or not SPEC.fullmatch(spec or "")):
                raise ConfigError(f"command: {line!r}: a number is written as {{X:.4f}}, {{X:+d}} or {{X}}")
    return lines


def _scale(axis: str, options: OffsetOptions, machine: Machine) -> float:
    """The controller's number for one unit of output."""
    mm = options.resolution_um * 1e-3
    if options.unit == "counts":
        counts = mm * machine.axis(axis).counts_per_mm
        if not math.isclose(counts, round(counts), rel_tol=1e-9) or round(counts) == 0:
            raise ConfigError(
                f'unit = "counts": resolution_um {options.resolution_um:g} is {counts:g} counts of axis {axis}; it '
                f"must be a whole number of them: one count is {1e3 / machine.axis(axis).counts_per_mm:g} µm"
            )
        return options.factor.get(axis, 1.0) * round(counts)
    return options.factor.get(axis, 1.0) * mm / MM_OF[options.unit]

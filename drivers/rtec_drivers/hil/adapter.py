"""An slcan adapter in software, and the sensors on its bus, made from the driver's options in the run file.

Written from the manual of Lawicel's CAN232 ("S6", "O", "t1858…", each ended by a carriage return) and from CiA 301.
"""

import importlib
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rtec.errors import ConfigError, DriverUnavailable
from rtec_drivers.can.driver import CanTemperatureOptions, TemperatureSignal
from rtec_drivers.can.signals import SignalOptions

SAY_NS = 100_000_000
HEARTBEAT_NS = 500_000_000
HEARTBEAT, OPERATIONAL = 0x700, b"\x05"
PDO_BASE = 0x180
PDO_STEP = 0x100
OK, REFUSED = b"\r", b"\a"
OTHER_NODE = 0x20
Value = Callable[[], float]
"""Gives a temperature, °C, or the spindle's speed, 1/min."""


@dataclass
class SignalNumber:
    """A number in a frame: its value, its conversion to a raw number, and its code of a broken wire.

    Attributes:
        open: is its wire broken?
        frozen: it keeps this raw number.
    """

    value: Value
    scale: float
    offset: float
    open_code: float | None
    open: bool = False
    frozen: float | None = None

    def raw(self) -> float:
        """The number in the frame."""
        if self.open and self.open_code is not None:
            return self.open_code
        return self.frozen if self.frozen is not None else (self.value() - self.offset) / self.scale


@dataclass
class FrameOut:
    """A frame that is sent repeatedly."""

    identifier: int
    extended: bool
    pack: Callable[[Mapping[str, float]], bytes]
    numbers: dict[str, SignalNumber] = field(default_factory=dict)

    def line(self, shift: int) -> bytes:
        """The frame as the adapter prints it."""
        data = self.pack({name: n.raw() for name, n in self.numbers.items()})
        return slcan(self.identifier + shift, self.extended, data)


class SlcanSimulator:
    """The adapter as `PtyPeer` serves it.

    Attributes:
        frames: frames that the sensors send.
        silent: the sensors send nothing.
        bus_off: the adapter has left the bus: it receives nothing, and refuses to send.
        wrong_node: the sensors send as another node.
        lose_every: one frame of this number is lost on the bus; 0: none.
        heard: frames that the computer sent.
    """

    def __init__(self, frames: list[FrameOut], nodes: list[int]) -> None:
        self.frames, self._nodes = frames, nodes
        self.silent = self.bus_off = self.wrong_node = False
        self.lose_every, self.heard = 0, 0
        self._rest, self._open, self._sent = b"", False, 0
        self._next_ns = self._next_beat_ns = 0

    def receive(self, data: bytes, now_ns: int) -> bytes:
        """Process commands; answer them, and print the frames that are due."""
        *lines, self._rest = (self._rest + data).split(b"\r")
        return b"".join(self._order(line) for line in lines) + self.idle(now_ns)

    def idle(self, now_ns: int) -> bytes:
        """Print the frames that came over the bus."""
        if not self._open or self.silent or self.bus_off:
            return b""
        out, shift = b"", OTHER_NODE if self.wrong_node else 0
        if now_ns >= self._next_beat_ns:
            self._next_beat_ns = now_ns + HEARTBEAT_NS
            for node in self._nodes:
                out += self._bus(slcan(HEARTBEAT + node + shift, False, OPERATIONAL))
        if now_ns >= self._next_ns:
            self._next_ns = now_ns + SAY_NS
            for frame in self.frames:
                out += self._bus(frame.line(shift))
        return out

    def _bus(self, line: bytes) -> bytes:
        self._sent += 1
        return b"" if self.lose_every and self._sent % self.lose_every == 0 else line

    def _order(self, line: bytes) -> bytes:
        kind = line[:1]
        if kind in (b"O", b"C"):
            self._open = kind == b"O"
        elif kind in (b"t", b"T", b"r", b"R"):
            if self.bus_off or not self._open:
                return REFUSED
            self.heard += 1
            return b"z\r"
        elif kind not in (b"S", b"s", b""):
            return REFUSED
        return OK


def slcan(identifier: int, extended: bool, data: bytes) -> bytes:
    """A frame in the adapter's text."""
    head = f"T{identifier:08X}" if extended else f"t{identifier:03X}"
    return f"{head}{len(data)}{data.hex().upper()}\r".encode()


def adapter(
    options: CanTemperatureOptions, sensors: Mapping[str, Value], rpm: Value, base: Path, where: str
) -> SlcanSimulator:
    """An adapter whose bus has the frames that the run file expects.

    Raises:
        ConfigError: a thermocouple's voltage, which it cannot send, or a message that is not in the DBC file.
        DriverUnavailable: DBC files need cantools.
    """
    voltages = [name for name, t in options.temperature.items() if t.thermocouple is not None]
    if voltages:
        raise ConfigError(f"{where} {', '.join(voltages)}: the bench's sensors give temperatures, not voltages")
    dbc = _dbc(base / options.dbc) if options.dbc is not None else None
    frames: dict[tuple[int, bool], FrameOut] = {}
    for name, table in options.temperature.items():
        _put(frames, dbc, table, SignalNumber(sensors[name], table.scale, table.offset, _open_code(table)))
    if options.spindle is not None:
        _put(frames, dbc, options.spindle, SignalNumber(rpm, options.spindle.scale, 0.0, None))
    return SlcanSimulator(list(frames.values()), [n.id for n in options.node.values()])


def _open_code(table: TemperatureSignal) -> float:
    beyond = (table.range_degc[1] + 500.0 - table.offset) / table.scale
    return table.open_codes[0] if table.open_codes else beyond


def _put(frames: dict[tuple[int, bool], FrameOut], dbc: Any, options: SignalOptions, number: SignalNumber) -> None:
    """Put a number into its frame; several signals may share a frame."""
    if options.node is not None:
        identifier = options.cob_id or PDO_BASE + (options.pdo - 1) * PDO_STEP + options.node
        places = [*options.map]
        frame = frames.setdefault((identifier, False), FrameOut(identifier, False, lambda raw: _pdo(places, raw)))
        frame.numbers[str(options.item - 1)] = number
        return
    message = dbc.get_message_by_name(options.message)
    key = (message.frame_id, message.is_extended_frame)
    frame = frames.setdefault(key, FrameOut(*key, lambda raw: _encoded(message, raw)))
    frame.numbers[str(options.signal)] = number


def _pdo(kinds: Sequence[str], raw: Mapping[str, float]) -> bytes:
    """Objects one after the other, little-endian, as in CiA 301; those without a reader are zero."""
    out = b""
    for k, kind in enumerate(kinds):
        number, size = raw.get(str(k), 0.0), int(kind[1:]) // 8
        if kind[0] == "f":
            out += struct.pack("<f" if size == 4 else "<d", number)
        else:
            low, high = (-(1 << 8 * size - 1), (1 << 8 * size - 1) - 1) if kind[0] == "i" else (0, (1 << 8 * size) - 1)
            out += max(low, min(high, round(number))).to_bytes(size, "little", signed=kind[0] == "i")
    return out


def _encoded(message: Any, raw: Mapping[str, float]) -> bytes:
    zero = {signal.name: 0 for signal in message.signals}
    return bytes(message.encode(zero | dict(raw), scaling=True, strict=False))


def _dbc(path: Path) -> Any:
    try:
        return importlib.import_module("cantools").database.load_file(path)
    except ImportError as e:
        raise DriverUnavailable("DBC files need the package cantools: pip install 'rtec[can]'") from e

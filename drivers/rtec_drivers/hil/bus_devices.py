"""Devices of the buses in software, from the drivers' options in the run file: slcan adapter, Modbus RTU slaves.

Written from the manual of Lawicel's CAN232 ("S6", "O", "t1858…", each ended by a carriage return), from CiA 301, and
from MODBUS over Serial Line 1.02; they share no code with the drivers, so each checks the other.
"""

import importlib
import struct
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rtec.errors import ConfigError, DriverUnavailable
from rtec_drivers.can.driver import CanTemperatureOptions, TemperatureSignal
from rtec_drivers.can.signals import SignalOptions
from rtec_drivers.modbus.driver import ModbusOptions, SlaveOptions
from rtec_drivers.modbus.map import Register, load_profile

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


FUNCTIONS = {3: "holding", 4: "input"}
FORMATS = {"int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "float32": ">f", "float64": ">d"}
BITS = {"int16": 15, "uint16": 16, "int32": 31, "uint32": 32}
REQUEST_BYTES = 8
NO_SUCH_REGISTER = 2
"""Gives a temperature, °C."""


@dataclass(frozen=True)
class RegisterPlace:
    """Place of a number in a slave, and its value."""

    register: Register
    degc: Value


class SlaveSimulator:
    """One slave.

    Attributes:
        number: number on the line.
        silent, frozen: it does not answer; its values stay constant.
        answers_as: number in its answers.
        late_ns: delay of its answers.
        open: its first thermocouple is open.
    """

    def __init__(self, number: int, places: list[RegisterPlace]) -> None:
        self.number = self.answers_as = number
        self.silent, self.open, self.late_ns = False, False, 0
        self._places = places
        self._frozen: list[float] | None = None

    @property
    def frozen(self) -> bool:
        """Do its values stay constant?"""
        return self._frozen is not None

    @frozen.setter
    def frozen(self, on: bool) -> None:
        self._frozen = [p.degc() for p in self._places] if on else None

    def answer(self, function: int, address: int, count: int) -> bytes:
        """Function, count of bytes and registers; or the refusal of registers that it does not have."""
        words: dict[int, bytes] = {}
        for k, place in enumerate(self._places):
            if FUNCTIONS.get(function) == place.register.function:
                value = self._frozen[k] if self._frozen is not None else place.degc()
                raw = _raw(place.register, value, self.open and k == 0)
                words |= {place.register.address + i: raw[2 * i : 2 * i + 2] for i in range(len(raw) // 2)}
        if not words or not 0 < count <= 125:
            return bytes((function | 0x80, NO_SUCH_REGISTER))
        content = b"".join(words.get(address + i, b"\0\0") for i in range(count))
        return bytes((function, len(content))) + content


class SlaveLine:
    """The line with its slaves, as `PtyPeer` serves it."""

    def __init__(self, slaves: list[SlaveSimulator]) -> None:
        self.slaves = slaves
        self._rest = b""
        self._due: deque[tuple[int, bytes]] = deque()

    def receive(self, data: bytes, now_ns: int) -> bytes:
        """Process requests; give the answers that are due."""
        self._rest += data
        while len(self._rest) >= REQUEST_BYTES:
            if not self._request(self._rest[:REQUEST_BYTES], now_ns):
                self._rest = b""  # out of step: a slave waits for the next silence
                break
            self._rest = self._rest[REQUEST_BYTES:]
        return self._answers(now_ns)

    def idle(self, now_ns: int) -> bytes:
        """Drop half a request after a silence; give an answer that is due."""
        self._rest = b""
        return self._answers(now_ns)

    def _request(self, frame: bytes, now_ns: int) -> bool:
        if crc(frame[:6]) != frame[6:]:
            return False
        for slave in self.slaves:
            if slave.number == frame[0] and not slave.silent:
                body = bytes((slave.answers_as,))
                body += slave.answer(frame[1], int.from_bytes(frame[2:4], "big"), int.from_bytes(frame[4:6], "big"))
                self._due.append((now_ns + slave.late_ns, body + crc(body)))
        return True

    def _answers(self, now_ns: int) -> bytes:
        due = [d for d in self._due if d[0] <= now_ns]
        for item in due:
            self._due.remove(item)
        return b"".join(content for _, content in due)


def slave_line(options: ModbusOptions, sensors: Mapping[str, Value], where: str) -> SlaveLine:
    """Slaves that answer the run file's requests.

    Raises:
        ConfigError: a line that cannot be simulated here.
    """
    if options.serial is None:
        raise ConfigError(f"{where} the bench has a far side for serial lines; this one goes over TCP")
    return SlaveLine([SlaveSimulator(t.id, _places(t, sensors, where)) for t in options.slave.values()])


def _places(table: SlaveOptions, sensors: Mapping[str, Value], where: str) -> list[RegisterPlace]:
    registers = dict(table.register_)
    if table.profile is not None:
        profile = load_profile(table.profile)
        registers |= {sensor: profile.channel[channel] for sensor, channel in table.channels.items()}
    voltages = [name for name, r in registers.items() if r.thermocouple is not None]
    if voltages:
        raise ConfigError(f"{where} {', '.join(voltages)}: the bench's slaves give temperatures, not voltages")
    return [RegisterPlace(register, sensors[name]) for name, register in registers.items()]


def _raw(register: Register, degc: float, is_open: bool) -> bytes:
    """The bytes of a number, high word first or last according to the register."""
    number = (degc - register.offset) / register.scale
    if is_open:
        beyond = (register.range_degc[1] + 500.0 - register.offset) / register.scale
        number = register.open_codes[0] if register.open_codes else beyond
    if register.type in BITS:
        low = -(1 << BITS[register.type]) if register.type.startswith("int") else 0
        number = max(low, min((1 << BITS[register.type]) - 1, round(number)))
    data = struct.pack(FORMATS[register.type], number)
    words = [data[i : i + 2] for i in range(0, len(data), 2)]
    return b"".join(words if register.word_order == "high" else words[::-1])


def crc(data: bytes) -> bytes:
    """CRC-16 of the line, low byte first: shifted right bit by bit, polynomial A001h."""
    register = 0xFFFF
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ (0xA001 if register & 1 else 0)
    return register.to_bytes(2, "little")

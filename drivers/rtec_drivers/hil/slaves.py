"""Modbus RTU slaves in software, from the driver's register maps in the run file.

Written from MODBUS over Serial Line 1.02; they share no code with the driver, so each checks the other.
"""

import struct
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from rtec.errors import ConfigError
from rtec_drivers.modbus.driver import ModbusOptions, SlaveOptions
from rtec_drivers.modbus.map import Register, load_profile

FUNCTIONS = {3: "holding", 4: "input"}
FORMATS = {"int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "float32": ">f", "float64": ">d"}
BITS = {"int16": 15, "uint16": 16, "int32": 31, "uint32": 32}
REQUEST_BYTES = 8
NO_SUCH_REGISTER = 2
Value = Callable[[], float]
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

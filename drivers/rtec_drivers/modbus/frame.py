"""Modbus frames on a serial line (RTU) and over TCP: requests, answers, one request with its answer, the way there.

Sources: MODBUS Application Protocol 1.1b3 and MODBUS over Serial Line 1.02 (modbus.org). Requests, answers and the
checksum are pymodbus'. The search for the answer is here, because an RTU answer has no number of its request: an
answer is only a frame of exactly the requested shape, from the right slave, with a correct CRC; noise may come
before or after it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, Protocol, Self

from pydantic import Field, model_validator
from pymodbus.framer import FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU
from pymodbus.pdu.register_message import ReadHoldingRegistersRequest, ReadInputRegistersRequest

from rtec.errors import DriverUnavailable
from rtec.loop.clock import Clock
from rtec.tomlfile import Strict
from rtec_drivers.byte_line import ByteLine, TcpPlace
from rtec_drivers.reopen import NS
from rtec_drivers.serial_line import PortOptions

HOLDING, INPUT = 3, 4
MAX_REGISTERS = 125
ERROR_BIT = 0x80
ERRORS = {
    1: 'it does not know this function; try function = "input" instead of "holding", or the other way round',
    2: "it has no such register; look at address and count",
    3: "it does not like the count",
    4: "it has failed",
    6: "it is busy",
    10: "the gateway is there, but has no way to this unit; look at id, and at the gateway's table of units",
    11: "the gateway is there, but the unit behind it does not answer; look at id, and at the unit's supply and wiring",
}
_DECODER = DecodePDU(is_server=False)
_RTU, _TCP = FramerRTU(_DECODER), FramerSocket(_DECODER)
MBAP_BYTES = 7


@dataclass(frozen=True, slots=True)
class ModbusRequest:
    """Read `count` registers from `address` of slave `slave` with function 3 (holding) or 4 (input)."""

    slave: int
    function: int
    address: int
    count: int

    @property
    def place(self) -> str:
        """The registers, for people."""
        kind = "holding" if self.function == HOLDING else "input"
        if self.count == 1:
            return f"{kind} register {self.address}"
        return f"{kind} registers {self.address} to {self.address + self.count - 1}"

    def _pdu(self) -> ReadHoldingRegistersRequest | ReadInputRegistersRequest:
        kind = ReadHoldingRegistersRequest if self.function == HOLDING else ReadInputRegistersRequest
        return kind(dev_id=self.slave, address=self.address, count=self.count)

    def rtu(self) -> bytes:
        """The request as sent on a serial line."""
        return _RTU.buildFrame(self._pdu())

    def tcp(self, transaction: int) -> bytes:
        """The request as sent on a TCP connection, with the number that its answer repeats."""
        pdu = self._pdu()
        pdu.transaction_id = transaction
        return _TCP.buildFrame(pdu)


@dataclass(frozen=True, slots=True)
class ModbusAnswer:
    """A slave's answer: registers, or the code of an error (then there are none)."""

    registers: tuple[int, ...] = ()
    error: int = 0


def good_crc(frame: bytes) -> bool:
    """Does an RTU frame end with the checksum of the bytes before?"""
    return len(frame) >= 4 and FramerRTU.compute_CRC(frame[:-2]) == int.from_bytes(frame[-2:], "big")


def find_rtu(data: bytes, request: ModbusRequest) -> ModbusAnswer | None:
    """The answer to a request within received bytes, or None."""
    whole, refused = 5 + 2 * request.count, 5
    for start in range(len(data) - refused + 1):
        if data[start] != request.slave:
            continue
        function = data[start + 1]
        if function == request.function and data[start + 2] == 2 * request.count:
            frame = data[start : start + whole]
        elif function == request.function | ERROR_BIT:
            frame = data[start : start + refused]
        else:
            continue
        if len(frame) in (whole, refused) and good_crc(frame):
            return decode(frame[1:-2], request)
    return None


def decode(pdu: bytes, request: ModbusRequest) -> ModbusAnswer | None:
    """Registers from function code and content; None if it is no answer to this request."""
    if len(pdu) == 2 and pdu[0] == request.function | ERROR_BIT:
        return ModbusAnswer(error=pdu[1])
    if len(pdu) != 2 + 2 * request.count or pdu[0] != request.function or pdu[1] != 2 * request.count:
        return None
    answer = _DECODER.decode(pdu)
    return ModbusAnswer(tuple(answer.registers)) if answer is not None else None


def frames_of_slaves(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Slave and frame of all register answers and refusals with a correct CRC within received bytes."""
    start = 0
    while start + 5 <= len(data):
        function = data[start + 1]
        size = 5 if function & ERROR_BIT else 5 + data[start + 2]
        plausible = function & ~ERROR_BIT in (HOLDING, INPUT)
        if plausible and good_crc(data[start : start + size]) and start + size <= len(data):
            yield data[start], data[start : start + size]
            start += size
        else:
            start += 1


def why_not(data: bytes, request: ModbusRequest) -> str:
    """Describe the bytes that came instead of the answer."""
    if not data:
        return "no answer"
    others = sorted({slave for slave, _ in frames_of_slaves(data)} - {request.slave})
    if others:
        return f"slave {', '.join(map(str, others))} answered instead; two slaves with one number, or a wrong id?"
    functions = {frame[1] & ~ERROR_BIT for slave, frame in frames_of_slaves(data) if slave == request.slave}
    if functions and request.function not in functions:
        return _other_function(functions.pop(), request)
    if functions:
        return "it answered something that was not asked; perhaps an older request"
    if data[:1] == bytes([request.slave]) and len(data) >= 5 + 2 * request.count:
        return "the answer's checksum is wrong; look at cable, shield and termination"
    if data[:1] == bytes([request.slave]) and len(data) > 1:
        return f"only {len(data)} of {5 + 2 * request.count} bytes of an answer came"
    return f"{len(data)} bytes that are no answer; look at baud rate, parity and wiring"


def _other_function(function: int, request: ModbusRequest) -> str:
    return (
        f"it answers with function code {function}, but {request.function} was asked; try the other function "
        '("holding" is 3, "input" is 4), or ask the maker'
    )


def _odd(content: bytes, request: ModbusRequest) -> str:
    """Describe an answer, function code and content, that is none to the request."""
    if content and content[0] & ~ERROR_BIT != request.function:
        return _other_function(content[0], request)
    return f"it answers with {len(content)} bytes, {2 + 2 * request.count} are right: another register map?"


def split_tcp(data: bytes) -> tuple[list[tuple[int, int, bytes]], bytes] | None:
    """Received bytes to (transaction, unit, content) of each whole message, and the rest; None if not Modbus."""
    out = []
    while len(data) >= MBAP_BYTES:
        length = int.from_bytes(data[4:6], "big")
        if data[2:4] != b"\0\0" or not 3 <= length <= 254:
            return None
        if len(data) < 6 + length:
            break
        out.append((int.from_bytes(data[:2], "big"), data[6], data[7 : 6 + length]))
        data = data[6 + length :]
    return out, data


LONGEST_NOISE = 4096
"""Bytes of noise that are kept, so that a line full of garbage fills no memory."""


class Exchange(Protocol):
    """One request and its answer, in one of the two framings.

    Attributes:
        numbered: does an answer identify its request?
    """

    numbered: bool

    def ask(self, line: ByteLine, request: ModbusRequest, until_ns: int) -> tuple[ModbusAnswer | None, bytes]:
        """The answer or None, and all other received bytes."""
        ...

    def why_not(self, data: bytes, request: ModbusRequest) -> str:
        """Describe the bytes that came instead of the answer that was asked for last."""
        ...

    def proves_line(self, data: bytes) -> bool:
        """Do the bytes that came instead show that the line is good?"""
        ...

    def if_silent(self, slave: int) -> str:
        """What to look at where nothing came."""
        ...


class RtuExchange:
    """On a serial line, or on a TCP connection that carries a serial line's frames.

    Args:
        clock: clock of the deadlines.
        worker_wait: waits until an instant, or until the worker is stopped.
        silence_ns: quiet time between frames, 3.5 characters.
    """

    numbered = False

    def __init__(self, clock: Clock, worker_wait: Callable[[int], None], silence_ns: int) -> None:
        self._clock, self._wait, self._silence_ns = clock, worker_wait, silence_ns

    def ask(self, line: ByteLine, request: ModbusRequest, until_ns: int) -> tuple[ModbusAnswer | None, bytes]:
        """Send when the line has been quiet; accept the frame of exactly the requested shape."""
        self._wait(self._clock.now_ns() + self._silence_ns)
        line.send(request.rtu())
        data = b""
        while self._clock.now_ns() < until_ns:
            more = line.receive(until_ns)
            data = (data + more)[-LONGEST_NOISE:]
            answer = find_rtu(data, request) if more else None
            if answer is not None:
                return answer, data
        return None, data

    def why_not(self, data: bytes, request: ModbusRequest) -> str:
        """Describe the bytes that came instead of the answer."""
        return why_not(data, request)

    def proves_line(self, data: bytes) -> bool:
        """Is there a frame with a correct checksum among them?"""
        return any(True for _ in frames_of_slaves(data))

    def if_silent(self, slave: int) -> str:
        """What to look at where nothing came."""
        return f"look at id = {slave} (has the module this number?), baud rate, parity, wires A and B, and its supply"


class TcpExchange:
    """On a TCP connection: the answer has the number of its request, so an old one is never accepted."""

    numbered = True

    def __init__(self, clock: Clock) -> None:
        self._clock, self._transaction, self._rest, self._odd = clock, 0, b"", ""

    def ask(self, line: ByteLine, request: ModbusRequest, until_ns: int) -> tuple[ModbusAnswer | None, bytes]:
        """Send with the next number; skip answers with any other."""
        self._transaction = self._transaction % 0xFFFF + 1
        line.send(request.tcp(self._transaction))
        noise, self._odd = b"", ""
        while self._clock.now_ns() < until_ns:
            more = line.receive(until_ns)
            noise = (noise + more)[-LONGEST_NOISE:]
            parts = split_tcp(self._rest + more)
            if parts is None:
                raise DriverUnavailable("what comes is no Modbus TCP; is it the right port?")
            messages, self._rest = parts
            for transaction, unit, content in messages:
                answer = decode(content, request)
                if transaction != self._transaction:
                    continue
                if unit == request.slave and answer is not None:
                    return answer, noise
                self._odd = _odd(content, request)
                if unit != request.slave:
                    self._odd = f"unit {unit} answered instead; a wrong id, or a gateway that puts in its own?"
        return None, noise

    def why_not(self, data: bytes, request: ModbusRequest) -> str:
        """Describe what came instead of the answer: with its number, or with older ones only."""
        del request
        return self._odd or ("it answers only earlier requests; raise timeout_s" if data else "no answer")

    def proves_line(self, data: bytes) -> bool:
        """Did anything come? What is no Modbus ends the connection."""
        return bool(data)

    def if_silent(self, slave: int) -> str:
        """What to look at where nothing came."""
        return f"the connection is open: look at id = {slave} (the unit id of the device), or raise timeout_s"


TCP_PORT = 502
SILENT_CHARACTERS = 3.5
LEAST_SILENCE_NS = 1_750_000
"""MODBUS over Serial Line 1.02, 2.5.1.1: above 19200 baud the silence between frames stays 1.75 ms."""


class TcpOptions(TcpPlace):
    """A TCP connection to Modbus slaves.

    Attributes:
        rtu: the connection carries a serial line's frames, as with simple serial servers.
    """

    port: Annotated[int, Field(ge=1, le=65535)] = TCP_PORT
    rtu: bool = False


class ModbusPort(PortOptions):
    """Options of a serial port, with the default rate of Modbus modules."""

    baud: Annotated[int, Field(ge=300, le=4_000_000)] = 9600


class ModbusLineOptions(Strict):
    """Access to a Modbus line.

    Attributes:
        serial: a serial line; either this or `tcp`.
        tcp: a connection over TCP; either this or `serial`.
    """

    serial: ModbusPort | None = None
    tcp: TcpOptions | None = None

    @model_validator(mode="after")
    def _one_line(self) -> Self:
        if (self.serial is None) == (self.tcp is None):
            raise ValueError("give either serial or tcp")
        return self

    def exchange(self, clock: Clock, wait: Callable[[int], None]) -> Exchange:
        """Requests and answers in this line's framing; `wait` waits until an instant."""
        tcp, port = self.tcp, self.serial
        if tcp is not None and not tcp.rtu:
            return TcpExchange(clock)
        silence_ns = LEAST_SILENCE_NS
        if port is not None:
            bits = 1 + port.bytesize + (port.parity != "none") + port.stopbits
            silence_ns = max(silence_ns, round(SILENT_CHARACTERS * bits * NS / port.baud))
        return RtuExchange(clock, wait, silence_ns)

"""One session with an encoder box on a CAN bus: sends latches and assembles the answers.

RTEC box link over CAN, version 1: one frame an axis. The document, with test vectors, is `docs/can.md`.

Every frame has 8 bytes: a signed 32-bit number, a sequence number, the box's boot number, a byte of bits, and
a CRC-8 over identifier and content. CAN's own CRC ends at the controller; this one also covers gateways and slcan,
whose text on a serial line has no checksum.
"""

import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass

from rtec.errors import DriverError

VERSION = 1
LATCH, INFO, COUNTS, COMMAND, LEDGER = 0x00, 0x01, 0x10, 0x20, 0x30
"""Offsets of the identifiers from the base; the last three are for axis 0, and the axis' number is added."""
MAX_AXES = 16
BLOCK = 0x40
WANT_INFO, WANT_LEDGER, RESUME = 0x01, 0x02, 0x04
"""Bits of a LATCH frame."""
_BODY = struct.Struct("<iBBB")
_POLYNOMIAL = 0x2F


@dataclass(frozen=True, slots=True)
class BoxFrame:
    """A frame with a correct CRC.

    Attributes:
        number: counts, inserted counts, or the content of INFO or LATCH.
        sequence: 0 to 255; that of the latch or the command that it belongs to.
        boot: the box's boot number, 1 to 255; 0: unknown.
        bits: bits of LATCH, or the status of the box.
    """

    number: int
    sequence: int
    boot: int
    bits: int = 0


def pack(identifier: int, frame: BoxFrame) -> bytes:
    """The 8 bytes of a frame."""
    body = _BODY.pack(frame.number, frame.sequence, frame.boot, frame.bits)
    return body + bytes([crc8(identifier.to_bytes(2, "little") + body)])


def unpack(identifier: int, data: bytes) -> BoxFrame | None:
    """A frame from its 8 bytes; None where length or CRC is wrong."""
    if len(data) != 8 or crc8(identifier.to_bytes(2, "little") + data[:7]) != data[7]:
        return None
    return BoxFrame(*_BODY.unpack(data[:7]))


def info_number(version: int, axes: int, hold_after_ms: int) -> int:
    """Number of an INFO frame: version (8 bits), axes (8 bits), time until it holds (16 bits)."""
    number: int = struct.unpack("<i", struct.pack("<BBH", version, axes, hold_after_ms))[0]
    return number


def info_of(number: int) -> tuple[int, int, int]:
    """Version, axes, and the silence after which the box holds, ms."""
    version, axes, hold_after_ms = struct.unpack("<BBH", struct.pack("<i", number))
    return version, axes, hold_after_ms


def crc8(data: bytes) -> int:
    """CRC-8/AUTOSAR: polynomial 2Fh, start FFh, result inverted; of "123456789" it is DFh."""
    value = 0xFF
    for byte in data:
        value = _TABLE[value ^ byte]
    return value ^ 0xFF


def _step(value: int) -> int:
    for _ in range(8):
        value = (value << 1) ^ _POLYNOMIAL if value & 0x80 else value << 1
        value &= 0xFF
    return value


_TABLE = tuple(_step(k) for k in range(256))


PATIENCE_NS = 50_000_000
"""After a silence of this time the box is asked less often,"""
ASK_PERIOD_NS = 20_000_000
"""namely with this period."""
LATEST_NS = 5_000_000_000
"""Longest time to an answer; the sequence numbers repeat after 256 questions."""


@dataclass(frozen=True, slots=True)
class Latched:
    """Counts of all axes from one latch.

    Attributes:
        counts: raw counters, signed, 32 bits.
        status: status bits (`rtec_drivers.box.protocol`) of all axes together.
        boot: the box's boot number.
        asked_ns, came_ns: instants of the LATCH frame, and of the last axis' answer.
    """

    counts: tuple[int, ...]
    status: int
    boot: int
    asked_ns: int
    came_ns: int


class CanBoxSession:
    """Everything received from the box; the interface's thread fills it, the loop reads it.

    Args:
        base_id: first identifier of the box.
        axes: number of axes.
        send: passes a frame to the interface.

    Attributes:
        newest: the newest whole reading.
        info: version, axes and silence after which it holds, ms; None before its INFO.
        boot: the box's boot number; 0 before its INFO.
        came: set whenever a good frame arrives.
        bad: number of frames with a wrong CRC or length.
    """

    def __init__(self, base_id: int, axes: int, send: Callable[[int, bytes], None]) -> None:
        self.newest: Latched | None = None
        self.info: tuple[int, int, int] | None = None
        self.boot = self.bad = 0
        self.came = threading.Event()
        self._base, self._axes, self._send = base_id, axes, send
        self._asked_ns: dict[int, int] = {}
        self._heard_ns = 0
        self._latch = self._command = 0
        self._parts: dict[int, BoxFrame] = {}
        self._ledgers: dict[int, BoxFrame] = {}

    def latch(self, resume: bool, now_ns: int) -> None:
        """Ask for counts and ledger; `resume`: order to resume, too, once the box's boot number is known.

        After a silence it asks less often, and never reuses a number whose answer may still come: that would look new.
        """
        number = (self._latch + 1) & 0xFF
        last_ns = self._asked_ns.get(self._latch)
        if last_ns is not None and now_ns - self._heard_ns > PATIENCE_NS and now_ns - last_ns < ASK_PERIOD_NS:
            return
        if now_ns - self._asked_ns.get(number, now_ns - LATEST_NS) < LATEST_NS:
            return
        self._latch = number
        bits = WANT_LEDGER | (0 if self.info else WANT_INFO)
        if resume and self.boot:
            bits |= RESUME
        self._asked_ns[self._latch] = now_ns
        try:
            self.send(LATCH, BoxFrame(VERSION, self._latch, self.boot, bits))
        except DriverError:  # it was not sent, so no answer comes
            self._asked_ns.pop(self._latch, None)
            raise

    def command(self, targets: tuple[int, ...], boot: int) -> None:
        """Send inserted counts, one frame an axis."""
        self._command = (self._command + 1) & 0xFF
        for k, target in enumerate(targets):
            self.send(COMMAND + k, BoxFrame(target, self._command, boot))

    def ledger(self, boot: int) -> tuple[tuple[int, ...], int] | None:
        """The ledger that this start of the box reported, and the number of the last accepted command."""
        ledgers = [self._ledgers.get(k) for k in range(self._axes)]
        same = [f for f in ledgers if f is not None and f.boot == boot]
        return (tuple(f.number for f in same), same[-1].sequence) if len(same) == self._axes else None

    def send(self, place: int, frame: BoxFrame) -> None:
        """Send one frame."""
        identifier = self._base + place
        self._send(identifier, pack(identifier, frame))

    def take(self, identifier: int, extended: bool, data: bytes, now_ns: int) -> None:
        """Process a received frame."""
        frame = None if extended else unpack(identifier, data)
        if frame is None:
            self.bad += 1
            return
        place = identifier - self._base
        if place == INFO:
            self.info, self.boot = info_of(frame.number), frame.boot
        elif place >= LEDGER:
            self._ledgers[place - LEDGER] = frame
        elif place >= COUNTS:
            self._part(place - COUNTS, frame, now_ns)
        self.came.set()

    def _part(self, axis: int, frame: BoxFrame, now_ns: int) -> None:
        """Store one axis of a reading; it is whole when all axes have the number of the same latch."""
        self._parts[axis] = frame
        same = [f for f in self._parts.values() if f.sequence == frame.sequence and f.boot == frame.boot]
        asked_ns = self._asked_ns.pop(frame.sequence, None) if len(same) == self._axes else None
        if asked_ns is None:
            return
        status = 0
        for part in same:
            status |= part.bits
        counts = tuple(self._parts[k].number for k in range(self._axes))
        for old in [n for n, t in list(self._asked_ns.items()) if t < asked_ns]:  # a bus keeps the order of frames
            self._asked_ns.pop(old, None)
        self._heard_ns = now_ns
        self.boot = frame.boot
        self.newest = Latched(counts, status, frame.boot, asked_ns, now_ns)
        self._parts.clear()

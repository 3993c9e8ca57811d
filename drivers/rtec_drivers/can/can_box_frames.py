"""RTEC box link over CAN, version 1: one frame an axis. The document, with test vectors, is `docs/can.md`.

Every frame has 8 bytes: a signed 32-bit number, a sequence number, the number of the box's start, a byte of bits, and
a CRC-8 over identifier and content. CAN's own CRC ends at the controller; this one also covers gateways and slcan,
whose text on a serial line has no checksum at all.
"""

import struct
from dataclasses import dataclass

VERSION = 1
LATCH, INFO, COUNTS, COMMAND, LEDGER = 0x00, 0x01, 0x10, 0x20, 0x30
"""Places of the identifiers above the base; to the last three the number of the axis is added."""
MAX_AXES = 16
BLOCK = 0x40
WANT_INFO, WANT_LEDGER, RESUME = 0x01, 0x02, 0x04
"""Bits of a LATCH frame."""
_BODY = struct.Struct("<iBBB")
_POLYNOMIAL = 0x2F


@dataclass(frozen=True, slots=True)
class BoxFrame:
    """A frame with a good CRC.

    Attributes:
        number: counts, inserted counts, or what INFO and LATCH say in it.
        sequence: 0 to 255; of the latch or the command that it belongs to.
        boot: number of the box's start, 1 to 255; 0: not known.
        bits: of LATCH, or the status of the box.
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
    """What stands in an INFO frame's number: version (8 bits), axes (8 bits), time until it holds (16 bits)."""
    number: int = struct.unpack("<i", struct.pack("<BBH", version, axes, hold_after_ms))[0]
    return number


def info_of(number: int) -> tuple[int, int, int]:
    """Version, axes and the silence after which the box holds, ms."""
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

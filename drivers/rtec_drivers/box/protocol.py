"""RTEC box link, version 1: frames of the line between rtec and a box that counts and inserts.

The document is `docs/rtec-box-link.md`; its test vectors are checked against this file. A frame is

    00  COBS(version, type, sequence, payload, CRC-32)  00

Numbers are little-endian. The zero byte ends a frame and is nowhere else, so after any damage the next frame can be
read.
"""

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

VERSION = 1
HELLO, READ, COMMAND, RESUME = 0x01, 0x02, 0x03, 0x04
INFO, STATE = 0x81, 0x82
MAX_AXES = 16
LONGEST_BODY = 254
"""Largest body, bytes, that COBS holds in one block; no frame of this version is longer."""

NOT_RESUMED = 0x01
"""The box restarted and inserts nothing until it is ordered to resume."""
HELD_BY_SILENCE = 0x02
"""No command came for longer than `hold_after_ms`: the box keeps its ledger."""
MOVING = 0x04
"""The ledger is on its way to the commanded one."""
ENCODER_FAULT = 0x08
"""The box has an impossible encoder signal (both lines at once, wire broken): its counts are invalid."""

_HEADER = struct.Struct("<BBH")
_CRC = struct.Struct("<I")
_INFO = struct.Struct("<HIBBHI")
_STATE = struct.Struct("<HBHI")
_SHORTEST = _HEADER.size + _CRC.size


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame with a correct CRC.

    Attributes:
        kind: HELLO to STATE.
        sequence: 0 to 65535; an answer has that of its question.
        payload: the remaining bytes.
        version: version of the protocol.
    """

    kind: int
    sequence: int
    payload: bytes = b""
    version: int = VERSION


@dataclass(frozen=True, slots=True)
class Info:
    """A box's description of itself.

    Attributes:
        boot: differs after every start of the box.
        box_serial: number of this box.
        axes: number of axes.
        counter_bits: width of its encoder counters.
        hold_after_ms: silence after which it holds.
        counts_per_s: highest rate at which it inserts.
    """

    boot: int
    box_serial: int
    axes: int
    counter_bits: int
    hold_after_ms: int
    counts_per_s: int


@dataclass(frozen=True, slots=True)
class BoxState:
    """State of a box at one instant.

    Attributes:
        boot: as in `Info`.
        status: NOT_RESUMED and the other bits.
        last_command: sequence number of the last accepted command.
        time_us: the box's own clock at the instant of latching, 32 bits, wrapping.
        counts: raw counters, unsigned, as wide as `counter_bits`.
        ledger: counts that are inserted at present, signed.
    """

    boot: int
    status: int
    last_command: int
    time_us: int
    counts: tuple[int, ...]
    ledger: tuple[int, ...]


def encode(frame: Frame) -> bytes:
    """The bytes on the wire, with the zero byte before and after."""
    body = _HEADER.pack(frame.version, frame.kind, frame.sequence) + frame.payload
    body += _CRC.pack(zlib.crc32(body))
    return b"\0" + cobs(body) + b"\0"


def decode(block: bytes) -> Frame | None:
    """The frame between two zero bytes; None where it is damaged, or not a frame."""
    body = uncobs(block)
    if body is None or len(body) < _SHORTEST:
        return None
    if zlib.crc32(body[:-4]) != _CRC.unpack_from(body, len(body) - 4)[0]:
        return None
    version, kind, sequence = _HEADER.unpack_from(body)
    return Frame(kind, sequence, body[4:-4], version)


def cobs(body: bytes) -> bytes:
    """Remove the zeros from at most 254 bytes (consistent overhead byte stuffing, one block).

    Raises:
        ValueError: more bytes than that.
    """
    if len(body) > LONGEST_BODY:
        raise ValueError(f"a body of {len(body)} bytes; at most {LONGEST_BODY} fit into a frame")
    pieces = body.split(b"\0")
    # 254 bytes without a zero get the code 255, which means that no zero follows: the same as one block's end.
    return b"".join(bytes((len(piece) + 1,)) + piece for piece in pieces)


def uncobs(block: bytes) -> bytes | None:
    """Restore the zeros; None where the codes do not add up."""
    out, at, end = [], 0, len(block)
    if not 0 < end <= LONGEST_BODY + 1:
        return None
    while at < end:
        code = block[at]
        if not code:  # a block contains no zero
            return None
        out.append(block[at + 1 : at + code])
        at += code
    return b"\0".join(out) if at == end else None


class FrameReader:
    """Bytes in, frames out; keeps at most one unfinished frame.

    Attributes:
        bad: number of blocks, so far, that were no frame.
    """

    def __init__(self) -> None:
        self.bad = 0
        self._rest = b""

    def feed(self, received: bytes) -> list[Frame]:
        """The good frames that these bytes complete, in order."""
        *blocks, rest = (self._rest + received).split(b"\0")
        # A block longer than any frame is garbage; two bytes more than the longest block mark it as such for good.
        self._rest = rest[: LONGEST_BODY + 3]
        out = []
        for block in blocks:
            if block:
                frame = decode(block)
                if frame is None:
                    self.bad += 1
                else:
                    out.append(frame)
        return out


def command_payload(boot: int, targets: Sequence[int]) -> bytes:
    """Payload of COMMAND: inserted counts of every axis, absolute, for the box that started as `boot`.

    Raises:
        struct.error: a number that does not fit into 32 bits.
    """
    return struct.pack(f"<H{len(targets)}i", boot, *targets)


def resume_payload(boot: int) -> bytes:
    """Payload of RESUME, for the box that started as `boot`."""
    return struct.pack("<H", boot)


def info_of(payload: bytes) -> Info | None:
    """Content of an INFO; None where it is too short. Of a longer one the known part is read."""
    return Info(*_INFO.unpack_from(payload)) if len(payload) >= _INFO.size else None


def state_of(payload: bytes) -> BoxState | None:
    """Content of a STATE; None where the length is wrong."""
    axes, rest = divmod(len(payload) - _STATE.size, 8)
    if rest or not 0 < axes <= MAX_AXES:
        return None
    pairs = struct.unpack_from("<" + "Ii" * axes, payload, _STATE.size)
    boot, status, last_command, time_us = _STATE.unpack_from(payload)
    return BoxState(boot, status, last_command, time_us, pairs[0::2], pairs[1::2])

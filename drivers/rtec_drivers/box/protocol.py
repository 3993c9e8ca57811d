"""RTEC box link, version 1: frames of the line between rtec and a box that counts and inserts.

The document is `docs/rtec-box-link.md`; its test vectors are checked against this file. A frame is

    00  COBS(version, type, sequence, payload, CRC-32)  00

Numbers are little-endian. The zero byte ends a frame and is nowhere else, so after any damage the next frame can be
read.

`BoxLedger` is the driver's side of the box's commands: the ledger, and whether the box may be commanded.
"""

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

from rtec.errors import DriverFault, DriverTimeout
from rtec.loop.ports import HOLDS

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


LARGEST = 2**31 - 1
PATIENT_TRIES = 10
"""Orders to resume that may be lost on the way before that is reported."""


class BoxLedger:
    """The driver's side of the box's ledger.

    A box that restarted (another boot number, or its bit NOT_RESUMED) is not commanded until `order_resume`.

    Attributes:
        counts: the box's newest ledger; None before the first report.
        boot: boot number of the commanded box.
        must_resume: why it waits for an order; "" where it does not.
        pending: must the order to resume go out with the next command?

    Args:
        step_counts: the first command may differ from the box's ledger by at most this.
        timeout_s: longest time without an accepted command.
    """

    def __init__(self, step_counts: int, timeout_s: float) -> None:
        self._step, self._timeout_ns = step_counts, round(timeout_s * 1e9)
        self.counts: tuple[int, ...] | None = None
        self.order_resume()

    def order_resume(self) -> None:
        """Accept the present box, and command it from its ledger."""
        self.must_resume, self.boot, self.counts = "", -1, None
        self.pending, self._tries, self._first = True, 0, True
        self._last_taken, self._waiting_ns = -1, -1

    def reconnected(self) -> None:
        """Restart the time without an accepted command, since the line is back."""
        self._waiting_ns, self._tries = -1, 0

    def stop(self, why: str) -> None:
        """Command nothing until the order comes, for this reason; "" changes nothing."""
        self.must_resume = self.must_resume or why

    def reported(self, state: BoxState) -> None:
        """Process the box's report.

        Raises:
            DriverFault: it does not accept the order to resume.
        """
        self.counts = state.ledger
        if state.last_command != self._last_taken:
            self._last_taken, self._waiting_ns = state.last_command, -1
        why = ""
        if self.boot not in (-1, state.boot):
            why = f"the encoder box restarted (start {state.boot}, before {self.boot}): its ledger is zero again"
        elif self.pending:
            self._take_up(state)
        elif state.status & NOT_RESUMED:
            why = "the encoder box stopped inserting by itself"
        elif state.status & ENCODER_FAULT:
            why = "the encoder box saw a fault of an encoder's signal: the position is not known"
        if why:
            self.stop(f"{why}; {HOLDS}")

    def check_command(self, targets: Sequence[int]) -> None:
        """Check that this may be commanded.

        Raises:
            DriverFault: it waits for an order, the numbers are too large, or the first command is a jump.
            DriverTimeout: the box has not reported its ledger yet.
        """
        if self.must_resume:
            raise DriverFault(self.must_resume)
        if self.counts is None:
            raise DriverTimeout("the encoder box has not told its ledger yet")
        if any(abs(t) > LARGEST for t in targets):
            raise DriverFault(f"inserted counts {list(targets)} do not fit into 32 bits")
        if self._first:
            self._check_first(targets, self.counts)

    def commanded(self, now_ns: int) -> None:
        """Record a command that was sent, with the order to resume where that was pending.

        Raises:
            DriverTimeout: the box has accepted none for too long.
        """
        self._tries += self.pending
        if self._waiting_ns < 0:
            self._waiting_ns = now_ns
        self.check_taken(now_ns)

    def check_taken(self, now_ns: int) -> None:
        """Check that the box accepts commands; called in every cycle, whether a command was sent or not.

        Raises:
            DriverTimeout: it has accepted none for too long.
        """
        if 0 <= self._waiting_ns < now_ns - self._timeout_ns:
            raise DriverTimeout(f"the encoder box has taken no command for {(now_ns - self._waiting_ns) * 1e-9:.2f} s")

    def _take_up(self, state: BoxState) -> None:
        self.boot = state.boot
        if state.status & ENCODER_FAULT:
            raise DriverFault("the encoder box sees, or saw, a fault of an encoder's signal")
        self.pending = bool(state.status & NOT_RESUMED)
        if self.pending and self._tries > PATIENT_TRIES:
            raise DriverFault("the encoder box does not take the order to resume")

    def _check_first(self, targets: Sequence[int], has: Sequence[int]) -> None:
        furthest = max(abs(t - h) for t, h in zip(targets, has, strict=True))
        if furthest > self._step:
            raise DriverFault(
                f"the first command {list(targets)} is {furthest} counts off what the encoder box has, {list(has)}: "
                "refused; the loop must take over the box's ledger first"
            )
        self._first = False

"""Encoder box on a CAN bus: reads latched counts, inserts counts; one frame an axis (`docs/can.md`).

RTEC box link over CAN, version 1. Every frame has 8 bytes: a signed 32-bit number, a sequence number, the box's boot
number, a byte of bits, and a CRC-8 over identifier and content. CAN's own CRC ends at the controller; this one also
covers gateways and slcan, whose text on a serial line has no checksum.
"""

import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, field_validator

from rtec.arrays import Ints
from rtec.correction.sinks import Sink
from rtec.errors import DriverError, DriverFault, DriverTimeout, DriverUnavailable
from rtec.loop.clock import Clock
from rtec.machine import Machine
from rtec.quantities import Counts, MillimetresPerSecond
from rtec_drivers.box.protocol import NOT_RESUMED, BoxLedger, BoxState
from rtec_drivers.can.bus import CanOptions, CanPort, LongestAge
from rtec_drivers.count_tracker import CountTracker, axis_order, max_counts_per_s

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


COUNTER_BITS = 32
REPEAT_NS = 20_000_000
ASK_S = 0.05


class CanBoxOptions(CanOptions):
    """Options of an encoder box on a CAN bus.

    Attributes:
        base_id: first identifier of the box; a multiple of 64. The box uses 64 identifiers.
        axes: the box's inputs in order, by the machine's axis names; not given: the machine's order.
        max_speed_mm_s: highest speed of each axis; faster counts are refused.
        timeout_ms: a reading older than this is reported as missing. Not given: 2.5 cycles, and 20 ms at least.
        open_timeout_s: longest wait for the box when its interface is opened.
        command_timeout_s: longest time without an accepted command before that is reported.
        resume_step_counts: the first command after a start or an order to resume may differ from the box's ledger
            by at most this.
    """

    base_id: Annotated[int, Field(ge=0x40, le=0x780)] = 0x140
    axes: tuple[str, ...] | None = None
    max_speed_mm_s: dict[str, MillimetresPerSecond]
    timeout_ms: Annotated[float, Field(ge=1e-3, le=1000)] | None = None
    open_timeout_s: Annotated[float, Field(ge=0.1, le=30)] = 2.0
    command_timeout_s: Annotated[float, Field(ge=1e-4, le=10)] = 0.2
    resume_step_counts: Counts = 16

    @field_validator("base_id")
    @classmethod
    def _block(cls, value: int) -> int:
        if value % BLOCK:
            raise ValueError("must be a multiple of 64 (0x40)")
        return value


class CanBoxDriver:
    """Encoder box on a CAN bus.

    Each reading sends a LATCH frame and gives the result of the one before: it is a cycle old, and its instant is that
    of its LATCH frame. Commands are absolute and have the box's boot number: a lost or repeated frame loses nothing,
    and a box that restarted accepts none of them. The driver then refuses readings and commands, and reports why, until
    `resume` is called (or the run is started again).

    Args:
        options: options of the run file.
        machine: machine with the axes of the arrays.
        clock: clock of instants and deadlines.
        base: not used, as there are no files.

    Raises:
        ConfigError: axes or speeds do not fit the machine.
    """

    options_model = CanBoxOptions
    TAKES = ("pulse",)
    EXAMPLE = """\
[device.box]
driver = "can_box"
interface = "socketcan"
channel = "can0"
base_id = 0x140
max_speed_mm_s = { X = 400, Z = 400 }    # faster counts are refused
"""

    def __init__(self, options: CanBoxOptions, machine: Machine, clock: Clock, base: Path = Path()) -> None:
        del base
        self._options, self._clock = options, clock
        self._order = axis_order(options.axes, machine)
        limits = max_counts_per_s(options.max_speed_mm_s, machine)
        names = [machine.axis_names[i] for i in self._order]
        self._tracker = CountTracker(names, COUNTER_BITS, [limits[i] for i in self._order])
        self._ledger = BoxLedger(options.resume_step_counts, options.command_timeout_s)
        axes = range(len(self._order))
        hears = [INFO, *(place + k for place in (COUNTS, LEDGER) for k in axes)]
        self._port = CanPort(options, clock, [(options.base_id + n, False) for n in hears], self._hear)
        self._where = f"{options.place}: the encoder box at {options.base_id:#x}"
        self._sent: tuple[int, ...] | None = None
        self._sent_ns = 0
        self._digested: Latched | None = None
        self._good: tuple[tuple[int, ...], int] | None = None
        self._longest = LongestAge(options.timeout_ms)
        self._session = self._new_session()

    def __enter__(self) -> Self:
        """Open the interface and greet the box. Starting a run is an order to resume.

        Raises:
            DriverUnavailable, DriverTimeout, DriverFault: where the options have `at_start = "required"`.
        """
        self._session = self._new_session()
        self.resume()
        self._port.open()
        try:
            self._greet()
        except DriverError:
            if self._options.at_start == "required":
                self._port.close()
                raise
        return self

    def __exit__(self, *error: object) -> None:
        """Hold, then close."""
        self.hold()
        self._port.close()

    @property
    def supply(self) -> int:
        """Number of the box's start; -1 where it is not known."""
        newest = self._session.newest
        return -1 if newest is None else newest.boot

    @property
    def must_resume(self) -> str:
        """Why it waits for an order to resume; "" where it does not."""
        return self._ledger.must_resume

    def resume(self) -> None:
        """Go on after a reset of the box or a lost position: its ledger and counts are accepted as they are.

        The caller must take over the ledger (`read_output`) before the next command.
        """
        self._ledger.order_resume()
        self._tracker.restart()
        self._sent = self._good = None

    def read_counts(self, counts: Ints) -> int:
        """Fill in the newest raw counts; give the instant of their LATCH frame, ns.

        Raises:
            DriverTimeout: they are older than `timeout_ms`, or there are none yet.
            DriverFault: counts that are not possible, or a box that waits for an order to resume.
            DriverUnavailable: the interface is not open; it is being reopened.
        """
        self._port.check()
        now_ns = self._clock.now_ns()
        longest_ns = self._longest.reads(now_ns)
        self._latch()
        self._digest()
        if self._ledger.must_resume:
            raise DriverFault(self._ledger.must_resume)
        if self._good is None:
            raise DriverTimeout(f"{self._where} does not answer")
        values, asked_ns = self._good
        if (age_ns := now_ns - asked_ns) > longest_ns:
            raise DriverTimeout(f"{self._where} has sent no counts for {age_ns * 1e-6:.0f} ms")
        for value, axis in zip(values, self._order, strict=True):
            counts[axis] = value
        return asked_ns

    def refuses(self, sink: Sink) -> str:
        """Refuse all but pulses."""
        return "" if sink.kind == "pulse" else f"inserts counts: it takes 'pulse', not {sink.kind!r}"

    def apply(self, output: Ints) -> None:
        """Command the inserted counts of every axis, absolute. Does not wait.

        Frames go out when the command changes, and every 20 ms: the next frame makes good for a lost one.

        Raises:
            DriverFault: the box waits for an order to resume, or the command would be a jump.
            DriverTimeout: the interface accepts no frames, or the box accepts no commands.
            DriverUnavailable: the interface is not open.
        """
        self._port.check()
        targets = tuple(int(output[axis]) for axis in self._order)
        self._ledger.check_command(targets)
        now_ns = self._clock.now_ns()
        if targets == self._sent and now_ns - self._sent_ns < REPEAT_NS:
            self._ledger.check_taken(now_ns)
            return
        self._session.command(targets, self._ledger.boot)
        self._sent, self._sent_ns = targets, now_ns
        self._ledger.commanded(now_ns)

    def read_output(self, output: Ints) -> None:
        """Fill in the box's newest ledger.

        Raises:
            DriverUnavailable: it has not reported one yet.
        """
        if self._ledger.counts is None:
            raise DriverUnavailable(f"{self._options.place}: the encoder box has not told its ledger yet")
        for value, axis in zip(self._ledger.counts, self._order, strict=True):
            output[axis] = value

    def hold(self) -> None:
        """Send nothing: the box keeps the last command's ledger, and holds by itself when no more commands come."""

    def faults(self) -> list[str]:
        """Present faults, one line each."""
        texts = (self._port.trouble, self._port.warning, self._ledger.must_resume)
        return [text for text in texts if text]

    def _new_session(self) -> CanBoxSession:
        self._digested = self._good = None
        return CanBoxSession(self._options.base_id, len(self._order), self._port_send)

    def _port_send(self, identifier: int, data: bytes) -> None:
        self._port.send(identifier, data)

    def _hear(self, identifier: int, extended: bool, data: bytes, now_ns: int) -> None:
        self._session.take(identifier, extended, data, now_ns)

    def _greet(self) -> None:
        deadline_ns = self._clock.now_ns() + round(self._options.open_timeout_s * 1e9)
        while self._clock.now_ns() < deadline_ns:
            self._session.came.clear()
            if not self._port.trouble:
                self._latch()
            self._session.came.wait(ASK_S)
            if self._session.info is not None:
                self._check_info(*self._session.info[:2])
                self._digest()
            if self._ledger.boot > 0:
                return
        raise DriverTimeout(f"{self._where} does not answer within {self._options.open_timeout_s:g} s")

    def _check_info(self, version: int, axes: int) -> None:
        if version != VERSION:
            raise DriverFault(f"{self._where} speaks version {version} of the link, rtec {VERSION}")
        if axes != len(self._order):
            raise DriverFault(f"{self._where} has {axes} axes, the machine {len(self._order)}")

    def _latch(self) -> None:
        self._session.latch(self._ledger.boot < 0, self._clock.now_ns())

    def _digest(self) -> None:
        """Take over a new reading of counts and ledger, once."""
        newest = self._session.newest
        if newest is None or newest is self._digested:
            return
        self._digested = newest
        ledger = self._session.ledger(newest.boot)
        not_yet = self._ledger.boot < 0 and newest.status & NOT_RESUMED
        if ledger is not None and not not_yet:
            values, last_command = ledger
            self._ledger.reported(BoxState(newest.boot, newest.status, last_command, 0, newest.counts, values))
        try:
            self._good = (self._tracker.update(newest.counts, newest.asked_ns, newest.came_ns), newest.asked_ns)
        finally:
            self._ledger.stop(self._tracker.lost)

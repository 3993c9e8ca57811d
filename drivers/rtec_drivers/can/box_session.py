"""One conversation with an encoder box on a CAN bus: latches sent, frames put together again."""

import threading
from collections.abc import Callable
from dataclasses import dataclass

from rtec.errors import DriverError
from rtec_drivers.can import can_box_frames as frames
from rtec_drivers.can.can_box_frames import BoxFrame

PATIENCE_NS = 50_000_000
"""After so long a silence the box is asked less often,"""
ASK_PERIOD_NS = 20_000_000
"""namely so often."""
LATEST_NS = 5_000_000_000
"""An answer comes within this, or never; a number is used again after 256 questions."""


@dataclass(frozen=True, slots=True)
class Latched:
    """Counts of all axes from one latch.

    Attributes:
        counts: raw counters, signed, 32 bits.
        status: bits of `box_protocol`, of all axes together.
        boot: number of the box's start.
        asked_ns, came_ns: when the LATCH frame went out, and when the last axis had answered.
    """

    counts: tuple[int, ...]
    status: int
    boot: int
    asked_ns: int
    came_ns: int


class CanBoxSession:
    """What has come from the box; filled by the interface's thread, read by the loop.

    Args:
        base_id: first identifier of the box.
        axes: how many.
        send: hands a frame to the interface.

    Attributes:
        newest: the newest whole reading.
        info: version, axes and silence after which it holds, ms; None before it told.
        boot: number of the box's start; 0 before it told.
        came: is set whenever a good frame came.
        bad: frames with a wrong CRC or length.
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
        """Ask for counts and ledger; order to resume where that is wanted and the box's start is known.

        After a silence less often, and never by a number whose answer may still come: it would be taken for a new one.
        """
        number = (self._latch + 1) & 0xFF
        last_ns = self._asked_ns.get(self._latch)
        if last_ns is not None and now_ns - self._heard_ns > PATIENCE_NS and now_ns - last_ns < ASK_PERIOD_NS:
            return
        if now_ns - self._asked_ns.get(number, now_ns - LATEST_NS) < LATEST_NS:
            return
        self._latch = number
        bits = frames.WANT_LEDGER | (0 if self.info else frames.WANT_INFO)
        if resume and self.boot:
            bits |= frames.RESUME
        self._asked_ns[self._latch] = now_ns
        try:
            self.send(frames.LATCH, BoxFrame(frames.VERSION, self._latch, self.boot, bits))
        except DriverError:  # it never left, so no answer comes
            self._asked_ns.pop(self._latch, None)
            raise

    def command(self, targets: tuple[int, ...], boot: int) -> None:
        """Send inserted counts, one frame an axis."""
        self._command = (self._command + 1) & 0xFF
        for k, target in enumerate(targets):
            self.send(frames.COMMAND + k, BoxFrame(target, self._command, boot))

    def ledger(self, boot: int) -> tuple[tuple[int, ...], int] | None:
        """Inserted counts that the box told in this start of it, and the number of the command taken last."""
        told = [self._ledgers.get(k) for k in range(self._axes)]
        same = [f for f in told if f is not None and f.boot == boot]
        return (tuple(f.number for f in same), same[-1].sequence) if len(same) == self._axes else None

    def send(self, place: int, frame: BoxFrame) -> None:
        """Send one frame."""
        identifier = self._base + place
        self._send(identifier, frames.pack(identifier, frame))

    def take(self, identifier: int, extended: bool, data: bytes, now_ns: int) -> None:
        """Take in a frame that came."""
        frame = None if extended else frames.unpack(identifier, data)
        if frame is None:
            self.bad += 1
            return
        place = identifier - self._base
        if place == frames.INFO:
            self.info, self.boot = frames.info_of(frame.number), frame.boot
        elif place >= frames.LEDGER:
            self._ledgers[place - frames.LEDGER] = frame
        elif place >= frames.COUNTS:
            self._part(place - frames.COUNTS, frame, now_ns)
        self.came.set()

    def _part(self, axis: int, frame: BoxFrame, now_ns: int) -> None:
        """A reading is whole when all axes carry the number of the same latch."""
        self._parts[axis] = frame
        same = [f for f in self._parts.values() if f.sequence == frame.sequence and f.boot == frame.boot]
        asked_ns = self._asked_ns.pop(frame.sequence, None) if len(same) == self._axes else None
        if asked_ns is None:
            return
        status = 0
        for part in same:
            status |= part.bits
        counts = tuple(self._parts[k].number for k in range(self._axes))
        for old in [n for n, t in list(self._asked_ns.items()) if t < asked_ns]:  # a bus keeps frames in order
            self._asked_ns.pop(old, None)
        self._heard_ns = now_ns
        self.boot = frame.boot
        self.newest = Latched(counts, status, frame.boot, asked_ns, now_ns)
        self._parts.clear()

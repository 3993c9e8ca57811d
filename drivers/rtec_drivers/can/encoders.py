"""Encoders on a CAN bus (CANopen profile CiA 406, or any with a DBC file) as one count source."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import Field

from rtec.arrays import Ints
from rtec.errors import ConfigError, DriverError, DriverFault, DriverTimeout
from rtec.files import beside
from rtec.loop.clock import Clock
from rtec.loop.ports import Scanner
from rtec.machine import Axis, Machine
from rtec.quantities import MillimetresPerSecond
from rtec.tomlfile import nearest, validated
from rtec_drivers.can.bus import CanOptions, CanPort, LongestAge
from rtec_drivers.can.scan import CanScanner
from rtec_drivers.can.signals import Dbc, NodeOptions, NodeWatch, SignalOptions, SignalSource
from rtec_drivers.can.sync_book import SyncBook
from rtec_drivers.count_tracker import CountTracker

SYNC = 0x080
LAST_SHORT = 0x7FF
"""Largest identifier of 11 bits."""
Reading = tuple[tuple[int, ...], int, int]
"""Counters of all axes, and the two instants between which they were latched, ns."""


class EncoderSignal(SignalOptions):
    """The position of one axis, in counts.

    Attributes:
        max_speed_mm_s: highest speed of the axis; faster counts are refused.
    """

    max_speed_mm_s: MillimetresPerSecond


class CanEncoderOptions(CanOptions):
    """Options of encoders on a CAN bus.

    Attributes:
        dbc: file with messages and signals; a relative path starts at the run file's folder.
        axis: signals by axis; all of the machine's.
        bits: width of the position value; it wraps there.
        sync: send SYNC, so that all encoders latch at the same instant (their PDOs must be synchronous, type 1).
            Without it each position has the instant of its own frame, and the reading has that of the oldest.
        timeout_ms: a reading older than this is reported as missing. Not given: 2.5 cycles, and 20 ms at least.
        node: CANopen devices to watch, by a name of your choice.
    """

    dbc: Path | None = None
    axis: dict[str, EncoderSignal]
    bits: Annotated[int, Field(ge=8, le=64)] = 32
    sync: bool = True
    timeout_ms: Annotated[float, Field(ge=1e-3, le=10_000)] | None = None
    node: dict[str, NodeOptions] = Field(default_factory=dict)


class CanEncodersDriver:
    """Encoders on a CAN bus: the counts of all axes.

    With `sync` each reading sends the next SYNC and gives the result of the one before: it is a cycle old, as its
    instant shows. The next SYNC waits until all encoders have answered the one before. Where one does not answer, no
    reading is given until it is certain which SYNC the next answers belong to (`SyncBook`), so no position is assigned
    to the wrong instant.

    Args:
        options: options of the run file.
        machine: machine with the axes of the array.
        clock: clock of the instants.
        base: folder at which relative paths start.

    Raises:
        ConfigError: an axis, message or signal does not exist, or an axis is missing.
    """

    options_model = CanEncoderOptions
    EXAMPLE = """\
[device.scales]
driver = "can_encoders"
interface = "socketcan"
channel = "can0"
bits = 25                          # single turn 13 bits, 4096 turns

# CiA 406: object 6004h, position value, in the first PDO.
[device.scales.axis.X]
node = 10
pdo = 1
map = ["u32"]
max_speed_mm_s = 500

[device.scales.axis.Z]
node = 11
pdo = 1
map = ["u32"]
max_speed_mm_s = 500
"""

    @classmethod
    def scanner(cls, table: Mapping[str, Any], clock: Clock) -> Scanner:
        """A scanner that lists the received frames and the bytes that change."""
        way = {key: value for key, value in table.items() if key in CanOptions.model_fields}
        return CanScanner(validated(CanOptions, way, "can_encoders"), clock, "axis")

    def __init__(self, options: CanEncoderOptions, machine: Machine, clock: Clock, base: Path = Path()) -> None:
        names = machine.axis_names
        wrong = [f"axis {n!r}: the machine has no such axis{nearest(n, names)}" for n in options.axis if n not in names]
        wrong += [f"axis {n!r} is missing" for n in names if n not in options.axis]
        if wrong:
            raise ConfigError("\n".join(wrong))
        self._options, self._clock, self._names = options, clock, names
        dbc = Dbc(None if options.dbc is None else beside(base, options.dbc))
        self._sources = [dbc.source(options.axis[n], scaled=False) for n in names]
        wrong = [
            f"axis {n!r}: bits = {options.bits}, but its number in the frame has {s.bits}: it would wrap unseen"
            for n, s in zip(names, self._sources, strict=True)
            if options.bits > s.bits
        ]
        wrong += [
            f"axis {a.name!r}: a counter of {options.bits} bits goes round within its travel, "
            f"{_span(a):.0f} counts: its position would be ambiguous"
            for a in machine.axes
            if _span(a) >= 2**options.bits
        ]
        if wrong:
            raise ConfigError("\n".join(wrong))
        fastest = [options.axis[a.name].max_speed_mm_s * a.counts_per_mm for a in machine.axes]
        middle = [round(0.5 * sum(a.travel_mm) * a.counts_per_mm) for a in machine.axes]
        self._tracker = CountTracker(names, options.bits, fastest, middle)
        self._nodes = NodeWatch(list(options.node.values()))
        filters = {(s.identifier, s.extended) for s in self._sources} | set(self._nodes.identifiers())
        # A wrong length of the identifier is to be named, so it must pass the filter.
        filters |= {(s.identifier, not s.extended) for s in self._sources if s.identifier <= LAST_SHORT}
        self._port = CanPort(options, clock, sorted(filters), self._frame)
        self._pending: dict[int, tuple[int, int]] = {}
        self._book = SyncBook(len(names))
        self._unusable = [""] * len(names)
        self._newest: Reading | None = None
        self._used: Reading | None = None
        self._counts: tuple[int, ...] | None = None
        self._instant_ns = -(2**62)
        self._longest = LongestAge(options.timeout_ms)

    def __enter__(self) -> Self:
        """Open the interface and start listening."""
        self._forget()
        self._tracker.restart()
        self._port.open()
        return self

    def __exit__(self, *error: object) -> None:
        """Stop listening and close."""
        self._port.close()

    @property
    def must_resume(self) -> str:
        """Why it waits for an order to resume; "" where it does not."""
        return self._tracker.lost

    def resume(self) -> None:
        """Go on after a lost position: the next reading is accepted as it is."""
        self._tracker.restart()
        self._used, self._counts = self._newest, None

    def read_counts(self, counts: Ints) -> int:
        """Fill in the newest positions, counts; give the instant at which they were latched, ns, or the earliest.

        Raises:
            DriverTimeout: they are older than `timeout_ms`, or there are none yet.
            DriverFault: they are not possible: a jump that the machine cannot make.
            DriverUnavailable: the interface is not open.
        """
        self._port.check()
        newest = self._newest
        if newest is not None and newest is not self._used:
            self._used = newest
            raw, earliest_ns, latest_ns = newest
            self._counts, self._instant_ns = self._tracker.update(raw, earliest_ns, latest_ns), earliest_ns
        elif self._tracker.lost:
            raise DriverFault(self._tracker.lost)
        now_ns = self._clock.now_ns()
        longest_ns = self._longest.reads(now_ns)
        if self._options.sync and self._book.due(now_ns, longest_ns):
            self._send_sync(now_ns)
        if self._counts is None or now_ns - self._instant_ns > longest_ns:
            raise DriverTimeout(self._silent(now_ns))
        counts[:] = self._counts
        return self._instant_ns

    def faults(self) -> list[str]:
        """Present faults, one line each."""
        bus = [text for text in (self._port.trouble, self._port.warning, self._tracker.lost) if text]
        return [*bus, *self._nodes.faults(self._clock.now_ns())]

    def _forget(self) -> None:
        self._pending.clear()
        self._book = SyncBook(len(self._names))
        self._unusable = [""] * len(self._names)
        self._newest = self._used = self._counts = None
        self._instant_ns = -(2**62)

    def _send_sync(self, now_ns: int) -> None:
        self._book.sent(now_ns)
        try:
            self._port.send(SYNC, b"")
        except DriverError:
            self._book.not_sent()
            raise

    def _frame(self, identifier: int, extended: bool, data: bytes, now_ns: int) -> None:
        if not extended:
            self._nodes.frame(identifier, data, now_ns)
        come = False
        for k, source in enumerate(self._sources):
            if source.identifier != identifier:
                continue
            if source.extended == extended:
                come = self._take(k, source, data, now_ns) or come
            else:
                self._unusable[k] = _other_length(source)
        if come and (not self._options.sync or self._book.whole(now_ns)) and len(self._pending) == len(self._sources):
            self._complete(now_ns)

    def _take(self, k: int, source: SignalSource, data: bytes, now_ns: int) -> bool:
        """Keep an axis' position; False where it is none, or where no SYNC asked for it."""
        try:
            number = int(source.number(data))
        except (DriverFault, ValueError, OverflowError) as e:  # no number: the reading ages and times out
            self._unusable[k] = str(e) if isinstance(e, DriverFault) else f"{_identifier(source)}: no number ({e})"
            return False
        self._unusable[k] = ""
        if self._options.sync and not self._book.takes(k, now_ns):
            return False
        self._pending[k] = (number, now_ns)
        return True

    def _complete(self, now_ns: int) -> None:
        raw = tuple(self._pending[k][0] for k in range(len(self._sources)))
        earliest_ns = self._book.answered_ns if self._options.sync else min(t for _, t in self._pending.values())
        self._newest = (raw, earliest_ns, now_ns)
        if not self._options.sync:
            self._pending.clear()

    def _silent(self, now_ns: int) -> str:
        longest_ns = self._longest.ns
        waiting = f"can_encoders: no new positions within {longest_ns * 1e-6:.3g} ms"
        unusable = [f"axis {n}: {text}" for n, text in zip(self._names, self._unusable, strict=True) if text]
        if unusable:
            return f"{waiting}: what comes is unusable: {'; '.join(unusable)}"
        late_ns = self._book.late_ns(now_ns, longest_ns)
        if late_ns:
            return (
                f"can_encoders: answers come {late_ns * 1e-6:.3g} ms after SYNC, too late for timeout_ms = "
                f"{longest_ns * 1e-6:.3g}; set timeout_ms = {self._enough_ms(late_ns)} or more, "
                "and counts_max_age_s of [guard] above that, or make the encoders answer sooner"
            )
        missing = [n for k, n in enumerate(self._names) if self._missing(k)] or self._names
        return f"{waiting} (waiting for {', '.join(missing)})"

    def _missing(self, k: int) -> bool:
        return self._book.owes(k) if self._options.sync else k not in self._pending

    def _enough_ms(self, late_ns: int) -> int:
        """A timeout for answers that come this late: a reading is used until the one after it has come."""
        return math.ceil((2 * late_ns + 3 * self._longest.period_ns) * 1e-6)


def _identifier(source: SignalSource) -> str:
    return f"{source.identifier:X}h"


def _other_length(source: SignalSource) -> str:
    came, needed = ("an 11-bit", "a 29-bit") if source.extended else ("a 29-bit", "an 11-bit")
    way_out = (
        "look at the DBC file" if source.extended else "clear bit 29 of the COB-ID in the device's object 1800h ff."
    )
    return f"{_identifier(source)} comes as {came} identifier, {needed} one is needed; {way_out}"


def _span(axis: Axis) -> float:
    """Travel of an axis, counts."""
    return (axis.travel_mm[1] - axis.travel_mm[0]) * abs(axis.counts_per_mm)

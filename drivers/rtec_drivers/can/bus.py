"""A CAN interface that is kept open: a thread receives, sending does not wait, errors of the bus are reported.

Interfaces are python-can's, by its own names: socketcan, slcan, virtual, udp_multicast, pcan, kvaser, ixxat, vector, …
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from rtec.errors import DriverFault, DriverTimeout, DriverUnavailable
from rtec.loop.clock import Clock
from rtec.quantities import Code, Whole
from rtec.tomlfile import Strict
from rtec_drivers.reopen import Backoff, FirstRetry, LongestRetry, Worker

RECEIVE_S = 0.02
"""Longest wait, s, for a frame before the thread checks for its end, and for silent devices."""
GARBLED_TOLD, GARBLED_IN_A_ROW = 3, 20
"""Lines in a row that are no frame: number from which it is reported, and at which the adapter is reopened."""
GARBAGE = "what comes is no frame; look at the adapter's cable and at the rate of its serial port"
BUS_OFF, CONTROLLER, LOST_ARBITRATION, RESTARTED = 0x40, 0x04, 0x02, 0x100
PASSIVE, WARNING, OVERFLOW = 0x30, 0x0C, 0x03
ERROR_CLASSES = (0x04, 0x08, 0x20, 0x40, 0x44, 0x80)
"""Bits of SocketCAN's error frames (linux/can/error.h), which python-can passes on unchanged."""
SHORTEST_AGE_NS = 20_000_000
PERIODS_2 = 5
"""Half periods of reading that a reading may be old."""
LONGEST_PERIOD_NS = 1_000_000_000
"""A loop that stood still for longer than this has no such period."""


class CanOptions(Strict):
    """Options of the interface of a CAN device.

    Attributes:
        interface: python-can's name of the kind.
        channel: name of the interface: "can0", a serial port for slcan, a group address for udp_multicast.
        bitrate: bit/s, where the interface sets it itself (socketcan does not: `ip link set can0 type can bitrate …`).
        settings: further settings of that kind of interface, by python-can's names.
        at_start: "required": the run does not begin without the interface; "later": it may appear at any time.
        first_retry_s, longest_retry_s: wait between two attempts to open; doubled from the first up to the longest.
    """

    interface: str
    channel: str
    bitrate: Annotated[int, Field(ge=5_000, le=1_000_000)] | None = None
    settings: dict[str, str | Whole | Code | bool] = Field(default_factory=dict)
    at_start: Literal["required", "later"] = "required"
    first_retry_s: FirstRetry = 0.1
    longest_retry_s: LongestRetry = 5.0

    @property
    def place(self) -> str:
        """Name of the interface, for people."""
        return f"{self.interface} {self.channel}"


class CanLink:
    """An open interface.

    Args:
        options: interface and its settings.
        filters: identifiers to receive, as (identifier, extended); empty: all.

    Attributes:
        garbled: number of texts in a row, from an adapter on a serial line, that were no frame.

    Raises:
        DriverUnavailable: it cannot be opened, or python-can or its back end is not installed.
    """

    def __init__(self, options: CanOptions, filters: Sequence[tuple[int, bool]]) -> None:
        import can

        self.place, self._errors, self.garbled = options.place, (can.CanError, OSError, ValueError), 0
        settings: Mapping[str, Any] = {**options.settings, **({"bitrate": options.bitrate} if options.bitrate else {})}
        # Interfaces that filter in software filter error frames, too: their classes must pass, or bus-off is missed.
        passed = [*filters, *((n, False) for n in ERROR_CLASSES)] if filters else []
        exact = [{"can_id": n, "can_mask": 0x1FFFFFFF if e else 0x7FF, "extended": e} for n, e in passed]
        try:
            self._bus: Any = can.Bus(
                interface=options.interface, channel=options.channel, can_filters=exact or None, **settings
            )
        except Exception as e:  # back ends without their maker's library raise all kinds of exceptions
            missing = options.channel.startswith("/") and not Path(options.channel).exists()
            package = ": pip install 'rtec[can]'" if "msgpack" in str(e) else ""  # udp_multicast
            why = "no such port; plug it in, or name another" if missing else f"{e}{package}"
            raise DriverUnavailable(f"{self.place}: cannot be opened: {why}") from e

    def receive(self) -> Any:
        """The next frame; None after a short while, or for an adapter's text that is no frame.

        Raises:
            DriverUnavailable: the interface is gone, or only garbage comes.
        """
        try:
            message = self._bus.recv(RECEIVE_S)
        except Exception as e:
            no_text = isinstance(e.__cause__, UnicodeDecodeError)
            if not no_text and not isinstance(e, ValueError | IndexError):
                raise DriverUnavailable(f"{self.place}: is gone: {e}") from e
            self._skip_garbage(no_text)
            return None
        if message is not None:
            self.garbled = 0
        return message

    def _skip_garbage(self, no_text: bool) -> None:
        """Skip a line that is no frame, which is faster than the seconds that it takes to reopen an adapter.

        python-can parses the text of an adapter on a serial line (slcan) without checks: its errors are those of
        numbers and indexes. Bytes that are no text stay in its buffer and would make every later line malformed.
        """
        self.garbled += 1
        if self.garbled > GARBLED_IN_A_ROW:
            raise DriverUnavailable(f"{self.place}: {GARBAGE}")
        if no_text:
            with suppress(*self._errors, AttributeError):
                self._bus.flush()

    def send(self, identifier: int, data: bytes, extended: bool = False) -> None:
        """Pass a frame to the interface without waiting; DriverTimeout where it accepts none now."""
        import can

        try:
            self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=extended), timeout=0)
        except self._errors as e:
            raise DriverTimeout(f"{self.place}: takes no frame: {e}") from e

    def off(self) -> bool:
        """Does the interface report that it has left the bus?"""
        import can

        with suppress(*self._errors, NotImplementedError):
            return bool(self._bus.state is can.BusState.ERROR)
        return False

    def close(self) -> None:
        """Close the interface."""
        with suppress(*self._errors):
            self._bus.shutdown()


class LongestAge:
    """Largest age of a reading that is a cycle old by design, before it counts as missing.

    Args:
        timeout_ms: as given; None: 2.5 times the period of reading, and 20 ms at least: one late answer is no fault.

    Attributes:
        period_ns: newest period of reading, ns; 0 before the second reading.
    """

    def __init__(self, timeout_ms: float | None) -> None:
        self._given, self._last_ns, self.period_ns = timeout_ms, 0, 0

    def reads(self, now_ns: int) -> int:
        """Note a reading; give the largest age, ns."""
        if self._last_ns and now_ns > self._last_ns:
            self.period_ns = min(now_ns - self._last_ns, LONGEST_PERIOD_NS)
        self._last_ns = now_ns
        return self.ns

    @property
    def ns(self) -> int:
        """The largest age, ns."""
        given = self._given
        return max(SHORTEST_AGE_NS, PERIODS_2 * self.period_ns // 2) if given is None else round(given * 1e6)


class CanPort:
    """Keeps an interface open.

    Args:
        options: interface and its settings.
        clock: clock of the frames' instants.
        filters: identifiers to receive; empty: all.
        on_frame: called with identifier, whether it is extended, content and instant, ns, in the port's thread.
        on_idle: called now and then in the port's thread, with the instant, ns.

    Attributes:
        trouble: why the interface is not open, or "".
        warning: the controller's warning (error passive, overflow), or "".
    """

    def __init__(
        self,
        options: CanOptions,
        clock: Clock,
        filters: Sequence[tuple[int, bool]],
        on_frame: Callable[[int, bool, bytes, int], None],
        on_idle: Callable[[int], None] = lambda _: None,
    ) -> None:
        self.trouble, self.warning = "", ""
        self._options, self._clock, self._filters = options, clock, tuple(filters)
        self._on_frame, self._on_idle = on_frame, on_idle
        self._link: CanLink | None = None
        self._worker: Worker[CanLink] | None = None

    @property
    def entered(self) -> bool:
        """Is it open, or being reopened?"""
        return self._worker is not None

    @property
    def attempts(self) -> int:
        """Number of attempts to open the interface in the background."""
        return self._worker.attempts if self._worker is not None else 0

    def open(self) -> None:
        """Open the interface and start listening.

        Raises:
            DriverUnavailable: it cannot be opened, and the options have `at_start = "required"`.
        """
        link, self.trouble = None, ""
        try:
            link = self._connect()
        except DriverUnavailable as e:
            if self._options.at_start == "required":
                raise
            self.trouble = str(e)
        backoff = Backoff(self._options.first_retry_s, self._options.longest_retry_s)
        self._worker = Worker("rtec-can", self._clock, self._connect, self._serve, self._tell, backoff)
        self._worker.start(link)

    def close(self) -> None:
        """Stop listening and close the interface."""
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.stop()

    def send(self, identifier: int, data: bytes, extended: bool = False) -> None:
        """Send a frame without waiting.

        Raises:
            DriverTimeout: the interface accepts none now.
            DriverUnavailable: it is not open.
        """
        link = self._link
        if link is None:
            raise DriverUnavailable(self.trouble or f"{self._options.place}: not open")
        link.send(identifier, data, extended)

    def check(self) -> None:
        """Raise DriverUnavailable while the interface is not open."""
        if not self.entered:
            raise DriverUnavailable(f"{self._options.place}: not entered, so it is not open")
        if self.trouble:
            raise DriverUnavailable(f"{self.trouble}; trying again")

    def _connect(self) -> CanLink:
        self._link = CanLink(self._options, self._filters)
        return self._link

    def _serve(self, link: CanLink) -> None:
        worker = self._worker
        try:
            while worker is not None and not worker.stopping:
                message = link.receive()
                now_ns = self._clock.now_ns()
                if message is None:
                    self._nothing(link, now_ns)
                elif message.is_error_frame:
                    self._error(link, message)
                elif not message.is_remote_frame:
                    worker.backoff.reset()
                    self.warning = ""
                    self._on_frame(message.arbitration_id, message.is_extended_id, bytes(message.data), now_ns)
        finally:
            self._link = None

    def _nothing(self, link: CanLink, now_ns: int) -> None:
        if link.garbled >= GARBLED_TOLD:
            self.warning = f"{link.place}: {GARBAGE}"
        elif link.off():
            raise DriverFault(f"{link.place}: bus-off: look at wiring, termination and bit rate")
        self._on_idle(now_ns)

    def _error(self, link: CanLink, message: Any) -> None:
        if message.arbitration_id & BUS_OFF:
            raise DriverFault(f"{link.place}: bus-off: look at wiring, termination and bit rate")
        detail = message.data[1] if len(message.data) > 1 else 0
        if message.arbitration_id & CONTROLLER and detail & PASSIVE:
            self.warning = f"{link.place}: error passive: nobody acknowledges, or the wiring is bad"
        elif message.arbitration_id & CONTROLLER and detail & OVERFLOW:
            self.warning = f"{link.place}: frames were lost, the computer is too slow for the bus"
        elif message.arbitration_id & ~(LOST_ARBITRATION | RESTARTED | CONTROLLER):
            self.warning = f"{link.place}: errors on the bus (error frame {message.arbitration_id:#x})"

    def _tell(self, why: str) -> None:
        self.trouble = why

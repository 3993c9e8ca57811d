"""Encoder box on a serial port: reads latched counts, inserts counts (RTEC box link, `docs/rtec-box-link.md`)."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Final, Self

from pydantic import Field

from rtec.arrays import Ints
from rtec.correction.sinks import Sink
from rtec.errors import DriverError, DriverFault, DriverTimeout, DriverUnavailable
from rtec.loop.clock import Clock
from rtec.loop.ports import Scanner
from rtec.machine import Machine
from rtec.quantities import Counts, MillimetresPerSecond
from rtec.tomlfile import validated
from rtec_drivers.box import protocol
from rtec_drivers.box.protocol import BoxLedger, Info
from rtec_drivers.box.session import HELLO_PERIOD_S, BoxAnswer, BoxSession
from rtec_drivers.count_tracker import CountTracker, axis_order, max_counts_per_s
from rtec_drivers.reopen import Reopener
from rtec_drivers.serial_line import PortFinder, PortOptions, Ports, SerialLine


class BoxOptions(PortOptions):
    """Options of an encoder box on a serial port.

    Attributes:
        baud: ignored by a box with a USB port of its own.
        axes: the box's inputs in order, by the machine's axis names; not given: the machine's order.
        max_speed_mm_s: highest speed of each axis; faster counts are refused.
        box_serial: number of the box; another box is refused. Not given: any box.
        timeout_ms: longest wait for an answer in a cycle; shorter than the cycle.
        open_timeout_s: longest wait for the box when its port is opened (some boxes restart then).
        command_timeout_s: longest time without an accepted command before that is reported.
        silent_reopen_s: after this time of silence the port is closed and reopened.
        resume_step_counts: the first command after a start or an order to resume may differ from the box's ledger
            by at most this.
    """

    baud: Annotated[int, Field(ge=50, le=20_000_000)] = 1_000_000
    axes: tuple[str, ...] | None = None
    max_speed_mm_s: dict[str, MillimetresPerSecond]
    box_serial: Annotated[int, Field(ge=0, le=2**32 - 1)] | None = None
    timeout_ms: Annotated[float, Field(ge=1e-3, le=100)] = 0.6
    open_timeout_s: Annotated[float, Field(ge=0.1, le=30)] = 3.0
    command_timeout_s: Annotated[float, Field(ge=1e-4, le=10)] = 0.05
    silent_reopen_s: Annotated[float, Field(ge=1e-3, le=600)] = 2.0
    resume_step_counts: Counts = 16


OPEN_S: Final = 3.0
"""Longest wait, s: some boxes restart when their port is opened."""
ANSWER_S: Final = 0.1
PLACE: Final = "input {}"


class BoxScanner:
    """Asks a box for its description and its counts.

    Args:
        options: the port.
        clock: clock of the deadlines.

    Attributes:
        duration: duration of the search, in words.
        info: the box's description; None before its answer.
    """

    def __init__(self, options: PortOptions, clock: Clock) -> None:
        self.duration = f"up to {OPEN_S:g} s"
        self.info: Info | None = None
        self._options, self._clock = options, clock
        self._session: BoxSession | None = None
        self._counts: tuple[int, ...] = ()

    def __enter__(self) -> Self:
        """Open the port.

        Raises:
            DriverUnavailable: it cannot be opened.
        """
        self._session = BoxSession(SerialLine(self._options, PortFinder(self._options).find()), self._clock)
        return self

    def __exit__(self, *error: object) -> None:
        """Close the port."""
        if self._session is not None:
            self._session.line.close()
            self._session = None

    def search(self) -> Iterator[tuple[float, str]]:
        """Greet until the box answers."""
        tries = round(OPEN_S / HELLO_PERIOD_S)
        for k in range(tries):
            yield k / tries, ""
            with suppress(DriverTimeout):
                self.info = info = self._session.greet(HELLO_PERIOD_S) if self._session is not None else None
                if info is not None:
                    yield (
                        1.0,
                        (
                            f"RTEC encoder box number {info.box_serial}: {info.axes} inputs, counters of "
                            f"{info.counter_bits} bits, inserts up to {info.counts_per_s} counts/s"
                        ),
                    )
                    return
        yield 1.0, "no RTEC encoder box answers here"

    def read(self) -> dict[str, float]:
        """Counts by input."""
        if self._session is not None and self.info is not None:
            with suppress(DriverTimeout):
                self._counts = self._session.exchange(ANSWER_S).state.counts
        return {PLACE.format(k + 1): float(count) for k, count in enumerate(self._counts)}

    def proposed(self, names: Sequence[str]) -> dict[str, str]:
        """In order, if the box has as many inputs as the machine has axes."""
        if self.info is None or self.info.axes != len(names):
            return {}
        return {name: PLACE.format(k + 1) for k, name in enumerate(names)}

    def table(self, places: Mapping[str, str], unit: float) -> dict[str, Any]:
        """`axes`, in the order of the inputs, and the number of the box."""
        del unit
        number = {} if self.info is None else {"box_serial": self.info.box_serial}
        return {"axes": sorted(places, key=lambda name: int(places[name].split()[1])), **number}


def _furthest_mm(low_mm: float, high_mm: float) -> float:
    """Largest distance from zero, mm, where zero is the machine's, or any place of the axis."""
    return max(high_mm - low_mm, abs(low_mm), abs(high_mm))


FIRST_WAIT_S = 0.1


class SerialBoxDriver:
    """Encoder box on a serial port.

    One exchange a cycle: `read_counts` asks and waits for the answer, at most `timeout_ms`; `apply` sends the command
    without waiting, since the next answer has the box's ledger. A late answer counts as an older reading. A thread of
    its own reopens a lost line; the box holds meanwhile, and goes on.

    A box that restarted has lost ledger and position. The driver then refuses readings and commands, and reports why,
    until `resume` is called or the run is started again.

    Args:
        options: options of the run file.
        machine: machine with the axes of the arrays.
        clock: clock of instants and deadlines.
        base: not used, as there are no files.
        ports: lists the serial ports; None: pyserial's list.

    Raises:
        ConfigError: axes or speeds do not fit the machine.
    """

    options_model = BoxOptions
    TAKES = ("pulse",)
    EXAMPLE = """\
[device.box]
driver = "serial_box"
port = "/dev/serial/by-id/usb-RTEC_box_0042-if00"
max_speed_mm_s = {X = 400.0, Z = 400.0}    # counts that move faster are refused
"""

    @classmethod
    def scanner(cls, table: Mapping[str, Any], clock: Clock) -> Scanner:
        """A scanner that asks whether a box is at this port, and what its inputs count."""
        way = {key: value for key, value in table.items() if key in PortOptions.model_fields}
        return BoxScanner(
            validated(PortOptions, {"baud": BoxOptions.model_fields["baud"].default, **way}, "serial_box"), clock
        )

    def __init__(
        self, options: BoxOptions, machine: Machine, clock: Clock, base: Path = Path(), ports: Ports | None = None
    ) -> None:
        del base
        self.options, self._machine, self._clock = options, machine, clock
        self._order = axis_order(options.axes, machine)
        limits = max_counts_per_s(options.max_speed_mm_s, machine)
        axes = [machine.axes[i] for i in self._order]
        self._travel_counts = {a.name: _furthest_mm(*a.travel_mm) * abs(a.counts_per_mm) for a in axes}
        self._limits = [limits[i] for i in self._order]
        self._finder = PortFinder(options, ports)
        self._reopener = Reopener(self._connect, _close, clock, options.first_retry_s, options.longest_retry_s)
        self._session: BoxSession | None = None
        self._entered = False
        self._box_serial = options.box_serial
        self._ledger = BoxLedger(options.resume_step_counts, options.command_timeout_s)
        self._tracker = self._new_tracker(32)
        self._last_us = -1

    def __enter__(self) -> Self:
        """Open the port, greet the box and read its ledger. The box gets no command before the first `apply`.

        Starting a run is an order to resume; it goes out with that command.

        Raises:
            DriverUnavailable, DriverTimeout, DriverFault: where the options have `at_start = "required"`.
        """
        self._begin()
        self._entered = True
        self._reopener.start()
        try:
            session = self._connect()
            self._adopt(session)
            with suppress(DriverFault):  # a fault that the box remembers; at the first command it checks again
                self._ledger.reported(self._first_answer(session).state)
        except DriverError as e:
            if self.options.at_start == "required":
                self._leave()
                raise
            self._lose(str(e))
        return self

    def __exit__(self, *error: object) -> None:
        """Hold, then close."""
        self.hold()
        self._leave()

    @property
    def supply(self) -> int:
        """Number of the box's start; -1 where it is not known."""
        return self._ledger.boot

    @property
    def must_resume(self) -> str:
        """Why it waits for an order to resume; "" where it does not."""
        return self._ledger.must_resume

    def resume(self) -> None:
        """Go on after a reset of the box or a lost position: its ledger and counts are accepted as they are.

        The caller must take over the ledger (`read_output`) before the next command.
        """
        self._begin()

    def read_counts(self, counts: Ints) -> int:
        """Fill in the raw counts; give the instant of the question, ns: the counts are not older.

        Raises:
            DriverTimeout: no answer in time.
            DriverFault: counts that are not possible, a frozen box, or one that waits for an order to resume.
            DriverUnavailable: the port is gone; it is being reopened.
        """
        session = self._live()
        try:
            answer = session.talk(self.options.timeout_ms * 1e-3)
        except DriverTimeout:
            if session.silent_s > self.options.silent_reopen_s:
                self._lose(f"{session.line.device}: the encoder box was silent for {session.silent_s:.1f} s")
            raise
        except DriverUnavailable as e:
            self._lose(str(e))
            raise
        values = self._digest(answer)
        for value, axis in zip(values, self._order, strict=True):
            counts[axis] = value
        return answer.asked_ns

    def refuses(self, sink: Sink) -> str:
        """Refuse all but pulses."""
        return "" if sink.kind == "pulse" else f"inserts counts: it takes 'pulse', not {sink.kind!r}"

    def apply(self, output: Ints) -> None:
        """Command the inserted counts of every axis, absolute. Does not wait.

        Raises:
            DriverFault: the box waits for an order to resume, or the command would be a jump.
            DriverTimeout: the port accepts no bytes, or the box accepts no commands.
            DriverUnavailable: the port is gone.
        """
        session = self._live()
        if session.silence:  # by then the box holds, or soon will; so does the loop
            raise DriverTimeout(f"{session.line.device}: {session.silence}")
        targets = [int(output[axis]) for axis in self._order]
        self._ledger.check_command(targets)
        try:
            if self._ledger.pending:
                session.ask(protocol.RESUME, protocol.resume_payload(self._ledger.boot))
            session.send(protocol.COMMAND, protocol.command_payload(self._ledger.boot, targets))
        except DriverUnavailable as e:
            self._lose(str(e))
            raise
        self._ledger.commanded(self._clock.now_ns())

    def read_output(self, output: Ints) -> None:
        """Fill in the box's newest ledger.

        Raises:
            DriverUnavailable: it has not reported one yet.
        """
        if self._ledger.counts is None:
            raise DriverUnavailable(f"{self.options.place}: the encoder box has not told its ledger yet")
        for value, axis in zip(self._ledger.counts, self._order, strict=True):
            output[axis] = value

    def hold(self) -> None:
        """Send nothing: the box keeps the last command's ledger, and holds by itself when no more commands come."""

    def _begin(self) -> None:
        """As after an order to resume: the box's next report is accepted as it is."""
        self._ledger.order_resume()
        self._last_us = -1
        self._tracker.restart()

    def _connect(self) -> BoxSession:
        """Open and greet; called in the reopener's thread, so of the driver it changes only the finder."""
        device = self._finder.find()
        session = BoxSession(SerialLine(self.options, device), self._clock)
        try:
            session.greet(self.options.open_timeout_s)
            session.check(self._box_serial, self._travel_counts)
        except DriverError:
            _close(session)
            raise
        self._finder.remember(device)
        return session

    def _adopt(self, session: BoxSession) -> None:
        self._session, self._last_us = session, -1
        self._box_serial = session.info.box_serial
        self._ledger.reconnected()
        if session.info.counter_bits != self._tracker.bits:
            self._tracker = self._new_tracker(session.info.counter_bits)

    def _new_tracker(self, bits: int) -> CountTracker:
        return CountTracker([self._machine.axis_names[i] for i in self._order], bits, self._limits)

    def _live(self) -> BoxSession:
        if not self._entered:
            raise DriverUnavailable("serial_box: not entered, so its port is not open")
        if self._session is not None:
            return self._session
        session = self._reopener.poll()
        if session is None:
            raise DriverUnavailable(f"{self._reopener.error}; trying again")
        self._adopt(session)
        return session

    def _first_answer(self, session: BoxSession) -> BoxAnswer:
        """Ask until the box answers; only before the first cycle."""
        for _ in range(max(1, round(self.options.open_timeout_s / FIRST_WAIT_S)) - 1):
            with suppress(DriverTimeout):
                return session.exchange(FIRST_WAIT_S)
        return session.exchange(FIRST_WAIT_S)

    def _digest(self, answer: BoxAnswer) -> tuple[int, ...]:
        """The unwrapped counts of a state, if it is valid."""
        state = answer.state
        self._ledger.reported(state)
        if self._ledger.must_resume:
            raise DriverFault(self._ledger.must_resume)
        frozen, self._last_us = state.time_us == self._last_us, state.time_us
        if frozen:
            raise DriverFault(f"{self.options.place}: the encoder box is frozen: its clock stands still")
        try:
            return self._tracker.update(state.counts, answer.asked_ns, answer.answered_ns)
        finally:
            self._ledger.stop(self._tracker.lost)

    def _lose(self, error: str) -> None:
        if self._session is not None:
            _close(self._session)
            self._session = None
        self._reopener.lost(error)

    def _leave(self) -> None:
        self._entered = False
        self._reopener.close()
        if self._session is not None:
            _close(self._session)
            self._session = None


def _close(session: BoxSession) -> None:
    session.line.close()

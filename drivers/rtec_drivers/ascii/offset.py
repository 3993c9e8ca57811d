"""A controller that accepts offsets as lines of text: its actuator, over a serial port or TCP."""

import math
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Self

from rtec.arrays import Ints
from rtec.correction.sinks import Sink
from rtec.errors import DriverError, DriverFault, DriverTimeout, DriverUnavailable
from rtec.loop.clock import Clock
from rtec.loop.ports import HOLDS
from rtec.machine import Machine
from rtec_drivers.ascii.offset_options import ENDS, OffsetOptions, OffsetText
from rtec_drivers.ascii.text import LINE_ENDS, LineReader
from rtec_drivers.byte_line import ByteLine, way_of
from rtec_drivers.reopen import NS, Backoff, Worker

COARSE = 10
"""Units by which a controller that answers in coarser steps is off at most."""
Output = tuple[int, ...]
IDLE_S = 0.1
"""Period, s, of reading lines that the controller sends unasked."""
RETRY_NS = 100_000_000
"""A command that was not accepted, or is not read back, is sent again after this, ns, while the loop repeats it."""
DRAIN_NS = 200_000_000
"""Time, ns, for the last command to leave: 24 characters at 1200 baud."""
MOST_LINES = 64
"""Lines read at once, so that a controller that floods the line does not hold the thread."""


class OffsetAccount:
    """The loop's request, the controller's offsets, and the fault; shared by the loop and the line's thread.

    Args:
        starts_with: offsets of the controller after its own restart; None where they can be read back.
        keeps: does the controller keep its offsets through its own restart?
        words: an output for people.

    Attributes:
        lost: why the controller's offsets are unknown; "" where they are known.
        wake: set when there is a command to send.
    """

    def __init__(self, starts_with: Output | None, keeps: bool, words: Callable[[Output], str] = str) -> None:
        self._words = words
        self.lost, self.wake, self._starts_with, self._keeps = "", threading.Event(), starts_with, keeps
        self._lock = threading.Lock()
        self._has: Output | None = None
        self._requested: Output | None = None
        self._sent: Output | None = None
        self._may_send = False
        self._trouble: DriverError | None = DriverUnavailable("not opened yet")
        self._refusal: DriverError | None = None

    def order(self, output: Output) -> None:
        """Request this output, unless the controller has it; after a refusal it is sent all the same, to be accepted.

        Raises:
            DriverError: it waits for an order to resume, or the controller accepts no commands.
        """
        with self._lock:
            if self.lost:
                raise DriverFault(self.lost)
            if output != self._has or self._refusal is not None:
                self._requested = output
                self.wake.set()
            if trouble := self._trouble or self._refusal:
                raise trouble

    def has(self) -> Output:
        """The controller's offsets.

        Raises:
            DriverError: they have not been read yet.
        """
        with self._lock:
            if self._has is None:
                raise self._trouble or DriverUnavailable("the controller has not said yet which offsets it has")
            return self._has

    def set_from_earlier_run(self, output: Output) -> None:
        """Take over the controller's offsets from an earlier run."""
        with self._lock:
            self._has = output

    def take(self) -> Output | None:
        """The output to command now, once; None for nothing."""
        with self._lock:
            self.wake.clear()
            requested, self._requested = self._requested, None
            if requested is None or self.lost or (requested == self._has and self._refusal is None):
                return None
            self._may_send = True
            return requested

    def sends(self, output: Output) -> bool:
        """May the command that was taken still go out? Not once the controller has lost its offsets: it would jump."""
        with self._lock:
            if self._may_send:
                self._sent = output
            return self._may_send

    def agrees(self, output: Output) -> bool:
        """Has the controller this output, and did it accept the command?"""
        with self._lock:
            return self._has == output and self._refusal is None

    def accepted(self, output: Output, confirmed: bool) -> None:
        """Record an accepted command; `confirmed`: the controller has its offsets, too."""
        with self._lock:
            self._refusal = None
            if confirmed:
                self._has, self._sent = output, None

    def refused(self, refusal: DriverError) -> None:
        """Record a refused command."""
        with self._lock:
            self._refusal = refusal

    def read_back(self, output: Output) -> None:
        """Record offsets read back: those before, by axis those sent since, or others, which mean a restart."""
        with self._lock:
            known = [k for k in (self._has, self._sent) if k is not None]
            if self._has is not None and any(x not in {k[i] for k in known} for i, x in enumerate(output)):
                why = f"the controller has {self._words(output)}, and was commanded {self._words(known[-1])}"
                off = max(abs(a - b) for a, b in zip(output, known[-1], strict=True))
                if off <= COARSE:
                    why += " (does it answer in steps coarser than resolution_um? Make that and the output's as coarse)"
                self._lose(why)
            self._has, self._trouble = output, None

    def restarted(self, line: str) -> None:
        """Record a line that the controller prints after a restart."""
        with self._lock:
            self._lose(f"the controller restarted: {line[:60]!r}")
            if not self._keeps:
                self._has, self._sent = self._starts_with, None

    def well(self) -> None:
        """Record that the line is open, without a known fault."""
        with self._lock:
            self._trouble = None

    def fail(self, trouble: DriverError) -> None:
        """Record that the controller cannot be reached, or that its answers make no sense."""
        with self._lock:
            self._trouble = trouble

    def resume(self) -> None:
        """Accept the controller's present offsets."""
        with self._lock:
            self.lost = ""

    def _lose(self, why: str) -> None:
        self._requested, self._may_send = None, False
        self.lost = self.lost or f"{why}: check a known position; {HOLDS}"


class AsciiOffsetDriver:
    """Controller that accepts an offset for each axis as a line of text, over a serial port or TCP.

    A thread of its own sends the newest command, waits for the acknowledgement, and reads the offsets back before and
    after it where the controller can report them; the loop never waits. A command is sent again only when the loop
    repeats it, so that an outdated one moves nothing. Where the controller cannot report its offsets, the driver is a
    `OneWay`.

    Args:
        options: options of the run file.
        machine: machine with the axes of the outputs.
        clock: clock of the deadlines.
        base: not used, as there are no files.

    Raises:
        ConfigError: the lines do not fit the machine, or print too few digits.
    """

    options_model = OffsetOptions
    EXAMPLE = """\
[device.offsets]
driver = "ascii_offset"
serial = {port = "/dev/serial/by-id/usb-FTDI_FT232R_A5069RR4-if00-port0", baud = 19200, parity = "even"}
# or: tcp = {host = "192.168.1.60", port = 5000}
command = ["OFS X={X:.4f} Z={Z:.4f}"]          # mm with four decimals: OFS X=-0.0124 Z=0.0035
unit = "mm"
resolution_um = 0.1                            # also that of [output.X] and [output.Z]
factor = {X = 2.0}                             # this controller takes X as a diameter
acknowledge = "OK"
refuse = "ERR.*"
ask = "OFS?"                                   # leave both out where it cannot say
answer = 'OFS X=(?P<X>\\S+) Z=(?P<Z>\\S+)'
line_end = "crlf"
"""

    def __init__(self, options: OffsetOptions, machine: Machine, clock: Clock, base: Path = Path()) -> None:
        del base
        self.options, self._axes, self._clock = options, machine.axis_names, clock
        self._text = OffsetText(options, machine)
        nothing = (0,) * len(self._axes)
        self._account = OffsetAccount(nothing if options.ask is None else None, options.keeps_offsets, self._in_words)
        self._connect, self._retry = way_of(options.serial, options.tcp, clock)
        self._worker: Worker[ByteLine] | None = None
        self._ending = False
        if options.ask is None:
            self._account.set_from_earlier_run(nothing)
            self.was_told = self._was_told
            """Only where offsets cannot be read back is it a `OneWay`."""

    def __enter__(self) -> Self:
        """Open the line.

        Raises:
            DriverUnavailable: it does not exist, and the options have `at_start = "required"`.
        """
        line = None
        try:
            line = self._connect()
        except DriverUnavailable as e:
            if self._retry.at_start == "required":
                raise
            self._account.fail(e)
        if line is not None and self.options.ask is None:
            self._account.well()
        self._ending = False
        backoff = Backoff(self._retry.first_retry_s, self._retry.longest_retry_s)
        self._worker = Worker("rtec-offsets", self._clock, self._connect, self._serve, self._tell, backoff)
        self._worker.start(line)
        return self

    def __exit__(self, *error: object) -> None:
        """Send the last command, then close the line."""
        worker, self._worker = self._worker, None
        if worker is not None:
            self._ending = True
            self._account.wake.set()
            worker.stop()

    def refuses(self, sink: Sink) -> str:
        """Refuse all kinds but that of the options, and any other resolution."""
        options = self.options
        if sink.kind == "pulse" or sink.kind != options.actuator:
            return f"takes {options.actuator!r} (its option actuator), not {sink.kind!r}"
        if not math.isclose(sink.unit_um, options.resolution_um, rel_tol=1e-9):
            return f"has resolution_um = {options.resolution_um:g}, the output has {sink.unit_um:g}: make them equal"
        return ""

    def apply(self, output: Ints) -> None:
        """Command the absolute offsets, in units of `resolution_um`; the line's thread sends them.

        Raises:
            DriverFault: the controller refused a command, or it waits for an order to resume.
            DriverTimeout: it does not acknowledge.
            DriverUnavailable: the line is gone; it is being reopened.
        """
        self._check_entered()
        self._account.order(tuple(int(n) for n in output))

    def read_output(self, output: Ints) -> None:
        """Fill in the offsets that the controller reports; where it cannot, the last ones sent or acknowledged.

        Raises:
            DriverError: it has not reported yet.
        """
        self._check_entered()
        output[:] = self._account.has()

    def hold(self) -> None:
        """Do nothing: the controller keeps its offsets."""

    @property
    def must_resume(self) -> str:
        """Why it waits for an order to resume; "" where it does not."""
        return self._account.lost

    def resume(self) -> None:
        """Go on from the controller's present offsets."""
        self._account.resume()

    def _in_words(self, output: Output) -> str:
        unit = self.options.resolution_um
        return ", ".join(f"{axis} {n * unit:+.4g} µm" for axis, n in zip(self._axes, output, strict=True))

    def _was_told(self, output: Ints) -> None:
        self._account.set_from_earlier_run(tuple(int(n) for n in output))

    def _check_entered(self) -> None:
        if self._worker is None:
            raise DriverUnavailable("ascii_offset: not entered, so its line is not open")

    def _tell(self, why: str) -> None:
        if why:
            self._account.fail(DriverUnavailable(f"{why}; trying again"))

    def _serve(self, line: ByteLine) -> None:
        worker = self._worker
        if worker is None:
            return
        talk = OffsetTalk(self.options, self._text, self._account, line, self._clock)
        if self.options.ask is None:
            self._account.well()
        ask_ns = self._clock.now_ns()
        while True:
            ending = self._ending  # read first, so that an earlier order is still sent
            command = self._account.take()
            if command is not None and (self.options.ask is None or talk.read_back(self._axes)):
                talk.command(command)
            if self.options.ask is not None and (command is not None or self._clock.now_ns() >= ask_ns):
                talk.read_back(self._axes)
                ask_ns = self._clock.now_ns() + round(self.options.ask_period_s * NS)
            else:
                talk.listen()
            if talk.answers:
                worker.backoff.reset()
            if ending:
                if command is not None:  # closing discards the bytes that the port has not sent yet
                    self._clock.sleep_until_ns(self._clock.now_ns() + DRAIN_NS)
                return
            if command is None or self._account.agrees(command):
                self._account.wake.wait(IDLE_S)
            else:
                worker.wait_until_ns(self._clock.now_ns() + RETRY_NS)


class OffsetTalk:
    """One dialogue over an open line.

    Attributes:
        answers: has the controller sent a line that was understood?
    """

    def __init__(
        self, options: OffsetOptions, text: OffsetText, account: OffsetAccount, line: ByteLine, clock: Clock
    ) -> None:
        self.answers = False
        self._options, self._text, self._account, self._line, self._clock = options, text, account, line, clock
        self._reader = LineReader(LINE_ENDS[options.line_end], options.longest_line, from_start=True)
        self._heard: list[str] = []
        self._lines: list[str] = []
        patterns = (options.acknowledge, options.refuse, options.restarted)
        self._yes, self._no, self._restart = (None if p is None else re.compile(p) for p in patterns)

    def command(self, output: Output) -> None:
        """Send the lines of a command, each after the one before was acknowledged; record the result."""
        self.listen()
        for line in self._text.lines(output):
            if not self._account.sends(output):  # it has restarted since this order: from zero this would be a jump
                return
            self._send(line)
            trouble = None if self._yes is None else self._acknowledged(line.decode(self._options.encoding))
            if trouble is not None:
                self._account.refused(trouble)
                return
        self._account.accepted(output, confirmed=self._options.ask is None)

    def read_back(self, axes: tuple[str, ...]) -> bool:
        """Ask for the offsets that are in force; record the answer, and say whether there was one."""
        ask = self._options.ask or ""
        self.listen()
        self._send(ask.encode(self._options.encoding))
        end_ns = self._end_ns()
        while (line := self._next(end_ns)) is not None:
            try:
                units = self._text.units(line)
            except ValueError as e:
                self._account.fail(DriverFault(f"{self._options.place}: the answer {line[:60]!r}: {e}"))
                return False
            if units is not None:
                self.answers = True
                self._account.read_back(tuple(units.get(axis, 0) for axis in axes))
                return True
        self._account.fail(self._silent(ask))
        return False

    def listen(self) -> None:
        """Process the lines that were sent unasked."""
        for _ in range(MOST_LINES):
            if self._next(0) is None:
                return

    def _acknowledged(self, sent: str) -> DriverError | None:
        end_ns = self._end_ns()
        while (line := self._next(end_ns)) is not None:
            if self._yes is not None and self._yes.fullmatch(line):
                self.answers = True
                return None
            if self._no is not None and self._no.fullmatch(line):
                self.answers = True
                return DriverFault(f"{self._options.place}: the controller refuses {sent!r}: {line[:60]!r}")
        return self._silent(sent)

    def _silent(self, sent: str) -> DriverTimeout:
        place, wait_s = self._options.place, self._options.timeout_s
        text = f"; it said {self._heard[-1][:60]!r}" if self._heard else ""
        return DriverTimeout(f"{place}: no answer to {sent!r} that is understood, within {wait_s:g} s{text}")

    def _end_ns(self) -> int:
        self._heard.clear()
        return self._clock.now_ns() + round(self._options.timeout_s * NS)

    def _send(self, line: bytes) -> None:
        self._line.send(line + ENDS[self._options.line_end])

    def _next(self, until_ns: int) -> str | None:
        """The next line; None where none came by then. At 0 it gives only a line that has arrived."""
        while not self._lines:
            received = self._line.receive(until_ns)
            self._lines += [x.decode(self._options.encoding, "replace").strip() for x in self._reader.feed(received)]
            if not self._lines and (not received or self._clock.now_ns() >= until_ns):
                return None
        if 0 < until_ns <= self._clock.now_ns():
            return None
        line = self._lines.pop(0)
        self._heard.append(line)
        if self._restart is not None and self._restart.fullmatch(line):
            self._account.restarted(line)
        return line

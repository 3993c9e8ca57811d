"""Counts and temperatures from another process, and commands to it, by ZeroMQ (`docs/zmq-link.md`).

Messages with their instant of sending give the offset of the other computer's clock.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from rtec.arrays import Floats, Ints
from rtec.correction.sinks import Sink, differs
from rtec.errors import DriverFault, DriverTimeout, DriverUnavailable
from rtec.loop.clock import Clock
from rtec.loop.ports import HOLDS
from rtec.machine import Machine
from rtec_drivers.count_tracker import CountTracker, max_counts_per_s
from rtec_drivers.temperatures import StuckWatch
from rtec_drivers.zmq import message
from rtec_drivers.zmq.link import Sockets, ZmqOptions, load_keys
from rtec_drivers.zmq.message import MessageError, StateMessage, read_state

WINDOW_NS = 30_000_000_000


class ClockOffset:
    """Our clock minus theirs: the least of `received - sent`, over the last thirty to sixty seconds.

    The error of the offset is the unknown travelling time of the fastest message: a reading looks younger by it than it
    is. Delayed messages do not change the offset. Within the window two clocks drift apart: at 50 millionths, by 3 ms
    in a minute.
    """

    def __init__(self) -> None:
        self._now: int | None = None
        self._before: int | None = None
        self._start_ns = 0

    def reset(self) -> None:
        """Forget the offset: their clock restarted."""
        self._now = self._before = None

    def add(self, sent_ns: int, received_ns: int) -> None:
        """Add one message: sent by their clock, received by ours."""
        if self._now is None or received_ns - self._start_ns > WINDOW_NS:
            self._before, self._now, self._start_ns = self._now, None, received_ns
        offset = received_ns - sent_ns
        self._now = offset if self._now is None else min(self._now, offset)

    def ours(self, their_ns: int) -> int:
        """Convert an instant of their clock to ours.

        Raises:
            ValueError: no message yet.
        """
        known = [offset for offset in (self._now, self._before) if offset is not None]
        if not known:
            raise ValueError("no message yet")
        return their_ns + min(known)


FUTURE_NS = 1_000_000


@dataclass(frozen=True)
class Counts:
    """Counts of all axes at one instant, by their clock and by ours."""

    values: tuple[int, ...]
    their_ns: int
    instant_ns: int


class StateBook:
    """Processes states; keeps the newest value of each quantity.

    Attributes:
        counts, degc: newest values; temperatures by sensor with their instants.
        heard: has any good message arrived?
    """

    def __init__(self, machine: Machine, options: ZmqOptions) -> None:
        self.counts: Counts | None = None
        self.degc: dict[str, tuple[float, int]] = {}
        self.heard = False
        self._machine, self._options = machine, options
        self._spindle: tuple[float, int] | None = None
        self._offset, self._stuck = ClockOffset(), StuckWatch(options.stuck_after_s)
        self._boot, self._seq, self._old_seq = "", -1, -1
        self._heard_ns = self._now_ns = self._behind_ns = 0
        self._fault, self._stuck_faults = "", dict[str, str]()

    def take(self, text: bytes, now_ns: int) -> StateMessage | None:
        """Process a message; None for one that is malformed, or older than the last."""
        try:
            state = read_state(text)
            self._check(state, now_ns)
        except MessageError as e:
            self.fault(f"a message: {e}")
            return None
        if state.boot != self._boot:
            self._boot, self._seq = state.boot, -1
            self._offset.reset()
        if state.seq <= self._seq:
            self._old_seq = state.seq
            return None
        self._seq, self._old_seq, self._heard_ns, self.heard, self._fault = state.seq, -1, now_ns, True, ""
        self._offset.add(state.time_ns, now_ns)
        self._behind_ns = now_ns - state.time_ns
        self._keep(state, now_ns)
        return state

    def now(self, now_ns: int) -> None:
        """Set the time; silence is counted from the first call."""
        self._heard_ns = self._heard_ns or now_ns
        self._now_ns = now_ns

    def restart(self) -> None:
        """Accept the next message, whatever its number."""
        self._seq = self._old_seq = -1

    def fault(self, text: str) -> None:
        """Record a fault; it stays until a good message comes."""
        self._fault = text

    def tell(self) -> None:
        """Raise the present fault.

        Raises:
            DriverFault: a message was malformed, or a sensor is stuck.
            DriverTimeout: silence.
        """
        self.tell_fault()
        self.tell_silence()

    def tell_fault(self) -> None:
        """Raise DriverFault where a message was malformed, or a sensor is stuck."""
        faults = [f for f in (self._fault, *self._stuck_faults.values()) if f]
        if faults:
            raise DriverFault(f"{self._options.state}: {'; '.join(faults)}")

    def tell_silence(self) -> None:
        """Raise where no new message has come lately.

        Raises:
            DriverTimeout: silence, or messages whose numbers are not above the last.
        """
        place, silent_s = self._options.state, (self._now_ns - self._heard_ns) * 1e-9
        if silent_s <= self._options.silent_s:
            return
        if self._old_seq >= 0:
            raise DriverTimeout(
                f"{place}: for {silent_s:.1f} s no seq above {self._seq}, the newest is {self._old_seq}: did the "
                "program restart with the same boot, or do two publish there? Mend that, then `rtec ctl resume`"
            )
        raise DriverTimeout(f"{place}: no message for {silent_s:.1f} s")

    def tell_behind(self) -> None:
        """Raise where messages come, and are as old as silence by a clock that should be this computer's.

        Raises:
            DriverFault: they are.
        """
        if self._options.clock == "shared" and self._behind_ns > self._options.silent_s * 1e9:
            raise DriverFault(
                f"{self._options.state}: messages come, but their time_ns is {self._behind_ns * 1e-9:.1f} s behind "
                'this PC\'s clock (CLOCK_MONOTONIC): publish by that clock; from another PC, set clock = "own"'
            )

    def spindle(self) -> float:
        """The spindle speed, 1/min.

        Raises:
            DriverTimeout: none lately.
        """
        value, heard_ns = self._spindle or (0.0, -(2**62))
        if self._now_ns - heard_ns > self._options.silent_s * 1e9:
            raise DriverTimeout(f"{self._options.state}: no spindle speed")
        return value

    def _check(self, state: StateMessage, now_ns: int) -> None:
        axes = self._machine.axis_names
        if state.counts and set(state.counts) != set(axes):
            raise MessageError(f"counts are of {', '.join(state.counts)}; the machine has {', '.join(axes)}")
        unknown = sorted(set(state.degc) - set(self._machine.sensor_names))
        if unknown:
            raise MessageError(f"the machine has no sensor {unknown[0]!r}")
        newest = max((state.counts_time_ns, *(t for _, t in state.degc.values())), default=0)
        if newest > state.time_ns:
            raise MessageError("holds a reading from after it was sent")
        if self._options.clock == "shared" and state.time_ns > now_ns + FUTURE_NS:
            raise MessageError('is from the future: the clocks are not the same; set clock = "own"')

    def _keep(self, state: StateMessage, now_ns: int) -> None:
        if state.counts:
            values = tuple(state.counts[a] for a in self._machine.axis_names)
            self.counts = Counts(values, state.counts_time_ns, self._ours(state.counts_time_ns, now_ns))
        for name, (degc, their_ns) in state.degc.items():
            self._keep_degc(name, degc, self._ours(their_ns, now_ns), now_ns)
        if state.spindle_rpm is not None:
            self._spindle = (state.spindle_rpm, now_ns)

    def _keep_degc(self, name: str, degc: float, instant_ns: int, now_ns: int) -> None:
        stuck = self._stuck.look(name, degc, now_ns)
        if stuck:
            self._stuck_faults[name] = stuck
            return
        self._stuck_faults.pop(name, None)
        if instant_ns > self.degc.get(name, (0.0, -(2**62)))[1]:
            self.degc[name] = (degc, instant_ns)

    def _ours(self, their_ns: int, now_ns: int) -> int:
        if self._options.clock == "shared":
            return min(their_ns, now_ns)
        return self._offset.ours(their_ns)


class CommandAccount:
    """This side's account of the commands.

    Attributes:
        has: output that the other process reports, axis by axis; None before its first report.
        must_resume: why it waits for an order; "" where it does not.

    Args:
        axes: names in order.
        step: the first command may differ from `has` by at most this.
        timeout_s: longest time without an answer to a command.
    """

    def __init__(self, axes: Sequence[str], step: int, timeout_s: float) -> None:
        self._axes, self._step, self._timeout_ns = tuple(axes), step, round(timeout_s * 1e9)
        self.has: tuple[int, ...] | None = None
        self._seq = 0
        self.order_resume()

    def order_resume(self) -> None:
        """Accept the process that publishes now, and command it."""
        self.must_resume, self._boot, self._first = "", "", True
        self._refused, self._waiting_ns, self._answered = "", -1, self._seq

    def stop(self, why: str) -> None:
        """Command nothing until the order comes, for this reason; "" changes nothing."""
        self.must_resume = self.must_resume or why

    def reported(self, boot: str, output: Mapping[str, int]) -> None:
        """Process the other process' report."""
        if not self._boot:
            self._boot = boot
        elif boot != self._boot:
            self.stop(f"the other process restarted; {HOLDS}")
        if set(output) == set(self._axes):
            self.has = tuple(output[a] for a in self._axes)

    def answered(self, answer: message.CommandAnswer) -> None:
        """Process an answer; ignore one that belongs to another start."""
        if answer.boot != self._boot or answer.seq <= self._answered:
            return
        self._answered, self._waiting_ns, self._refused = answer.seq, -1, answer.refused

    def next_command(self, output: Sequence[int]) -> bytes:
        """The text of the next command.

        Raises:
            DriverFault: it waits for an order, or the first command is a jump.
            DriverTimeout: the other process has not reported its output yet.
        """
        if self.must_resume:
            raise DriverFault(self.must_resume)
        if self.has is None or not self._boot:
            raise DriverTimeout("the other process has not said what it has applied")
        furthest = max(abs(a - b) for a, b in zip(output, self.has, strict=True))
        if self._first and furthest > self._step:
            raise DriverFault(
                f"the first command {list(output)} is {furthest} off what the other process has, {list(self.has)}: "
                "refused; the loop must take over its output first"
            )
        self._first = False
        self._seq += 1
        return message.command(self._boot, self._seq, dict(zip(self._axes, output, strict=True)))

    def sent(self, now_ns: int) -> None:
        """Record a command that was sent.

        Raises:
            DriverFault: the last command was refused.
            DriverTimeout: no command was answered for too long.
        """
        if self._refused:
            raise DriverFault(f"the other process refuses commands: {self._refused}")
        if self._waiting_ns < 0:
            self._waiting_ns = now_ns
        elif now_ns - self._waiting_ns > self._timeout_ns:
            raise DriverTimeout(f"no command was answered for {(now_ns - self._waiting_ns) * 1e-9:.2f} s")


LOOK_S = 0.01
RECONNECT_NS = 5_000_000_000
"""After this time without any message both addresses are connected again; libzmq's own heartbeat takes 3 s."""


class ZmqLinkDriver:
    """Another process as a device, by ZeroMQ.

    Never waits: each call processes the messages that have arrived. Commands are absolute, may be repeated, and are
    answered; a later cycle reads the answer. If the other process restarts, counts and commands hold until `resume` is
    called; temperatures go on.

    Args:
        options: options of the run file.
        machine: machine with the axes and sensors of the arrays.
        clock: clock of the instants.
        base: folder at which relative paths of key files start.

    Raises:
        ConfigError: keys or speeds are at fault.
    """

    options_model = ZmqOptions
    EXAMPLE = """\
[device.cell]
driver = "zmq_link"
state = "ipc:///run/cell/state"
command = "ipc:///run/cell/command"
clock = "shared"                           # the other process is on this computer
max_speed_mm_s = {X = 400.0, Z = 400.0}    # counts that move faster are refused
"""

    def __init__(self, options: ZmqOptions, machine: Machine, clock: Clock, base: Path = Path()) -> None:
        self.options, self._machine, self._clock = options, machine, clock
        self._keys = load_keys(options, base)
        self._tracker: CountTracker | None = None
        if options.max_speed_mm_s:
            self._tracker = CountTracker(machine.axis_names, 64, max_counts_per_s(options.max_speed_mm_s, machine))
        self._sockets: Sockets | None = None
        self._received_ns = 0
        self._book = StateBook(machine, options)
        self._commands = CommandAccount(machine.axis_names, options.resume_step, options.command_timeout_s)
        self._counts: Counts | None = None
        self._counts_ns = -(2**62)

    def __enter__(self) -> Self:
        """Connect; wait for the first message. Starting a run is an order to resume.

        Raises:
            DriverTimeout, DriverFault: none came, or none that is good, and the options have `at_start = "required"`.
            DriverUnavailable: an address cannot be used.
        """
        self._book = StateBook(self._machine, self.options)
        self._sockets, self._received_ns = Sockets(self.options, self._keys), self._clock.now_ns()
        self.resume()
        try:
            self._first_message(self._sockets)
        except (DriverTimeout, DriverFault):
            if self.options.at_start == "required":
                self._leave()
                raise
        return self

    def __exit__(self, *error: object) -> None:
        """Hold, then close."""
        self.hold()
        self._leave()

    @property
    def must_resume(self) -> str:
        """Why counts and commands wait for an order to resume; "" where they do not."""
        return self._commands.must_resume

    def resume(self) -> None:
        """Go on after the other process restarted or a position was lost."""
        self._commands.order_resume()
        self._book.restart()
        self._counts, self._counts_ns = None, -(2**62)
        if self._tracker is not None:
            self._tracker.restart()

    def read_counts(self, counts: Ints) -> int:
        """Fill in the newest counts; give their instant of latching by our clock, ns.

        Raises:
            DriverTimeout: no counts in the last `silent_s`.
            DriverFault: impossible counts, a malformed message, or it waits for an order to resume.
            DriverUnavailable: not entered.
        """
        self._listen()
        self._book.tell()
        self._book.tell_behind()
        if self._commands.must_resume:
            raise DriverFault(self._commands.must_resume)
        if self._tracker is None:
            raise DriverFault(f"{self.options.state}: counts are not taken without max_speed_mm_s")
        got = self._book.counts
        if got is None:
            raise DriverTimeout(f"{self.options.state}: no counts yet")
        if got is not self._counts:
            self._check(self._tracker, got)
        counts[:] = got.values
        return self._counts_ns

    def read_temperatures(self, degc: Floats, time_ns: Ints) -> None:
        """Fill in the newest values, °C and instants by our clock; then raise the faults.

        Raises:
            DriverTimeout, DriverFault, DriverUnavailable: as `read_counts`.
        """
        self._listen()
        for i, name in enumerate(self._machine.sensor_names):
            if name in self._book.degc:
                degc[i], time_ns[i] = self._book.degc[name]
        self._book.tell()
        self._book.tell_behind()

    def read_spindle(self) -> float:
        """The newest spindle speed, 1/min.

        Raises:
            DriverTimeout: none in the last `silent_s`.
            DriverFault, DriverUnavailable: as `read_counts`.
        """
        self._listen()
        self._book.tell()
        return self._book.spindle()

    def refuses(self, sink: Sink) -> str:
        """Refuse all kinds but that of the options, and any other unit; refuse all without an address for commands."""
        options = self.options
        if options.command is None:
            return "has no address for commands (its option command)"
        return differs(sink, options.actuator, options.unit_um)

    def apply(self, output: Ints) -> None:
        """Send the absolute output of every axis. Does not wait.

        Raises:
            DriverFault: the other process refuses, restarted, or the command would be a jump.
            DriverTimeout: nothing accepts commands, they are not answered, or no state confirms them.
            DriverUnavailable: not entered.
        """
        sockets = self._listen()
        now_ns = self._clock.now_ns()
        command = tuple(int(n) for n in output)
        sockets.send(self._commands.next_command(command))
        self._commands.sent(now_ns)
        if command != self._commands.has:
            self._book.tell_silence()

    def read_output(self, output: Ints) -> None:
        """Fill in the output that the other process reports.

        Raises:
            DriverUnavailable: it has not reported yet.
        """
        self._listen()
        if self._commands.has is None:
            raise DriverUnavailable(f"{self.options.state}: the other process has not said what it has applied")
        output[:] = self._commands.has

    def hold(self) -> None:
        """Send nothing: the other process keeps the last command's output."""

    def _listen(self) -> Sockets:
        """Process all received messages."""
        if self._sockets is None:
            raise DriverUnavailable("zmq_link: not entered, so nothing is connected")
        texts = self._sockets.states()
        now_ns = self._clock.now_ns()  # after they were received: none of them is from the future
        if texts:
            self._received_ns = now_ns
        elif now_ns - self._received_ns > RECONNECT_NS:
            self._received_ns = now_ns
            self._sockets.reconnect()
        for text in texts:
            state = self._book.take(text, now_ns)
            if state is not None:
                self._commands.reported(state.boot, state.output)
        for text in self._sockets.answers():
            try:
                self._commands.answered(message.read_answer(text))
            except message.MessageError as e:
                self._book.fault(f"an answer {e}")
        self._book.now(now_ns)
        return self._sockets

    def _first_message(self, sockets: Sockets) -> None:
        for _ in range(max(1, round(self.options.open_timeout_s / LOOK_S))):
            sockets.wait(LOOK_S)
            self._listen()
            if self._book.heard:
                return
        self._book.tell_fault()
        raise DriverTimeout(f"{self.options.state}: no message within {self.options.open_timeout_s:g} s")

    def _check(self, tracker: CountTracker, got: Counts) -> None:
        """Check that the machine can have moved so far, in a time by the other process' clock."""
        try:
            tracker.update(got.values, got.their_ns, got.their_ns)
        finally:
            self._commands.stop(tracker.lost)
        # A message faster than all before makes the offset of the clocks smaller; instants do not go back for that.
        self._counts, self._counts_ns = got, max(self._counts_ns, got.instant_ns)

    def _leave(self) -> None:
        if self._sockets is not None:
            self._sockets.close()
            self._sockets = None

"""The newest values that another process published, with instants of our clock.

Messages with their instant of sending give the offset of the other computer's clock.
"""

from dataclasses import dataclass

from rtec.errors import DriverFault, DriverTimeout
from rtec.machine import Machine
from rtec_drivers.stuck import StuckWatch
from rtec_drivers.zmq.link import ZmqOptions
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
        self._boot, self._seq = "", -1
        self._heard_ns = self._now_ns = 0
        self._fault, self._stuck_faults = "", dict[str, str]()

    def take(self, text: bytes, now_ns: int) -> StateMessage | None:
        """Process a message; None for one that is malformed, or older than the last."""
        try:
            state = read_state(text)
            self._check(state, now_ns)
        except MessageError as e:
            self.fault(f"a message {e}")
            return None
        if state.boot != self._boot:
            self._boot, self._seq = state.boot, -1
            self._offset.reset()
        if state.seq <= self._seq:
            return None
        self._seq, self._heard_ns, self.heard, self._fault = state.seq, now_ns, True, ""
        self._offset.add(state.time_ns, now_ns)
        self._keep(state, now_ns)
        return state

    def now(self, now_ns: int) -> None:
        """Set the time; silence is counted from the first call."""
        self._heard_ns = self._heard_ns or now_ns
        self._now_ns = now_ns

    def fault(self, text: str) -> None:
        """Record a fault; it stays until a good message comes."""
        self._fault = text

    def tell(self) -> None:
        """Raise the present fault.

        Raises:
            DriverFault: a message was malformed, or a sensor is stuck.
            DriverTimeout: silence.
        """
        place, silent_s = self._options.state, (self._now_ns - self._heard_ns) * 1e-9
        faults = [f for f in (self._fault, *self._stuck_faults.values()) if f]
        if faults:
            raise DriverFault(f"{place}: {'; '.join(faults)}")
        if silent_s > self._options.silent_s:
            raise DriverTimeout(f"{place}: no message for {silent_s:.1f} s")

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

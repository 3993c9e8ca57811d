"""The loop: wait for the deadline, read, step, keep the state, command. Nothing else.

`rtec.loop.believed` decides whether a temperature is believed, `rtec.loop.output` whether a command may be sent. An
order to resume (`Loop.order_resume`) goes to every device that takes one; the loop then takes over the actuator's
ledger before it commands anything. Where the positions of the axes are not known (`rtec.loop.zero`) it holds.

The loop keeps the state (`rtec.loop.state`) before it sends the command: the kept state is never behind the actuator.

Deadlines are absolute, so jitter does not add up. A cycle that ends after the next deadline misses that deadline (a
miss, counted); the loop goes on with the first deadline that is still ahead.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.correction.flags import MODE_HOLD, MODE_TAKEN_OVER, ORDER_MASK
from rtec.errors import DriverError
from rtec.loop.believed import AHEAD_NS, BelievedTemperatures, ahead_in_words
from rtec.loop.clock import Clock
from rtec.loop.devices import Ports
from rtec.loop.output import CommandGate
from rtec.loop.records import NEVER_NS, Commands, Samples
from rtec.loop.state import StateWriter
from rtec.loop.stats import LoopStats, Trouble
from rtec.loop.step import Step
from rtec.loop.zero import Home, Zero


@dataclass(frozen=True, slots=True)
class Row:
    """One row of a ring or buffer, with the views that a cycle writes through and the call that steps it."""

    samples: Samples
    commands: Commands
    counts: Ints
    degc: Floats
    degc_time_ns: Ints
    output: Ints
    step: Callable[[], None]


def bind_rows(step: Step, pairs: Sequence[tuple[Samples, Commands]]) -> list[Row]:
    """Make the views of all rows once, so that a cycle makes none."""
    return [Row(s, c, s.counts[0], s.degc[0], s.degc_time_ns[0], c.output[0], step.bind(s, c)) for s, c in pairs]


class Loop:
    """The loop; its rows are reused in a circle.

    Attributes:
        step: the step that it runs.
        mode: MODE_ON, MODE_OFF or MODE_HOLD; read every cycle.
        stats: counts, times and failures so far.
        keeper: keeps the state of every cycle; None: no state is kept.
        zero: zero of the axes.
    """

    def __init__(
        self,
        step: Step,
        ports: Ports,
        clock: Clock,
        period_ns: int,
        rows: list[Row],
        mode: int,
        zero: Zero | None = None,
    ) -> None:
        self.step, self.mode = step, mode
        self.stats = LoopStats.empty()
        self.keeper: StateWriter | None = None
        self._ports, self._clock, self._period_ns, self._rows = ports, clock, period_ns, rows
        self._resumable = ports.resumable()
        self._counts_trouble = self._trouble("counts")
        machine = step.settings.model.machine
        self._temperatures = [
            (BelievedTemperatures(s, machine), self._trouble("temperatures", k))
            for k, s in enumerate(ports.temperatures)
        ]
        self._spindle_trouble = self._trouble("spindle")
        output_trouble = self._trouble("output")
        self._waiting = Trouble(ports.name("output"), "state")
        self.stats.troubles.append(self._waiting)
        layout = step.layout
        self._gate = CommandGate(ports.actuator, len(layout.axes), output_trouble, self._waiting, period_ns)
        self.zero = Zero(ports.counts, layout.axes, by_order=False) if zero is None else zero
        self._not_homed = self._trouble("zero")
        self._tell_zero()
        self._device_counts = np.zeros(len(layout.axes), dtype=np.int64)
        self._counts = np.zeros(len(layout.axes), dtype=np.int64)
        self._degc = np.full(len(layout.sensors), np.nan)
        self._degc_time_ns = np.zeros(len(layout.sensors), dtype=np.int64)
        self._counts_time_ns = NEVER_NS
        self._spindle_rpm = float("nan")
        self._next = 0

    def run(self, cycles: int | None, after_cycle: Callable[[Row], bool]) -> None:
        """Run that many cycles, or for ever; `after_cycle` gets each row and returns whether to go on."""
        deadline_ns = self._clock.now_ns() + self._period_ns
        remaining = -1 if cycles is None else cycles
        while remaining != 0:
            remaining -= 1
            self._clock.sleep_until_ns(deadline_ns)
            row = self._rows[self._next]
            end_ns = self.cycle(row, deadline_ns)
            self._next = (self._next + 1) % len(self._rows)
            if not after_cycle(row):
                return
            deadline_ns += self._period_ns
            if end_ns > deadline_ns:
                lost = 1 + (end_ns - deadline_ns) // self._period_ns
                self.stats.misses += lost
                deadline_ns += lost * self._period_ns

    def wait_for_order(self, why: str) -> None:
        """Hold until the order to resume comes, whatever the mode: for a start without a ledger that can be trusted."""
        self._waiting.failed(why)

    def order_resume(self) -> None:
        """Order all devices to go on after a reset or a lost position. Call it between cycles, in the loop's thread."""
        for device in self._resumable:
            device.resume()
        for source, _ in self._temperatures:
            source.resume()
        self._waiting.now = False
        self.zero.resume()
        self.take_over(None)

    def home(self, home: Home) -> bool:
        """Take over where the axes stand; False: the device lost its supply since. Call it between cycles.

        The correction goes to its new value at its slew limit. The directions of these axes are unknown again.
        """
        if home.supply != self.zero.supply:
            return False
        self.zero.home(home.by)
        self._tell_zero()
        np.add(self._device_counts, self.zero.offset, self._counts)
        self.step.forget_directions(home.axes, self._counts)
        return True

    def take_over(self, expected: Ints | None, allowed: Ints | None = None, or_zero: bool = False) -> None:
        """Hold and command nothing until the actuator reports its ledger; see `CommandGate.take_over`."""
        self._gate.take_over(expected, allowed, or_zero)

    @property
    def waits(self) -> bool:
        """Does it wait for an order to resume, or has it not carried one out yet?"""
        jumped = any(source.must_resume for source, _ in self._temperatures)
        return jumped or self._gate.waits or any(d.must_resume for d in self._resumable)

    def go_on_with(self, step: Step, rows: list[Row]) -> list[Row]:
        """Change to another step, with rows bound to it in the same memory, for the next cycle; give the old rows."""
        old = self._rows
        self.step, self._rows = step, rows
        return old

    def cycle(self, row: Row, deadline_ns: int) -> int:
        """Run one cycle into a row; give the instant after the command was sent, ns."""
        clock, stats = self._clock, self.stats
        now_ns = clock.now_ns()
        self._read(now_ns)
        samples = row.samples
        mode = self._gate.look(self.step, MODE_HOLD if self._waiting.now or self._not_homed.now else self.mode, now_ns)
        taken_over = mode & ORDER_MASK == MODE_TAKEN_OVER
        samples.time_ns[0], samples.mode[0] = now_ns, mode
        samples.counts_time_ns[0] = self._counts_time_ns
        row.counts[:] = self._counts
        row.degc[:] = self._degc
        row.degc_time_ns[:] = self._degc_time_ns
        samples.spindle_rpm[0] = self._spindle_rpm
        row.step()
        if taken_over:  # the actuator has this output already; the row records it
            row.output[:] = self._gate.has
            stats.takeovers += mode == MODE_TAKEN_OVER
        if self.keeper is not None:
            self.keeper.order = self.mode
            self.keeper.waits |= self._waiting.now
            self.keeper.keep(samples, row.output, stats.cycles)
        if not taken_over:
            self._gate.send(row.output)
        end_ns = clock.now_ns()
        stats.cycles += 1
        stats.wake_up.add(now_ns - deadline_ns)
        stats.compute.add(end_ns - now_ns)
        return end_ns

    def _read(self, now_ns: int) -> None:
        """Read every source; a source that fails keeps its old value and time, and the guard judges the age."""
        ports = self._ports
        try:
            self._counts_time_ns = ports.counts.read_counts(self._device_counts)
            self._counts_trouble.now = False
            if self._counts_time_ns > now_ns + AHEAD_NS:
                self._counts_trouble.failed(ahead_in_words(self._counts_time_ns, now_ns))
            if why := self.zero.lost():
                self._waiting.failed(why)
            if self._not_homed.now is self.zero.known:
                self._tell_zero()
            np.add(self._device_counts, self.zero.offset, self._counts)
        except DriverError as e:
            self._counts_trouble.failed(str(e))
        for source, trouble in self._temperatures:
            try:
                source.read(self._degc, self._degc_time_ns, self.step.sensors, now_ns)
                trouble.now = False
            except DriverError as e:  # the good values are in the arrays all the same
                trouble.failed(str(e))
        if ports.spindle is not None:
            try:
                self._spindle_rpm = ports.spindle.read_spindle()
                self._spindle_trouble.now = False
            except DriverError as e:
                self._spindle_rpm = float("nan")
                self._spindle_trouble.failed(str(e))

    def _tell_zero(self) -> None:
        self._not_homed.now = False
        if self.zero.why:
            self._not_homed.failed(self.zero.why)

    def _trouble(self, does: str, k: int = 0) -> Trouble:
        made = Trouble(self._ports.name("counts" if does == "zero" else does, k), does)
        self.stats.troubles.append(made)
        return made

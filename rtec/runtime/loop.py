"""The loop: wait for the deadline, read, step, apply, record. Nothing else, and nothing allocated on the way.

Deadlines are absolute, so jitter does not add up. A cycle that ends after the next deadline costs that deadline (a
miss, counted) and the loop goes on with the next one that is still to come.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rtec.errors import DriverError
from rtec.runtime.clock import Clock
from rtec.runtime.devices import Ports
from rtec.runtime.ports import FloatArray, IntArray
from rtec.runtime.records import Commands, Samples
from rtec.runtime.stats import LoopStats
from rtec.runtime.step import Step


@dataclass(frozen=True, slots=True)
class Row:
    """One row of a ring or buffer, with the views that a cycle writes through and the call that steps it."""

    samples: Samples
    commands: Commands
    counts: IntArray
    degc: FloatArray
    degc_time_ns: IntArray
    output: IntArray
    step: Callable[[], None]


def bind_rows(step: Step, pairs: Sequence[tuple[Samples, Commands]]) -> list[Row]:
    """Prepare rows once, so that a cycle makes no views."""
    return [Row(s, c, s.counts[0], s.degc[0], s.degc_time_ns[0], c.output[0], step.bind(s, c)) for s, c in pairs]


class Loop:
    """The loop over rows in a circle.

    Attributes:
        mode: MODE_ON, MODE_OFF or MODE_HOLD; read every cycle.
        stats: what it did so far.
    """

    def __init__(self, step: Step, ports: Ports, clock: Clock, period_ns: int, rows: Sequence[Row], mode: int) -> None:
        self.mode = mode
        self.stats = LoopStats.empty()
        self._ports, self._clock, self._period_ns, self._rows = ports, clock, period_ns, rows
        layout = step.layout
        self._counts = np.zeros(len(layout.axes), dtype=np.int64)
        self._degc = np.full(len(layout.sensors), np.nan)
        self._degc_time_ns = np.zeros(len(layout.sensors), dtype=np.int64)
        # Before the first good reading the counts are as old as the clock itself, which is stale.
        self._counts_time_ns = -(2**62)
        self._next = 0

    def run(self, cycles: int | None, after_cycle: Callable[[Row], bool]) -> None:
        """Run so many cycles, or for ever; `after_cycle` sees each row and says whether to go on."""
        deadline_ns = self._clock.now_ns() + self._period_ns
        left = -1 if cycles is None else cycles
        while left != 0:
            left -= 1
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

    def cycle(self, row: Row, deadline_ns: int) -> int:
        """Do one cycle into a row; give the instant at which the command was out, ns."""
        clock, stats = self._clock, self.stats
        now_ns = clock.now_ns()
        self._read()
        samples = row.samples
        samples.time_ns[0] = now_ns
        samples.mode[0] = self.mode
        samples.counts_time_ns[0] = self._counts_time_ns
        row.counts[:] = self._counts
        row.degc[:] = self._degc
        row.degc_time_ns[:] = self._degc_time_ns
        samples.spindle_rpm[0] = self._spindle_rpm
        row.step()
        try:
            self._ports.actuator.apply(row.output)
        except DriverError as e:
            self._failed(e)
        end_ns = clock.now_ns()
        stats.cycles += 1
        stats.wake_up.add(now_ns - deadline_ns)
        stats.compute.add(end_ns - now_ns)
        return end_ns

    _spindle_rpm = float("nan")

    def _read(self) -> None:
        """Read every source; what fails keeps its old value and its old time, and the guard judges the age."""
        ports = self._ports
        try:
            self._counts_time_ns = ports.counts.read_counts(self._counts)
        except DriverError as e:
            self._failed(e)
        for source in ports.temperatures:
            try:
                source.read_temperatures(self._degc, self._degc_time_ns)
            except DriverError as e:
                self._failed(e)
        if ports.spindle is not None:
            try:
                self._spindle_rpm = ports.spindle.read_spindle()
            except DriverError as e:
                self._spindle_rpm = float("nan")
                self._failed(e)

    def _failed(self, error: DriverError) -> None:
        self.stats.driver_errors += 1
        self.stats.last_error = str(error)

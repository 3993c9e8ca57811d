"""From a device's counters to the machine's axes: their order, their highest speeds, and positions that do not wrap.

Refuses readings that the machine cannot have reached.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from rtec.errors import ConfigError, DriverFault
from rtec.loop.ports import HOLDS
from rtec.machine import Machine
from rtec.tomlfile import nearest


def axis_order(axes: tuple[str, ...] | None, machine: Machine) -> tuple[int, ...]:
    """For every input of a device, the index of its axis in the machine's order.

    Raises:
        ConfigError: an axis that the machine does not have, or one that is missing or named twice.
    """
    names = machine.axis_names
    ordered = names if axes is None else axes
    faults = [f"axes: machine {machine.name!r} has no axis {n!r}{nearest(n, names)}" for n in ordered if n not in names]
    faults += [f"axes: {n!r} is there {ordered.count(n)} times; every axis must, once" for n in names
               if ordered.count(n) != 1]  # fmt: skip
    if faults:
        raise ConfigError("\n".join(faults))
    return tuple(names.index(n) for n in ordered)


def max_counts_per_s(max_speed_mm_s: dict[str, float], machine: Machine) -> tuple[float, ...]:
    """Highest speed of every axis in counts a second.

    Raises:
        ConfigError: an axis that the machine does not have, or one without a speed.
    """
    names = machine.axis_names
    faults = [
        f"max_speed_mm_s: machine {machine.name!r} has no axis {n!r}{nearest(n, names)}"
        for n in max_speed_mm_s
        if n not in names
    ]
    faults += [f"max_speed_mm_s: axis {n!r} is missing" for n in names if n not in max_speed_mm_s]
    if faults:
        raise ConfigError("\n".join(faults))
    return tuple(max_speed_mm_s[a.name] * a.counts_per_mm for a in machine.axes)


NS = 1e-9
SLACK_COUNTS = 2
"""Counts of the encoder's own flicker, which no speed limit excludes."""


@dataclass(frozen=True, slots=True)
class CounterReading:
    """One reading of the counters.

    Attributes:
        values: unwrapped counts.
        earliest_ns, latest_ns: they were latched between these two instants.
    """

    values: tuple[int, ...]
    earliest_ns: int
    latest_ns: int


class CountTracker:
    """Unwraps the counters of all axes together.

    A reading further from the last accepted one than the machine's highest speed allows is refused. If the next reading
    confirms it, the counters have really jumped: from then on nothing is accepted until `restart`, because the position
    is unknown. If the next reading goes back, the refused one was a slip, and reading goes on.

    Args:
        axes: names of the axes.
        bits: width of the counters; 64: they do not wrap.
        max_counts_per_s: highest speed of each axis.
        middle: middle of the travel of each axis, counts: the first reading is the position nearest to it, of those at
            which the counter shows this number. Not given: zero, so that the number is a signed one.
    """

    def __init__(
        self, axes: Sequence[str], bits: int, max_counts_per_s: Sequence[float], middle: Sequence[int] = ()
    ) -> None:
        self.lost, self.bits = "", bits
        self._axes, self._fastest = tuple(axes), tuple(max_counts_per_s)
        self._middle = tuple(middle) or (0,) * len(self._axes)
        self._good: CounterReading | None = None
        self._refused: CounterReading | None = None

    def restart(self) -> None:
        """Forget everything: the next reading is accepted as it is."""
        self.lost, self._good, self._refused = "", None, None

    def update(self, raw: Sequence[int], earliest_ns: int, latest_ns: int) -> tuple[int, ...]:
        """The unwrapped counts of one reading.

        Args:
            raw: counters, as wide as `bits`.
            earliest_ns, latest_ns: they were latched between these two instants.

        Raises:
            DriverFault: the reading is not possible; `lost` has the reason once the position is unknown.
        """
        if self.lost:
            raise DriverFault(self.lost)
        if self._good is None:
            self._good = CounterReading(self._near(raw, self._middle), earliest_ns, latest_ns)
            return self._good.values
        self._check_gap(self._good, latest_ns)
        reading = CounterReading(self._near(raw, self._good.values), earliest_ns, latest_ns)
        fault = self._too_fast(self._good, reading)
        if not fault and not self._confirms_refused(reading):
            self._good, self._refused = reading, None
            return reading.values
        if self._refused is not None and self._confirms_refused(reading):
            self.lost = f"{fault or 'counts jumped'}, and stayed there: the position is not known; {HOLDS}"
            raise DriverFault(self.lost)
        self._refused = reading
        raise DriverFault(f"{fault}: refused")

    def _near(self, raw: Sequence[int], last: Sequence[int]) -> tuple[int, ...]:
        return tuple(known + _signed(n - known, self.bits) for n, known in zip(raw, last, strict=True))

    def _check_gap(self, good: CounterReading, latest_ns: int) -> None:
        gap_s = (latest_ns - good.earliest_ns) * NS
        for axis, fastest in zip(self._axes, self._fastest, strict=True):
            if fastest * gap_s >= 2 ** (self.bits - 1):
                self.lost = (
                    f"axis {axis} was not read for {gap_s:.3g} s, in which a counter of {self.bits} bits may have gone "
                    f"round unseen: the position is not known; {HOLDS}"
                )
                raise DriverFault(self.lost)

    def _too_fast(self, before: CounterReading, after: CounterReading) -> str:
        span_s = max(0, after.latest_ns - before.earliest_ns) * NS
        for axis, fastest, old, new in zip(self._axes, self._fastest, before.values, after.values, strict=True):
            if abs(new - old) > fastest * span_s + SLACK_COUNTS:
                return (
                    f"axis {axis} jumped by {new - old} counts in {span_s * 1e3:.3g} ms, "
                    f"more than its highest speed allows ({fastest * span_s:.0f})"
                )
        return ""

    def _confirms_refused(self, reading: CounterReading) -> bool:
        """Is it nearer to the refused reading than to the accepted one, and reachable from there?"""
        if self._refused is None or self._good is None or self._too_fast(self._refused, reading):
            return False
        return _distance(reading, self._refused) < _distance(reading, self._good)


def _signed(number: int, bits: int) -> int:
    half = 1 << (bits - 1)
    return ((number + half) & ((1 << bits) - 1)) - half


def _distance(a: CounterReading, b: CounterReading) -> int:
    return max(abs(x - y) for x, y in zip(a.values, b.values, strict=True))

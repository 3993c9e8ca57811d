"""Answers to SYNC that come late or never, on a virtual clock.

Oracle: an axis whose position tells the instant at which it was latched: 1000 counts a millisecond, the other axis
backwards. The encoders are written here: they latch at SYNC and answer each SYNC once, in order, after a delay.
"""

import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import pytest

from rtec.errors import DriverTimeout
from rtec.loop.clock import VirtualClock
from rtec.tomlfile import validated
from rtec_drivers.can.bus import CanPort
from rtec_drivers.can.encoders import CanEncoderOptions, CanEncodersDriver
from rtec_drivers.can.sync_book import SyncBook
from tests.support.conformance import MACHINE

MS = 1_000_000
START_NS = 10**12
CYCLE_NS = MS
LATE_SEEDS = 60
Delay = Callable[[int, int], float | None]
"""Of the k-th SYNC and an axis: delay of the answer, ms; None: it is lost."""


@dataclass
class LateBus:
    """A bus on a virtual clock, in the place of the driver's port."""

    clock: VirtualClock
    delay: Delay
    syncs: int = 0
    last_ns: list[int] = field(default_factory=lambda: [0, 0])
    due: list[tuple[int, int, int]] = field(default_factory=list)
    trouble: str = ""
    warning: str = ""

    def check(self) -> None:
        pass

    def send(self, identifier: int, data: bytes, extended: bool = False) -> None:
        assert (identifier, data, extended) == (0x80, b"", False)
        self.ask()

    def ask(self) -> None:
        """Each encoder latches now, and answers later."""
        now_ns, k = self.clock.now_ns(), self.syncs
        self.syncs += 1
        for axis in range(2):
            delay_ms = self.delay(k, axis)
            if delay_ms is not None:
                self.last_ns[axis] = max(self.last_ns[axis] + 1, now_ns + round(delay_ms * MS))
                self.due.append((self.last_ns[axis], axis, position(axis, now_ns)))

    def until(self, end_ns: int, frame: Callable[[int, bool, bytes, int], None]) -> None:
        """Deliver what comes until an instant."""
        for at_ns, axis, number in sorted(d for d in self.due if d[0] <= end_ns):
            self.clock.sleep_until_ns(at_ns)
            frame(0x18A + axis, False, (number % 2**32).to_bytes(4, "little"), at_ns)
        self.due = [d for d in self.due if d[0] > end_ns]
        self.clock.sleep_until_ns(end_ns)


def position(axis: int, at_ns: int) -> int:
    """Counts of an axis that moves evenly."""
    return (1 - 2 * axis) * ((at_ns - START_NS) // 1000)


@dataclass
class Run:
    """What the driver gave: per cycle the age of the reading, ms, or None; the largest error; the last refusal."""

    ages_ms: list[float | None]
    worst_counts: int
    texts: set[str]

    def longest_gap(self, first: int = 0) -> int:
        """Cycles in a row without a reading, from cycle `first`."""
        longest = now = 0
        for age in self.ages_ms[first:]:
            now = now + 1 if age is None else 0
            longest = max(longest, now)
        return longest


def run(delay: Delay, cycles: int, before: int = 0, **options: Any) -> Run:
    """Read so many cycles; an earlier run has sent `before` SYNCs in the milliseconds before the start."""
    clock = VirtualClock(START_NS)
    axis = {"map": ["u32"], "max_speed_mm_s": 1000.0}
    axes = {"X": {**axis, "node": 10}, "Z": {**axis, "node": 11}}
    table = {"interface": "virtual", "channel": "none", "axis": axes, **options}
    device = CanEncodersDriver(validated(CanEncoderOptions, table, "run.toml"), MACHINE, clock)
    bus, out, counts = LateBus(clock, delay), Run([], 0, set()), np.zeros(2, np.int64)
    device._port = cast(CanPort, bus)
    for _ in range(before):
        bus.ask()
        bus.until(clock.now_ns() + MS, lambda *_: None)
    for _ in range(cycles):
        bus.until(clock.now_ns() + CYCLE_NS, device._frame)
        age_ms = None
        try:
            instant_ns = device.read_counts(counts)
        except DriverTimeout as e:
            out.texts.add(str(e))
        else:
            age_ms = (clock.now_ns() - instant_ns) / MS
            right = [position(k, instant_ns) for k in range(2)]
            out.worst_counts = max(out.worst_counts, *(abs(int(c) - r) for c, r in zip(counts, right, strict=True)))
        out.ages_ms.append(age_ms)
    return out


def steady(delay_ms: float) -> Delay:
    return lambda _, axis: delay_ms + 0.1 * axis


@pytest.mark.parametrize("timeout_ms", [None, 20.0, 65.0, 450.0])
@pytest.mark.parametrize("delay_ms", [0.1, 30.0, 200.0, 700.0])
@pytest.mark.parametrize("before", [0, 1, 7])
def test_no_answer_is_credited_to_a_later_sync(delay_ms: float, timeout_ms: float | None, before: int) -> None:
    seen = run(steady(delay_ms), 5000, before, **({} if timeout_ms is None else {"timeout_ms": timeout_ms}))
    assert seen.worst_counts <= 1
    good = [a for a in seen.ages_ms if a is not None]
    assert bool(good) == (delay_ms < (timeout_ms or 20.0))
    assert all(a >= delay_ms for a in good)


def test_delays_that_change_at_once_and_frames_that_are_lost_mislead_nobody() -> None:
    """60 buses: delays from a drawn range, which changes now and then; up to a third of frames is lost."""
    for seed in range(LATE_SEEDS):
        rng = random.Random(seed)
        ranges = [(0.2, rng.choice([1.0, 5.0, 30.0, 80.0])) for _ in range(4)]
        lost = rng.choice([0.0, 0.01, 0.1, 0.3])

        def delay(k: int, _: int, rng: random.Random = rng, ranges: list[Any] = ranges, lost: float = lost) -> Any:
            return None if rng.random() < lost else rng.uniform(*ranges[k // 60 % 4])

        assert run(delay, 2000, 3).worst_counts <= 1, seed


def test_a_lost_frame_costs_less_than_the_guard_allows() -> None:
    """Oracle: counts_max_age_s of the examples, 50 ms; the readings are otherwise a cycle old."""
    seen = run(lambda k, axis: None if axis and k >= 100 and k % 150 == 0 else 0.2, 3000, timeout_ms=100.0)
    ages = [a for a in seen.ages_ms[200:] if a is not None]
    assert len(ages) == 2800
    assert 50.0 > max(ages) > 5.0
    assert sorted(ages)[len(ages) * 8 // 10] <= 1.0


def test_a_prompt_encoder_that_gets_slow_is_waited_for() -> None:
    seen = run(lambda k, _: 0.2 if k < 500 else 30.0 if k < 520 else 200.0 if k < 530 else 0.2, 10_000)
    assert seen.worst_counts <= 1
    assert seen.ages_ms[-1] == 1.0


@pytest.mark.parametrize(("delay_ms", "enough"), [(30.0, 64), (200.0, 404)])
def test_a_device_that_always_answers_late_is_named_with_the_timeout_that_it_needs(
    delay_ms: float, enough: int
) -> None:
    text = f"answers come {delay_ms + 0.1:.3g} ms after SYNC, too late for timeout_ms = 20; set timeout_ms = {enough}"
    assert any(text in t for t in run(steady(delay_ms), 5000).texts)
    assert run(steady(delay_ms), 5000, timeout_ms=enough).longest_gap(3000) == 0


def test_a_silent_encoder_is_not_called_late_and_comes_back() -> None:
    seen = run(lambda k, axis: None if axis and 500 < k < 520 else 30.0 if k == 400 else 0.2, 20_000)
    first, *others = sorted(seen.texts)
    assert first.endswith("no new positions within 20 ms (waiting for X, Z)")
    assert [t.endswith("no new positions within 20 ms (waiting for Z)") for t in others] == [True]
    assert seen.ages_ms[-1] == 1.0
    assert seen.worst_counts <= 1


def test_a_sync_that_goes_out_while_a_reading_is_published_does_not_get_it() -> None:
    """The loop may send the next SYNC between the last answer's count and the reading's instant."""
    book, sync_ns, whole = SyncBook(1), 0, False
    for now_ns in range(START_NS, START_NS + 1000 * MS, MS):
        if not whole and book.due(now_ns, 20 * MS):
            book.sent(sync_ns := now_ns)
            whole = book.takes(0, now_ns) and book.whole(now_ns)
    assert whole
    book.sent(sync_ns + MS)
    assert book.answered_ns == sync_ns

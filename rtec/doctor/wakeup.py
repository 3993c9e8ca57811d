"""`python -m rtec.doctor.wakeup`: how late this computer wakes a process that sleeps until absolute deadlines.

It is a process of its own with the loop's real-time settings, so it measures the loop's wake-ups. It reads its orders
as JSON from standard input, prints a dot every tenth of a second, and then the result as JSON.
"""

import json
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from rtec.daemon.process import prepare_process
from rtec.doctor.found import PcFinding, State
from rtec.errors import DriverUnavailable
from rtec.loop.clock import Clock, RealClock
from rtec.loop.run_file import Realtime

NS_PER_S = 1_000_000_000
DOTS_PER_S = 10
POOR = 0.1
"""A wake-up later than this share of a cycle leaves too little room for the cycle's work."""
MANY = 0.001


@dataclass(frozen=True)
class WakeUps:
    """Lateness of the wake-ups, µs.

    Attributes:
        n: number of wake-ups.
        p50_us, p99_us, p99_9_us, max_us: percentiles and largest lateness.
        late: number of wake-ups later than a whole cycle: each misses a deadline.
        refused: what the system refused; "" for nothing.
    """

    n: int
    p50_us: float
    p99_us: float
    p99_9_us: float
    max_us: float
    late: int
    refused: str


def measure(clock: Clock, rate_hz: float, seconds: float, refused: str, tell: Callable[[], None]) -> WakeUps:
    """Sleep until absolute deadlines and measure the lateness of each wake-up.

    Args:
        clock: clock that sleeps.
        rate_hz: deadlines a second.
        seconds: duration.
        refused: copied to the result.
        tell: called ten times a second.
    """
    period_ns = round(NS_PER_S / rate_hz)
    n = max(1, round(seconds * rate_hz))
    late_ns = np.zeros(n, np.int64)
    every = max(1, round(rate_hz / DOTS_PER_S))
    due_ns = clock.now_ns() + period_ns
    for k in range(n):
        clock.sleep_until_ns(due_ns)
        now_ns = clock.now_ns()
        late_ns[k] = now_ns - due_ns
        due_ns += period_ns * max(1, -(-(now_ns - due_ns) // period_ns))  # skips deadlines that have passed
        if k % every == 0:
            tell()
    p50, p99, p99_9, most = (round(float(x) * 1e-3, 1) for x in np.percentile(late_ns, (50, 99, 99.9, 100)))
    return WakeUps(n, p50, p99, p99_9, most, int(np.count_nonzero(late_ns > period_ns)), refused)


def measured(realtime: Realtime, rate_hz: float, seconds: float, tell: Callable[[int, int], None]) -> WakeUps:
    """Measure in a process of its own; `tell` is called with the amount done, and the total.

    Raises:
        DriverUnavailable: that process failed.
    """
    orders = json.dumps({"realtime": realtime.model_dump(), "rate_hz": rate_hz, "seconds": seconds})
    command = [sys.executable, "-m", "rtec.doctor.wakeup"]
    with subprocess.Popen(  # noqa: S603 - our own interpreter and module
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdin is not None  # noqa: S101 - for the type checker: both are pipes
        assert child.stdout is not None  # noqa: S101
        child.stdin.write(orders)
        child.stdin.close()
        of, outcome = round(seconds * DOTS_PER_S), ""
        for done, line in enumerate(child.stdout):
            outcome = line.strip(".\n")
            tell(min(done, of), of)
    if child.returncode or not outcome:
        raise DriverUnavailable(f"the measurement of wake-ups failed (exit status {child.returncode})")
    return WakeUps(**json.loads(outcome))


def judged(wake_ups: WakeUps, rate_hz: float) -> PcFinding:
    """Are the wake-ups early enough for the loop?"""
    cycle_us = 1e6 / rate_hz
    text = (
        f"late by {wake_ups.p50_us:.0f} µs (p50), {wake_ups.p99_us:.0f} (p99), {wake_ups.p99_9_us:.0f} (p99.9), "
        f"{wake_ups.max_us:.0f} (max) of {wake_ups.n}, cycle {cycle_us:.0f} µs"
    )
    state: State = "good"
    why = ""
    if wake_ups.late > MANY * wake_ups.n:
        state, why = "wrong", f"{wake_ups.late} of {wake_ups.n} came later than a whole cycle: deadlines are missed"
    elif wake_ups.late or wake_ups.p99_9_us > POOR * cycle_us:
        state, why = (
            "better",
            f"{wake_ups.late} came later than a whole cycle"
            if wake_ups.late
            else "a tenth of the cycle and more is over before its work begins",
        )
    if wake_ups.refused:
        why = "; ".join(t for t in (why, f"measured without: {wake_ups.refused}") if t)
    return PcFinding("wake-ups", text, state, why)


def main() -> None:
    """Measure as ordered."""
    orders: dict[str, Any] = json.load(sys.stdin)
    realtime = Realtime.model_validate(orders["realtime"])
    refused = prepare_process(realtime)

    def dot() -> None:
        sys.stdout.write(".\n")
        sys.stdout.flush()

    wake_ups = measure(RealClock(), orders["rate_hz"], orders["seconds"], "; ".join(refused), dot)
    sys.stdout.write(json.dumps(asdict(wake_ups)) + "\n")


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):  # the parent, which has it too, says so
        main()

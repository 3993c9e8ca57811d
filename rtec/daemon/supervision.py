"""Supervision of the daemon's parts: one mechanism for every thread, process and job that can fail by itself.

A part that fails is reported (an event, so also a line in the journal), counted (`Status.faults`, Prometheus) and
restarted after a wait that doubles from half a second to half a minute. A minute without a fault begins a new series.

A part that fails `LOST_AFTER` times in a row is lost. Where the daemon must not correct without it (`essential`), the
supervisor orders a hold and asks the service manager to restart the daemon. The part is still restarted.
"""

import threading
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Final

from rtec.errors import RtecError, unforeseen
from rtec.loop.clock import Clock
from rtec.loop.orders import LONGEST_TEXT

FIRST_WAIT_NS: Final = 500_000_000
LONGEST_WAIT_NS: Final = 30_000_000_000
WELL_NS: Final = 60_000_000_000
"""A part that has run for this time, ns, has recovered: its next fault is the first of a series."""
LOST_AFTER: Final = 6
"""Faults in a row; some 30 s from the first to the last where the part fails at once each time."""
FRAMES: Final = 3

Report = Callable[[str], None]
"""Called with a sentence, from any thread; does not wait."""


class DaemonPart:
    """One part: counts its faults, and times its restarts. Made by `DaemonParts.add`.

    Attributes:
        name: name of the part in the status.
        essential: the daemon must not correct without it.
        faults: how often it failed.
        report: writes a sentence about it to the events; from any thread.
    """

    def __init__(self, name: str, clock: Clock, report: Report, essential: bool = False) -> None:
        self.name, self.essential, self.faults = name, essential, 0
        self._clock, self.report = clock, report
        self._why, self._in_a_row, self._failed_ns, self._wait_ns = "", 0, 0, FIRST_WAIT_NS

    @property
    def due(self) -> bool:
        """May it (re)start now?"""
        return self.wait_s <= 0

    @property
    def wait_s(self) -> float:
        """Time until its restart, s."""
        return max(0, self._failed_ns + self._wait_ns - self._clock.now_ns()) * 1e-9 if self._in_a_row else 0.0

    @property
    def lost(self) -> bool:
        """Has it failed too often in a row?"""
        return self._in_a_row >= LOST_AFTER and not self._well

    @property
    def trouble(self) -> str:
        """Its present fault; "" where there is none."""
        return self._why if self.lost or not self.due else ""

    def failed(self, why: str, again: str = "begun again") -> str:
        """Count a fault and report it with the wait that follows; give the reported text.

        Args:
            why: in words.
            again: what follows the wait, in words.
        """
        new = not self._in_a_row or self._well
        self._wait_ns = FIRST_WAIT_NS if new else min(2 * self._wait_ns, LONGEST_WAIT_NS)
        self._in_a_row = 1 if new else self._in_a_row + 1
        self._failed_ns, self._why = self._clock.now_ns(), why
        self.faults += 1
        text = f"{why}; {again} in {self._wait_ns * 1e-9:g} s"
        if self._in_a_row == LOST_AFTER:
            text += f"; it failed {LOST_AFTER} times in a row"
        self.report(text)
        return text

    def keep(self, work: Callable[[], None], stop: threading.Event) -> None:
        """Run work until it returns; restart it after each exception.

        Args:
            work: each call starts from the state that it keeps outside; it checks `stop` itself.
            stop: once set, work is restarted once more at most, to end in order.
        """
        while True:
            last = stop.is_set()
            try:
                work()
            except Exception as e:  # noqa: BLE001 - any fault is reported, and the part is restarted
                self.failed(fault(e))
            else:
                return
            if last:
                return
            stop.wait(self.wait_s)

    @property
    def _well(self) -> bool:
        return self._clock.now_ns() - self._failed_ns > self._wait_ns + WELL_NS


class KeptThread:
    """A thread that restarts its work when that fails.

    Args:
        part: counts its faults.
        work: as for `DaemonPart.keep`.

    Attributes:
        stop: set by `end`.
    """

    def __init__(self, part: DaemonPart, work: Callable[[], None]) -> None:
        self.stop = threading.Event()
        self._thread = threading.Thread(
            target=part.keep, args=(work, self.stop), name=f"rtec-{part.name}".replace(" ", "-"), daemon=True
        )

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def end(self, timeout_s: float) -> bool:
        """Ask it to end; return whether it did within the time."""
        self.stop.set()
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
        return not self._thread.is_alive()


class DaemonParts:
    """All parts of a daemon.

    Args:
        clock: monotonic.
        tell: writes a fault to the events: kind of event, text; from any thread.
    """

    def __init__(self, clock: Clock, tell: Callable[[str, str], None]) -> None:
        self._clock, self._tell = clock, tell
        self._parts: dict[str, DaemonPart] = {}
        self._shown: list[DaemonPart] = []

    def add(self, name: str, essential: bool = False, device: bool = False) -> DaemonPart:
        """Add a part.

        Args:
            name: name of the part, for people: "disk", "control".
            essential: the daemon must not correct without it.
            device: the worker of a device, whose trouble is in `Status.devices`.
        """

        def report(text: str) -> None:
            if device:
                self._tell("worker", f"{name}: {text}")
            else:
                self._tell("fault", f"{name}: {text}")

        part = DaemonPart(name, self._clock, report, essential)
        self._parts[name] = part
        if not device:
            self._shown.append(part)
        return part

    @property
    def faults(self) -> dict[str, int]:
        """Number of failures by part, of the parts that failed."""
        return {name: part.faults for name, part in list(self._parts.items()) if part.faults}

    @property
    def troubles(self) -> dict[str, str]:
        """Present faults by part; without the devices' workers."""
        return {part.name: text for part in list(self._shown) if (text := part.trouble)}

    @property
    def lost(self) -> list[str]:
        """Essential parts that are lost."""
        return [name for name, part in list(self._parts.items()) if part.essential and part.lost]


def fault(error: Exception) -> str:
    """An exception in a sentence: a user's own error as it is; else its kind, and where it occurred."""
    if isinstance(error, RtecError):
        return str(error)
    frames = traceback.extract_tb(error.__traceback__)[-FRAMES:]
    where = " < ".join(f"{Path(frame.filename).name}:{frame.lineno}" for frame in reversed(frames))
    return f"{unforeseen(error)[:LONGEST_TEXT]} ({where})"

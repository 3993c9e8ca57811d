"""What keeps the parts of the daemon alive: one mechanism for every thread, process and job that can fail by itself.

A part that fails is reported (an event, so also a line in the journal), counted (`Status.faults`, Prometheus) and begun
again after a wait that doubles from half a second to half a minute. A minute without a fault begins a new series.

A part that fails `LOST_AFTER` times in a row is lost. Where the daemon must not correct without it (`essential`), the
supervisor orders a hold and asks the service manager to restart the daemon. The part is tried again all the same.
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
"""A part that has gone on for so long is well again: the next fault is the first of a series."""
LOST_AFTER: Final = 6
"""Faults in a row, some 30 s from the first to the last where the part fails at once each time."""
FRAMES: Final = 3

Report = Callable[[str], None]
"""Told a sentence; from any thread, waits for nothing."""


class DaemonPart:
    """One part: counts its faults, and says when it may begin again. Made by `Parts.add`.

    Attributes:
        name: of the part, as in the status.
        essential: the daemon must not correct without it.
        faults: how often it failed.
        report: puts a sentence about it into the events; from any thread.
    """

    def __init__(self, name: str, clock: Clock, report: Report, essential: bool = False) -> None:
        self.name, self.essential, self.faults = name, essential, 0
        self._clock, self.report = clock, report
        self._why, self._in_a_row, self._failed_ns, self._wait_ns = "", 0, 0, FIRST_WAIT_NS

    @property
    def due(self) -> bool:
        """May it begin (again)?"""
        return self.wait_s <= 0

    @property
    def wait_s(self) -> float:
        """How long it still waits before it begins again, s."""
        return max(0, self._failed_ns + self._wait_ns - self._clock.now_ns()) * 1e-9 if self._in_a_row else 0.0

    @property
    def lost(self) -> bool:
        """Has it failed too often in a row to be counted on?"""
        return self._in_a_row >= LOST_AFTER and not self._well

    @property
    def trouble(self) -> str:
        """Why it does not work now; "" where it works."""
        return self._why if self.lost or not self.due else ""

    def failed(self, why: str, again: str = "begun again") -> str:
        """Count a fault, report it with the wait that follows; give what was reported.

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
        """Do some work until it returns; begin it again after each exception.

        Args:
            work: begins anew each time from what it keeps outside; looks at `stop` by itself.
            stop: set: it is begun once more at most, to end in order.
        """
        while True:
            last = stop.is_set()
            try:
                work()
            except Exception as e:  # noqa: BLE001 - whatever it is: the part lives, and says so
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
    """A thread that begins its work again when that failed.

    Args:
        part: counts its faults.
        work: as for `Part.keep`.

    Attributes:
        stop: set by `end`.
    """

    def __init__(self, part: DaemonPart, work: Callable[[], None]) -> None:
        self.stop = threading.Event()
        self._thread = threading.Thread(
            target=part.keep, args=(work, self.stop), name=f"rtec-{part.name}".replace(" ", "-"), daemon=True
        )

    def start(self) -> None:
        """Start it."""
        self._thread.start()

    def end(self, timeout_s: float) -> bool:
        """Ask it to end; say whether it did within so long."""
        self.stop.set()
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
        return not self._thread.is_alive()


class DaemonParts:
    """All parts of a daemon.

    Args:
        clock: monotonic.
        tell: puts a fault into the events: kind of event, text; from any thread.
    """

    def __init__(self, clock: Clock, tell: Callable[[str, str], None]) -> None:
        self._clock, self._tell = clock, tell
        self._parts: dict[str, DaemonPart] = {}
        self._shown: list[DaemonPart] = []

    def add(self, name: str, essential: bool = False, device: bool = False) -> DaemonPart:
        """Give a new part.

        Args:
            name: of the part, for people: "disk", "control".
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
        """How often each part failed, of those that did."""
        return {name: part.faults for name, part in list(self._parts.items()) if part.faults}

    @property
    def troubles(self) -> dict[str, str]:
        """Why a part does not work now, by part; without the devices' workers."""
        return {part.name: text for part in list(self._shown) if (text := part.trouble)}

    @property
    def lost(self) -> list[str]:
        """Essential parts that cannot be counted on."""
        return [name for name, part in list(self._parts.items()) if part.essential and part.lost]


def fault(error: Exception) -> str:
    """An exception in a sentence: what a user can mend as it stands; else what it is, and where it came from."""
    if isinstance(error, RtecError):
        return str(error)
    frames = traceback.extract_tb(error.__traceback__)[-FRAMES:]
    where = " < ".join(f"{Path(frame.filename).name}:{frame.lineno}" for frame in reversed(frames))
    return f"{unforeseen(error)[:LONGEST_TEXT]} ({where})"

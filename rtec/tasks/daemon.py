"""Connection of the pages to a running daemon: polls its status over its socket, which the loop does not serve.

One connection serves all tabs. It polls five times a second while a page shows the status, else once a second for the
sparklines.
"""

import asyncio
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rtec.control.client import Client, Outcome, carry_out, find
from rtec.control.messages import Role
from rtec.errors import RtecError
from rtec.loop.clock import Clock, RealClock, wall_clock_iso
from rtec.loop.orders import order_named
from rtec.report.daemon import DaemonMoment, Moment

LOOKED_S, ALONE_S, AGAIN_S = 0.2, 1.0, 1.0
NAME: Final = "studio"
SECOND, MINUTE = 1.0, 60.0
MINUTES, HOURS = 600, 1440
"""Number of stored points, one a second and one a minute."""
EARLIER: Final = 50
"""Largest number of events of earlier runs that are stored."""


def limits_of(config: Path) -> dict[str, tuple[float, float]]:
    """Limits by axis, µm: correction above which it is flagged, and above which it is not followed.

    They are read as the daemon reads them; a run file that it would refuse has none.
    """
    from rtec.loop.run_file import load_setup

    try:
        limits = load_setup(config, needs_model=False).file.limits
    except RtecError:
        return {}
    return {axis: (each.warning_um, each.stop_um) for axis, each in limits.items()}


@dataclass(frozen=True)
class _Heard:
    """The newest answer: the process, the time of its newest row, s, when it came, ns, and its events."""

    pid: int
    time_s: float
    at_ns: int
    events: Sequence[Mapping[str, Any]]


class LiveLink:
    """The connection to a daemon.

    Attributes:
        config: its run file; `role` has the rights of the pages.
        status: its newest answer; None before the first, or while it does not answer (`trouble` has the reason).
        limits_um: by axis: correction above which it is flagged, and above which it is not followed.
        minutes, hours: points of the sparklines; a point without values separates the runs of the daemon.
        runs: number of the runs of the daemon that were seen.

    Args:
        config: see above.
        role: see above.
        clock: tells how long the daemon did not run.
    """

    def __init__(self, config: Path, role: Role, clock: Clock | None = None) -> None:
        self.config, self.role = config, role
        self.status: dict[str, Any] | None = None
        self.trouble = "not asked yet"
        self.limits_um: Mapping[str, tuple[float, float]] = {}
        self._read_ns = -1
        self.minutes: deque[Moment] = deque(maxlen=MINUTES)
        self.hours: deque[Moment] = deque(maxlen=HOURS)
        self._looking: dict[int, Callable[[], None]] = {}
        self._client: Client | None = None
        self._clock: Clock = clock or RealClock()
        self.runs = 0
        self._heard: _Heard | None = None
        self._begins = True  # a run of which no point is stored yet
        self._began_s = 0.0  # first row of this run, on the time of the sparklines
        self._earlier: tuple[Mapping[str, Any], ...] = ()

    @property
    def events(self) -> list[Mapping[str, Any]]:
        """Events of the daemon, oldest first, with those of its earlier runs."""
        return [*self._earlier, *(self._heard.events if self._heard is not None else ())]

    def moment(self) -> DaemonMoment | None:
        """The daemon as it is now, for a report; None while it does not answer."""
        if self.status is None:
            return None
        status = {**self.status, "events": self.events}
        return DaemonMoment(wall_clock_iso(), status, self.limits_um, tuple(self.minutes), tuple(self.hours), self.runs)

    def look(self, key: int, changed: Callable[[], None]) -> None:
        """Register a callback that is called after each new status."""
        self._looking[key] = changed

    def leave(self, key: int) -> None:
        """Remove a callback."""
        self._looking.pop(key, None)

    async def follow(self) -> None:
        """Poll the daemon until the server ends."""
        while True:
            try:
                self.status, self.trouble = await asyncio.to_thread(self._ask), ""
                self.note(self.status)
            except RtecError as e:
                self.status, self.trouble = None, str(e)
                self._hang_up()
            for changed in list(self._looking.values()):
                changed()
            await asyncio.sleep(AGAIN_S if self.status is None else LOOKED_S if self._looking else ALONE_S)

    async def order(self, name: str, text: str = "") -> Outcome:
        """Give an order, and wait for its outcome.

        Raises:
            RtecError: the order is refused, or the daemon does not answer.
        """
        return await asyncio.to_thread(self._order, name, text)

    def _order(self, name: str, text: str) -> Outcome:
        with self._connected() as client:
            return carry_out(client, order_named(name), text, RealClock())

    def _ask(self) -> dict[str, Any]:
        if self._client is None:
            self._client = self._connected()
        self._look_at_limits()
        return self._client.status()

    def _look_at_limits(self) -> None:
        """Read the run file's limits again if it was changed: the daemon may have reloaded it."""
        try:
            changed_ns = self.config.stat().st_mtime_ns
        except OSError:
            return
        if changed_ns != self._read_ns:
            self.limits_um, self._read_ns = limits_of(self.config), changed_ns

    def _connected(self) -> Client:
        client = Client(find(self.config, None, None))
        try:
            client.lower(NAME, self.role)
        except RtecError:
            client.close()
            raise
        return client

    def _hang_up(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None

    def note(self, found: Mapping[str, Any]) -> None:
        """Store what an answer of the daemon tells of its past; the time of a restarted daemon goes on behind a gap."""
        s, last = found["status"], self._heard
        time_s, now_ns = (s["time_s"] if s["cycles"] else 0.0), self._clock.now_ns()
        restarted = last is not None and (found["pid"] != last.pid or time_s < last.time_s)
        if last is not None and restarted:
            self._began_s += last.time_s + (now_ns - last.at_ns) * 1e-9 - time_s
            self._begins = True
            if found["pid"] != last.pid:
                self._earlier = (*self._earlier, *last.events)[-EARLIER:]
        self._heard = _Heard(found["pid"], time_s, now_ns, found["events"])
        if not s["cycles"]:
            return
        begins, self.runs = self._begins, self.runs + self._begins
        self._begins = False
        now = Moment(self._began_s + time_s, s["applied_um"], s["degc"])
        for kept, every in ((self.minutes, SECOND), (self.hours, MINUTE)):
            if kept and begins:
                kept.append(Moment(kept[-1].time_s, {}, {}))
            if not kept or kept[-1].is_gap or now.time_s - kept[-1].time_s >= every:
                kept.append(now)

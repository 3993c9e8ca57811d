"""Connection of the pages to a running daemon: polls its status over its socket, which the loop does not serve.

One connection serves all tabs. It polls five times a second while a page shows the status, else once a second for the
sparklines.
"""

import asyncio
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from rtec.control.client import Client, Outcome, carry_out, find
from rtec.control.messages import Role
from rtec.errors import RtecError
from rtec.loop.clock import RealClock, wall_clock_iso
from rtec.loop.orders import order_named
from rtec.report.daemon import DaemonMoment, Moment

LOOKED_S, ALONE_S, AGAIN_S = 0.2, 1.0, 1.0
NAME: Final = "studio"
SECOND, MINUTE = 1.0, 60.0
MINUTES, HOURS = 600, 1440
"""Number of stored points, one a second and one a minute."""


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


class LiveLink:
    """The connection to a daemon.

    Attributes:
        config: its run file; `role` has the rights of the pages.
        status: its newest answer; None before the first, or while it does not answer (`trouble` has the reason).
        limits_um: by axis: correction above which it is flagged, and above which it is not followed.
        minutes, hours: points of the sparklines.

    Args:
        config: see above.
        role: see above.
    """

    def __init__(self, config: Path, role: Role) -> None:
        self.config, self.role = config, role
        self.status: dict[str, Any] | None = None
        self.trouble = "not asked yet"
        self.limits_um: Mapping[str, tuple[float, float]] = {}
        self._read_ns = -1
        self.minutes: deque[Moment] = deque(maxlen=MINUTES)
        self.hours: deque[Moment] = deque(maxlen=HOURS)
        self._looking: dict[int, Callable[[], None]] = {}
        self._client: Client | None = None

    def moment(self) -> DaemonMoment | None:
        """The daemon as it is now, for a report; None while it does not answer."""
        if self.status is None:
            return None
        return DaemonMoment(wall_clock_iso(), self.status, self.limits_um, tuple(self.minutes), tuple(self.hours))

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
                self._note(self.status)
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

    def _note(self, found: dict[str, Any]) -> None:
        s = found["status"]
        if not s["cycles"]:
            return
        now = Moment(s["time_s"], s["applied_um"], s["degc"])
        for kept, every in ((self.minutes, SECOND), (self.hours, MINUTE)):
            if kept and now.time_s < kept[-1].time_s:
                kept.clear()  # the daemon was restarted
            if not kept or now.time_s - kept[-1].time_s >= every:
                kept.append(now)

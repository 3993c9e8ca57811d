"""Watches the daemon during the faults, and gives the operator's orders."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from rtec.daemon.status import Status
from rtec.hil import FaultOrder
from rtec.loop.clock import Clock
from rtec_drivers.hil.catalogue import FAULTS, Bus

AFTER_S = 0.5
"""Time, s, after which the operator notices that a fault is over and orders to resume."""
LATER_S = 3.0
"""A message this long after a fault's end, s, may still be on that fault."""


@dataclass
class DeviceReports:
    """The daemon's messages during one fault.

    Attributes:
        noticed_s: time from its begin to the first new message; NaN: none yet.
        texts: last message by device.
    """

    noticed_s: float = math.nan
    texts: dict[str, str] = field(default_factory=dict)


class FaultWatch:
    """Processes every status.

    Args:
        faults: ordered faults.
        buses: bus by device: a device's message is attributed to faults of its own bus.
        clock: clock of `start_ns`.
        tell: called with the seconds done.

    Attributes:
        start_ns: start of the corrected run.
        resume: gives the daemon the order to resume.
        place: the bench's folder, which is removed from messages.
        faults: ordered faults.
        reports: one element a fault.
        unasked: last message on a device while its bus had no fault.
    """

    def __init__(
        self,
        faults: Sequence[FaultOrder],
        buses: Mapping[str, Bus],
        clock: Clock,
        tell: Callable[[float], None],
    ) -> None:
        self.start_ns = 0
        self._buses = buses
        self.reports = [DeviceReports() for _ in faults]
        self.unasked: dict[str, str] = {}
        self.faults, self._clock, self._tell = faults, clock, tell
        self.resume: Callable[[], None] = lambda: None
        self.place = ""
        self._orders = sorted((f.end_s + AFTER_S for f in faults if FAULTS[f.name].needs_order), reverse=True)

    def look(self, status: Status) -> None:
        """Record its messages; order to resume when that is due."""
        if not self.start_ns:
            return
        now_s = (self._clock.now_ns() - self.start_ns) * 1e-9
        self._tell(now_s)
        while self._orders and now_s >= self._orders[-1]:
            self._orders.pop()
            self.resume()
        for device, reasons in status.devices.items():
            text = "; ".join(reasons)
            self._note(now_s, device, text.replace(self.place, "") if self.place else text)

    def _note(self, now_s: float, device: str, text: str) -> None:
        mine = [
            k
            for k, f in enumerate(self.faults)
            if f.at_s <= now_s <= f.end_s + LATER_S and FAULTS[f.name].bus == self._buses.get(device)
        ]
        if not mine:
            self.unasked[device] = text
        for k in mine:
            reports = self.reports[k]
            if math.isnan(reports.noticed_s):
                reports.noticed_s = now_s - self.faults[k].at_s
            if now_s <= self.faults[k].end_s or device not in reports.texts:
                reports.texts[device] = text

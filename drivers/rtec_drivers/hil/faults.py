"""The faults that the bench can cause, by name (`injector` causes them), and a watch over the daemon meanwhile."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from rtec.daemon.status import Status
from rtec.hil import FaultOrder
from rtec.loop.clock import Clock

Bus = Literal["box", "modbus", "can"]
BUS_OF_DRIVER: dict[str, Bus] = {"serial_box": "box", "modbus": "modbus", "can": "can"}


@dataclass(frozen=True)
class BusFault:
    """One fault.

    Attributes:
        bus: bus that has the fault.
        what: description.
        needs_order: must the operator order to resume after it?
    """

    bus: Bus
    what: str
    needs_order: bool = False


FAULTS: dict[str, BusFault] = {
    "box-unplugged": BusFault("box", "the box's cable is pulled, whatever is on the line, and put back: another port"),
    "box-silent": BusFault("box", "the box does not answer"),
    "box-garbage": BusFault("box", "garbage before every answer and between them"),
    "box-crc": BusFault("box", "one answer in a hundred arrives with a wrong bit"),
    "box-half-frames": BusFault("box", "one answer in ten ends in its middle"),
    "box-late": BusFault("box", "every answer comes 3 ms late, so it belongs to an older question"),
    "box-frozen": BusFault("box", "the box answers, always with the same instant and counts"),
    "box-reset": BusFault("box", "the box restarts: its ledger is zero; ordered to resume at the end", True),
    "box-count-jump": BusFault("box", "the counters jump by 10 mm; at the end they are right, ordered to resume", True),
    "box-encoder-fault": BusFault("box", "a line of an encoder is broken; ordered to resume at the end", True),
    "modbus-unplugged": BusFault("modbus", "the line's cable is pulled and put back: another port"),
    "modbus-silent": BusFault("modbus", "the first slave does not answer; the others do"),
    "modbus-garbage": BusFault("modbus", "garbage before every answer and between them"),
    "modbus-crc": BusFault("modbus", "one answer in a hundred arrives with a wrong bit"),
    "modbus-half-frames": BusFault("modbus", "every third answer ends in its middle"),
    "modbus-late": BusFault("modbus", "the first slave answers 700 ms late, so to an older request"),
    "modbus-wrong-node": BusFault("modbus", "another slave answers in the place of the first"),
    "modbus-frozen": BusFault("modbus", "the first slave's values stay as they are"),
    "modbus-open": BusFault("modbus", "a thermocouple of the first slave is open"),
    "can-unplugged": BusFault("can", "the adapter is pulled out and put back: another port"),
    "can-silent": BusFault("can", "the sensors say nothing"),
    "can-garbage": BusFault("can", "garbage before every frame and between them"),
    "can-lost-frames": BusFault("can", "one frame in a hundred has a wrong CRC, so the adapter drops it"),
    "can-half-frames": BusFault("can", "every third frame ends in its middle, between adapter and computer"),
    "can-late": BusFault("can", "every frame comes 700 ms late"),
    "can-wrong-node": BusFault("can", "the sensors send as another node"),
    "can-frozen": BusFault("can", "the values stay as they are"),
    "can-open": BusFault("can", "a thermocouple is open"),
    "can-bus-off": BusFault("can", "the adapter has left the bus: no frames either way"),
}


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

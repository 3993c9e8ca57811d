"""The zero of the axes: what the loop adds to a device's counts, so that count 0 is position 0 of the machine.

An incremental encoder counts from where the axis stood when its device got its supply. With `[run] zero = "ordered"` a
person orders where the axes stand (`rtec ctl home X=0 Z=120`). That holds over all runs until the device loses its
supply; without it the correction holds. With `[run] zero = "counts"` the device's count 0 is position 0: then the
device got its supply at the machine's zero, or its encoders are absolute. Where it was without supply between two runs,
the loop waits for the order to resume.

Rows, logs and the kept state have the counts after the addition: a log replays without it.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtec.arrays import Bools, Ints
from rtec.loop.orders import OrderRefused
from rtec.loop.ports import HOLDS, CountSource, Incremental
from rtec.machine import Machine
from rtec.wording import POSITIONS_NOT_KNOWN

UNKNOWN: Final = -1
"""Number of a device's start where it is not known."""


BEYOND: Final = 0.05
"""Share of its travel by which an axis may be outside it: the travel is of the controller's software limits."""


def beyond_travel(machine: Machine, counts: Ints) -> list[str]:
    """A line for each axis whose counts are a position far outside its travel, where no axis can be."""
    out = []
    for axis, n in zip(machine.axes, counts.tolist(), strict=True):
        (low, high), at = axis.travel_mm, n / axis.counts_per_mm
        if max(low - at, at - high) > BEYOND * (high - low):
            out.append(f"axis {axis.name} is at {at:.3f} mm; its travel_mm is {low:g} to {high:g}")
    return out


class Zero:
    """The zero of one run's axes.

    Attributes:
        offset: added to the device's counts, by axis.
        supply: number of the start of the device that the offset belongs to; UNKNOWN before its first reading.
        known: are the positions of the axes known?
        by_order: does an order give them?
        why: why they are not known; "" where they are.
        restarted: why an order to resume is needed, as `lost` gave it last; "" where it is not.

    Args:
        source: the device.
        axes: names of the axes.
        by_order: `[run] zero` is "ordered".
    """

    def __init__(self, source: CountSource, axes: tuple[str, ...], by_order: bool) -> None:
        self.offset: Ints = np.zeros(len(axes), np.int64)
        self.supply, self.by_order, self.known = UNKNOWN, by_order, not by_order
        self.restarted = ""
        self._axes, self._source = axes, source if isinstance(source, Incremental) else None
        self.why = "" if self.known else self._say("nobody has ordered them since this device got its supply")

    def go_on(self, offset: Ints, supply: int, known: bool) -> None:
        """Take over the zero of the run before."""
        self.supply = supply
        if self.by_order and known:
            self.offset[:], self.known, self.why = offset, True, ""

    def lost(self) -> str:
        """After a reading: was the device without supply? Give why an order to resume is needed; "" where none is."""
        source = self._source
        if source is None or source.supply in (self.supply, UNKNOWN):
            return ""
        before, self.supply = self.supply, source.supply
        if before == UNKNOWN:
            return ""
        starts = f"(start {self.supply}, before {before})"
        if self.by_order:
            self.offset[:], self.known = 0, False
            self.why = self._say(f"this device was without supply {starts}")
            return ""
        self.restarted = (
            f"it was without supply since the run before {starts}: its count 0 is where the axes stood then, and must "
            f"be the machine's zero; {HOLDS}"
        )
        return self.restarted

    def resume(self) -> None:
        """Accept the device as it is, where its count 0 is the machine's zero."""
        if not self.by_order:
            self.supply = UNKNOWN

    def home(self, by: Ints) -> None:
        """Add these counts to the offset, by axis: the positions are known."""
        self.offset += by
        self.known, self.why = True, ""

    def _say(self, why: str) -> str:
        order = " ".join(f"{axis}=…" for axis in self._axes)
        return (
            f"{POSITIONS_NOT_KNOWN}: {why}. The correction holds until they are ordered: reference "
            f"the axes, then `rtec ctl home {order}` (mm)"
        )


@dataclass(frozen=True)
class Home:
    """An order for the loop. It says by how much the counts were wrong, so an axis may move before the loop has it.

    Attributes:
        axes: whose position is ordered, (axes,).
        by: what must be added to their counts, (axes,); 0 for the others.
        supply: number of the device's start that these counts belong to.
    """

    axes: Bools
    by: Ints
    supply: int


def home_of(positions_mm: Mapping[str, float], machine: Machine, counts: Ints, supply: int) -> Home:
    """The order for the loop, from positions by axis name, and the counts of all axes at that instant, (axes,)."""
    axes = np.array([a.name in positions_mm for a in machine.axes])
    wanted = [round(positions_mm.get(a.name, 0.0) * a.counts_per_mm) for a in machine.axes]
    return Home(axes, np.where(axes, np.array(wanted, np.int64) - counts, 0), supply)


def read_positions(text: str, machine: Machine) -> dict[str, float]:
    """Read the text of an order to home, as "X=0 Z=120.5": positions, mm, by axis name.

    Raises:
        OrderRefused: the text is malformed, an axis is unknown or named twice, or a position is outside its travel.
    """
    out: dict[str, float] = {}
    travel_mm = {a.name: a.travel_mm for a in machine.axes}
    for part in text.split():
        match = re.fullmatch(r"([^=]+)=([^=]+)", part)
        position = _number(match[2]) if match else math.nan
        if match is None or not math.isfinite(position):
            raise OrderRefused(f"home: {part!r} is not AXIS=POSITION in mm, such as {machine.axis_names[0]}=0")
        axis = match[1]
        if axis not in travel_mm:
            raise OrderRefused(f"home: the machine has no axis {axis!r}; its axes are {', '.join(machine.axis_names)}")
        if axis in out:
            raise OrderRefused(f"home: axis {axis} is named twice")
        low, high = travel_mm[axis]
        if not low <= position <= high:
            raise OrderRefused(f"home: {axis} = {position:.10g} mm is outside its travel, {low:g} to {high:g} mm")
        out[axis] = position
    if not out:
        raise OrderRefused(f"home: name where the axes stand: {' '.join(f'{a}=…' for a in machine.axis_names)} (mm)")
    return out


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan

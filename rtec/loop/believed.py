"""Temperatures that may be believed: a reading that jumps as no part of a machine can is not used.

A loose plug or a swapped cable gives a number within the sensor's range, which nothing else would find. What a sensor
reads instead is not used until it is back near the last reading that was, or until the order to resume. Meanwhile that
reading keeps its instant, so the guard holds the correction once it is too old.
"""

from collections.abc import Collection
from typing import Final

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.errors import DriverError, DriverFault
from rtec.loop.ports import TemperatureSource
from rtec.machine import Machine
from rtec.wording import TO_RESUME

STEP_DEGC: Final = 2.0
"""Largest change, °C, from one reading to the next, however soon: coarse steps and noise are far below."""
RATE_DEGC_PER_S: Final = 0.1
"""This much more, °C, for each second between them: parts of a machine warm more slowly."""
AHEAD_NS: Final = 1_000_000_000
"""A reading is from the future where its instant is later than now by more than this."""


def ahead_in_words(instant_ns: int, now_ns: int) -> str:
    """What to say of a reading from the future; "" of any other. The guard counts it as old as it is ahead."""
    if instant_ns - now_ns <= AHEAD_NS:
        return ""
    return (
        f"its readings are {(instant_ns - now_ns) * 1e-9:.2g} s ahead of the loop's clock: the driver, or the device, "
        "stamps them by another clock than clock.now_ns(), so nobody knows how old they are"
    )


class BelievedTemperatures:
    """A device's temperatures without jumps.

    Args:
        source: the device.
        machine: its sensors.
    """

    def __init__(self, source: TemperatureSource, machine: Machine) -> None:
        self._source, self._sensors = source, machine.sensors
        n = len(machine.sensors)
        self._degc, self._time_ns = np.full(n, np.nan), np.full(n, -1, dtype=np.int64)  # -1: not of this device
        self._believed_degc, self._believed_ns = self._degc.copy(), self._time_ns.copy()
        self._judged = self._time_ns.tobytes()
        self._jumped: dict[str, str] = {}

    def read(self, degc: Floats, time_ns: Ints, used: Collection[str], now_ns: int) -> None:
        """Fill in what is new and believed, °C and instants, ns; `used` are the sensors that the model reads.

        Raises:
            DriverError: the device's own; or a sensor jumped, or is from the future of `now_ns`.
        """
        wrong = []
        try:
            self._source.read_temperatures(self._degc, self._time_ns)
        except DriverError as e:  # the good values are in the arrays all the same
            wrong.append(str(e))
        instants = self._time_ns.tobytes()
        if instants != self._judged:
            for i in np.flatnonzero(self._time_ns != np.frombuffer(self._judged, np.int64)).tolist():
                if self._believable(i, used):
                    degc[i], time_ns[i] = self._degc[i], self._time_ns[i]
            self._judged = instants
        if ahead := ahead_in_words(int(self._time_ns.max(initial=0)), now_ns):
            wrong.append(ahead)
        if wrong or self._jumped:
            raise DriverFault("; ".join([*wrong, *self._jumped.values()]))

    @property
    def must_resume(self) -> bool:
        """Did a sensor that the model reads jump, and is not back?"""
        return bool(self._jumped)

    def resume(self) -> None:
        """Believe the next reading of every sensor."""
        self._jumped.clear()
        self._believed_degc.fill(np.nan)
        self._judged = np.full_like(self._time_ns, -1).tobytes()

    def _believable(self, i: int, used: Collection[str]) -> bool:
        sensor, value, last = self._sensors[i], float(self._degc[i]), float(self._believed_degc[i])
        low, high = sensor.range_degc
        if not low <= value <= high:  # the guard judges what is no temperature
            return True
        gone_s = int(self._time_ns[i] - self._believed_ns[i]) * 1e-9
        allowed = STEP_DEGC + (0.0 if sensor.name in self._jumped else RATE_DEGC_PER_S * max(gone_s, 0.0))
        if sensor.name in used and abs(value - last) > allowed:
            self._jumped.setdefault(
                sensor.name,
                f"{sensor.name}: jumped from {last:.2f} to {value:.2f} °C within {gone_s:.2g} s, as no part of a "
                f"machine can: not used until it is back; look at its plug and cable; if it is right: {TO_RESUME}",
            )
            return False
        self._jumped.pop(sensor.name, None)
        self._believed_degc[i], self._believed_ns[i] = value, self._time_ns[i]
        return True

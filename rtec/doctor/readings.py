"""Readings of one device so far: newest values, their ages, the rate of new ones, the share of failures."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from rtec.correction.sinks import PulseSink
from rtec.doctor.found import Patient, Value
from rtec.errors import DriverError
from rtec.loop.clock import Clock

NS = 1e-9
NOTHING_YET = -(2**62)
FAILING_NS = 100_000_000
"""Time without a good reading, ns, above which it is no hiccup."""
MANY = 0.1
"""A device that fails in more than this share of the readings is faulty, even if it recovers each time."""
KEPT = 10_000


class Rate:
    """Counts the new instants of one value."""

    def __init__(self) -> None:
        self.first_ns = self.newest_ns = NOTHING_YET
        self._news = 0

    @property
    def started(self) -> bool:
        """Was there any?"""
        return self.newest_ns != NOTHING_YET

    def record(self, time_ns: int) -> None:
        """Record the instant of a reading; 0 means that there was none."""
        if time_ns in (self.newest_ns, 0):
            return
        if self.started:
            self._news += 1
        else:
            self.first_ns = time_ns
        self.newest_ns = time_ns

    def hz(self) -> float | None:
        """New values a second; None before the second one."""
        span_s = (self.newest_ns - self.first_ns) * NS
        return self._news / span_s if self._news and span_s > 0 else None

    def age_s(self, now_ns: int) -> float:
        """Time since the acquisition of the newest."""
        return (now_ns - self.newest_ns) * NS


class Ability:
    """One role of a device in the run file.

    Attributes:
        does: "counts", "temperatures" or "spindle".
        error: error of the last reading; None where that was good.
    """

    def __init__(self, does: str, read: Callable[[], None], clock: Clock) -> None:
        self.does = does
        self.error: DriverError | None = None
        self._read, self._clock = read, clock
        self._good = self._bad_since_good = self._since_good = 0
        self._failing_ns, self._last_words = NOTHING_YET, ""
        self._took_ns: list[int] = []

    def ask(self) -> None:
        """Read once; a fault is recorded, never raised."""
        start_ns = self._clock.now_ns()
        try:
            self._read()
        except DriverError as e:
            self._failed(e, start_ns)
            return
        self._good += 1
        self._since_good += 1
        self.error = None
        if len(self._took_ns) < KEPT:
            self._took_ns.append(self._clock.now_ns() - start_ns)

    def _failed(self, error: DriverError, now_ns: int) -> None:
        if self.error is None:
            self._failing_ns = now_ns
        self.error, self._last_words = error, str(error)
        if self._good:
            self._bad_since_good += 1
            self._since_good += 1

    def failing(self) -> DriverError | None:
        """The error, if it has lasted, or covers all readings; else None."""
        lasting = self._good == 0 or self._clock.now_ns() - self._failing_ns > FAILING_NS
        return self.error if lasting else None

    def hiccups(self) -> tuple[str, bool]:
        """Occasional errors since the first good reading, and whether they are too many; "" for none."""
        if not self._bad_since_good:
            return "", False
        text = (
            f"{self.does}: {self._bad_since_good} of {self._since_good} readings failed, the last: {self._last_words}"
        )
        return text, self._bad_since_good > MANY * self._since_good

    def took_ms(self) -> tuple[float, float] | None:
        """Duration of a good reading, ms: median and longest; None where there was none."""
        if not self._took_ns:
            return None
        return float(np.median(self._took_ns)) * 1e-6, max(self._took_ns) * 1e-6


class DeviceReadings:
    """Keeps the readings of a device.

    Args:
        device: the opened device.
        patient: run file with the axes and sensors of the arrays.
        clock: clock of the ages.

    Attributes:
        counts_age_s: age of the counts at each reading.
    """

    def __init__(self, device: Any, patient: Patient, clock: Clock) -> None:
        self._device, self._patient, self._machine, self._clock = device, patient, patient.machine, clock
        self._counts = np.zeros(len(self._machine.axes), np.int64)
        self._degc = np.full(len(self._machine.sensors), np.nan)
        self._degc_ns = np.zeros(len(self._machine.sensors), np.int64)
        self._rpm = float("nan")
        self._counts_rate, self._rates = Rate(), [Rate() for _ in self._machine.sensors]
        self.counts_age_s: list[float] = []

    @property
    def by_role(self) -> Mapping[str, Callable[[], None]]:
        """Read function of each role; each raises the driver's errors."""
        return {"counts": self._read_counts, "temperatures": self._read_temperatures, "spindle": self._read_spindle}

    @property
    def heard(self) -> bool:
        """Has the device given any reading?"""
        return bool(self._counts_rate.started or self.sensors)

    @property
    def sensors(self) -> set[str]:
        """Names of the sensors that it has read."""
        return {s.name for s, rate in zip(self._machine.sensors, self._rates, strict=True) if rate.started}

    def values(self) -> list[Value]:
        """Present readings."""
        now_ns = self._clock.now_ns()
        return [*self._axis_values(now_ns), *self.sensor_values(now_ns), *self._spindle_values()]

    def sensor_values(self, now_ns: int) -> list[Value]:
        """Present temperatures."""
        rows = zip(self._machine.sensors, self._degc.tolist(), self._rates, strict=True)
        return [Value(s.name, degc, "°C", 2, r.age_s(now_ns), r.hz()) for s, degc, r in rows if r.started]

    def output_values(self) -> list[Value]:
        """Output that an actuator reports; raises its errors."""
        output = np.zeros(len(self._machine.axes), np.int64)
        self._device.read_output(output)
        out = []
        for axis, applied in zip(self._machine.axes, output.tolist(), strict=True):
            kind = self._patient.file.output.get(axis.name, PulseSink()).kind
            unit = "counts" if kind == "pulse" else "units"
            out.append(Value(f"applied {axis.name}", float(applied), unit, 0))
        return out

    def _read_counts(self) -> None:
        latched_ns = self._device.read_counts(self._counts)
        self._counts_rate.record(latched_ns)
        self.counts_age_s.append((self._clock.now_ns() - latched_ns) * NS)

    def _read_temperatures(self) -> None:
        try:
            self._device.read_temperatures(self._degc, self._degc_ns)
        finally:  # good values are filled in, whatever is raised on the others
            for rate, time_ns in zip(self._rates, self._degc_ns.tolist(), strict=True):
                rate.record(time_ns)

    def _read_spindle(self) -> None:
        self._rpm = self._device.read_spindle()

    def _axis_values(self, now_ns: int) -> list[Value]:
        if not self._counts_rate.started:
            return []
        age_s, hz = self._counts_rate.age_s(now_ns), self._counts_rate.hz()
        return [
            Value(f"axis {a.name}", n / a.counts_per_mm, "mm", 4, age_s, hz)
            for a, n in zip(self._machine.axes, self._counts.tolist(), strict=True)
        ]

    def _spindle_values(self) -> list[Value]:
        return [Value("spindle", self._rpm, "1/min", 0)] if np.isfinite(self._rpm) else []

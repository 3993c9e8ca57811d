"""What one device has given so far: newest values, their age, how often new ones come."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from rtec.correction.sinks import PulseSink
from rtec.doctor.doctor_watch import NS, Rate
from rtec.doctor.found import Patient, Value
from rtec.loop.clock import Clock


class Readings:
    """Keeps what a device gives.

    Args:
        device: opened.
        patient: whose axes and sensors the arrays follow.
        clock: ages are in its time.

    Attributes:
        counts_age_s: of every reading of the counts, when it was read.
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
        """How to read, by role; each raises the driver's errors."""
        return {"counts": self._read_counts, "temperatures": self._read_temperatures, "spindle": self._read_spindle}

    @property
    def heard(self) -> bool:
        """Has the device given anything?"""
        return bool(self._counts_rate.seen or self.sensors)

    @property
    def sensors(self) -> set[str]:
        """Names of the sensors that it has read."""
        return {s.name for s, rate in zip(self._machine.sensors, self._rates, strict=True) if rate.seen}

    def values(self) -> list[Value]:
        """What it reads now."""
        now_ns = self._clock.now_ns()
        return [*self._axis_values(now_ns), *self.sensor_values(now_ns), *self._spindle_values()]

    def sensor_values(self, now_ns: int) -> list[Value]:
        """Temperatures now."""
        rows = zip(self._machine.sensors, self._degc.tolist(), self._rates, strict=True)
        return [Value(s.name, degc, "°C", 2, r.age_s(now_ns), r.hz()) for s, degc, r in rows if r.seen]

    def output_values(self) -> list[Value]:
        """What an actuator says it has applied; raises its errors."""
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
        self._counts_rate.see(latched_ns)
        self.counts_age_s.append((self._clock.now_ns() - latched_ns) * NS)

    def _read_temperatures(self) -> None:
        try:
            self._device.read_temperatures(self._degc, self._degc_ns)
        finally:  # what is good is filled in, whatever is told of the others
            for rate, time_ns in zip(self._rates, self._degc_ns.tolist(), strict=True):
                rate.see(time_ns)

    def _read_spindle(self) -> None:
        self._rpm = self._device.read_spindle()

    def _axis_values(self, now_ns: int) -> list[Value]:
        if not self._counts_rate.seen:
            return []
        age_s, hz = self._counts_rate.age_s(now_ns), self._counts_rate.hz()
        return [
            Value(f"axis {a.name}", n / a.counts_per_mm, "mm", 4, age_s, hz)
            for a, n in zip(self._machine.axes, self._counts.tolist(), strict=True)
        ]

    def _spindle_values(self) -> list[Value]:
        return [Value("spindle", self._rpm, "1/min", 0)] if np.isfinite(self._rpm) else []

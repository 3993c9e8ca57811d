"""One device, in a thread of its own: made, opened, read for a while, closed. It is never told to apply anything."""

import threading
from typing import Any

from pydantic import BaseModel

from rtec.doctor.advice import shared_ports, ways
from rtec.doctor.doctor_judge import count_faults, reasons, temperature_faults, unfit
from rtec.doctor.doctor_watch import NS, Ability
from rtec.doctor.found import DeviceFound, Fault, Patient, Value
from rtec.doctor.readings import Readings
from rtec.errors import DriverError, DriverTimeout, RtecError
from rtec.loop.clock import Clock
from rtec.loop.devices import device_options, make_device
from rtec.loop.driver_info import CAN_BE

SLOW_NS = 50_000_000
"""Temperatures and the spindle are asked for this often; counts in every cycle, as the loop will."""
FASTEST_NS = 1_000_000


class Look:
    """Looks at one device.

    Args:
        name: of the device.
        patient: the run file that it is in.
        clock: ages and deadlines are in its time.
        seconds: how long it is read.

    Attributes:
        found: what was found so far.
        stop: set to end it early.
        options: of its table; None where they are wrong, or not read yet.
    """

    def __init__(self, name: str, patient: Patient, clock: Clock, seconds: float) -> None:
        self._patient, self._clock, self._seconds = patient, clock, seconds
        self._table = patient.file.device[name]
        self.found = DeviceFound(name, str(self._table.get("driver", "-")), patient.roles(name))
        self.stop = threading.Event()
        self._device: Any = None
        self.options: BaseModel | None = None
        self._readings: Readings | None = None

    @property
    def sensors(self) -> set[str]:
        """Names of the sensors that it has read."""
        return self._readings.sensors if self._readings is not None else set()

    def values(self) -> list[Value]:
        """What it reads now, or what it read last."""
        readings = self._readings if self.found.doing == "is read" else None
        return self.found.values if readings is None else readings.values()

    def run(self) -> None:
        """Look at it; whatever is wrong is noted."""
        try:
            self._look()
        except RtecError as e:
            self._wrong(e)
        except Exception as e:  # noqa: BLE001 - a driver of another package may fail in any way, the others go on
            self.found.wrong.append(Fault(f"its driver fails: {type(e).__name__}: {e}", ("tell its author",)))
        self.found.doing = "done"

    def _look(self) -> None:
        name, patient = self.found.name, self._patient
        self.found.doing = "is made"
        self.options = device_options(name, self._table, patient.path)[1]
        self._device = make_device(name, self._table, patient.machine, self._clock, patient.path)
        self.found.wrong += unfit(patient, self.found, self._device)
        self.found.doing = "is opened"
        with self._device:
            self._readings = readings = Readings(self._device, patient, self._clock)
            self.found.doing = "is read"
            abilities = self._read(readings)
            self.found.values = readings.values()
            self._tell(readings, abilities)
            self.found.doing = "is closed"

    def _read(self, readings: Readings) -> list[Ability]:
        """Read as the loop will, until the time is over."""
        abilities = self._abilities(readings)
        fast = [a for a in abilities if a.does == "counts"]
        period_ns = max(FASTEST_NS, round(1.0 / NS / self._patient.file.run.rate_hz)) if fast else SLOW_NS
        due_ns = slow_ns = self._clock.now_ns()
        end_ns = due_ns + round(self._seconds / NS)
        while due_ns < end_ns and not self.stop.is_set():
            slow = due_ns >= slow_ns
            slow_ns += SLOW_NS if slow else 0
            for ability in abilities if slow else fast:
                ability.ask()
            due_ns = max(due_ns + period_ns, self._clock.now_ns())
            self._clock.sleep_until_ns(due_ns)
        return abilities

    def _abilities(self, readings: Readings) -> list[Ability]:
        by_role = readings.by_role
        asked = [r for r in self.found.roles if r in by_role and isinstance(self._device, CAN_BE[r])]
        return [Ability(role, by_role[role], self._clock) for role in asked]

    def _tell(self, readings: Readings, abilities: list[Ability]) -> None:
        if "actuator" in self.found.roles and isinstance(self._device, CAN_BE["actuator"]):
            try:
                self.found.values += readings.output_values()
            except DriverError as e:
                self._wrong(e)
        for ability in abilities:
            self._tell_of(ability, readings)
        if not self.found.roles:
            self.found.told.append("[role] does not name it: nothing reads it")
        if self.options is not None:
            self.found.told += shared_ports(self.options, self._patient.root)

    def _tell_of(self, ability: Ability, readings: Readings) -> None:
        error = ability.failing()
        if error is not None:
            for text in reasons(self._patient, self._device, ability, error):
                self._wrong(type(error)(text), error.__cause__)
        else:
            self._tell_hiccups(ability)
        if ability.does == "counts":
            faults, told = count_faults(self._patient, readings, ability)
            self.found.wrong += faults
            self.found.told += told
        elif ability.does == "temperatures":
            self.found.wrong += temperature_faults(self._patient, readings, self._clock.now_ns())
            if error is None and not readings.sensors:
                longer = f"a device that seldom speaks needs a longer look: --seconds {10 * self._seconds:g}"
                self._wrong(DriverTimeout(f"silent: no temperature came in {self._seconds:g} s"), more=longer)

    def _tell_hiccups(self, ability: Ability) -> None:
        text, often = ability.hiccups()
        if often:
            self.found.wrong.append(Fault(text))
        elif text:
            self.found.told.append(text)

    def _wrong(self, error: Exception, cause: BaseException | None = None, more: str = "") -> None:
        """Note what is wrong, one fault a line, and the ways to mend it below the last."""
        error.__cause__ = error.__cause__ or cause
        heard = self._readings is not None and self._readings.heard
        mend = ways(self.options, error, heard, self._patient.root)
        place = f"{self._patient.path}: [device.{self.found.name}]"
        *first, last = (line.removeprefix(place).lstrip(": ") for line in str(error).splitlines() or [repr(error)])
        faults = [*map(Fault, first), Fault(last, (*mend, more) if more else mend)]
        self.found.wrong += [f for f in faults if f not in self.found.wrong]

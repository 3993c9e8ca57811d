"""Examines every device of a run file, all at once: opens it, reads it, reports its faults and how to mend them.

Each device has a thread of its own (`Look`) that makes, opens, reads and closes it, and a deadline: a device that hangs
is reported and delays no other. No device is commanded.
"""

import os
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from rtec.doctor.found import DeviceFault, DeviceFound, Examination, Patient, Value
from rtec.doctor.ports import ROOT
from rtec.doctor.readings import (
    NS,
    Ability,
    DeviceReadings,
    count_faults,
    output_faults,
    reasons,
    serial_places,
    shared_ports,
    temperature_faults,
    unfit,
    ways,
)
from rtec.errors import DriverError, DriverTimeout, RtecError
from rtec.loop.clock import Clock, RealClock
from rtec.loop.devices import device_options, make_device, out_of_range
from rtec.loop.driver_info import CAN_BE
from rtec.loop.run_file import RunFile, load_setup
from rtec.machine import load_machine
from rtec.tomlfile import read_kind, validated

SLOW_NS = 50_000_000
"""Period, ns, of reading temperatures and the spindle; counts are read in every cycle, as in the loop."""
FASTEST_NS = 1_000_000


class Look:
    """Examines one device.

    Args:
        name: name of the device.
        patient: its run file.
        clock: clock of ages and deadlines.
        seconds: duration of reading, s.

    Attributes:
        found: result so far.
        stop: set to end it early.
        options: options of its table; None where they are at fault, or not read yet.
    """

    def __init__(self, name: str, patient: Patient, clock: Clock, seconds: float) -> None:
        self._patient, self._clock, self._seconds = patient, clock, seconds
        self._table = patient.file.device[name]
        self.found = DeviceFound(name, str(self._table.get("driver", "-")), patient.roles(name))
        self.stop = threading.Event()
        self._device: Any = None
        self.options: BaseModel | None = None
        self._readings: DeviceReadings | None = None

    @property
    def sensors(self) -> set[str]:
        """Names of the sensors that it has read."""
        return self._readings.sensors if self._readings is not None else set()

    def values(self) -> list[Value]:
        """Its present readings, or the last ones."""
        readings = self._readings if self.found.doing == "is read" else None
        return self.found.values if readings is None else readings.values()

    def run(self) -> None:
        """Examine it; every fault is recorded."""
        try:
            self._look()
        except RtecError as e:
            self._wrong(e)
        except Exception as e:  # noqa: BLE001 - a driver of another package may raise anything; the others go on
            self.found.wrong.append(DeviceFault(f"its driver fails: {type(e).__name__}: {e}", ("tell its author",)))
        self.found.doing = "done"

    def _look(self) -> None:
        name, patient = self.found.name, self._patient
        self.found.doing = "is made"
        self.options = device_options(name, self._table, patient.path)[1]
        self._device = make_device(name, self._table, patient.machine, self._clock, patient.path)
        self.found.wrong += unfit(patient, self.found, self._device)
        self.found.doing = "is opened"
        with self._device:
            self._readings = readings = DeviceReadings(self._device, patient, self._clock)
            self.found.doing = "is read"
            abilities = self._read(readings)
            self.found.values = readings.values()
            self._tell(readings, abilities)
            self.found.doing = "is closed"

    def _read(self, readings: DeviceReadings) -> list[Ability]:
        """Read as the loop does, until the time is over."""
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

    def _abilities(self, readings: DeviceReadings) -> list[Ability]:
        by_role = readings.by_role
        roles = [r for r in self.found.roles if r in by_role and isinstance(self._device, CAN_BE[r])]
        return [Ability(role, by_role[role], self._clock) for role in roles]

    def _tell(self, readings: DeviceReadings, abilities: list[Ability]) -> None:
        if "actuator" in self.found.roles and isinstance(self._device, CAN_BE["actuator"]):
            try:
                self.found.values += readings.output_values()
                self.found.wrong += output_faults(self._patient, readings)
                less = out_of_range(self._device, self._patient.machine, self._patient.file)
                self.found.wrong += [DeviceFault(text, ()) for text in less]
            except DriverError as e:
                self._wrong(e)
        for ability in abilities:
            self._tell_of(ability, readings)
        if not self.found.roles:
            self.found.told.append("[role] does not name it: nothing reads it")
        if self.options is not None:
            self.found.told += shared_ports(self.options, self._patient.root)

    def _tell_of(self, ability: Ability, readings: DeviceReadings) -> None:
        error = ability.failing()
        if error is not None:
            for text in reasons(self._device, ability, error):
                self._wrong(type(error)(text), error.__cause__)
        else:
            self._tell_hiccups(ability)
        if ability.does == "counts":
            faults, remarks = count_faults(self._patient, readings, ability)
            self.found.wrong += faults
            self.found.told += remarks
        elif ability.does == "temperatures":
            self.found.wrong += temperature_faults(self._patient, readings, self._clock.now_ns())
            if error is None and not readings.sensors:
                longer = f"a device that seldom speaks needs a longer look: --seconds {10 * self._seconds:g}"
                self._wrong(DriverTimeout(f"silent: no temperature came in {self._seconds:g} s"), more=longer)

    def _tell_hiccups(self, ability: Ability) -> None:
        text, often = ability.hiccups()
        if often:
            self.found.wrong.append(DeviceFault(text))
        elif text:
            self.found.told.append(text)

    def _wrong(self, error: Exception, cause: BaseException | None = None, more: str = "") -> None:
        """Record faults, one a line, and the ways to mend them with the last one."""
        error.__cause__ = error.__cause__ or cause
        heard = self._readings is not None and self._readings.heard
        mend = ways(self.options, error, heard, self._patient.root)
        place = f"{self._patient.path}: [device.{self.found.name}]"
        *first, last = (line.removeprefix(place).lstrip(": ") for line in str(error).splitlines() or [repr(error)])
        faults = [*map(DeviceFault, first), DeviceFault(last, (*mend, more) if more else mend)]
        self.found.wrong += [f for f in faults if f not in self.found.wrong]


OPEN_S = 35.0
"""Longest wait, s, for a device to open: a driver's own limit may be up to 30 s."""
CLOSE_S = 5.0
SHOW_NS = 100_000_000
Shown = Callable[[list[DeviceFound]], None]


def load_patient(path: Path, root: Path = ROOT) -> tuple[Patient, list[DeviceFault], tuple[str, ...] | None]:
    """Read a run file as far as its devices need it: devices can be examined before there is a model.

    Returns:
        the patient; faults that would keep `rtec run` from starting; the sensors that the model reads, None without a
        model.

    Raises:
        ConfigError: the run file or the machine file is at fault.
    """
    file = validated(RunFile, read_kind(path, "a run file"), str(path))
    machine = load_machine(path.parent / file.run.machine)
    patient = Patient(path, file, machine, root)
    try:
        model = load_setup(path).model
    except RtecError as e:
        return patient, [DeviceFault(line) for line in str(e).splitlines()], None
    return patient, [], tuple(n for n in machine.sensor_names if n in model.channels)


def examine(
    path: Path,
    seconds: float,
    shown: Shown = lambda _: None,
    clock: Clock | None = None,
    root: Path = ROOT,
    open_s: float = OPEN_S,
) -> Examination:
    """Examine all devices of a run file at once.

    Args:
        path: path of the run file.
        seconds: duration of reading each device, s.
        shown: called with the result so far, ten times a second.
        clock: None: the real one.
        root: folder of this computer's files.
        open_s: longest wait for a device to open.

    Raises:
        ConfigError: the run file or the machine file is at fault.
    """
    clock = clock or RealClock()
    patient, wrong, needed = load_patient(path, root)
    looks = [Look(name, patient, clock, seconds) for name in patient.file.device]
    threads = [threading.Thread(target=k.run, name=f"rtec-{k.found.name}", daemon=True) for k in looks]
    for thread in threads:
        thread.start()
    try:
        _wait(looks, threads, shown, clock, clock.now_ns() + round((open_s + seconds + CLOSE_S) * 1e9))
    finally:
        for look in looks:
            look.stop.set()
    for look, thread in zip(looks, threads, strict=True):
        if thread.is_alive():
            what = f"hangs while it {look.found.doing}: no end within {open_s:g} s"
            look.found.wrong.append(
                DeviceFault(what, ("unplug the device and plug it in again; then start rtec doctor again",))
            )
    wrong += _one_port(looks, root) + _missing(patient, looks, needed)
    return Examination(patient.machine.name, seconds, [look.found for look in looks], wrong)


def _wait(looks: list[Look], threads: list[threading.Thread], shown: Shown, clock: Clock, end_ns: int) -> None:
    while any(t.is_alive() for t in threads) and clock.now_ns() < end_ns:
        shown([replace(look.found, values=look.values()) for look in looks])
        clock.sleep_until_ns(clock.now_ns() + SHOW_NS)


def _one_port(looks: list[Look], root: Path) -> list[DeviceFault]:
    """Serial ports that several devices of the run file name; each device would get a part of the bytes, or none."""
    users: dict[str, list[str]] = {}
    for look in looks:
        for place in serial_places(look.options) if look.options is not None else []:
            users.setdefault(os.path.realpath(place.device(root) or place.usb_serial), []).append(look.found.name)
    return [
        DeviceFault(f"{', '.join(names)} name the same serial port, {port}", ("one device, one port",))
        for port, names in users.items()
        if len(names) > 1
    ]


def _missing(patient: Patient, looks: list[Look], needed: tuple[str, ...] | None) -> list[DeviceFault]:
    """Required sensors without a reading: those that the model reads, or without a model all of the machine file."""
    given = set().union(*(look.sensors for look in looks))
    lacking = [n for n in (patient.machine.sensor_names if needed is None else needed) if n not in given]
    if not lacking:
        return []
    who = "the machine file names them" if needed is None else "the model reads them, so the correction would hold"
    sources = ", ".join(patient.file.role.temperatures)
    where = f"[role] temperatures names {sources}" if sources else "[role] temperatures names no device"
    return [DeviceFault(f"no device gave {', '.join(lacking)}: {who}", (where,))]

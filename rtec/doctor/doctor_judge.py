"""What is wrong with a device that was read for a while, beside the errors that its driver raises."""

from typing import Any

import numpy as np

from rtec.correction.sinks import PulseSink
from rtec.doctor.doctor_watch import Ability
from rtec.doctor.found import DeviceFound, Fault, Patient
from rtec.doctor.readings import Readings
from rtec.errors import DriverError
from rtec.loop.driver_info import CAN_BE

FEW = 20
"""The first readings may be slow; fewer say nothing of the others."""
ROOM = 1.5
"""A cycle should be longer than the reading by this factor: the rest of the cycle needs time too."""


def unfit(patient: Patient, found: DeviceFound, device: Any) -> list[Fault]:
    """Roles that its driver cannot play, outputs that it does not take."""
    can = {role: isinstance(device, port) for role, port in CAN_BE.items()}
    is_ = ", ".join(role for role, so in can.items() if so)
    out = [
        Fault(f"[role] {role} names it, but driver {found.driver!r} cannot do this", (f"it can be: {is_}",))
        for role in found.roles
        if not can[role]
    ]
    if "actuator" in found.roles and can["actuator"]:
        for axis in (a for a in patient.machine.axes if a.compensate):
            why = device.refuses(patient.file.output.get(axis.name, PulseSink()))
            out += [Fault(f"[output.{axis.name}] {why}")] if why else []
    return out


def reasons(patient: Patient, device: Any, ability: Ability, error: DriverError) -> list[str]:
    """One text a cause: a driver that can list its faults does; sensors with the same fault stand together."""
    listed = getattr(device, "faults", None)
    if ability.does != "temperatures" or not callable(listed):
        return [str(error)]
    sensors: dict[str, list[str]] = {}
    for fault in listed():
        name, _, why = fault.partition(": ")
        known = name in patient.machine.sensor_names
        sensors.setdefault(why if known else fault, []).extend([name] if known else [])
    return [f"{', '.join(names)}: {why}" if names else why for why, names in sensors.items()] or [str(error)]


def count_faults(patient: Patient, readings: Readings, ability: Ability) -> tuple[list[Fault], list[str]]:
    """Counts that come too slowly or too late for the loop; and what else is to be told."""
    took = ability.took_ms()
    if took is None or len(readings.counts_age_s) < FEW:
        return [], []
    cycle_ms, faults = 1e3 / patient.file.run.rate_hz, []
    text = f"reading counts takes {took[0]:.2f} ms, at most {took[1]:.2f} ms, of a cycle of {cycle_ms:g} ms"
    if took[0] > cycle_ms:
        faults.append(Fault(text, (f"a lower [run] rate_hz, {1e3 / took[0] / ROOM:.0f} or less, or a faster line",)))
    age_s, allowed_s = float(np.median(readings.counts_age_s)), patient.file.guard.counts_max_age_s
    if age_s > allowed_s:
        what = f"counts are {age_s * 1e3:.1f} ms old when they are read; the correction would hold"
        faults.append(Fault(what, (f"[guard] counts_max_age_s is {allowed_s:g} s: is that meant?",)))
    return faults, [] if took[0] > cycle_ms else [text]


def temperature_faults(patient: Patient, readings: Readings, now_ns: int) -> list[Fault]:
    """Temperatures that the machine cannot have, or that are too old for the loop."""
    ranges = {s.name: s.range_degc for s in patient.machine.sensors}
    allowed_s, out = patient.file.guard.temperature_max_age_s, []
    for value in readings.sensor_values(now_ns):
        low, high = ranges[value.name]
        if not low <= value.value <= high:
            what = f"{value.name}: {value.value:.1f} °C; the machine file's range_degc is {low:g} to {high:g} °C"
            out.append(Fault(what, ("look at the sensor, its type and its wires; is it the right sensor?",)))
        if value.age_s is not None and value.age_s > allowed_s:
            what = f"{value.name}: {value.age_s:.0f} s old; the correction would hold"
            out.append(Fault(what, (f"[guard] temperature_max_age_s is {allowed_s:g} s: is that meant?",)))
    return out

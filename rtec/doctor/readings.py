"""Readings of one device that is read for a while: values, ages, rates, failures; faults, and ways to mend them.

The driver raises its own errors; this module adds the faults that only the readings show (too slow, too old, constant).
The ways to mend them are the same for every driver on the same kind of line. So they follow from the options that such
drivers share (`port`, `usb_serial`, `baud`, `host`, `interface`, `channel`) and from this computer's data on its
ports.
"""

import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from rtec.correction.flags import CYCLES_OF_AGE
from rtec.correction.sinks import PulseSink
from rtec.doctor.found import DeviceFault, DeviceFound, Patient, Value
from rtec.doctor.ports import (
    ROOT,
    can_interfaces,
    can_state,
    group_of,
    holders,
    latency_ms,
    sees_all_processes,
    serial_ports,
)
from rtec.errors import DriverError, DriverFault
from rtec.loop.clock import Clock
from rtec.loop.driver_info import CAN_BE
from rtec.loop.output import beyond_stop
from rtec.loop.zero import beyond_travel
from rtec.wording import percent

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
        counts: the newest counts, by axis.
        counts_age_s: age of the counts at each reading, at the instant before it, as the guard judges it.
    """

    def __init__(self, device: Any, patient: Patient, clock: Clock) -> None:
        self._device, self._patient, self._machine, self._clock = device, patient, patient.machine, clock
        self.counts, self.output = np.zeros((2, len(self._machine.axes)), np.int64)
        self._degc = np.full(len(self._machine.sensors), np.nan)
        self._degc_ns = np.zeros(len(self._machine.sensors), np.int64)
        self._rpm = float("nan")
        self._counts_rate, self._rates = Rate(), [Rate() for _ in self._machine.sensors]
        self.counts_age_s: list[float] = []
        self._sent_before = 0

    @property
    def by_role(self) -> Mapping[str, Callable[[], None]]:
        """Read function of each role; each raises the driver's errors."""
        return {"counts": self._read_counts, "temperatures": self._read_temperatures, "spindle": self._read_spindle}

    @property
    def heard(self) -> bool:
        """Has the device given any reading?"""
        return bool(self._counts_rate.started or self.sensors)

    @property
    def sends_itself(self) -> bool:
        """Are most counts older than the question for them? A device that latches when it is read has none such."""
        return 2 * self._sent_before > len(self.counts_age_s)

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
        self._device.read_output(self.output)
        out = []
        for axis, applied in zip(self._machine.axes, self.output.tolist(), strict=True):
            kind = self._patient.file.output.get(axis.name, PulseSink()).kind
            unit = "counts" if kind == "pulse" else "units"
            out.append(Value(f"applied {axis.name}", float(applied), unit, 0))
        return out

    def _read_counts(self) -> None:
        asked_ns = self._clock.now_ns()
        latched_ns = self._device.read_counts(self.counts)
        self._sent_before += latched_ns < asked_ns
        self._counts_rate.record(latched_ns)
        self.counts_age_s.append((asked_ns - latched_ns) * NS)

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
            for a, n in zip(self._machine.axes, self.counts.tolist(), strict=True)
        ]

    def _spindle_values(self) -> list[Value]:
        return [Value("spindle", self._rpm, "1/min", 0)] if np.isfinite(self._rpm) else []


LINE_KEYS = ("baud", "bytesize", "parity", "stopbits")
SILENT_WORDS = ("no answer", "not answer", "silent", "no connection", "no reading", "no such port", "no port")
HEARD_WORDS = ("received: ",)
REACHED_WORDS = ("the connection is open", "the gateway is there")
NUISANCE = {
    "rtec": "that is `rtec run`: `rtec status` shows its devices; to look at them here stop it first",
    "ModemManager": "it tries every new serial port: sudo systemctl disable --now ModemManager",
    "brltty": "it takes some USB adapters for Braille displays: sudo apt remove brltty",
}


@dataclass(frozen=True)
class SerialPlace:
    """A serial port in a device's options.

    Attributes:
        port: device file, or "" where only the adapter's number is given.
        usb_serial: number of the adapter, or "".
        settings: settings of the line, as in the run file.
    """

    port: str
    usb_serial: str
    settings: str

    def device(self, root: Path = ROOT) -> str:
        """Present path of the device file; "" where there is none."""
        if self.usb_serial:
            return next((p.device for p in serial_ports(root) if p.serial == self.usb_serial), "")
        return self.port


def ways(options: BaseModel | None, error: Exception, heard: bool, root: Path = ROOT) -> tuple[str, ...]:
    """Ways to mend an error of a device.

    Args:
        options: its options in the run file; None where they could not be read.
        error: error that its driver raised.
        heard: has it given any reading? Then its line works.
        root: folder of this computer's files.
    """
    if options is None:
        return ()
    out: list[str] = []
    for place in serial_places(options):
        out += _serial_ways(place, error, heard, root)
    for table in _tables(options):
        out += _can_ways(table, root) + ([] if heard else _network_ways(table, error))
    return tuple(dict.fromkeys(out))


def serial_places(options: BaseModel) -> list[SerialPlace]:
    """Every serial port that the options name."""
    out = []
    for table in _tables(options):
        port, number = _text(table, "port"), _text(table, "usb_serial")
        if _text(table, "interface") == "slcan":
            port = _text(table, "channel").partition("@")[0]
        if number or port.startswith("/"):
            settings = ", ".join(f"{k} {getattr(table, k)}" for k in LINE_KEYS if hasattr(table, k))
            out.append(SerialPlace(port, number, settings))
    return out


def shared_ports(options: BaseModel, root: Path = ROOT) -> list[str]:
    """Warnings on open ports: other programs that read them, adapters that hold bytes back."""
    out = []
    for place in serial_places(options):
        device = place.device(root)
        out += [f"{device} is open in process {h.pid} ({h.name}) too: each gets a part of the bytes"
                for h in holders(device, root)]  # fmt: skip
        late_ms = latency_ms(device, root) if device else None
        if late_ms is not None and late_ms > 1:
            name = Path(os.path.realpath(device)).name
            out.append(
                f"the USB adapter keeps bytes back for {late_ms} ms: "
                f"echo 1 | sudo tee /sys/bus/usb-serial/devices/{name}/latency_timer"
            )
    return out


def _serial_ways(place: SerialPlace, error: Exception, heard: bool, root: Path) -> list[str]:
    device = place.device(root)
    if not device or not os.path.lexists(device) or not Path(device).exists():
        return _missing(place, root)
    if not os.access(device, os.R_OK | os.W_OK):
        return [_no_access(device)]
    busy = "in use" in str(error)
    if heard or not (busy or _silent(error)):
        return []
    out = [f"process {h.pid} ({h.name}) has {device} open: {_end(h.name, h.pid)}" for h in holders(device, root)]
    if busy:
        hidden = not out and not sees_all_processes()
        return [f"sudo fuser -v {device} tells which program has it open"] if hidden else out
    out.append("is the device switched on, and its cable in (A and B, RX and TX not swapped)?")
    if place.settings:
        out.append(f"the line is set to {place.settings} here: the device must be, too")
    return out


def _silent(error: Exception) -> bool:
    """Does nothing arrive? A driver of several devices may report that as a fault of some."""
    if any(word in str(error) for word in HEARD_WORDS):
        return False
    return not isinstance(error, DriverFault) or any(word in str(error) for word in SILENT_WORDS)


def _missing(place: SerialPlace, root: Path) -> list[str]:
    ports = serial_ports(root)
    if not ports:
        return ["this computer has no serial port now: plug the adapter in; `sudo dmesg | tail` shows what it becomes"]
    out = [f"serial ports here: {'; '.join(p.words() for p in ports)}"]
    known = [p for p in ports if p.serial]
    if known and not place.usb_serial:
        out.append(f'found whatever its name is today: usb_serial = "{known[0].serial}" instead of port')
    return out


def _no_access(device: str) -> str:
    group = group_of(device)
    if not group:
        return f'no group may open {device}: a udev rule must give it one (GROUP="dialout", MODE="0660")'
    return f"members of group {group!r} may open {device}: sudo usermod -aG {group} $USER, then log in again"


def _end(name: str, pid: int) -> str:
    return NUISANCE.get(name, f"end it (kill {pid})")


def _can_ways(table: BaseModel, root: Path) -> list[str]:
    channel = _text(table, "channel")
    if _text(table, "interface") != "socketcan" or not channel:
        return []
    state = can_state(channel, root)
    rate = getattr(table, "bitrate", None) or 500_000
    if not state:
        there = ", ".join(can_interfaces(root)) or "none: is the adapter plugged in, and its kernel module loaded?"
        return [f"no interface {channel}; CAN interfaces here: {there}"]
    if state == "down":
        return [f"{channel} is down: sudo ip link set {channel} up type can bitrate {rate} restart-ms 100"]
    return [f"{channel} is up; ip -details -statistics link show {channel} tells its bit rate and errors"]


def _network_ways(table: BaseModel, error: Exception) -> list[str]:
    host = _text(table, "host")
    if not host or not _silent(error) or any(word in str(error) for word in REACHED_WORDS):
        return []
    if isinstance(error.__cause__, ConnectionRefusedError):
        return [f"{host} is there, but nothing listens on port {getattr(table, 'port', '?')}: is that the right port?"]
    return [f"does `ping {host}` answer? If not: power, network cable, address of the device"]


def _tables(options: BaseModel) -> Iterator[BaseModel]:
    """The options and every table within them."""
    yield options
    for value in dict(options).values():
        within: list[Any] = list(value.values()) if isinstance(value, dict) else [value]
        for item in within:
            if isinstance(item, BaseModel):
                yield from _tables(item)


def _text(table: BaseModel, key: str) -> str:
    value = getattr(table, key, None)
    return value if isinstance(value, str) else ""


FEWEST_CYCLES = 2
"""Smallest age, cycles, that the guard should allow the counts of a device that sends by itself."""
MANY_LATE = 0.01
"""Share of the counts that are too old; rtec doctor is no real-time program, so a few are none of the device's."""
FEW = 20
"""Fewer readings are no basis for a judgement; the first ones may be slow."""
ROOM = 1.5
"""A cycle should be longer than the reading by this factor: the rest of the cycle needs time, too."""


def unfit(patient: Patient, found: DeviceFound, device: Any) -> list[DeviceFault]:
    """Roles that its driver cannot serve, and outputs that it refuses."""
    can = {role: isinstance(device, port) for role, port in CAN_BE.items()}
    is_ = ", ".join(role for role, so in can.items() if so)
    out = [
        DeviceFault(f"[role] {role} names it, but driver {found.driver!r} cannot do this", (f"it can be: {is_}",))
        for role in found.roles
        if not can[role]
    ]
    if "actuator" in found.roles and can["actuator"]:
        for axis in (a for a in patient.machine.axes if a.compensate):
            why = device.refuses(patient.file.output.get(axis.name, PulseSink()))
            out += [DeviceFault(f"[output.{axis.name}] {why}")] if why else []
    return out


def reasons(device: Any, ability: Ability, error: DriverError) -> list[str]:
    """One text a cause: from the driver's list of faults, if it has one."""
    listed = getattr(device, "faults", None)
    if ability.does != "temperatures" or not callable(listed):
        return [str(error)]
    return list(listed()) or [str(error)]


HOLDS_AHEAD = "the correction would hold"
OTHER_PLACE = "counts_per_mm, travel_mm, or the zero of the axis: does the controller show the same position?"
OTHER_CLOCK = "its clock is another one than the loop's; a driver stamps its readings with clock.now_ns()"


def count_faults(patient: Patient, readings: DeviceReadings, ability: Ability) -> tuple[list[DeviceFault], list[str]]:
    """Counts that are too slow or too late for the loop; and remarks."""
    took = ability.took_ms()
    if took is None or len(readings.counts_age_s) < FEW:
        return [], []
    cycle_ms, faults = 1e3 / patient.file.run.rate_hz, []
    text = f"reading counts takes {took[0]:.2f} ms, at most {took[1]:.2f} ms, of a cycle of {cycle_ms:g} ms"
    if took[0] > cycle_ms:
        faults.append(
            DeviceFault(text, (f"a lower [run] rate_hz, {1e3 / took[0] / ROOM:.0f} or less, or a faster line",))
        )
    age_s, allowed_s = float(np.median(readings.counts_age_s)), patient.file.guard.counts_max_age_s
    late = float(np.mean(np.asarray(readings.counts_age_s) > allowed_s))
    is_meant = f"[guard] counts_max_age_s is {allowed_s:g} s: is that meant?"
    cycles_s, oldest_s = CYCLES_OF_AGE * cycle_ms * 1e-3, float(np.max(readings.counts_age_s))
    enough = f"[guard] counts_max_age_s = {cycles_s:g}, {CYCLES_OF_AGE} cycles"
    if oldest_s > cycles_s:
        enough = f"[guard] counts_max_age_s = {ROOM * oldest_s:.2g}: the oldest were {oldest_s * 1e3:.0f} ms old"
    if patient.file.run.zero == "counts":
        faults += [DeviceFault(text, (OTHER_PLACE,)) for text in beyond_travel(patient.machine, readings.counts)]
    if age_s < -allowed_s:
        faults.append(DeviceFault(f"counts are from the future, {-age_s:.3g} s ahead: {HOLDS_AHEAD}", (OTHER_CLOCK,)))
    elif age_s > allowed_s:
        what = f"counts are {age_s * 1e3:.1f} ms old when they are read; the correction would hold"
        faults.append(DeviceFault(what, (is_meant,)))
    elif late > MANY_LATE:
        what = (
            f"{percent(late)} of the counts are older than {allowed_s * 1e3:g} ms when read; the correction would hold"
        )
        faults.append(DeviceFault(what, (is_meant, enough)))
    elif readings.sends_itself and allowed_s < FEWEST_CYCLES * cycle_ms * 1e-3:
        what = (
            f"counts older than {allowed_s * 1e3:g} ms hold the correction, and a cycle takes {cycle_ms:g} ms: the "
            "device sends by itself, so one late reading is enough"
        )
        faults.append(DeviceFault(what, (enough,)))
    return faults, [] if took[0] > cycle_ms else [text]


def output_faults(patient: Patient, readings: DeviceReadings) -> list[DeviceFault]:
    """Output beyond the stop limit, where the loop waits for an order (`rtec.loop.output.beyond`)."""
    out = []
    for axis, units in zip(patient.machine.axes, readings.output.tolist(), strict=True):
        limits, scale = patient.file.limits.get(axis.name), patient.file.output.get(axis.name, PulseSink()).scale(axis)
        if limits is None or not beyond_stop(units, scale.units_per_um, scale.quantum, limits.stop_um):
            continue
        has = f"it has {units / scale.units_per_um:+.2f} µm of axis {axis.name}"
        what = f"{has}, and stop_um is {limits.stop_um:g}: the loop would wait for an order"
        out.append(DeviceFault(what, ("set it back by hand, or order it back slowly: `rtec ctl resume`",)))
    return out


def temperature_faults(patient: Patient, readings: DeviceReadings, now_ns: int) -> list[DeviceFault]:
    """Temperatures that are not possible on the machine, or too old for the loop."""
    ranges = {s.name: s.range_degc for s in patient.machine.sensors}
    allowed_s, out = patient.file.guard.temperature_max_age_s, []
    for value in readings.sensor_values(now_ns):
        low, high = ranges[value.name]
        if not low <= value.value <= high:
            what = f"{value.name}: {value.value:.1f} °C; the machine file's range_degc is {low:g} to {high:g} °C"
            out.append(DeviceFault(what, ("look at the sensor, its type and its wires; is it the right sensor?",)))
        if value.age_s is not None and value.age_s < -allowed_s:
            what = f"{value.name}: from the future, {-value.age_s:.3g} s ahead: {HOLDS_AHEAD}"
            out.append(DeviceFault(what, (OTHER_CLOCK,)))
        elif value.age_s is not None and value.age_s > allowed_s:
            what = f"{value.name}: {value.age_s:.0f} s old; the correction would hold"
            out.append(DeviceFault(what, (f"[guard] temperature_max_age_s is {allowed_s:g} s: is that meant?",)))
    return out

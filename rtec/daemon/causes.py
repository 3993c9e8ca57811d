"""Names what a flag of the guard is about: which device, sensor or axis, its value, and what is allowed.

The guard judges numbers of a row, without names. This looks at the same row with the names of the run file; it decides
nothing.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Final

from rtec.correction.flags import Flag
from rtec.loop.devices import names_sensor
from rtec.machine.machine import CONSTANT_CHANNELS
from rtec.text import joined

if TYPE_CHECKING:
    from rtec.daemon.status import Status
    from rtec.loop.run_file import Setup

MOST_NAMED: Final = 5


def causes(setup: "Setup", status: "Status") -> dict[str, str]:
    """What each flag of the newest row is about, in words, by the flag's name; only where it can be named."""
    ways: Mapping[Flag, Callable[[Setup, Status], Iterable[str]]] = {
        Flag.STALE_COUNTS: _stale_counts,
        Flag.STALE_TEMPERATURE: _stale_temperatures,
        Flag.SENSOR_FAULT: _impossible,
        Flag.OUT_OF_RANGE: _outside,
        Flag.OVER_STOP_LIMIT: lambda setup, status: _over(setup, status, "stop_um"),
        Flag.OVER_WARNING_LIMIT: lambda setup, status: _over(setup, status, "warning_um"),
    }
    found = {flag.name or "": list(way(setup, status)) for flag, way in ways.items() if flag & status.flags}
    return {name: _listed(texts) for name, texts in found.items() if texts}


def _listed(texts: list[str]) -> str:
    more = len(texts) - MOST_NAMED
    return joined([*texts[:MOST_NAMED], *([f"and {more} more"] if more > 0 else [])])


def _stale_counts(setup: "Setup", status: "Status") -> Iterable[str]:
    device, most = setup.file.role.counts, setup.file.guard.counts_max_age_s
    if math.isnan(status.counts_age_s):
        yield f"device {device} has sent none yet"
    else:
        yield f"those of device {device} are {status.counts_age_s:.3g} s old, and {most:g} s are allowed"


def _stale_temperatures(setup: "Setup", status: "Status") -> Iterable[str]:
    most = setup.file.guard.temperature_max_age_s
    for name in _sensors(setup):
        if math.isnan(status.degc.get(name, math.nan)):
            yield f"{_sensor(setup, name)} has no reading"
        elif (age_s := status.degc_age_s.get(name, 0.0)) > most:
            yield f"{_sensor(setup, name)} was read {age_s:.3g} s ago, and {most:g} s are allowed"
    if "spindle_rpm" in setup.model.channels and math.isnan(status.spindle_rpm):
        yield f"the spindle speed of device {setup.file.role.spindle} has no reading"


def _impossible(setup: "Setup", status: "Status") -> Iterable[str]:
    read = set(_sensors(setup))
    for sensor in setup.machine.sensors:
        (low, high), degc = sensor.range_degc, status.degc.get(sensor.name, math.nan)
        if sensor.name in read and (degc < low or degc > high):
            yield f"{_sensor(setup, sensor.name)} reads {degc:.2f} °C, and its range is {low:g} to {high:g} °C"


def _outside(setup: "Setup", status: "Status") -> Iterable[str]:
    read, ranges = set(setup.model.channels), setup.model.valid_range
    values = [
        (f"axis {a.name}", a.channel, counts / a.counts_per_mm, "mm")
        for a in setup.machine.axes
        if (counts := status.counts.get(a.name)) is not None
    ]
    values += [(_sensor(setup, s), s, status.degc.get(s, math.nan), "°C") for s in _sensors(setup)]
    if "spindle_rpm" in read:
        values.append(("the spindle", "spindle_rpm", status.spindle_rpm, "rpm"))
    values += [(c, c, float(getattr(setup.file.inputs, c)), "") for c in CONSTANT_CHANNELS if c in read]
    for name, channel, value, unit in values:
        low, high = ranges.get(channel, (-math.inf, math.inf))
        if value < low or value > high:
            yield f"{name} is at {value:.6g} {unit}".rstrip() + f", and the model knows {low:.6g} to {high:.6g}"


def _over(setup: "Setup", status: "Status", limit: str) -> Iterable[str]:
    for axis, limits in setup.file.limits.items():
        um, most = status.requested_um.get(axis, 0.0), getattr(limits, limit)
        if not abs(um) <= most:
            yield f"{um:+.2f} µm for axis {axis}, and {limit} is {most:g}"


def _sensors(setup: "Setup") -> list[str]:
    """The sensors that the model reads; the guard judges no others."""
    read = set(setup.model.channels)
    return [name for name in setup.machine.sensor_names if name in read]


def _sensor(setup: "Setup", name: str) -> str:
    """A sensor with its device: the only one, or the only one whose options name the sensor."""
    devices = setup.file.role.temperatures
    owners = devices if len(devices) == 1 else [d for d in devices if names_sensor(setup.file.device.get(d, {}), name)]
    return f"sensor {name} of device {owners[0]}" if len(owners) == 1 else f"sensor {name}"

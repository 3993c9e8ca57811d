"""Finds drivers by name, makes the devices of a run file, and opens them together."""

import importlib
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from rtec.correction.sinks import PulseSink
from rtec.errors import ConfigError, DriverUnavailable, RtecError
from rtec.machine import Machine
from rtec.runtime.clock import Clock
from rtec.runtime.config import Roles, Setup
from rtec.runtime.ports import Actuator, CountSource, Device, SpindleSource, TemperatureSource
from rtec.tomlfile import nearest, validated

GROUP = "rtec.drivers"


@dataclass(frozen=True)
class Ports:
    """Opened devices by what they do."""

    counts: CountSource
    temperatures: tuple[TemperatureSource, ...]
    spindle: SpindleSource | None
    actuator: Actuator


def driver_table() -> dict[str, tuple[str, str]]:
    """All drivers that are installed: name to module and class; those of other packages too."""
    out: dict[str, tuple[str, str]] = {}
    for entry in entry_points(group=GROUP):
        out.update(entry.load())
    return out


def driver_class(name: str, where: str) -> Any:
    """Give the class of a driver; only now is its module imported.

    Raises:
        ConfigError: no driver of that name.
        DriverUnavailable: its module, or a library that it needs, is not installed; or it has no such class.
    """
    table = driver_table()
    if name not in table:
        raise ConfigError(f"{where}: no driver {name!r}{nearest(name, table)}")
    module_name, class_name = table[name]
    try:
        module = importlib.import_module(module_name)
    except ImportError as e:
        raise DriverUnavailable(f"{where}: driver {name!r} cannot be imported: {e}") from e
    try:
        return getattr(module, class_name)
    except AttributeError as e:
        raise DriverUnavailable(f"{where}: driver {name!r}: module {module_name} has no {class_name}") from e


def make_devices(setup: Setup, clock: Clock) -> dict[str, Device]:
    """Construct every device of a run file; nothing is opened yet.

    Raises:
        ConfigError: all faults of all devices.
    """
    out: dict[str, Device] = {}
    faults: list[str] = []
    for name, table in setup.file.device.items():
        try:
            out[name] = _make(name, table, setup.machine, clock, setup.path)
        except RtecError as e:
            faults.append(str(e))
    faults += _role_faults(out, setup.file.role, str(setup.path))
    faults += _sink_faults(out, setup)
    if faults:
        raise ConfigError("\n".join(faults))
    return out


def open_ports(setup: Setup, devices: Mapping[str, Any], stack: ExitStack) -> Ports:
    """Open all devices on the stack, which holds and closes them, and give them by role.

    Raises:
        DriverUnavailable: all that could not be opened.
    """
    faults = []
    for name, device in devices.items():
        try:
            stack.enter_context(device)
        except RtecError as e:
            faults.append(f"[device.{name}] {e}")
    if faults:
        raise DriverUnavailable("\n".join(faults))
    role = setup.file.role
    return Ports(
        counts=devices[role.counts],
        temperatures=tuple(devices[name] for name in role.temperatures),
        spindle=devices[role.spindle] if role.spindle else None,
        actuator=devices[role.actuator],
    )


def _make(name: str, table: Mapping[str, Any], machine: Machine, clock: Clock, path: Path) -> Device:
    where = f"{path}: [device.{name}]"
    driver = table.get("driver")
    if not isinstance(driver, str):
        raise ConfigError(f"{where} key 'driver' is missing; it names the driver")
    kind = driver_class(driver, where)
    options_model: type[BaseModel] = kind.options_model
    options = validated(options_model, {k: v for k, v in table.items() if k != "driver"}, where)
    try:
        device: Device = kind(options, machine, clock, path.parent)
    except RtecError as e:
        raise ConfigError("\n".join(f"{where} {line}" for line in str(e).splitlines())) from e
    return device


def _role_faults(devices: Mapping[str, object], role: Roles, source: str) -> list[str]:
    wanted: list[tuple[str, str, type]] = [
        ("counts", role.counts, CountSource),
        ("actuator", role.actuator, Actuator),
        *(("temperatures", name, TemperatureSource) for name in role.temperatures),
    ]
    if role.spindle:
        wanted.append(("spindle", role.spindle, SpindleSource))
    return [
        f"{source}: [role] {what} = {name!r}: that device's driver cannot do this"
        for what, name, kind in wanted
        if name in devices and not isinstance(devices[name], kind)
    ]


def _sink_faults(devices: Mapping[str, object], setup: Setup) -> list[str]:
    """Compensated axes whose kind of output the actuator does not take."""
    actuator = devices.get(setup.file.role.actuator)
    if not isinstance(actuator, Actuator):
        return []
    out = []
    for axis in (a for a in setup.machine.axes if a.compensate):
        why = actuator.refuses(setup.file.output.get(axis.name, PulseSink()))
        if why:
            out.append(f"{setup.path}: [output.{axis.name}] [device.{setup.file.role.actuator}] {why}")
    return out

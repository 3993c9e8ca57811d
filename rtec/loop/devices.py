"""Finds drivers by name, makes the devices of a run file, and opens them together."""

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pydantic import BaseModel

from rtec.correction.sinks import PulseSink
from rtec.errors import ConfigError, DriverUnavailable, RtecError
from rtec.loop.clock import Clock
from rtec.loop.driver_info import find
from rtec.loop.ports import (
    Actuator,
    CountSource,
    Device,
    Incremental,
    NoActuator,
    Ranged,
    Resumable,
    SpindleSource,
    TemperatureSource,
)
from rtec.machine import Machine
from rtec.tomlfile import validated

if TYPE_CHECKING:
    from rtec.loop.run_file import Roles, RunFile, Setup

LESS: Final = "lower stop_um, or raise the actuator's own limit"


@dataclass(frozen=True)
class Ports:
    """Opened devices by role.

    Attributes:
        names: the devices' names by role, for messages; a role without a device has the role's name.
    """

    counts: CountSource
    temperatures: tuple[TemperatureSource, ...]
    spindle: SpindleSource | None
    actuator: Actuator
    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def name(self, does: str, k: int = 0) -> str:
        """Name of the k-th device of a role: "counts", "temperatures", "spindle" or "output"."""
        names = self.names.get(does, ())
        return names[k] if k < len(names) else does

    def resumable(self) -> list[Resumable]:
        """Devices that take an order to resume, each once."""
        devices: tuple[object, ...] = (self.counts, *self.temperatures, self.spindle, self.actuator)
        return [d for d in {id(d): d for d in devices}.values() if isinstance(d, Resumable)]


def driver_class(name: str, where: str) -> Any:
    """Import a driver's module and give the driver's class.

    Raises:
        ConfigError: no driver has that name.
        DriverUnavailable: its module, or a library that it needs, is not installed; or the module has no such class.
    """
    try:
        return find(name, where).load()
    except DriverUnavailable as e:
        raise DriverUnavailable(f"{where}: {e}") from e


def make_devices(setup: "Setup", clock: Clock) -> dict[str, Device]:
    """Construct every device of a run file; opens none.

    Raises:
        ConfigError: all faults of all devices.
    """
    out: dict[str, Device] = {}
    faults: list[str] = []
    for name, table in setup.file.device.items():
        try:
            out[name] = make_device(name, table, setup.machine, clock, setup.path)
        except RtecError as e:
            faults.append(str(e))
    faults += _role_faults(out, setup.file.role, str(setup.path))
    faults += _sink_faults(out, setup)
    faults += _sensor_faults(setup)
    counts = out.get(setup.file.role.counts)
    if setup.file.run.zero == "ordered" and counts is not None and not isinstance(counts, Incremental):
        faults.append(
            f'{setup.path}: [run] zero = "ordered": [device.{setup.file.role.counts}] has a zero of its own, or does '
            "not tell when it was without supply; reference it there"
        )
    if faults:
        raise ConfigError("\n".join(faults))
    return out


def open_ports(setup: "Setup", devices: Mapping[str, Any], stack: ExitStack) -> Ports:
    """Open all devices on the stack, which holds and closes them; give them by role.

    Raises:
        DriverUnavailable: every device that could not be opened; an actuator that takes less than a run may ask for.
    """
    faults = []
    for name, device in devices.items():
        try:
            stack.enter_context(device)
        except RtecError as e:
            faults.append(f"[device.{name}] {e}")
    role = setup.file.role
    if not faults and role.actuator:
        less = out_of_range(devices[role.actuator], setup.machine, setup.file)
        faults += [f"[device.{role.actuator}] {text}" for text in less]
    if faults:
        raise DriverUnavailable("\n".join(faults))
    return Ports(
        counts=devices[role.counts],
        temperatures=tuple(devices[name] for name in role.temperatures),
        spindle=devices[role.spindle] if role.spindle else None,
        actuator=devices[role.actuator] if role.actuator else NoActuator(),
        names={
            "counts": (role.counts,),
            "temperatures": role.temperatures,
            "spindle": (role.spindle,) if role.spindle else (),
            "output": (role.actuator,) if role.actuator else (),
        },
    )


def make_device(name: str, table: Mapping[str, Any], machine: Machine, clock: Clock, path: Path) -> Device:
    """Construct one device of the run file at `path`; does not open it.

    Raises:
        ConfigError: its table is wrong; all faults.
        DriverUnavailable: its driver, or a library that it needs, is not installed.
    """
    kind, options = device_options(name, table, path)
    where = f"{path}: [device.{name}]"
    try:
        device: Device = kind(options, machine, clock, path.parent)
    except RtecError as e:
        raise type(e)("\n".join(f"{where} {line}" for line in str(e).splitlines())) from e
    return device


def device_options(name: str, table: Mapping[str, Any], path: Path) -> tuple[Any, BaseModel]:
    """Driver class of a device of the run file at `path`, and its checked options.

    Raises:
        ConfigError, DriverUnavailable: as `make_device`.
    """
    where = f"{path}: [device.{name}]"
    driver = table.get("driver")
    if not isinstance(driver, str):
        raise ConfigError(f"{where} key 'driver' is missing; it names the driver")
    kind = driver_class(driver, where)
    options_model: type[BaseModel] = kind.options_model
    return kind, validated(options_model, {k: v for k, v in table.items() if k != "driver"}, where)


def _role_faults(devices: Mapping[str, object], role: "Roles", source: str) -> list[str]:
    assigned: list[tuple[str, str, type]] = [
        ("counts", role.counts, CountSource),
        *(("temperatures", name, TemperatureSource) for name in role.temperatures),
    ]
    if role.actuator:
        assigned.append(("actuator", role.actuator, Actuator))
    if role.spindle:
        assigned.append(("spindle", role.spindle, SpindleSource))
    return [
        f"{source}: [role] {what} = {name!r}: that device's driver cannot do this"
        for what, name, kind in assigned
        if name in devices and not isinstance(devices[name], kind)
    ]


def _sink_faults(devices: Mapping[str, object], setup: "Setup") -> list[str]:
    """Compensated axes whose kind of output the actuator does not take."""
    actuator = devices.get(setup.file.role.actuator or "")
    if not isinstance(actuator, Actuator):
        return []
    out = []
    for axis in (a for a in setup.machine.axes if a.compensate):
        why = actuator.refuses(setup.file.output.get(axis.name, PulseSink()))
        if why:
            out.append(f"{setup.path}: [output.{axis.name}] [device.{setup.file.role.actuator}] {why}")
    return out


def out_of_range(actuator: object, machine: Machine, file: "RunFile") -> list[str]:
    """Axes of which the guard allows a correction that the opened actuator does not take."""
    if not isinstance(actuator, Ranged):
        return []
    out = []
    for axis, most_um in zip(machine.axes, actuator.most_um, strict=True):
        limits = file.limits.get(axis.name)
        if limits is not None and limits.stop_um > most_um:
            out.append(
                f"it takes at most {most_um:g} µm of axis {axis.name}, and stop_um is {limits.stop_um:g}: {LESS}"
            )
    return out


def _sensor_faults(setup: "Setup") -> list[str]:
    """Sensors that two devices would read: the correction would jump between them."""
    out = []
    for sensor in setup.machine.sensor_names:
        devices = [d for d in setup.file.role.temperatures if names_sensor(setup.file.device.get(d, {}), sensor)]
        if len(devices) > 1:
            out.append(
                f"{setup.path}: [role] temperatures: {' and '.join(repr(d) for d in devices)} name the same sensor, "
                f"{sensor}; each sensor is read by one device"
            )
    return out


def names_sensor(options: Any, name: str) -> bool:
    """Whether options of a device name a sensor: as a key, as a value, or as a group of a pattern."""
    if isinstance(options, Mapping):
        return name in options or any(names_sensor(value, name) for value in options.values())
    if isinstance(options, list | tuple):
        return any(names_sensor(value, name) for value in options)
    return isinstance(options, str) and (options == name or f"(?P<{name}>" in options)

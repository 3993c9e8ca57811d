"""Machine and sensors as plain data, the names derived from them, and their TOML file (`docs/files.md`)."""

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from rtec.errors import ConfigError
from rtec.machine.chain import Axis, Chain, Link, derive_chain
from rtec.quantities import Counts, CountsPerMillimetre, DegreesCelsius, Millimetres, MillimetresPositive, Vector
from rtec.tomlfile import Strict, digest, nearest, read_kind, validated

CONSTANT_CHANNELS = ("load_kg", "force_n")
"""Workpiece weight and force: columns of a measurement; in the loop, constants from the run file."""


@dataclass(frozen=True)
class Sensor:
    """A temperature sensor; a reading outside `range_degc` is a broken sensor, not a temperature."""

    name: str
    range_degc: tuple[float, float] = (-20.0, 120.0)


@dataclass(frozen=True)
class Machine:
    """A machine tool.

    Attributes:
        tool_chain: link names from the base to the tool tip [G 2.22].
        work_chain: link names from the base to the cutting point [G 2.23].
        axes, sensors: in the order of all count and temperature arrays.
        links: the fixed links by name.
        file: path of its file; None for a machine made in memory. No part of the machine's identity.
    """

    name: str
    tool_chain: tuple[str, ...]
    work_chain: tuple[str, ...]
    axes: tuple[Axis, ...]
    links: Mapping[str, Link] = field(default_factory=dict)
    sensors: tuple[Sensor, ...] = ()
    file: Path | None = field(default=None, compare=False)

    def axis(self, name: str) -> Axis:
        """The axis of that name; KeyError where there is none."""
        for axis in self.axes:
            if axis.name == name:
                return axis
        raise KeyError(name)

    @property
    def axis_names(self) -> tuple[str, ...]:
        """Axis names in order."""
        return tuple(a.name for a in self.axes)

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Sensor names in order."""
        return tuple(s.name for s in self.sensors)

    def sensor_place(self, name: str) -> int:
        """Index of a sensor in `sensors`.

        Raises:
            ConfigError: no sensor has that name.
        """
        if name not in self.sensor_names:
            raise ConfigError(f"the machine has no sensor {name!r}{nearest(name, self.sensor_names)}")
        return self.sensor_names.index(name)

    def of_another_axis(self, sensor: str, axis: str) -> bool:
        """Whether the name of a sensor says that it is at another axis: `T_z_nut`, for X."""
        named = {w.upper() for w in sensor.split("_")[1:]} & {a.name.upper() for a in self.axes}
        return bool(named) and axis.upper() not in named

    @property
    def moving_channels(self) -> tuple[str, ...]:
        """Names of the channels that change from cycle to cycle, axis by axis."""
        return tuple(c for a in self.axes for c in a.moving_channels)

    @property
    def slow_channels(self) -> tuple[str, ...]:
        """Names of the channels that change slowly: temperatures, spindle speed, load, force."""
        return (*self.sensor_names, "spindle_rpm", *CONSTANT_CHANNELS)

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of all channels that an effect may read."""
        return (*self.moving_channels, *self.slow_channels, "time_s")

    @cached_property
    def columns(self) -> Mapping[str, str]:
        """Channel of each column of a measurement's table, for every channel that the machine can have."""
        out = {name: name for name in ("spindle_rpm", "feed_mm_min", *CONSTANT_CHANNELS, "angle_deg")}
        for axis in self.axes:
            c = axis.channel
            out |= {f"{c}_mm": c, f"dir_{c}": axis.direction_channel}
            out |= {f"v{c}_mm_s": axis.velocity_channel, f"a{c}_mm_s2": axis.acceleration_channel}
        return out | {f"{sensor}_degc": sensor for sensor in self.sensor_names}

    @cached_property
    def chain(self) -> Chain:
        """The lever arms: component errors to tool-tip error."""
        return derive_chain(self.tool_chain, self.work_chain, self.axes, self.links)

    @property
    def components(self) -> tuple[str, ...]:
        """Names of all component errors, in the order of the chain's columns."""
        return self.chain.components

    @property
    def turns_work(self) -> bool:
        """Whether a spindle carries the workpiece, as on a lathe; by the names of the links."""
        return any("spindle" in name.lower() for name in self.work_chain)

    @cached_property
    def hash(self) -> str:
        """SHA-256 of the machine file's content, independent of its formatting."""
        return digest(self.content())

    def content(self) -> dict[str, Any]:
        """The machine file's content as plain data, without the file's path."""
        return {name: value for name, value in asdict(self).items() if name != "file"}


RESERVED = {"time_s", "spindle_rpm", "feed_mm_min", *CONSTANT_CHANNELS, "run", "pi", "e"}
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


class _MachineTable(Strict):
    """`[machine]`: name and kinematic chain.

    Attributes:
        name: name of the machine.
        tool_chain: the links from the base to the tool tip: axes by their names, fixed links by names of your choice.
        work_chain: the links from the base to the cutting point.
    """

    name: Annotated[str, Field(min_length=1)]
    tool_chain: tuple[str, ...]
    work_chain: tuple[str, ...] = ()


class _AxisTable(Strict):
    """`[axis.X]`: one axis.

    Attributes:
        kind: kind of motion.
        direction: machine coordinate that grows when the axis moves positive: of the tool relative to the workpiece.
        travel_mm: lowest and highest position.
        counts_per_mm: encoder counts per millimetre, after x4.
        pitch_mm: pitch of the screw or the scale; not given where there is none.
        offset_mm: frame origin at position zero, relative to the previous link.
        compensate: may rtec correct this axis?
        dead_band_counts: motion back by at most this much does not count as a reversal.
    """

    kind: Literal["linear"] = "linear"
    direction: Literal["X", "Y", "Z"]
    travel_mm: tuple[Millimetres, Millimetres]
    counts_per_mm: CountsPerMillimetre
    pitch_mm: MillimetresPositive | None = None
    offset_mm: Vector = (0.0, 0.0, 0.0)
    compensate: bool = True
    dead_band_counts: Counts = 2

    @field_validator("kind", "direction", mode="before")
    @classmethod
    def _linear(cls, value: object) -> object:
        if value in ("A", "B", "C", "rotary"):
            raise ValueError("rotary axes are not modelled (leave it out, and keep it at one angle while measuring)")
        return value


class _LinkTable(Strict):
    """`[link.NAME]`: a fixed link; one without a table is at the previous link.

    Attributes:
        offset_mm: its origin, relative to the previous link.
    """

    offset_mm: Vector = (0.0, 0.0, 0.0)


class _SensorTable(Strict):
    """`[temperature.NAME]`: a temperature sensor.

    Attributes:
        range_degc: a reading outside is a broken sensor, not a temperature.
    """

    range_degc: tuple[DegreesCelsius, DegreesCelsius] = (-20.0, 120.0)


class MachineFile(Strict):
    """The whole machine file.

    Attributes:
        machine: name and kinematic chain.
        axis: the axes by name, as on the machine's panel.
        link: the fixed links of the chain by name.
        temperature: the temperature sensors by name.
    """

    machine: _MachineTable
    axis: dict[str, _AxisTable]
    link: dict[str, _LinkTable] = Field(default_factory=dict)
    temperature: dict[str, _SensorTable] = Field(default_factory=dict)


def load_machine(path: Path) -> Machine:
    """Read a machine file.

    Raises:
        ConfigError: all faults of the file, with file, section, key and what is allowed.
    """
    return replace(machine_from(read_kind(path, "a machine file"), str(path)), file=path)


def machine_from(data: Mapping[str, Any], source: str) -> Machine:
    """Build a machine from the tables of its file; `source` names it in messages."""
    file = validated(MachineFile, data, source)
    faults = [f"{source}: {fault}" for fault in _faults(file)]
    if faults:
        raise ConfigError("\n".join(faults))
    named = {*file.machine.tool_chain, *file.machine.work_chain} - set(file.axis)
    return Machine(
        name=file.machine.name,
        tool_chain=file.machine.tool_chain,
        work_chain=file.machine.work_chain,
        axes=tuple(Axis(name=name, **table.model_dump()) for name, table in file.axis.items()),
        links={name: Link(name, file.link.get(name, _LinkTable()).offset_mm) for name in sorted(named)},
        sensors=tuple(Sensor(name, table.range_degc) for name, table in file.temperature.items()),
    )


def _faults(file: MachineFile) -> list[str]:
    chain = [*file.machine.tool_chain, *file.machine.work_chain]
    return [*_name_faults(file, chain), *_chain_faults(file, chain), *_range_faults(file)]


def _name_faults(file: MachineFile, chain: list[str]) -> list[str]:
    out = []
    taken = dict.fromkeys(RESERVED, "a channel of every machine")
    for kind, names in (("axis", file.axis), ("temperature", file.temperature)):
        for name in names:
            channels = [p + name.lower() for p in ("", "d_", "v_", "a_", "s_")] if kind == "axis" else [name]
            if not NAME.fullmatch(name):
                out.append(f"[{kind}.{name}] a name is letters, digits and _, and starts with a letter")
            for channel in channels:
                if channel in taken:
                    out.append(f"[{kind}.{name}] channel {channel!r} is already {taken[channel]}")
                taken[channel] = f"[{kind}.{name}]"
    out += [f"[machine] link name {n!r} is letters, digits and _" for n in chain if not NAME.fullmatch(n)]
    return out


def _chain_faults(file: MachineFile, chain: list[str]) -> list[str]:
    out = [f"[machine] {name!r} is twice in the chains" for name in sorted({n for n in chain if chain.count(n) > 1})]
    described = {*file.axis, *file.link}
    bare = [name for name in chain if name not in described]
    for kind, tables in (("axis", file.axis), ("link", file.link)):
        for name in (n for n in tables if n not in chain):
            near = nearest(name, bare)
            mistyped = f"{near} That name in a chain has no table" if "did you mean" in near else nearest(name, chain)
            out.append(f"[{kind}.{name}] is in neither tool_chain nor work_chain{mistyped}")
    out += [
        f"[axis.{name}] and [link.{name}]: a link moves or is fixed, not both"
        for name in file.axis
        if name in file.link
    ]
    if not file.machine.tool_chain:
        out.append("[machine] tool_chain is empty; it names the links from the base to the tool tip")
    if not file.axis:
        out.append("[axis] no axis is described")
    lines = [table.direction for table in file.axis.values() if table.compensate]
    for direction in sorted({d for d in lines if lines.count(d) > 1}):
        names = [n for n, t in file.axis.items() if t.compensate and t.direction == direction]
        out.append(f"[axis] {' and '.join(names)} both correct {direction}; set compensate = false for all but one")
    return out


def _range_faults(file: MachineFile) -> list[str]:
    out = []
    for name, axis in file.axis.items():
        if axis.travel_mm[0] >= axis.travel_mm[1]:
            out.append(f"[axis.{name}] travel_mm {list(axis.travel_mm)}: the first must be below the second")
    for name, sensor in file.temperature.items():
        if sensor.range_degc[0] >= sensor.range_degc[1]:
            out.append(f"[temperature.{name}] range_degc {list(sensor.range_degc)}: the first must be below the second")
    return out

"""Reads a machine from TOML (`docs/files.md` describes the file)."""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from rtec.errors import ConfigError
from rtec.machine.chain import Axis, Link
from rtec.machine.machine import CONSTANT_CHANNELS, Machine, Sensor
from rtec.quantities import Counts, CountsPerMillimetre, DegreesCelsius, Millimetres, MillimetresPositive, Vector
from rtec.tomlfile import Strict, nearest, read_toml, validated

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
    return replace(machine_from(read_toml(path), str(path)), file=path)


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
    out += [
        f"[axis.{name}] is in neither tool_chain nor work_chain{nearest(name, chain)}"
        for name in file.axis
        if name not in chain
    ]
    out += [
        f"[link.{name}] is in neither tool_chain nor work_chain{nearest(name, chain)}"
        for name in file.link
        if name not in chain
    ]
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

"""Machine and sensors as plain data, and the names derived from them."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from rtec.errors import ConfigError
from rtec.machine.chain import Axis, Chain, Link, derive_chain
from rtec.tomlfile import digest, nearest

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

    @cached_property
    def hash(self) -> str:
        """SHA-256 of the machine file's content, independent of its formatting."""
        return digest(self.content())

    def content(self) -> dict[str, Any]:
        """The machine file's content as plain data, without the file's path."""
        return {name: value for name, value in asdict(self).items() if name != "file"}

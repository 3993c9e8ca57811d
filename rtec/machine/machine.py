"""Machine, axis, fixed link and sensor as plain data, and the names that follow from them."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Literal

from rtec.errors import ConfigError
from rtec.machine.chain import Chain, derive_chain
from rtec.tomlfile import digest, nearest

Direction = Literal["X", "Y", "Z"]
Vector = tuple[float, float, float]

CONSTANT_CHANNELS = ("load_kg", "force_n")
"""Work-piece weight and force: columns of a measurement; in the loop constants from the run file."""


@dataclass(frozen=True)
class Axis:
    """One moving link.

    Attributes:
        name: as on the machine's panel, for example "X"; its position channel is the lower-case name.
        kind: "linear"; rotary axes will be another value.
        direction: machine coordinate that grows when the axis moves positive. For an axis on the work side this
            is the tool's motion relative to the workpiece (the slide itself moves the other way).
        travel_mm: lowest and highest position.
        counts_per_mm: encoder counts after x4.
        pitch_mm: screw or scale pitch; None where there is none.
        offset_mm: frame origin at position zero, relative to the previous link.
        compensate: may rtec correct this axis?
        dead_band_counts: motion back by at most this much does not count as a reversal.
    """

    name: str
    direction: Direction
    travel_mm: tuple[float, float]
    counts_per_mm: float
    pitch_mm: float | None = None
    offset_mm: Vector = (0.0, 0.0, 0.0)
    compensate: bool = True
    dead_band_counts: int = 2
    kind: Literal["linear"] = "linear"

    @property
    def channel(self) -> str:
        """Name of the position channel, mm."""
        return self.name.lower()

    @property
    def dead_band_mm(self) -> float:
        """The dead band of direction, mm."""
        return self.dead_band_counts / self.counts_per_mm

    @property
    def direction_channel(self) -> str:
        """Name of the channel of the last direction of motion: -1, +1, or 0 before the first motion."""
        return f"d_{self.channel}"

    @property
    def velocity_channel(self) -> str:
        """Name of the velocity channel, mm/s, signed."""
        return f"v_{self.channel}"

    @property
    def acceleration_channel(self) -> str:
        """Name of the acceleration channel, mm/s², signed."""
        return f"a_{self.channel}"

    @property
    def since_reversal_channel(self) -> str:
        """Name of the channel of the distance travelled since the last reversal, mm."""
        return f"s_{self.channel}"

    @property
    def moving_channels(self) -> tuple[str, ...]:
        """Names of all its channels: position, direction, velocity, acceleration, distance since reversal."""
        return (
            self.channel,
            self.direction_channel,
            self.velocity_channel,
            self.acceleration_channel,
            self.since_reversal_channel,
        )


@dataclass(frozen=True)
class Link:
    """A fixed link: spindle, turret, tool, workpiece; `offset_mm` from the previous link."""

    name: str
    offset_mm: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Sensor:
    """A temperature sensor; a reading outside `range_degc` is a broken sensor, not a temperature."""

    name: str
    range_degc: tuple[float, float] = (-20.0, 120.0)


@dataclass(frozen=True)
class Machine:
    """A machine tool as rtec sees it.

    Attributes:
        tool_chain: link names from the base to the tool tip [G 2.22].
        work_chain: link names from the base to the cutting point [G 2.23].
        axes, sensors: in the order of every count and temperature array.
        links: the fixed links by name.
    """

    name: str
    tool_chain: tuple[str, ...]
    work_chain: tuple[str, ...]
    axes: tuple[Axis, ...]
    links: Mapping[str, Link] = field(default_factory=dict)
    sensors: tuple[Sensor, ...] = ()

    def axis(self, name: str) -> Axis:
        """Give the axis of that name; KeyError where there is none."""
        return {a.name: a for a in self.axes}[name]

    @property
    def axis_names(self) -> tuple[str, ...]:
        """Axis names in order."""
        return tuple(a.name for a in self.axes)

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Sensor names in order."""
        return tuple(s.name for s in self.sensors)

    def sensor_place(self, name: str) -> int:
        """Place of a sensor in `sensors`.

        Raises:
            ConfigError: there is none of that name.
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
    def chain(self) -> Chain:
        """The lever arms: component errors to tool-tip error."""
        return derive_chain(self)

    @property
    def components(self) -> tuple[str, ...]:
        """Names of all component errors, in the order of the chain's columns."""
        return self.chain.components

    @cached_property
    def hash(self) -> str:
        """SHA-256 of everything that the machine file says, independent of its formatting."""
        return digest(asdict(self))

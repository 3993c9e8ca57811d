"""The state: every channel at n instants, and how effects read it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from rtec.arrays import Floats
from rtec.effects.derived import direction_track, lag_track, since_reversal_track, since_turn_track
from rtec.errors import ModelError
from rtec.machine import Axis, Machine
from rtec.tomlfile import nearest

# A value is an array of n numbers, one number, or (while the kernel is being written) a symbol for either.
Value = Any


class Channels(Protocol):
    """Values by channel name, as an effect reads them; plain arithmetic and numpy functions work on them."""

    def value(self, name: str) -> Value:
        """Give a channel as it is, by its name.

        Of axis X: `x` position mm, `d_x` last direction -1 0 +1, `v_x` velocity mm/s, `a_x` acceleration mm/s²,
        `s_x` distance travelled since the last reversal mm (`derived.FAR_MM` before the first). Others: temperatures
        °C by the sensor's name, `spindle_rpm` 1/min, `load_kg`, `force_n`, `time_s`.
        """
        ...

    def rise(self, sensor: str) -> Value:
        """Temperature above the model's reference, K."""
        ...

    def lagged(self, value: Value, tau_s: Value) -> Value:
        """First-order lag of a slow value; starts settled."""
        ...


@dataclass(frozen=True)
class State:
    """Channels at n instants, for numpy.

    Attributes:
        machine: has the axes, the sensors and the dead bands of directions.
        time_s: (n,), not falling.
        channels: arrays (n,) by channel name: `x`, `T_spindle`, `spindle_rpm`; a direction `d_x` and a distance
            since reversal `s_x` that are not given follow from the order of the positions. Velocities and
            accelerations are given, or zero where `at_rest` or where the axis has one position throughout, or missing.
        reference_degc: temperature at which a temperature effect is zero.
        dead_band_mm: by axis name, where it differs from the machine's.
        at_rest: the axes are at rest at all instants; velocities and accelerations that are not given are zero.
    """

    machine: Machine
    time_s: Floats
    channels: Mapping[str, Floats]
    reference_degc: float = 20.0
    dead_band_mm: Mapping[str, float] = field(default_factory=dict)
    at_rest: bool = False
    _cache: dict[str, Floats] = field(default_factory=dict, repr=False, compare=False)

    def __len__(self) -> int:
        return len(self.time_s)

    def value(self, name: str) -> Floats:
        """Give a channel, (n,).

        Raises:
            ModelError: the channel is not given and does not follow from the given ones.
        """
        if name in self.channels:
            return self.channels[name]
        if name == "time_s":
            return self.time_s
        if name not in self._cache:
            axis = next((a for a in self.machine.axes if name in a.moving_channels), None)
            if axis is None or not self.has(name):
                raise ModelError(f"channel {name!r} is not in this data{self._way_on(name, axis)}")
            self._cache[name] = self._following(axis, name)
        return self._cache[name]

    def has(self, name: str) -> bool:
        """Whether a channel is given or follows from the given ones."""
        axis = next((a for a in self.machine.axes if name in a.moving_channels), None)
        if name in self.channels or name == "time_s" or axis is None:
            return name in self.channels or name == "time_s"
        if name in (axis.velocity_channel, axis.acceleration_channel):
            return self.at_rest or self._still(axis)
        return name != axis.channel and axis.channel in self.channels

    def _still(self, axis: Axis) -> bool:
        """Whether an axis was recorded at one place throughout: it did not move."""
        return axis.channel in self.channels and not np.ptp(self.channels[axis.channel]) > 0.0

    def _following(self, axis: Axis, name: str) -> Floats:
        if name in (axis.velocity_channel, axis.acceleration_channel):
            return np.zeros(len(self))
        return self._direction(axis) if name == axis.direction_channel else self._since(axis)

    def _way_on(self, name: str, axis: Axis | None) -> str:
        if axis is not None and name in (axis.velocity_channel, axis.acceleration_channel):
            unit = "mm_s" if name == axis.velocity_channel else "mm_s2"
            return (
                f"; it comes from a column {name[0]}{axis.channel}_{unit} (a feed does not say whether the axis moved)"
            )
        if name in self.machine.sensor_names:
            return (
                f"; add a column {name}_degc to the file, 20.0 in every row where it was not logged (rtec import "
                f"--answer {name}_degc=20 writes it), but effects of that temperature can then not be tested"
            )
        return nearest(name, self.channels)

    def _direction(self, axis: Axis) -> Floats:
        return direction_track(self._position(axis), self.dead_band_mm.get(axis.name, axis.dead_band_mm))

    def _since(self, axis: Axis) -> Floats:
        if axis.direction_channel in self.channels:
            given = np.ascontiguousarray(self.channels[axis.direction_channel], dtype=np.float64)
            return since_turn_track(self._position(axis), given)
        return since_reversal_track(self._position(axis), self.dead_band_mm.get(axis.name, axis.dead_band_mm))

    def _position(self, axis: Axis) -> Floats:
        return np.ascontiguousarray(self.channels[axis.channel], dtype=np.float64)

    def rise(self, sensor: str) -> Floats:
        """Temperature above the reference, K, (n,)."""
        return self.value(sensor) - self.reference_degc

    def lagged(self, value: Value, tau_s: Value) -> Floats:
        """First-order lag over the state's own instants, (n,)."""
        whole = np.ascontiguousarray(np.broadcast_to(np.asarray(value, dtype=np.float64), self.time_s.shape))
        return lag_track(whole, self.time_s, float(tau_s))

    def positions_mm(self) -> Floats:
        """Axis positions, mm, (n, axes); zero for an axis that is not among the channels."""
        zero = np.zeros(len(self))
        return np.stack([self.channels.get(a.channel, zero) for a in self.machine.axes], axis=-1)

    def remembered(self) -> tuple[str, ...]:
        """Channels that follow from the order of the positions; `rows` computes them before it drops instants."""
        moved = [a for a in self.machine.axes if a.channel in self.channels]
        return tuple(c for a in moved for c in (a.direction_channel, a.since_reversal_channel))

    def rows(self, index: Sequence[int] | slice | Floats) -> "State":
        """The state at some instants; channels with memory of the motion keep their values in the whole state."""
        names = {*self.channels, *self.remembered()}
        channels = {n: self.value(n)[index] for n in names}
        return replace(self, time_s=self.time_s[index], channels=channels, _cache={})

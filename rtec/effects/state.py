"""The state: every channel at n instants, and what effects may ask of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rtec.effects.derived import direction_track, lag_track
from rtec.errors import ModelError
from rtec.machine import Machine
from rtec.tomlfile import nearest

Floats = NDArray[np.float64]
# A value is an array of n numbers, one number, or (while the kernel is being written) a symbol for either.
Value = Any


class Channels(Protocol):
    """What an effect sees: values by name, plain arithmetic and numpy functions work on them."""

    def value(self, name: str) -> Value:
        """Give a channel as it is: position mm, speed mm/s, spindle 1/min, direction -1 0 +1."""
        ...

    def rise(self, sensor: str) -> Value:
        """Temperature above the model's reference, K."""
        ...

    def lagged(self, value: Value, tau_s: Value) -> Value:
        """First-order lag of a value that changes slowly; starts settled."""
        ...


@dataclass(frozen=True)
class State:
    """Channels at n instants, for numpy.

    Attributes:
        machine: tells axes and sensors apart, and the dead band of directions.
        time_s: (n,), not falling.
        channels: arrays (n,) by channel name: `x`, `T_spindle`, `spindle_rpm`; a direction `d_x` that is not
            given follows from the order of the positions.
        reference_degc: temperature at which a temperature effect is nothing.
        dead_band_mm: by axis name, where it is another than the machine's own.
    """

    machine: Machine
    time_s: Floats
    channels: Mapping[str, Floats]
    reference_degc: float = 20.0
    dead_band_mm: Mapping[str, float] = field(default_factory=dict)
    _cache: dict[str, Floats] = field(default_factory=dict, repr=False, compare=False)

    def __len__(self) -> int:
        return len(self.time_s)

    def value(self, name: str) -> Floats:
        """Give a channel, (n,).

        Raises:
            ModelError: the channel is neither given nor follows from those that are.
        """
        if name in self.channels:
            return self.channels[name]
        if name == "time_s":
            return self.time_s
        axis = next((a for a in self.machine.axes if a.direction_channel == name), None)
        if axis is None or axis.channel not in self.channels:
            raise ModelError(f"channel {name!r} is not in this data{nearest(name, self.channels)}")
        if name not in self._cache:
            position = np.ascontiguousarray(self.channels[axis.channel], dtype=np.float64)
            self._cache[name] = direction_track(position, self.dead_band_mm.get(axis.name, axis.dead_band_mm))
        return self._cache[name]

    def rise(self, sensor: str) -> Floats:
        """Temperature above the reference, K, (n,)."""
        return self.value(sensor) - self.reference_degc

    def lagged(self, value: Value, tau_s: Value) -> Floats:
        """First-order lag over the state's own instants, (n,)."""
        whole = np.ascontiguousarray(np.broadcast_to(np.asarray(value, dtype=np.float64), self.time_s.shape))
        return lag_track(whole, self.time_s, float(tau_s))

    def positions_mm(self) -> Floats:
        """Axis positions, (n, axes); an axis that is not among the channels stands at zero."""
        zero = np.zeros(len(self))
        return np.stack([self.channels.get(a.channel, zero) for a in self.machine.axes], axis=-1)

    def rows(self, index: Sequence[int] | slice | Floats) -> "State":
        """Give the state at some instants; directions are kept as they were in the whole."""
        known = {a.direction_channel for a in self.machine.axes if a.channel in self.channels}
        names = {*self.channels, *known}
        channels = {n: self.value(n)[index] for n in names}
        return State(self.machine, self.time_s[index], channels, self.reference_degc, self.dead_band_mm)

"""A state from numbers, arrays, a dict or a frame, with the names of the machine file or of a table."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from rtec.arrays import Floats
from rtec.effects import State
from rtec.errors import ModelError
from rtec.machine import Axis, Machine
from rtec.result import columns_of, is_frame
from rtec.tomlfile import nearest

ABSOLUTE_ZERO_DEGC = -273.15


class Described(Protocol):
    """The part of a model that names the channels that it needs."""

    @property
    def machine(self) -> Machine:
        """The machine, whose channels have names."""
        ...

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels that the effects read."""
        ...

    @property
    def fed(self) -> tuple[str, ...]:
        """Components that the effects feed."""
        ...

    @property
    def reference_degc(self) -> float:
        """Temperature at which a temperature effect is zero."""
        ...

    @property
    def dead_bands_mm(self) -> Mapping[str, float]:
        """Dead bands by axis name: motion back by at most this much is no reversal."""
        ...


@dataclass(frozen=True)
class SettledState(State):
    """Instants without a time: each is a steady state, where every lag has settled."""

    def lagged(self, value: Any, tau_s: Any) -> Floats:
        """The value itself, (n,)."""
        del tau_s
        return np.array(np.broadcast_to(np.asarray(value, dtype=np.float64), self.time_s.shape))


def state_at(model: Described, given: Any, channels: Mapping[str, ArrayLike]) -> tuple[State, bool]:
    """The state, and whether all given values are single numbers.

    Args:
        model: its machine names the channels, and its effects need some of them.
        given: a dict, or a frame of pandas, polars or Arrow; columns of a frame that are no channel are ignored.
        channels: further channels by name.

    Raises:
        ModelError: a name that is no channel, one that the model needs and that is missing, lengths that differ, or a
            value that is no finite number.
    """
    names, frame = _names(model.machine), given is not None and not isinstance(given, Mapping) and is_frame(given)
    if given is not None and not frame and not isinstance(given, Mapping):
        raise ModelError(f"predict: a {type(given).__name__} is neither a dict nor a frame with named columns")
    items = columns_of(given) if frame else dict(given or {})
    known = {k: v for k, v in items.items() if not frame or k in names}
    values = _values(model.machine, names, known) | _values(model.machine, names, channels)
    single = not frame and all(v.ndim == 0 for v in values.values())
    lengths = {k: len(v) for k, v in values.items() if v.ndim}
    if len(set(lengths.values())) > 1:
        raise ModelError(f"predict: lengths differ: {', '.join(f'{k} {n}' for k, n in lengths.items())}")
    n = next(iter(lengths.values()), 1)
    whole = {k: np.ascontiguousarray(np.broadcast_to(v, (n,))) for k, v in values.items()}
    time_s = whole.pop("time_s", None)
    kind = SettledState if time_s is None else State
    time = np.zeros(n) if time_s is None else time_s
    state = kind(model.machine, time, whole, model.reference_degc, model.dead_bands_mm)
    _check_needed(model, state, timed=time_s is not None)
    return state, single


def _names(machine: Machine) -> dict[str, str]:
    """Channel by each of its names: its own, its column's, the axis' name, and `dir_X`."""
    out = {c: c for c in machine.channel_names} | dict(machine.columns)
    for axis in machine.axes:
        out |= {axis.name: axis.channel, f"dir_{axis.name}": axis.direction_channel}
    return out


def _numbers(name: str, value: Any) -> Floats:
    try:
        out = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as e:
        raise ModelError(f"predict: {name}: {e}") from e
    if out.ndim > 1:
        raise ModelError(f"predict: {name} has {out.ndim} dimensions; a number or one row of numbers is expected")
    if not np.isfinite(out).all():
        raise ModelError(f"predict: {name} has a value that is no finite number")
    return out


def _values(machine: Machine, names: Mapping[str, str], given: Mapping[str, Any]) -> dict[str, Floats]:
    """The values of each channel, from names that each stand for another one."""
    called: dict[str, str] = {}
    out: dict[str, Floats] = {}
    for name, value in given.items():
        if name not in names:
            raise ModelError(f"predict: {name!r} is no channel of this machine{nearest(name, names)}")
        channel = names[name]
        if channel in called:
            raise ModelError(f"predict: {called[channel]} and {name} are the same channel; give one of them")
        called[channel], out[channel] = name, _possible(name, _numbers(name, value), channel, machine)
    return out


def _possible(name: str, values: Floats, channel: str, machine: Machine) -> Floats:
    """The values of a channel.

    Raises:
        ModelError: a direction that is none, or a temperature below absolute zero.
    """
    if any(channel == a.direction_channel for a in machine.axes) and not np.isin(values, (-1.0, 0.0, 1.0)).all():
        raise ModelError(f"predict: {name} must be 1, -1, or 0 where it is unknown")
    if channel in machine.sensor_names and np.any(values < ABSOLUTE_ZERO_DEGC):
        raise ModelError(f"predict: {name} is below absolute zero; temperatures are in °C")
    return values


def _check_needed(model: Described, state: State, *, timed: bool) -> None:
    """Raise ModelError where a channel is missing that an effect reads or that a lever arm depends on."""
    machine = model.machine
    if len(state) and "time_s" in model.channels and not timed:
        raise ModelError("predict: time_s is missing; the model has an effect of the time")
    for axis in machine.axes:
        channels = {axis.direction_channel, axis.since_reversal_channel} & set(model.channels)
        if axis.channel not in state.channels and (_is_arm(model, axis) or axis.channel in model.channels or channels):
            raise ModelError(f"predict: the position of {axis.name} is missing: {axis.name}=…, mm")
        if channels and axis.direction_channel not in state.channels and len(state) == 1:
            raise ModelError(
                f"predict: one position has no direction of motion, which the model needs: dir_{axis.name}=1 or -1"
            )
    for channel in model.channels:
        if channel in machine.sensor_names and channel not in state.channels:
            raise ModelError(f"predict: temperature {channel} is missing: {channel}=…, °C")


def _is_arm(model: Described, axis: Axis) -> bool:
    """Whether the lever arm of a component that the model feeds depends on an axis' position."""
    machine = model.machine
    fed = [machine.components.index(component) for component in model.fed]
    return bool(np.any(machine.chain.terms[:, fed, 1 + machine.axis_names.index(axis.name)]))

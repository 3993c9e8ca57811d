"""Shapes without a name: what any smooth or periodic dependence on one or two variables would explain.

They judge whether the best effect of the catalogue is good enough (adequacy), and where none is, they say on which
variables the error depends, whether smoothly or periodically, and with which period. `shapes_search` weighs them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis.search.candidates import real
from rtec.estimation.readings import Readings

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

LEVELS = 8
"""A variable with at most so many values is taken level by level."""
MOVED = 0.1
"""Speeds that differ by less than this, octaves, are one."""


@dataclass(frozen=True)
class Shape:
    """A smooth or periodic dependence.

    Attributes:
        group: reading columns that it acts on, as told to people.
        over: its variables, as `Ground.known` names them.
        fine: basis functions along each; of a periodic one, powers of the variable that its height changes with.
        period: of a periodic one, in the unit of its first variable; None for a smooth one.
    """

    group: str
    over: tuple[str, ...]
    fine: tuple[int, ...]
    period: float | None = None

    @property
    def variables(self) -> tuple[str, ...]:
        """Channel names."""
        return tuple(dict.fromkeys(map(plain_name, self.over)))

    @property
    def kind(self) -> Literal["smooth", "periodic"]:
        """Smooth or periodic."""
        return "smooth" if self.period is None else "periodic"


def plain_name(variable: str) -> str:
    """The channel of a variable: |v_x| is made of v_x."""
    return variable.strip("|")


class Ground:
    """Readings that shapes are drawn over.

    Attributes:
        readings: the readings.
    """

    def __init__(self, readings: Readings) -> None:
        self.readings = readings
        self._curves: dict[tuple[str, int], Floats] = {}

    @cached_property
    def known(self) -> Mapping[str, Floats]:
        """What shapes depend on, by name, (m,) each."""
        return variables(self.readings)

    @cached_property
    def groups(self) -> Mapping[str, Bools]:
        """Readings that belong together, by name, (m,) each."""
        return groups(self.readings)

    def columns(self, shape: Shape) -> Floats:
        """Columns of a shape, (m, k)."""
        mask = self.groups[shape.group][:, None]
        if shape.period is not None:
            return self._wave(shape) * mask
        if len(shape.over) == 1:
            return self._curve(shape.over[0], shape.fine[0]) * mask
        one, two = (self._curve(name, fine) for name, fine in zip(shape.over, shape.fine, strict=True))
        cross = (one[:, :, None] * two[:, None, :]).reshape(len(one), -1)
        return np.concatenate([one, two, cross], axis=1) * mask

    def _curve(self, name: str, fine: int) -> Floats:
        if (name, fine) not in self._curves:
            raw = curve(self.known[name], fine)
            self._curves[name, fine] = raw / np.maximum(np.abs(raw).max(axis=0), 1e-12)
        return self._curves[name, fine]

    def _wave(self, shape: Shape) -> Floats:
        angle = self.known[shape.over[0]] * (2.0 * np.pi / (shape.period or 1.0))
        wave = np.stack([np.sin(angle), np.cos(angle)], axis=1)
        if len(shape.over) == 1:
            return wave
        u = _unit(self.known[shape.over[1]])
        powers = np.stack([u**k for k in range(shape.fine[1] + 1)], axis=1)
        return np.asarray((wave[:, :, None] * powers[:, None, :]).reshape(len(u), -1))


def variables(readings: Readings) -> dict[str, Floats]:
    """Channels that vary and that every measurement recorded, by name, (m,) each; speeds whatever the way beside."""
    machine = readings.machine
    out: dict[str, Floats] = {}
    names = [a.channel for a in machine.axes] + [a.direction_channel for a in machine.axes]
    velocities = [a.velocity_channel for a in machine.axes]
    names += ["feed_mm_min", *velocities, "spindle_rpm", "load_kg", "force_n", *machine.sensor_names]
    for name in names:
        value = readings.channel(name)
        if np.isfinite(value).all() and np.ptp(value) > real(machine, name):
            out[name] = value
    if any(v in out for v in velocities):
        out.pop("feed_mm_min", None)
    out["time_s"] = readings.time_s
    speeds = {f"|{n}|": _octaves(out[n]) for n in velocities if n in out}
    return {**out, **{n: v for n, v in speeds.items() if np.ptp(v) > MOVED}}


def _octaves(velocity: Floats) -> Floats:
    """Speed whatever the direction, on a logarithmic scale: what comes with speed comes over decades of it."""
    speed = np.abs(velocity)
    least = max(float(np.quantile(speed, 0.05)), 1e-3 * float(speed.max()), 1e-9)
    return np.asarray(np.log2(np.maximum(speed, least)))


def groups(readings: Readings) -> dict[str, Bools]:
    """Reading columns that belong together: the same column of the same kind of set-up."""
    out: dict[str, Bools] = {}
    for s in readings.series:
        m = readings.measurements[s.source]
        what = m.instrument.component or " ".join(filter(None, (m.instrument.name, m.instrument.axis)))
        column = s.column.removeprefix("reading_").removesuffix("um").removesuffix("urad").strip("_")
        name = f"{what} {column}".strip()
        mask = out.setdefault(name, np.zeros(len(readings), dtype=bool))
        mask[s.part] = True
    return out


def _unit(value: Floats) -> Floats:
    """Scaled to -1 … +1."""
    span = float(np.ptp(value))
    return np.asarray(2.0 * (value - value.min()) / span - 1.0 if span > 0 else np.zeros_like(value))


def curve(value: Floats, count: int) -> Floats:
    """Smooth basis over a variable, without the constant, (m, ≤ count): natural splines on its quantiles."""
    places = np.unique(value)
    if len(places) <= min(count + 1, LEVELS):
        # A few levels, as of a spindle speed: one column for each but the first.
        return np.stack([(value == p).astype(np.float64) for p in places[1:]], axis=1)
    u = (value - places[0]) / (places[-1] - places[0])
    knots = np.unique(np.quantile(u, np.linspace(0.0, 1.0, count + 1)))
    columns = [u]
    last = _ramp(u, knots[-2], knots[-1])
    columns += [_ramp(u, k, knots[-1]) - last for k in knots[:-2]]
    whole = np.stack(columns, axis=1)
    return np.asarray(whole - whole.mean(axis=0))


def _ramp(u: Floats, knot: float, end: float) -> Floats:
    span = max(end - knot, 1e-9)
    return np.asarray((np.maximum(u - knot, 0.0) ** 3 - np.maximum(u - end, 0.0) ** 3) / span)

"""The plainest shape of a residual, in words: a line, a bend or a step along one channel."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rtec.estimation.gls import without_runs
from rtec.estimation.readings import Readings, Series

Floats = NDArray[np.float64]

MOST_OF_IT = 0.5
"""Share of the mean square that a shape must explain."""
SIMPLER = 0.8
"""A bend is named only where it leaves less than this share of the mean square that the line leaves."""
REAL_DEGC = 0.5
UNITS = {"um": "µm", "urad": "µrad"}


@dataclass(frozen=True)
class ResidualShape:
    """How a residual goes with one channel.

    Attributes:
        kind: "line", "bend" or "step" (between the directions of motion).
        channel: name of the channel.
        share: of the mean square that it explains.
        words: what it does, in words.
    """

    kind: Literal["line", "bend", "step"]
    channel: str
    share: float
    words: str


def shape_of(readings: Readings, s: Series, left: Floats) -> ResidualShape | None:
    """The plainest shape that explains most of a residual, (n,); None where none does."""
    unit, state = UNITS[s.unit], readings.states[s.source]
    y = without_runs(s, left)
    y = y - y.mean()
    whole = float(y @ y)
    if not whole > 0.0:
        return None
    found: list[tuple[float, ResidualShape]] = []
    for axis in readings.machine.axes:
        place = state.value(axis.channel)[s.row]
        if np.ptp(place) > 0.01 * (axis.travel_mm[1] - axis.travel_mm[0]):
            found += _along(s, y, place / 1e3, axis.channel, axis.name, f"{unit}/m")
        way = np.sign(state.value(axis.direction_channel)[s.row])
        if np.ptp(way):
            share, size = _explained(s, y, way[:, None])
            words = f"steps by {2.0 * abs(size[-1]):.3g} {unit} between the directions of {axis.name}"
            found.append((share, ResidualShape("step", axis.direction_channel, share, words)))
    for sensor in readings.machine.sensor_names:
        value = state.channels.get(sensor)
        if value is not None and np.isfinite(value[s.row]).all() and np.ptp(value[s.row]) > REAL_DEGC:
            found += _along(s, y, value[s.row], sensor, sensor, f"{unit}/K")
    if np.ptp(s.time_s) > 0.0:
        found += _along(s, y, (s.time_s - s.time_s[0]) / 3600.0, "time_s", "time", f"{unit}/h")
    best = max(found, key=lambda f: f[0], default=None)
    return best[1] if best is not None and best[1].share >= MOST_OF_IT else None


def _along(s: Series, y: Floats, x: Floats, channel: str, name: str, unit: str) -> list[tuple[float, ResidualShape]]:
    """A line and a bend along a channel, with what each is worth: a bend costs more."""
    u = (x - x.mean()) / max(float(np.ptp(x)), 1e-300)
    line, slope = _explained(s, y, u[:, None])
    bend, _ = _explained(s, y, np.column_stack([u, u**2]))
    per = slope[0] / float(np.ptp(x))
    way = "rises" if per > 0.0 else "falls"
    out = [(line, ResidualShape("line", channel, line, f"{way} straight along {name}, {abs(per):.3g} {unit}"))]
    if 1.0 - bend < SIMPLER * (1.0 - line):
        out.append((bend, ResidualShape("bend", channel, bend, f"bends along {name}")))
    return out


def _explained(s: Series, y: Floats, columns: Floats) -> tuple[float, Floats]:
    """Share of the mean square that columns explain, and their coefficients."""
    flat = without_runs(s, columns)
    flat = flat - flat.mean(axis=0)
    values = np.linalg.lstsq(flat, y, rcond=None)[0]
    left = y - flat @ values
    return 1.0 - float(left @ left) / float(y @ y), np.asarray(values)

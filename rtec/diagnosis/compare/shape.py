"""The simplest shape of a residual, in words: a line, a bend or a step along one channel.

And the recorded temperature that a slow drift follows with a delay or a curve. What follows the channels smoothly at
the same instant is already projected out, where there were enough readings for that.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rtec.arrays import Floats
from rtec.effects.derived import lag_track
from rtec.estimation.gls import without_runs
from rtec.estimation.gram.source import TAU_S
from rtec.estimation.readings import Readings, Series
from rtec.estimation.visible import moves, same_place_mm
from rtec.wording import ERROR_UNITS, significant

MOST_OF_IT = 0.5
"""Share of the mean square that a shape must explain."""
SIMPLER = 0.8
"""A bend is named only where its residual has less than this share of the line's mean square."""
REAL_DEGC = 0.5
AGAIN = "comes again at the same places"
READINGS = 4000
"""Fewest readings in which a slow drift shows."""


@dataclass(frozen=True)
class ResidualShape:
    """Dependence of a residual on one channel.

    Attributes:
        kind: "line", "bend" or "step" (between the directions of motion).
        channel: name of the channel.
        share: of the mean square that it explains.
        words: the dependence in words.
    """

    kind: Literal["line", "bend", "step"]
    channel: str
    share: float
    words: str


def shape_of(readings: Readings, s: Series, left: Floats) -> ResidualShape | None:
    """The simplest shape that explains most of a residual, (n,); None where none does."""
    unit, state = ERROR_UNITS[s.unit], readings.states[s.source]
    y = without_runs(s, left)
    y = y - y.mean()
    whole = float(y @ y)
    if not whole > 0.0:
        return None
    found: list[tuple[float, ResidualShape]] = []
    for axis in readings.machine.axes:
        place = state.value(axis.channel)[s.row]
        if moves(readings.measurements[s.source], axis, s.row):
            found += _along(s, y, place / 1e3, axis.channel, axis.name, f"{unit}/m")
        way = np.sign(state.value(axis.direction_channel)[s.row])
        if np.ptp(way):
            share, size = _explained(s, y, way[:, None])
            words = f"steps by {significant(2.0 * abs(size[-1]))} {unit} between the directions of {axis.name}"
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
    """A line and a bend along a channel, with the value of each: a bend costs more."""
    u = (x - x.mean()) / max(float(np.ptp(x)), 1e-300)
    line, slope = _explained(s, y, u[:, None])
    bend, _ = _explained(s, y, np.column_stack([u, u**2]))
    per = slope[0] / float(np.ptp(x))
    way = "rises" if per > 0.0 else "falls"
    out = [(line, ResidualShape("line", channel, line, f"{way} straight along {name}, {significant(abs(per))} {unit}"))]
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


def comes_again(readings: Readings, s: Series, left: Floats) -> float:
    """Share of the mean square of a residual, (n,), that other runs show at the same places in the same direction.

    Where places hardly recur, as in a record taken on the fly: what the other runs read nearest to each place along the
    only axis that moves, in either direction.
    """
    state = readings.states[s.source]
    poses = readings.poses_mm[s.source][s.row]
    same_mm = same_place_mm(readings.measurements[s.source])
    keys = [np.round(poses / same_mm)]
    keys += [np.sign(state.value(a.direction_channel)[s.row])[:, None] for a in readings.machine.axes]
    place = np.unique(np.concatenate(keys, axis=1), axis=0, return_inverse=True)[1].ravel()
    if len(np.unique(place)) < 2 or s.run[0] == s.run[-1]:
        return 0.0
    y = without_runs(s, left)
    count = np.bincount(place)[place] - 1
    again, others = count > 0, (np.bincount(place, y)[place] - y) / np.maximum(count, 1)
    if again.sum() < MOST_OF_IT * len(y):
        moving = np.flatnonzero(np.ptp(poses, axis=0) > same_mm)
        if len(moving) != 1:
            return 0.0
        again, others = np.ones(len(y), dtype=bool), _nearest_in_other_runs(poses[:, moving[0]], s, y)
    rest = y[again] - others[again]
    return 1.0 - float(rest @ rest) / max(float(y[again] @ y[again]), 1e-300)


def _nearest_in_other_runs(place: Floats, s: Series, y: Floats) -> Floats:
    """Interpolated readings of all other runs at each place, (n,)."""
    out = np.empty(len(y))
    for run in np.unique(s.run):
        mine = s.run == run
        order = np.argsort(place[~mine], kind="stable")
        out[mine] = np.interp(place[mine], place[~mine][order], y[~mine][order])
    return out


def drift_goes_with(readings: Readings, s: Series, left: Floats, smooth: Floats) -> str:
    """What explains most of a slow drift, in words: the place, or a temperature and its delay; empty where nothing.

    Args:
        readings, s: the series.
        left: its residual, (n,).
        smooth: columns that were projected out of the drift, (n, p).
    """
    if comes_again(readings, s, left) > MOST_OF_IT:
        return AGAIN
    few = np.arange(0, len(s), -(-len(s) // READINGS))
    time, state = s.time_s[few], readings.states[s.source]
    flat = smooth[few] - smooth[few].mean(axis=0)

    def beside(columns: Floats) -> Floats:
        mine = columns - columns.mean(axis=0)
        return np.asarray(mine - flat @ np.linalg.lstsq(flat, mine, rcond=None)[0])

    drift = beside(without_runs(s, left)[few])
    best, words = MOST_OF_IT, ""
    for sensor in readings.machine.sensor_names:
        value = state.channels.get(sensor)
        if value is None or not np.isfinite(value[s.row]).all() or np.ptp(value[s.row]) < REAL_DEGC:
            continue
        now = value[s.row][few]
        taus = [tau for tau in TAU_S if tau <= 0.5 * float(np.ptp(time))]
        shapes = [(np.column_stack([now, (now - now.mean()) ** 2]), f"goes with {sensor}")]
        shapes += [
            (lag_track(now, time, tau)[:, None], f"goes with {sensor}, about {significant(tau / 60)} min behind it")
            for tau in taus
        ]
        for columns, what in shapes:
            mine = beside(columns)
            rest = drift - mine @ np.linalg.lstsq(mine, drift, rcond=None)[0]
            share = 1.0 - float(rest @ rest) / max(float(drift @ drift), 1e-300)
            if share > best:
                best, words = share, what
    return words

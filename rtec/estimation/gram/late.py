"""The change of a fit by a lag that all axes have in common.

A ball bar reads in motion, against commanded angles. An equal lag of all axes turns the circle by a small angle, which
no circle shows: servo lags show only as their difference. But every error is then turned by that angle. To the second
order a scale reads as a squareness, and a squareness or a difference of two lags `δ` as a difference of two servo
gains: `(τ_a + τ_b) δ` of the acceleration.

A first-order loop with time constant τ falls short by `½ τ²` of the acceleration. So the fitted servo gains bound the
common lag; feed-forward makes it smaller.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rtec.arrays import Floats
from rtec.estimation.gram.source import Source
from rtec.estimation.gram.stream import Term, gather, predict
from rtec.machine import Axis

PER_UNIT_S2 = 1e-6
"""A servo gain of 1 µm per m/s²."""


def shift_by_common_lag(sources: Sequence[Source], terms: Sequence[Term], values: Floats) -> Floats:
    """Change of each coefficient if all axes lagged as far as their servo gains allow, (coefficients,).

    Args:
        sources: measurements with the weights of the fit.
        terms: of the fit; zeros where no servo gain is among them.
        values: their coefficients, and those of the explicit nuisances.
    """
    width = sum(len(t.names(sources[0].measurement.machine)) for t in terms)
    gains = _servo_gains(sources, terms, values)
    on_the_run = [axes for s in sources if len(axes := _moving(s)) > 1] if gains else []
    lag_s = max((_largest_s([gains.get(a.name, 0.0) for a in axes]) for axes in on_the_run), default=0.0)
    if lag_s == 0.0:
        return np.zeros(width)
    return lag_s * gather([_instead(s, _slope_per_s(s, terms, values)) for s in sources], terms).values()[:width]


def _servo_gains(sources: Sequence[Source], terms: Sequence[Term], values: Floats) -> dict[str, float]:
    """Servo gain of each axis, s²."""
    machine, out, k = sources[0].measurement.machine, {}, 0
    along = {f"E{a.direction}{a.name}": a.name for a in machine.axes}
    for term in terms:
        if term.effect.effect == "inertia" and term.effect.component in along:
            out[along[term.effect.component]] = PER_UNIT_S2 * float(values[k])
        k += len(term.names(machine))
    return out


def _largest_s(gains_s2: Sequence[float]) -> float:
    return float(np.sqrt(max(2.0 * float(np.mean(gains_s2)), 0.0)))


def _moving(source: Source) -> list[Axis]:
    """Axes that accelerate while the instrument reads, and whose place and velocity are known."""
    m, out = source.measurement, []
    for axis in (a for a in m.machine.axes if a.channel in m.channels):
        faster = source.rate(axis, axis.acceleration_channel)
        if faster is not None and faster.any() and source.rate(axis, axis.velocity_channel) is not None:
            out.append(axis)
    return out


def _slope_per_s(source: Source, terms: Sequence[Term], values: Floats) -> Floats:
    """Minus the derivative in time of the terms' prediction, (readings, n); zero at rest.

    It is taken along the path, between the places at which an axis reverses: a lag does not move a reversal.
    """
    m, axes = source.measurement, _moving(source)
    out = np.zeros((source.count, len(m)))
    if len(axes) < 2:
        return out
    predicted = predict(source.weighted(np.ones(len(source.weight))), terms, values).reshape(-1, source.count).T
    place = np.stack([m.channels[a.channel] for a in axes])
    speed = np.linalg.norm([source.state.value(a.velocity_channel) for a in axes], axis=0)
    ways = np.stack([source.state.value(a.direction_channel) for a in axes])
    cut = np.flatnonzero((np.diff(m.run) != 0) | (np.diff(ways) != 0).any(axis=0)) + 1
    for rows in np.split(np.arange(len(m)), cut):
        way_mm = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(place[:, rows]), axis=0)))
        if len(rows) > 1 and (np.diff(way_mm) > 0).all():
            out[:, rows] = -speed[rows] * np.gradient(predicted[:, rows], way_mm, axis=1)
    return out


def _instead(source: Source, readings: Floats) -> Source:
    m = source.measurement
    columns = dict(zip(m.instrument.columns(), readings, strict=True))
    return Source(replace(m, readings=columns), source.blocks, source.weight)

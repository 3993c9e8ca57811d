"""What a figure of a finding shows: residuals against what drives them, and what the finding says of them."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis import floor, words
from rtec.diagnosis.noise import Whitener
from rtec.diagnosis.readings import Readings
from rtec.diagnosis.refit import solve
from rtec.diagnosis.result import Picture
from rtec.effects import Effect

Floats = NDArray[np.float64]
SEEN = 1e-3
"""Readings in which a finding does less than this share of its largest are of another instrument."""


def of_effect(
    readings: Readings, base: Floats, whitener: Whitener, label: str, effect: Effect, theta: Mapping[str, float]
) -> Picture | None:
    """Picture of an effect."""
    return _picture(readings, base, whitener, readings.columns(effect, theta), label, effect.channels(readings.machine))


def of_shape(
    readings: Readings, base: Floats, whitener: Whitener, columns: Floats, variables: Sequence[str]
) -> Picture | None:
    """Picture of a shape without a name: its columns, (m, k), and what it depends on."""
    return _picture(readings, base, whitener, columns, " and ".join(variables), variables)


def _picture(
    readings: Readings, base: Floats, whitener: Whitener, columns: Floats, label: str, channels: Sequence[str]
) -> Picture | None:
    whole = np.concatenate([base, columns], axis=1)
    values = solve(whitener(whole), whitener(readings.values))
    part = columns @ values[base.shape[1] :]
    residual = readings.values - base @ values[: base.shape[1]]
    # Run by run the two lose the same zero, so that they lie on each other where the effect explains the residual.
    part, residual = floor.cleaned(readings, part), floor.cleaned(readings, residual)
    units = {s.unit for s in readings.series}
    strongest = max(units, key=lambda u: _most(readings, part, u))
    rows = np.concatenate([np.full(len(s), s.unit == strongest) for s in readings.series])
    rows &= np.abs(columns).max(axis=1) > SEEN * np.abs(columns).max()
    if not rows.any():
        return None
    drivers = [(name, readings.channel(name)) for name in _by_interest(readings, channels)]
    seen = [(n, words.unit_of_channel(n), v[rows]) for n, v in drivers if np.isfinite(v[rows]).all()]
    direction = None
    axis = next((a for a in readings.machine.axes if seen and a.channel == seen[0][0]), None)
    if axis is not None:
        found = readings.channel(axis.direction_channel)[rows]
        direction = found if np.isfinite(found).all() and np.ptp(found) > 0 else None
    return Picture(
        label,
        "urad" if strongest == "urad" else "um",
        residual[rows],
        part[rows],
        tuple(seen),
        direction,
        readings.time_s[rows],
    )


def _most(readings: Readings, part: Floats, unit: str) -> float:
    return max((float(np.std(part[s.part])) for s in readings.series if s.unit == unit), default=0.0)


def _by_interest(readings: Readings, channels: Sequence[str]) -> list[str]:
    """Positions first, directions last and never alone: a picture over two places says little."""
    machine = readings.machine
    positions = [a.channel for a in machine.axes]
    directions = {a.direction_channel: a.channel for a in machine.axes}
    named = [directions.get(c, c) for c in channels]
    return sorted(dict.fromkeys(named), key=lambda c: (c not in positions, named.index(c)))

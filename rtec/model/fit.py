"""Shared by all fits of a model: the scale of a search, and the range in which the result is valid."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtec.arrays import Ints
from rtec.effects import Effect, Parameter, State
from rtec.errors import ModelError

LOG_SPAN = 50.0
"""If the upper bound is more than this factor times the lower one, the search scale is logarithmic."""


@dataclass(frozen=True)
class Margin:
    """How far a model is valid beyond its readings: by a share of their range, for temperatures by so many °C at least.

    Another day begins a little colder or ends a little warmer than the day of the readings; outside the valid range
    the guard holds the correction.
    """

    share: float = 0.05
    least_degc: float = 2.0


MARGIN = Margin()


@dataclass(frozen=True)
class SearchScale:
    """Maps a parameter's bounds to 0 … 1, linearly or logarithmically."""

    low: float
    high: float
    log: bool

    @classmethod
    def of(cls, parameter: Parameter) -> "SearchScale":
        """The scale of a parameter; ModelError where it has no bounds."""
        low, high = parameter.low, parameter.high
        if not np.isfinite([low, high]).all():
            raise ModelError(f"fit: non-linear parameter {parameter.name!r} has no bounds to search within")
        log = low > 0 and high / low > LOG_SPAN
        return cls(np.log(low), np.log(high), True) if log else cls(low, high, False)

    def value(self, place: float) -> float:
        """Value of the parameter at a place in 0 … 1."""
        there = self.low + (self.high - self.low) * place
        return float(np.exp(there)) if self.log else float(there)

    def place(self, value: float) -> float:
        """Place of a value, 0 … 1 within the bounds."""
        there = np.log(value) if self.log else value
        return float((there - self.low) / (self.high - self.low))


def valid_range(
    effects: Sequence[Effect], read: Sequence[tuple[State, Ints]], margin: Margin = MARGIN
) -> dict[str, tuple[float, float]]:
    """Valid range of every channel that the effects read: its range in the readings, with the margin.

    Directions have no margin. Velocities and accelerations include standstill, at which every motion begins and ends.
    Distances since a reversal have no range: each begins at zero and may become as long as the travel.

    Args:
        effects: the effects.
        read: states, and the rows of each that have a reading; a state without a channel does not limit its range.
        margin: how far beyond the readings.
    """
    machine = read[0][0].machine
    directions = {a.direction_channel for a in machine.axes}
    rates = {c for a in machine.axes for c in (a.velocity_channel, a.acceleration_channel)}
    since = {a.since_reversal_channel for a in machine.axes}
    out = {}
    for channel in sorted({c for e in effects for c in e.channels(machine)} - since):
        values = [state.value(channel)[rows] for state, rows in read if state.has(channel) and len(rows)]
        low, high = float(min(v.min() for v in values)), float(max(v.max() for v in values))
        if channel in rates:
            low, high = min(low, 0.0), max(high, 0.0)
        extra = margin.share * (high - low)
        if channel in machine.sensor_names:
            extra = max(extra, margin.least_degc)
        out[channel] = (low, high) if channel in directions else (low - extra, high + extra)
    return out

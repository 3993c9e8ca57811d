"""What every fit of a model needs: the scale on which a search runs, and the range in which its result may be used."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.effects import Effect, Parameter, State
from rtec.errors import ModelError

LOG_SPAN = 50.0
"""Parameters whose bounds are further apart than this factor are searched for on a logarithmic scale."""


@dataclass(frozen=True)
class Margin:
    """How far beyond the readings a model may be used: a share of what was seen, and at least so many °C.

    Another day begins a little colder or ends a little warmer than the day of the readings; outside the valid range
    the guard holds the correction where it is.
    """

    share: float = 0.05
    least_degc: float = 2.0


@dataclass(frozen=True)
class SearchScale:
    """A parameter's bounds as 0 … 1, straight or logarithmic."""

    low: float
    high: float
    log: bool

    @classmethod
    def of(cls, parameter: Parameter) -> "SearchScale":
        """Give the scale of a parameter; ModelError where it has no bounds."""
        low, high = parameter.low, parameter.high
        if not np.isfinite([low, high]).all():
            raise ModelError(f"fit: non-linear parameter {parameter.name!r} has no bounds to search within")
        log = low > 0 and high / low > LOG_SPAN
        return cls(np.log(low), np.log(high), True) if log else cls(low, high, False)

    def value(self, place: float) -> float:
        """Give the parameter at a place in 0 … 1."""
        there = self.low + (self.high - self.low) * place
        return float(np.exp(there)) if self.log else float(there)

    def place(self, value: float) -> float:
        """Give the place of a parameter, 0 … 1 within the bounds."""
        there = np.log(value) if self.log else value
        return float((there - self.low) / (self.high - self.low))


def valid_range(
    effects: Sequence[Effect], read: Sequence[tuple[State, NDArray[np.int64]]], margin: Margin
) -> dict[str, tuple[float, float]]:
    """Range of every channel that the effects read, where there are readings, with the margin.

    Directions have no margin. Velocities and accelerations take in standstill, at which every motion begins and
    ends. Distances since a reversal have no range: each begins at nothing and is as long as the travel allows.

    Args:
        effects: whose channels.
        read: states, and the rows of each that have a reading; a state without a channel says nothing of it.
        margin: how far beyond.
    """
    machine = read[0][0].machine
    directions = {a.direction_channel for a in machine.axes}
    rates = {c for a in machine.axes for c in (a.velocity_channel, a.acceleration_channel)}
    since = {a.since_reversal_channel for a in machine.axes}
    out = {}
    for channel in sorted({c for e in effects for c in e.channels(machine)} - since):
        seen = [state.value(channel)[rows] for state, rows in read if state.has(channel) and len(rows)]
        low, high = float(min(s.min() for s in seen)), float(max(s.max() for s in seen))
        if channel in rates:
            low, high = min(low, 0.0), max(high, 0.0)
        extra = margin.share * (high - low)
        if channel in machine.sensor_names:
            extra = max(extra, margin.least_degc)
        out[channel] = (low, high) if channel in directions else (low - extra, high + extra)
    return out

"""Axes that made only one pass: such a record confounds position, direction, time and heat."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtec.estimation.candidates import real
from rtec.estimation.readings import Readings, Series
from rtec.machine import Axis

TOGETHER = 0.98
"""From this correlation on, position and time cannot be distinguished."""
MOVES = 0.05
"""An axis that covers this share of its travel moves."""
FEWEST = 5
"""Fewest readings that show whether position and time rise together."""


@dataclass(frozen=True)
class OnePass:
    """An axis that made only one pass.

    Attributes:
        message: what cannot be distinguished, in words.
        next_step: what to measure.
        one_way: it never came back, so that position and time are confounded.
    """

    message: str
    next_step: str
    one_way: bool


def one_pass(readings: Readings) -> list[OnePass]:
    """Axes that made one pass in one direction, or one there and back while a temperature changed."""
    out = []
    passes_of = {
        a.name: [_pass(readings, s, a.channel, a.travel_mm) for s in readings.series] for a in readings.machine.axes
    }
    alone = sum(any(p is not None for p in passes) for passes in passes_of.values()) == 1
    for axis in readings.machine.axes:
        passes = passes_of[axis.name]
        moving = [p for p in passes if p is not None]
        files = {readings.series[i].source for i, p in enumerate(passes) if p is not None}
        if len(files) == 1 and min(abs(r) for r in moving) > TOGETHER:
            message = (
                f"{axis.name} went through once, in one direction: position and time are one in this record, so an "
                f"error along {axis.name}, a drift and a reversal cannot be distinguished."
            )
            out.append(OnePass(message, "Measure there and back, at least twice.", one_way=True))
        elif alone and len(files) == 1 and _turns(readings, axis) == 1 and (warmed := _warmed(readings, min(files))):
            message = (
                f"{axis.name} went there and back only once while {warmed}: an error along {axis.name}, a reversal and "
                "a growth with temperature can stand for each other in this record."
            )
            step = "Repeat the pass, and measure once more when the machine is warm."
            out.append(OnePass(message, step, one_way=False))
    return out


def _warmed(readings: Readings, source: int) -> str:
    """The recorded temperature that varied most in a measurement, in words; empty where none varied."""
    machine, state = readings.machine, readings.states[source]
    names = [n for n in machine.sensor_names if n in state.channels]
    varied = {n: float(np.nanmax(state.channels[n]) - np.nanmin(state.channels[n])) for n in names}
    name = max(varied, key=lambda n: varied[n] / real(machine, n), default=None)
    return f"{name} changed by {varied[name]:.1f} K" if name and varied[name] > real(machine, name) else ""


def _turns(readings: Readings, axis: Axis) -> int:
    """Turns of an axis between the outer quarters of its way, in the series with the most of them."""
    most = 0
    for s in readings.series:
        place = readings.states[s.source].value(axis.channel)[s.row]
        low, high = float(place.min()), float(place.max())
        side = np.sign(place - 0.5 * (low + high)) * (np.abs(place - 0.5 * (low + high)) > 0.25 * (high - low))
        most = max(most, int(np.count_nonzero(np.diff(side[side != 0.0]))) - 1)
    return most


def _pass(readings: Readings, s: Series, channel: str, travel_mm: Sequence[float]) -> float | None:
    """Correlation of position and time; None where the axis hardly moves."""
    place = readings.states[s.source].value(channel)[s.row]
    if float(np.ptp(place)) < MOVES * (travel_mm[1] - travel_mm[0]) or len(place) < FEWEST:
        return None
    if not np.ptp(s.time_s):
        return None
    return float(np.corrcoef(place, s.time_s)[0, 1])

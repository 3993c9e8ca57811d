"""What the current model explains by itself: one column for each of its numbers, and for unknowns of a set-up.

A fit of these columns is a refit of the model; what it cannot reach is what the model misses.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.errors import MeasurementError, ModelError
from rtec.estimation.readings import Readings, Series
from rtec.model import FittedEffect, Model

Floats = NDArray[np.float64]
STEP = 1e-3
"""Of a non-linear parameter's size, for its derivative."""


@dataclass(frozen=True)
class Base:
    """The current model as the readings see it.

    Attributes:
        columns: derivative of the readings by each number, then set-up terms, (m, p); zero columns are left out.
        predicted: what the model says, (m,).
        effects: columns and prediction of each effect: places in `columns`.
    """

    columns: Floats
    predicted: Floats
    names: tuple[str, ...]


def base_of(model: Model, readings: Readings) -> Base:
    """Work out the base of a model.

    Raises:
        MeasurementError: a measurement lacks a channel that the model needs.
    """
    parts: list[Floats] = [np.zeros((len(readings), 0))]
    names: list[str] = []
    predicted = np.zeros(len(readings))
    for fitted in model.effects:
        columns, slopes, value = effect_columns(fitted, readings)
        predicted += value
        parts += [columns, slopes]
        names += [f"{fitted.label} {n}" for n in (*fitted.values, *fitted.theta)]
    parts.append(readings.setup)
    whole = np.concatenate(parts, axis=1)
    names += readings.setup_names
    seen = np.abs(whole).max(axis=0, initial=0.0) > 0.0
    return Base(whole[:, seen], predicted, tuple(n for n, s in zip(names, seen, strict=True) if s))


def effect_columns(fitted: FittedEffect, readings: Readings) -> tuple[Floats, Floats, Floats]:
    """Columns of an effect's coefficients, slopes by its non-linear parameters, and its prediction."""
    try:
        columns = readings.columns(fitted.effect, fitted.theta)
    except ModelError as e:
        raise MeasurementError(f"the model's {fitted.label} cannot be worked out: {e}") from e
    coefficients = ordered(fitted, readings)
    slopes = [slope(fitted, readings, name, coefficients) for name in fitted.theta]
    stacked = np.stack(slopes, axis=1) if slopes else np.zeros((len(readings), 0))
    return columns, stacked, columns @ coefficients


def ordered(fitted: FittedEffect, readings: Readings) -> Floats:
    """Coefficients in the order of the columns."""
    return np.array([fitted.values[p.name] for p in fitted.effect.coefficients(readings.machine)])


def slope(fitted: FittedEffect, readings: Readings, name: str, coefficients: Floats) -> Floats:
    """Derivative of an effect's part of the readings by one of its non-linear parameters, (m,)."""
    at = fitted.theta[name]
    bounds = next(p for p in fitted.effect.nonlinear(readings.machine) if p.name == name)
    step = STEP * max(abs(at), 1e-6)
    high, low = min(at + step, bounds.high), max(at - step, bounds.low)
    if high <= low:
        return np.zeros(len(readings))
    ends = [readings.columns(fitted.effect, {**fitted.theta, name: t}) @ coefficients for t in (high, low)]
    return np.asarray((ends[0] - ends[1]) / (high - low))


def spikes(readings: Readings, left: Floats) -> NDArray[np.bool_]:
    """Single readings that are far from their neighbours in what the model leaves, (m,).

    Only isolated ones: a quadrant glitch has company and is what the machine does. So is what comes again at the same
    place in other runs.
    """
    out = np.zeros(len(readings), dtype=bool)
    for s in readings.series:
        if len(s) >= SHORT:
            off = left[s.part] - _median5(left[s.part], s.run)
            far, limit = _lonely(off, left[s.part], s.run)
            out[s.part] = far & ~_comes_again(readings, s, off, far, limit)
    return out


FAR, NEAR, LEAST = 6.0, 3.0, 0.05
SHORT = 7
AGAIN = 3
"""Readings at a place, going the same way, that tell what the machine does there."""
PLACE_MM = 0.01


def _comes_again(readings: Readings, s: Series, off: Floats, far: NDArray[np.bool_], limit: float) -> NDArray[np.bool_]:
    """Whether most readings at the same place, going the same way, are as far off."""
    out = np.zeros(len(off), dtype=bool)
    if not far.any():
        return out
    state = readings.states[s.source]
    moves = [a for a in readings.machine.axes if a.channel in state.channels]
    ways = [state.value(a.direction_channel)[s.row] for a in moves]
    at = np.column_stack([np.round(state.positions_mm()[s.row] / PLACE_MM), *ways])
    _, place = np.unique(at, axis=0, return_inverse=True)
    for p in np.unique(place[far]):
        here = place == p
        if here.sum() >= AGAIN:
            out |= here & (np.abs(off - np.median(off[here])) <= limit)
    return out


def _lonely(off: Floats, left: Floats, run: NDArray[np.int64]) -> tuple[NDArray[np.bool_], float]:
    """Which are far off with neighbours that are not; and how far that is."""
    # On a slope the middle one of five is the reading itself, and nothing seems to be off: neighbours tell the noise.
    bend = np.abs(left[1:-1] - 0.5 * (left[:-2] + left[2:]))[(run[2:] == run[:-2])]
    rough = float(np.median(bend)) / math.sqrt(1.5) if len(bend) else 0.0
    sigma = 1.4826 * max(float(np.median(np.abs(off - np.median(off)))), rough)
    limit = FAR * max(sigma, 1e-9) + LEAST * float(np.std(left))
    big = np.abs(off) > limit
    near = np.abs(off) <= NEAR * max(sigma, 1e-9) + LEAST * float(np.std(left))
    same = run[1:] == run[:-1]
    before = np.concatenate([[True], near[:-1] | ~same])
    after = np.concatenate([near[1:] | ~same, [True]])
    return np.asarray(big & before & after), limit


def _median5(value: Floats, run: NDArray[np.int64]) -> Floats:
    """Median of five neighbours in the run; at its ends of the five next to it."""
    out = np.empty_like(value)
    edges: Sequence[int] = [0, *(np.flatnonzero(np.diff(run)) + 1).tolist(), len(value)]
    for a, b in itertools.pairwise(edges):
        part = value[a:b]
        if b - a < 5:
            out[a:b] = np.median(part)
            continue
        windows = np.lib.stride_tricks.sliding_window_view(part, 5)
        middle = np.median(windows, axis=1)
        out[a + 2 : b - 2] = middle
        out[a : a + 2], out[b - 2 : b] = middle[0], middle[-1]
    return out

"""What the current model can explain: one column for each of its numbers, and for unknowns of a set-up.

A fit of these columns is a refit of the model; its residual is what the model misses.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from rtec.arrays import Floats
from rtec.errors import MeasurementError, ModelError
from rtec.estimation.gls import solve, without_nuisance
from rtec.estimation.readings import Readings
from rtec.model import FittedEffect, Model

FARTHEST, SURELY = 2.0, 10.0
"""A non-linear parameter, such as a delay, is kept where a refit would change it by over this many times itself, and by
over this many standard errors of the fit that determined it: the readings then show something else."""
NONE: Mapping[int, float] = MappingProxyType({})
STEP = 1e-3
"""Relative step of a non-linear parameter for its derivative."""


@dataclass(frozen=True)
class Base:
    """Columns and prediction of the current model at the readings.

    Attributes:
        columns: derivative of the readings by each number, then set-up terms, (m, p); without zero columns, and without
            those of non-linear parameters that a refit would move out of reach of a derivative.
        predicted: prediction of the model, (m,).
        effects: columns and prediction of each effect: places in `columns`.
    """

    columns: Floats
    predicted: Floats
    names: tuple[str, ...]


def base_of(model: Model, readings: Readings, delays: Mapping[int, float] = NONE) -> Base:
    """Columns and prediction of a model.

    Args:
        model: the model.
        readings: the readings.
        delays: delays in s in place of the model's where the columns are worked out, by the number of their effect. The
            prediction is by the model's own.

    Raises:
        MeasurementError: a measurement lacks a channel that the model needs.
    """
    parts: list[Floats] = [np.zeros((len(readings), 0))]
    names: list[str] = []
    predicted = np.zeros(len(readings))
    farthest: list[float] = []
    there = np.zeros(len(readings))
    for i, fitted in enumerate(model.effects):
        columns, slopes, value = effect_columns(fitted, readings)
        predicted += value
        if i in delays:
            moved = replace(fitted, theta={**fitted.theta, "tau": delays[i]})
            columns, slopes, value = effect_columns(moved, readings)
        there += value
        parts += [columns, slopes]
        names += [f"{fitted.label} {n}" for n in (*fitted.values, *fitted.theta)]
        farthest += [np.inf] * columns.shape[1] + [_farthest(fitted, n) for n in fitted.theta]
    parts.append(readings.setup)
    whole = np.concatenate(parts, axis=1)
    names += readings.setup_names
    farthest += [np.inf] * readings.setup.shape[1]
    seen = np.abs(whole).max(axis=0, initial=0.0) > 0.0
    if np.isfinite(farthest).any():
        left = readings.values - there
        flat = without_nuisance(readings, np.column_stack([whole[:, seen], left]))
        steps = np.zeros(len(farthest))
        steps[seen] = solve(flat[:, :-1], flat[:, -1])
        seen &= np.abs(steps) <= np.array(farthest)
    return Base(whole[:, seen], predicted, tuple(n for n, s in zip(names, seen, strict=True) if s))


def _farthest(fitted: FittedEffect, name: str) -> float:
    return max(FARTHEST * abs(fitted.theta[name]), SURELY * fitted.errors.get(name, np.inf))


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
    """Coefficients in the order of the columns, (k,)."""
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

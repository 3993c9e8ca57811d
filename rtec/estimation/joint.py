"""Refits all numbers of a model together, non-linear ones too, under the noise of the readings.

A number that the measurements do not show keeps its value. Numbers move from their current values, the more freely
the less certain they were.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.effects import Effect, Parameter
from rtec.errors import MeasurementError, ModelError
from rtec.estimation.columns import slope
from rtec.estimation.determined import undetermined
from rtec.estimation.gls import HeldOut, held_out, solve
from rtec.estimation.noise import Whitener, find_noise, refine
from rtec.estimation.plain import Plain, as_good, covariance, plain_fit, weights
from rtec.estimation.readings import Readings
from rtec.estimation.visible import within_record
from rtec.model import FittedEffect
from rtec.model.fit import SearchScale
from rtec.model.model import names_of
from rtec.wording import significant

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LOOSE = 30.0
"""Standard errors that a number may move freely where the same readings are fitted again."""
LOOSENESS = (1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 100.0, 300.0, 1e3, 1e4, 1e5)
"""The values to choose from where the readings are new."""
CHANGED = 6.0
"""Numbers have changed where twice the logarithm of the evidence rises by this: the odds are 20 to 1."""
NEW = 1e6
"""Standard deviation of the prior of a number without an earlier fit, over its usual size."""
ROUNDS = 2
EVALUATIONS = 40
TOLD = 4


@dataclass(frozen=True)
class Joint:
    """A joint refit.

    Attributes:
        effects: with refitted numbers.
        whitener: the noise.
        columns: of every linear number, then terms of the set-up, (m, p).
        left: residual of the fit, (m,).
        weights: of the fit; ordinary ones where generalised least squares predicts held-out runs worse.
        disputed: numbers on which both fits disagree by more than their errors, in words.
        plain: the ordinary fit.
        undetermined: effects, by number, of which only the sum with others is determined.
    """

    effects: tuple[FittedEffect, ...]
    whitener: Whitener
    columns: Floats
    left: Floats
    weights: Whitener | Plain
    disputed: tuple[str, ...] = ()
    plain: "Joint | None" = field(default=None, repr=False)
    undetermined: tuple[int, ...] = ()


@dataclass(frozen=True)
class _Numbers:
    """Numbers fitted under some weights."""

    weights: Whitener | Plain
    noise: Whitener
    thetas: list[dict[str, float]]
    columns: Floats
    values: Floats
    loose: float

    def left(self, readings: Readings) -> Floats:
        return np.asarray(readings.values - self.columns @ self.values)


@dataclass
class _Work:
    """Effects with the columns that stay constant during a search of non-linear parameters."""

    effects: Sequence[Effect]
    readings: Readings
    start: Sequence[FittedEffect]
    still: dict[int, Floats] = field(default_factory=dict)

    def columns(self, thetas: Sequence[Mapping[str, float]]) -> Floats:
        parts = [np.zeros((len(self.readings), 0))]
        for i, (effect, theta) in enumerate(zip(self.effects, thetas, strict=True)):
            if theta:
                parts.append(_columns(effect, theta, self.readings))
                continue
            if i not in self.still:
                self.still[i] = _columns(effect, theta, self.readings)
            parts.append(self.still[i])
        return np.concatenate([*parts, self.readings.setup], axis=1)


def joint_fit(
    effects: Sequence[FittedEffect],
    readings: Readings,
    *,
    search: bool = True,
    loose: float | None = LOOSE,
    least: tuple[float, ...] = (),
) -> Joint:
    """Refit effects together.

    Args:
        effects: with the numbers to start from; a new one with `errors` empty and coefficients zero.
        readings: all readings, with the channels that the loop has.
        search: also refit non-linear parameters.
        loose: standard errors that a number may move freely; None: the most likely value for these readings.
        least: smallest white noise of each series, as `least_noise` gives it; empty for none.

    Raises:
        MeasurementError: a channel that an effect needs was not recorded.
    """
    work = _Work([f.effect for f in effects], readings, effects)
    free = _free(effects, readings) if search else []
    weighed = _weighed(work, free, loose, least)
    plain = _ordinary(work, free, weighed)
    judged = [held_out(f.weights, f.columns) for f in (weighed, plain)]
    ordinary, by_weight = _joint(effects, readings, plain), _joint(effects, readings, weighed)
    words = _disputed(by_weight, ordinary, judged)
    return replace(by_weight if as_good(*judged) else ordinary, disputed=words, plain=ordinary)


def _joint(effects: Sequence[FittedEffect], readings: Readings, found: _Numbers) -> Joint:
    numbers, loose = _numbers(effects, readings, found)
    left = found.left(readings)
    return Joint(numbers, found.noise, found.columns, left, found.weights, undetermined=loose)


APART = 3.0
"""From this many standard errors between both fits on, they disagree about a number."""


def _disputed(weighed: Joint, plain: Joint, judged: Sequence[HeldOut]) -> tuple[str, ...]:
    """Words on numbers that the noise weights move by more than their errors."""
    out = []
    for one, two in zip(weighed.effects, plain.effects, strict=True):
        for name, value in two.values.items():
            error = math.hypot(one.errors.get(name, 0.0), two.errors.get(name, 0.0))
            if 0.0 < APART * error < abs(one.values[name] - value):
                out.append(
                    f"{two.label} {name}: {significant(value)} by ordinary, {significant(one.values[name])} by "
                    "weighted least squares"
                )
    if not out:
        return ()
    rms = [math.sqrt(j.square) for j in judged]
    taken = "weighted" if as_good(*judged) else "ordinary"
    first = (
        "the fit depends on how slow changes of the residual are weighed, so something slow is not in the model: "
        f"held-out runs are predicted to {significant(rms[1])} by ordinary and to {significant(rms[0])} by weighted "
        f"least squares; the {taken} fit was taken"
    )
    return (first, *out[:TOLD])


def _weighed(
    work: _Work, free: Sequence[tuple[int, Parameter]], loose: float | None, least: tuple[float, ...]
) -> _Numbers:
    """Generalised least squares, with the noise estimated in the same fit."""
    readings, effects = work.readings, work.start
    thetas = [dict(f.theta) for f in effects]
    columns = work.columns(thetas)
    whitener = find_noise(readings, columns, least=least)
    loose = _looseness(effects, readings, whitener, columns) if loose is None else loose
    for _ in range(ROUNDS if free else 1):
        if free:
            thetas = _polish(work, whitener, thetas, free)
            columns = work.columns(thetas)
        values = _values(effects, readings, whitener, columns, loose)
        whitener = refine(whitener, readings.values - columns @ values, 30)
    values = _values(effects, readings, whitener, columns, loose)
    return _Numbers(whitener, whitener, thetas, columns, values, loose)


def _ordinary(work: _Work, free: Sequence[tuple[int, Parameter]], weighed: _Numbers) -> _Numbers:
    """Ordinary robust least squares."""
    readings, effects = work.readings, work.start
    thetas = [dict(f.theta) for f in effects]
    columns = work.columns(thetas)
    plain, values = plain_fit(readings, weighed.noise, columns)
    for _ in range(ROUNDS if free else 1):
        if free:
            thetas = _polish(work, plain, thetas, free)
            columns = work.columns(thetas)
            plain, values = plain_fit(readings, weighed.noise, columns)
    plain = plain.refined(readings.values - columns @ values, columns)
    values = _values(effects, readings, plain, columns, weighed.loose)
    return _Numbers(plain, plain.noise, thetas, columns, values, weighed.loose)


def _columns(effect: Effect, theta: Mapping[str, float], readings: Readings) -> Floats:
    try:
        return readings.columns(effect, theta)
    except ModelError as e:
        raise MeasurementError(f"{effect.effect}({effect.component}) cannot be worked out: {e}") from e


def _free(effects: Sequence[FittedEffect], readings: Readings) -> list[tuple[int, Parameter]]:
    """Bounded non-linear parameters of effects that the readings see; the upper bound includes the current value."""
    return [
        (i, replace(p, high=max(p.high, f.theta[p.name])))
        for i, f in enumerate(effects)
        if np.abs(readings.arms(f.effect.component)).max() > 0.0
        for p in within_record(f.effect, readings.measurements)
        if np.isfinite([p.low, p.high]).all()
    ]


def _polish(
    work: _Work, whitener: Whitener | Plain, thetas: list[dict[str, float]], free: Sequence[tuple[int, Parameter]]
) -> list[dict[str, float]]:
    """Variable projection on the whitened readings."""
    from scipy.optimize import least_squares

    scales = [SearchScale.of(p) for _, p in free]
    target = whitener(work.readings.values)

    def at(x: Floats) -> list[dict[str, float]]:
        out = [dict(t) for t in thetas]
        for (i, p), s, v in zip(free, scales, x, strict=True):
            out[i][p.name] = s.value(float(v))
        return out

    def left(x: Floats) -> Floats:
        white = whitener(work.columns(at(x)))
        return np.asarray(target - white @ solve(white, target))

    start = np.array([s.place(thetas[i][p.name]) for (i, p), s in zip(free, scales, strict=True)])
    options: dict[str, Any] = {"ftol": 1e-6, "xtol": 1e-5, "diff_step": 1e-3, "max_nfev": EVALUATIONS}
    found = least_squares(left, np.clip(start, 1e-5, 1.0 - 1e-5), bounds=(0.0, 1.0), **options)
    better = float(found.fun @ found.fun) < float(np.sum(left(np.clip(start, 1e-5, 1.0 - 1e-5)) ** 2))
    return at(found.x) if better else thetas


def _prior(effects: Sequence[FittedEffect], readings: Readings, loose: float) -> tuple[Floats, Floats]:
    """Start of the linear numbers and their prior standard deviations, (p,) each, set-up terms last."""
    centre: list[float] = []
    spread: list[float] = []
    for f in effects:
        for p in f.effect.coefficients(readings.machine):
            value = f.values.get(p.name, 0.0)
            error = f.errors.get(p.name)
            centre.append(value)
            spread.append(loose * error if error else NEW * max(p.typical, abs(value)))
    count = readings.setup.shape[1]
    return np.array([*centre, *[0.0] * count]), np.array([*spread, *[np.inf] * count])


def _looseness(effects: Sequence[FittedEffect], readings: Readings, whitener: Whitener, columns: Floats) -> float:
    """The likeliest looseness; one, too, where ordinary least squares shows no change.

    Noise of a sensor pulls quick changes, slow drift pulls slow ones; a number that has changed changes both.
    """
    by_all, _ = plain_fit(readings, whitener, columns)
    unchanged = _likeliest(effects, readings, by_all, columns) == 1.0
    return 1.0 if unchanged else _likeliest(effects, readings, whitener, columns)


def _likeliest(
    effects: Sequence[FittedEffect], readings: Readings, whitener: Whitener | Plain, columns: Floats
) -> float:
    """The looseness with the largest evidence: the numbers have changed; or one, where that is not clearly likelier.

    Numbers without an earlier fit and the terms of the set-up may have any size: the readings less these are compared.
    """
    centre, spread = _prior(effects, readings, 1.0)
    known = [bool(f.errors.get(p.name)) for f in effects for p in f.effect.coefficients(readings.machine)]
    fitted = np.array([*known, *[False] * readings.setup.shape[1]])
    if not fitted.any():
        return LOOSE
    free = whitener(columns[:, ~fitted])
    both = whitener(np.column_stack([columns[:, fitted] * spread[fitted], readings.values - columns @ centre]))
    both -= free @ solve(free, both)
    value, vector = np.linalg.eigh(both[:, :-1].T @ both[:, :-1])
    seen = vector.T @ (both[:, :-1].T @ both[:, -1])
    value = np.maximum(value, 0.0)

    def evidence(loose: float) -> float:
        return float(np.sum((loose * seen) ** 2 / (1.0 + loose**2 * value) - np.log1p(loose**2 * value)))

    likeliest = max(LOOSENESS, key=evidence)
    return likeliest if evidence(likeliest) - evidence(1.0) > CHANGED else 1.0


def _values(
    effects: Sequence[FittedEffect], readings: Readings, whitener: Whitener | Plain, columns: Floats, loose: float
) -> Floats:
    """Generalised least squares that starts at the current numbers, (p,)."""
    centre, spread = _prior(effects, readings, loose)
    white = whitener(columns)
    rows = np.diag(1.0 / spread)
    target = whitener(readings.values - columns @ centre)
    stacked = np.concatenate([white, rows])
    return np.asarray(centre + solve(stacked, np.concatenate([target, np.zeros(len(centre))])))


def _numbers(
    effects: Sequence[FittedEffect], readings: Readings, found: _Numbers
) -> tuple[tuple[FittedEffect, ...], tuple[int, ...]]:
    """Effects with their refitted numbers and standard errors; and those of which only the sum is determined."""
    machine, at = readings.machine, 0
    columns, thetas, values, loose = found.columns, found.thetas, found.values, found.loose
    filled: list[FittedEffect] = []
    for f, theta in zip(effects, thetas, strict=True):
        linear, _ = names_of(f.effect, machine)
        part = values[at : at + len(linear)]
        at += len(linear)
        filled.append(FittedEffect(f.effect, dict(zip(linear, map(float, part), strict=True)), dict(theta)))
    slopes, owner = [], []
    for i, f in enumerate(filled):
        for name in f.theta:
            slopes.append(slope(f, readings, name, np.array(list(f.values.values()))))
            owner.append((i, name))
    whole = np.concatenate([columns, *[s[:, None] for s in slopes]], axis=1)
    spread = np.concatenate([_prior(effects, readings, loose)[1], np.full(len(slopes), np.inf)])
    known = covariance(found.weights, whole, spread)
    errors = np.sqrt(np.maximum(np.diag(known), 0.0))
    errors = np.where(np.abs(whole).max(axis=0, initial=0.0) > 0.0, errors, np.nan)  # nan: not seen
    out, at = [], 0
    for i, (f, before) in enumerate(zip(filled, effects, strict=True)):
        places = {name: at + k for k, name in enumerate(f.values)}
        at += len(f.values)
        places |= {name: columns.shape[1] + k for k, (j, name) in enumerate(owner) if j == i}
        out.append(FittedEffect(f.effect, f.values, f.theta, _errors_of(before, errors, places)))
    of = np.repeat(np.arange(len(filled)), [len(f.values) for f in filled])
    terms = np.append(np.arange(len(of)), columns.shape[1] + np.arange(len(owner)))
    of = np.append(of, np.array([i for i, _ in owner], dtype=np.int64))
    return tuple(out), _undetermined(readings, found, whole[:, terms], known[np.ix_(terms, terms)], of)


def _undetermined(readings: Readings, found: _Numbers, columns: Floats, known: Floats, of: Ints) -> tuple[int, ...]:
    """Effects of which only the sum with others is determined.

    Args:
        readings: of the fit.
        found: the fit.
        columns: of coefficients, then slopes, (m, k).
        known: their covariance, (k, k).
        of: number of the effect of each, (k,).
    """
    left = found.left(readings)
    weigh = found.weights if isinstance(found.weights, Plain) else weights(readings, found.noise, left)
    flat, setup = weigh(np.column_stack([columns, left])), weigh(readings.setup)
    flat = flat - setup @ solve(setup, flat)
    source = np.array([s.source for s in readings.series])[readings.series_of]
    parts = [flat[source == k] for k in range(len(readings.measurements))]
    gram = np.stack([p.T @ p for p in parts])
    count = found.columns.shape[1] - readings.setup.shape[1]
    values = np.append(found.values[:count], np.zeros(len(of) - count))
    return tuple(undetermined(gram[:, :-1, :-1], values, known, of, gram[:, -1, -1]))


def _errors_of(before: FittedEffect, errors: Floats, places: Mapping[str, int]) -> dict[str, float]:
    """Standard errors by name; a number that the readings do not see keeps its earlier one."""
    out = {}
    for name, place in places.items():
        error = errors[place] if np.isfinite(errors[place]) else before.errors.get(name, 0.0)
        if error > 0.0:
            out[name] = float(error)
    return out

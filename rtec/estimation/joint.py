"""Refits all numbers of a model together, non-linear ones too, under the noise of the readings.

A number that the measurements do not show keeps its value. What earlier readings determined moves from there, as far as
it was uncertain; freely where these readings show that it has changed. So a worn nut does not loosen an expansion.
"""

import itertools
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from rtec.arrays import Bools, Floats, Ints
from rtec.effects import Effect, Parameter
from rtec.effects.geometry import Scale
from rtec.effects.reversal import Backlash, BacklashTemperature
from rtec.effects.thermal import AxisExpansion
from rtec.errors import MeasurementError, ModelError
from rtec.estimation.changed_delay import FAR, Delays, changed_delays, with_delays
from rtec.estimation.columns import slope
from rtec.estimation.determined import phases_of, undetermined
from rtec.estimation.gls import HeldOut, along_runs, held_out, inverse, solve
from rtec.estimation.noise import Whitener, find_noise, refine
from rtec.estimation.plain import Plain, as_good, better_within_runs, covariance, plain_fit, telling, weights, widening
from rtec.estimation.readings import Readings
from rtec.estimation.visible import within_record
from rtec.estimation.warmth import Misread, Warmer, misread, of_the_fit, warmer
from rtec.model import FittedEffect, Model
from rtec.model.fit import SearchScale
from rtec.model.model import ErrorCorrelation, names_of, number_name
from rtec.wording import significant

LOOSE = 30.0
"""Standard errors that a number may move freely where the same readings are fitted again."""
LOOSENESS = (2.0, 4.0, 8.0, 16.0, 30.0, 100.0, 300.0, 1e3, 1e4, 1e5)
"""Standard errors that the numbers of a changed effect may move, to choose from."""
CHANGED = 6.0
"""The numbers of an effect have changed where twice the logarithm of the evidence rises by this (odds of 20 to 1), and
one of them moves by `FAR` in standard errors, under noise that may drift; by more where few runs determine it, as of
Student's distribution."""
ENOUGH_RUNS, MOST = 6, 0.5
"""So many runs say how sure a number is, where its change leaves less than this share of the mean square."""
ONE_TEMPERATURE_K, NARROW_K = 1.0, 3.0
AT_ONE_TEMPERATURE: Mapping[type[Effect], type[Effect]] = {AxisExpansion: Scale, BacklashTemperature: Backlash}
"""What an effect of a temperature is while that is one and the same, within the second range."""
NEW = 1e6
"""Standard deviation of the prior of a number without an earlier fit, over its usual size."""
HELD = 1e-6
"""The same of a number that its fit left out, as one of two that cannot be distinguished."""
APART_BY = 0.02
"""Share by which correlations of an earlier fit are lowered: few runs make some of them look perfect."""
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
        correlation: of the errors of the numbers.
        settled: effects, by number, that earlier readings determined and that have not changed.
    """

    effects: tuple[FittedEffect, ...]
    whitener: Whitener
    columns: Floats
    left: Floats
    weights: Whitener | Plain
    disputed: tuple[str, ...] = ()
    plain: "Joint | None" = field(default=None, repr=False)
    undetermined: tuple[int, ...] = ()
    correlation: ErrorCorrelation | None = None
    settled: tuple[int, ...] = ()


@dataclass(frozen=True)
class _Numbers:
    """Numbers fitted under some weights.

    Attributes:
        weights, noise: of the fit.
        thetas: non-linear parameters of each effect.
        columns: of every linear number, then of the set-up, (m, p).
        values: of the linear numbers, (p,).
        prior: what was known before.
        free: non-linear parameters that were searched, with the number of their effect.
        settled: effects, by number, that earlier readings determined and that have not changed.
    """

    weights: Whitener | Plain
    noise: Whitener
    thetas: list[dict[str, float]]
    columns: Floats
    values: Floats
    prior: "_Prior"
    free: Sequence[tuple[int, Parameter]]
    settled: tuple[int, ...]

    def left(self, readings: Readings) -> Floats:
        return np.asarray(readings.values - self.columns @ self.values)


@dataclass
class _Work:
    """Effects with the columns that stay constant during a search of non-linear parameters.

    Attributes:
        effects: to be fitted.
        readings: of the fit.
        start: the effects with their current numbers.
        earlier: the model as earlier readings determined it: the first of the effects; None for none.
        since: whether what is new began after these, so that no known number contains a part of it.
        delays: of effects of which these readings show another one, by their number.
    """

    effects: Sequence[Effect]
    readings: Readings
    start: Sequence[FittedEffect]
    earlier: Model | None
    since: bool = False
    delays: Delays = field(default_factory=dict)
    still: dict[int, Floats] = field(default_factory=dict)

    @property
    def thetas(self) -> list[dict[str, float]]:
        """Non-linear parameters of each effect at which a search begins."""
        return [dict(f.theta) for f in with_delays(self.start, self.delays)]

    @property
    def known(self) -> Sequence[FittedEffect]:
        """The first of the effects, with the numbers that earlier readings determined."""
        return self.earlier.effects if self.earlier is not None else ()

    @cached_property
    def followed(self) -> list[tuple[int, int]]:
        """Places of each known number that a new one joins: both act by the same sensor, with another delay."""
        pairs = []
        for j, new in enumerate(self.effects[len(self.known) :], len(self.known)):
            i = next((i for i, f in enumerate(self.known) if f.errors and _follows(f.effect, new)), None)
            if i is not None:
                pairs += list(zip(_places(self, [i]), _places(self, [j]), strict=True))
        return pairs

    @cached_property
    def parts(self) -> list[tuple[int, int, float]]:
        """Places of each known number, of a new one that was a part of it, and how much of it.

        Where a machine was 0.4 K above its reference while it was measured, its scale error contains 0.4 K of an
        expansion that nobody knew then.
        """
        out = [(i, j, 1.0) for i, j in self.followed]
        then = of_the_fit(self.earlier) if self.earlier is not None and not self.since else {}
        for j, new in enumerate(self.effects[len(self.known) :], len(self.known)):
            slack = isinstance(new, AxisExpansion) and new.stretched  # no expansion that a scale error contains
            degc, still = then.get(getattr(new, "sensor", "")), None if slack else AT_ONE_TEMPERATURE.get(type(new))
            known = (k for k, f in enumerate(self.known) if f.errors and still and _along(f.effect, still, new))
            i = next(known, None)
            if i is not None and degc is not None and self.earlier is not None and degc[1] - degc[0] < NARROW_K:
                rise = sum(degc) / 2.0 - self.earlier.reference_degc
                out += [(*p, rise) for p in zip(_places(self, [i]), _places(self, [j]), strict=True)]
        return out

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


@dataclass(frozen=True)
class ChangedNumber:
    """A number of a model that is another one in new readings.

    Attributes:
        effect: label of its effect.
        name, unit: of the number.
        was, now: earlier, and in these readings.
        error: standard error of `now`.
        warmer: of a scale error: a sensor whose part is warmer now, so that its expansion would look the same.
        misread: of a scale error: a sensor that, if it reads too high or too low now, would look the same.
    """

    effect: str
    name: str
    unit: str
    was: float
    now: float
    error: float
    warmer: Warmer | None = None
    misread: Misread | None = None


def changed_numbers(
    model: Model, readings: Readings, beside: Sequence[FittedEffect] = ()
) -> tuple[tuple[ChangedNumber, ...], tuple[FittedEffect, ...]]:
    """Numbers of a model that have changed since the readings that it was fitted to; and its effects with them.

    Args:
        model: with standard errors; a number without one is known too little to have changed.
        readings: other ones.
        beside: effects that are fitted with it, their coefficients zero.
    """
    fit = joint_fit((*model.effects, *beside), readings, earlier=model)
    return changed_between(model, fit, readings), fit.effects[: len(model.effects)]


def changed_between(model: Model, fit: Joint, readings: Readings) -> tuple[ChangedNumber, ...]:
    """Numbers of a model that a fit to readings, whose first effects are the model's, found changed."""
    out = []
    for i, (was, now) in enumerate(zip(model.effects, fit.effects, strict=False)):
        for p in was.effect.coefficients(model.machine) if i not in fit.settled else ():
            old, new, error = was.values[p.name], now.values[p.name], now.errors.get(p.name, 0.0)
            if abs(new - old) > FAR * math.hypot(was.errors.get(p.name, math.inf), error):
                heat = warmer(model, readings, was.effect, new - old)
                off = misread(model, readings, was.effect, new - old)
                out.append(ChangedNumber(was.label, p.name, p.unit, old, new, error, heat, off))
        if "tau" in now.theta and i not in fit.settled:
            old, new, error = was.theta["tau"], now.theta["tau"], now.errors.get("tau", 0.0)
            if abs(new - old) > FAR * math.hypot(was.errors.get("tau", math.inf), error):
                out.append(ChangedNumber(was.label, "tau", "s", old, new, error))
    return tuple(out)


def joint_fit(
    effects: Sequence[FittedEffect],
    readings: Readings,
    *,
    earlier: Model | None = None,
    least: tuple[float, ...] = (),
) -> Joint:
    """Refit effects together.

    Args:
        effects: with the numbers to start from; a new one with `errors` empty and coefficients zero.
        readings: all readings, with the channels that the loop has.
        earlier: the model as other readings determined it, whose effects are the first ones: these readings refine its
            numbers. All other effects were fitted to these readings.
        least: smallest white noise of each series, as `least_noise` gives it; empty for none.

    Raises:
        MeasurementError: a channel that an effect needs was not recorded.
    """
    only_refined = earlier is not None and len(effects) == len(earlier.effects)
    delays = changed_delays(earlier, readings) if earlier and only_refined else {}
    work = _Work([f.effect for f in effects], readings, effects, earlier, delays=delays)
    free = _free(effects, readings)
    made = _refereed(work, free, least)
    if len(work.parts) == len(work.followed):
        return made
    # The readings decide whether the machine had what is new at the earlier fit.
    other = _refereed(_Work(work.effects, readings, effects, earlier, since=True), free, least)
    return other if np.linalg.norm(other.left) < np.linalg.norm(made.left) else made


def _refereed(work: _Work, free: Sequence[tuple[int, Parameter]], least: tuple[float, ...]) -> Joint:
    """The weighted or the ordinary fit, whichever predicts held-out runs as well or better."""
    weighed = _weighed(work, free, least)
    plain = _ordinary(work, weighed)
    judged = [held_out(f.weights, f.columns) for f in (weighed, plain)]
    ordinary, by_weight = _joint(work, plain), _joint(work, weighed)
    words = _disputed(by_weight, ordinary, judged)
    taken = ordinary
    if as_good(*judged):
        taken = by_weight
    elif better_within_runs(*judged):
        mixed = _mixed(work, weighed, plain)
        taken = by_weight if mixed is None else _joint(work, mixed)
    return replace(taken, disputed=words, plain=ordinary)


def _mixed(work: _Work, weighed: _Numbers, plain: _Numbers) -> _Numbers | None:
    """Weighted numbers of effects that change along the runs, ordinary ones of all others; None where there are none.

    What is better within the runs says nothing about an effect that only differs from run to run.
    """
    parts = [_columns(e, theta, work.readings) for e, theta in zip(work.effects, plain.thetas, strict=True)]
    along = [along_runs(work.readings, part) for part in parts]
    from_runs = [bool(np.any(part)) and not a for part, a in zip(parts, along, strict=True)]
    if not any(from_runs):
        return None
    thetas = [one if a else other for a, one, other in zip(along, weighed.thetas, plain.thetas, strict=True)]
    values = plain.values.copy()
    mine = np.repeat(along, [part.shape[1] for part in parts])
    values[: len(mine)][mine] = weighed.values[: len(mine)][mine]
    return replace(plain, thetas=thetas, columns=work.columns(thetas), values=values)


def _by_weight(judged: Sequence[HeldOut]) -> bool:
    """Whether the numbers of effects along the runs are taken from the weighted fit, by both fits on held-out runs."""
    return as_good(*judged) or better_within_runs(*judged)


def _joint(work: _Work, found: _Numbers) -> Joint:
    numbers, loose, known = _numbers(work, found)
    left = found.left(work.readings)
    return Joint(
        numbers,
        found.noise,
        found.columns,
        left,
        found.weights,
        undetermined=loose,
        correlation=known,
        settled=found.settled,
    )


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
    taken = "weighted" if _by_weight(judged) else "ordinary"
    first = (
        "the fit depends on how slow changes of the residual are weighed, so something slow is not in the model: "
        f"held-out runs are predicted to {significant(rms[1])} by ordinary and to {significant(rms[0])} by weighted "
        f"least squares; the {taken} fit was taken"
    )
    return (first, *out[:TOLD])


def _weighed(work: _Work, free: Sequence[tuple[int, Parameter]], least: tuple[float, ...]) -> _Numbers:
    """Generalised least squares, with the noise estimated in the same fit."""
    readings = work.readings
    thetas = work.thetas
    columns = work.columns(thetas)
    whitener = find_noise(readings, columns, least=least)
    prior, loose = _known(work, whitener, columns)
    settled = tuple(i for i, (f, much) in enumerate(zip(work.start, loose, strict=True)) if much == 1.0 and f.errors)
    free = [(i, p) for i, p in free if i not in settled]
    for _ in range(ROUNDS if free else 1):
        if free:
            thetas = _polish(work, whitener, thetas, free, prior)
            columns = work.columns(thetas)
        values = _values(readings, whitener, columns, prior)
        whitener = refine(whitener, readings.values - columns @ values, 30)
    values = _values(readings, whitener, columns, prior)
    return _Numbers(whitener, whitener, thetas, columns, values, prior, free, settled)


def _ordinary(work: _Work, weighed: _Numbers) -> _Numbers:
    """Ordinary robust least squares."""
    readings, prior, free = work.readings, weighed.prior, weighed.free
    thetas = work.thetas
    columns = work.columns(thetas)
    plain, values = plain_fit(readings, weighed.noise, columns)
    for _ in range(ROUNDS if free else 1):
        if free:
            thetas = _polish(work, plain, thetas, free, prior)
            columns = work.columns(thetas)
            plain, values = plain_fit(readings, weighed.noise, columns)
    plain = plain.refined(readings.values - columns @ values, columns)
    values = _values(readings, plain, columns, prior)
    return _Numbers(plain, plain.noise, thetas, columns, values, prior, free, weighed.settled)


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
        if np.isfinite([p.low, p.high]).all() and p.low < p.high
    ]


@dataclass(frozen=True)
class _Prior:
    """What is known of the linear numbers before a fit: a normal distribution.

    Attributes:
        centre, spread: mean and standard deviation, set-up terms last, (p,) each.
        held: numbers that an earlier fit left out, (p,).
        alike: correlation of their errors, (p, p).
        sums: ones; and how much of a new number was a part of a known one, of which only the sum was known, (p, p).
        honest: variance that these readings alone leave of a number which has not changed, under noise that may drift,
            (p,); infinite for all others.
    """

    centre: Floats
    spread: Floats
    held: Bools
    alike: Floats
    sums: Floats
    honest: Floats

    def rows(self, white: Floats) -> Floats:
        """Rows that stand for it beside weighted columns, (m, p) -> (p, p).

        Weights that take readings of one run for independent ones would let a number follow them, however well it is
        known: it is known better in the ratio of the variance that the weights suppose to the true one.
        """
        alone = np.diag(1.0 / (LOOSE * self.spread))
        supposed = np.diag(inverse(np.concatenate([white, alone])))
        ratio = np.where(np.isfinite(self.honest), self.honest / np.maximum(supposed, 1e-300), 1.0)
        return self._root / (self.spread / np.sqrt(np.maximum(ratio, 1.0))) @ self.sums

    @property
    def plain_rows(self) -> Floats:
        """Rows that stand for it beside independent readings, (p, p)."""
        return np.asarray(self._root / self.spread @ self.sums)

    @cached_property
    def _root(self) -> Floats:
        """Root of the inverse of the correlation, (p, p)."""
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.alike)))


def _prior(work: _Work, looseness: Sequence[float]) -> _Prior:
    """The prior where each number may move by these multiples of its standard error, one for each effect.

    What has changed has done so apart from errors of the earlier fit.
    """
    centre: list[float] = []
    spread: list[float] = []
    held: list[bool] = []
    names: list[str] = []
    for i, (now, loose) in enumerate(zip(work.start, looseness, strict=True)):
        f = work.known[i] if i < len(work.known) else now
        for p in f.effect.coefficients(work.readings.machine):
            value = f.values.get(p.name, 0.0)
            error, size = f.errors.get(p.name), max(p.typical, abs(value))
            centre.append(value)
            held.append(not error and bool(f.errors))
            spread.append(loose * error if error else (HELD if held[-1] else NEW) * size)
            names.append(number_name(i + 1, f.effect, p.name) if error and loose == 1.0 else "")
    count = work.readings.setup.shape[1]
    whole = np.array([*spread, *[np.inf] * count])
    linear, left_out = np.array([*centre, *[0.0] * count]), np.array([*held, *[False] * count])
    alike = np.eye(len(whole))
    if work.earlier is not None and work.earlier.correlation is not None:
        found = work.earlier.correlation.matrix(names)
        alike[: len(names), : len(names)] = (1.0 - APART_BY) * found + APART_BY * np.eye(len(names))
    sums = np.eye(len(whole))
    for i, j, much in work.parts:
        sums[i, j] = much
    return _Prior(linear, whole, left_out, alike, sums, np.full(len(whole), np.inf))


def _known(work: _Work, whitener: Whitener, columns: Floats) -> tuple[_Prior, list[float]]:
    """The prior for these readings, where what has changed may move freely; and how freely each effect may move."""
    if not any(f.errors for f in work.known):
        loose = [LOOSE] * len(work.start)
        return _prior(work, loose), loose
    by_all, _ = plain_fit(work.readings, whitener, columns)
    loose = _looseness(work, by_all, whitener, columns)
    prior = _prior(work, loose)
    variances = np.diag(covariance(by_all, columns, np.diag(1.0 / (LOOSE * prior.spread))))
    honest = np.full(len(variances), np.inf)
    same = [k for k in _places(work, [i for i, much in enumerate(loose) if much == 1.0]) if not prior.held[k]]
    honest[same] = variances[same]
    return replace(prior, honest=honest), loose


def _polish(
    work: _Work,
    whitener: Whitener | Plain,
    thetas: list[dict[str, float]],
    free: Sequence[tuple[int, Parameter]],
    prior: _Prior,
) -> list[dict[str, float]]:
    """Variable projection on the whitened readings."""
    from scipy.optimize import least_squares

    scales = [SearchScale.of(p) for _, p in free]

    def at(x: Floats) -> list[dict[str, float]]:
        out = [dict(t) for t in thetas]
        for (i, p), s, v in zip(free, scales, x, strict=True):
            out[i][p.name] = s.value(float(v))
        return out

    def left(x: Floats) -> Floats:
        rows, target = _stacked(work.readings, whitener, work.columns(at(x)), prior)
        return np.asarray(target - rows @ solve(rows, target))

    start = np.array([s.place(thetas[i][p.name]) for (i, p), s in zip(free, scales, strict=True)])
    options: dict[str, Any] = {"ftol": 1e-6, "xtol": 1e-5, "diff_step": 1e-3, "max_nfev": EVALUATIONS}
    found = least_squares(left, np.clip(start, 1e-5, 1.0 - 1e-5), bounds=(0.0, 1.0), **options)
    better = float(found.fun @ found.fun) < float(np.sum(left(np.clip(start, 1e-5, 1.0 - 1e-5)) ** 2))
    return at(found.x) if better else thetas


def _stacked(readings: Readings, whitener: Whitener | Plain, columns: Floats, prior: _Prior) -> tuple[Floats, Floats]:
    """Weighted columns, (m + p, p), and readings less the prior mean, (m + p,), with a row for each prior."""
    white = whitener(np.column_stack([columns, readings.values - columns @ prior.centre]))
    rows = np.concatenate([white[:, :-1], prior.rows(white[:, :-1])])
    return rows, np.append(white[:, -1], np.zeros(len(prior.centre)))


def _values(readings: Readings, whitener: Whitener | Plain, columns: Floats, prior: _Prior) -> Floats:
    """The likeliest linear numbers, (p,)."""
    return np.asarray(prior.centre + solve(*_stacked(readings, whitener, columns, prior)))


@dataclass(frozen=True)
class _Evidence:
    """How likely the readings are by how far earlier numbers may have moved.

    Numbers without an earlier fit and the terms of the set-up may have any size: the readings less these are compared.

    Attributes:
        moves: numbers with an earlier fit, (p,).
        gram: their weighted columns by each other, (q, q).
        seen: their weighted columns by what their earlier values leave, (q,).
    """

    moves: Bools
    gram: Floats
    seen: Floats

    @classmethod
    def of(cls, work: _Work, by: Whitener | Plain, columns: Floats) -> "_Evidence":
        """Under some weights, by columns of all numbers, (m, p)."""
        one, two = (_prior(work, [loose] * len(work.start)) for loose in (1.0, 2.0))
        moves = two.spread > one.spread
        moves[[*_places(work, range(len(work.known), len(work.start)))]] = False
        apart = columns @ np.linalg.inv(one.sums)
        free = by(apart[:, ~moves & ~one.held])
        both = by(np.column_stack([apart[:, moves], work.readings.values - columns @ one.centre]))
        both -= free @ solve(free, both)
        return cls(moves, both[:, :-1].T @ both[:, :-1], both[:, :-1].T @ both[:, -1])

    def under(self, prior: "_Prior") -> float:
        """Twice the logarithm, but for a constant."""
        root = np.linalg.cholesky(prior.alike[np.ix_(self.moves, self.moves)]) * prior.spread[self.moves, None]
        triangle = np.linalg.cholesky(np.eye(len(root)) + root.T @ self.gram @ root)
        flat = np.linalg.solve(triangle, root.T @ self.seen)
        return float(flat @ flat - 2.0 * np.log(np.diag(triangle)).sum())


def _places(work: _Work, numbers: Iterable[int]) -> Iterator[int]:
    """Places of the linear numbers of effects among all."""
    counts = [len(e.coefficients(work.readings.machine)) for e in work.effects]
    first = np.cumsum([0, *counts])
    return (k for i in numbers for k in range(int(first[i]), int(first[i + 1])))


def _moves_far(work: _Work, by: Plain, columns: Floats, changed: int, loose: Sequence[float]) -> bool:
    """Whether a number of a changed effect moves by many standard errors, under noise that may drift.

    Where the change explains most, the noise was found beside it and holds a part of it: what differs from run to run
    says as well how sure the number is.
    """
    was, prior = _prior(work, [1.0] * len(loose)), _prior(work, loose)
    values = _values(work.readings, by, columns, prior)
    moved = np.abs(prior.sums @ (values - prior.centre))
    variances = np.diag(prior.sums @ covariance(by, columns, prior.plain_rows) @ prior.sums.T)
    white = by(columns)
    share = prior.sums @ inverse(np.concatenate([white, prior.plain_rows])) @ white.T
    parts = [np.sum(share[:, work.readings.fold == f] ** 2, axis=1) for f in np.unique(work.readings.fold)]
    errors = np.sqrt(np.maximum(variances, 0.0)) * widening(telling(np.stack(parts)), FAR)
    setup, held, left = by(work.readings.setup), *(by(work.readings.values - columns @ v) for v in (was.centre, values))
    held = held - setup @ solve(setup, held)
    runs = np.unique(work.readings.run)
    if len(runs) >= ENOUGH_RUNS and left @ left < MOST * (held @ held):
        of = [work.readings.run == r for r in runs]
        pulls = np.stack([share[:, mine] @ left[mine] for mine in of])
        by_run = np.sqrt((pulls**2).sum(axis=0) * len(runs) / (len(runs) - 1))
        parts = [np.sum(share[:, mine] ** 2, axis=1) for mine in of]
        errors = np.minimum(errors, by_run * widening(telling(np.stack(parts)), FAR))
    return any(moved[k] > FAR * math.hypot(was.spread[k], errors[k]) for k in _places(work, [changed]))


def _follows(one: Effect, other: Effect) -> bool:
    """Whether an effect is another one but for its delay or its fixed end."""
    same = (one.effect, one.component, getattr(one, "sensor", None))
    return same == (other.effect, other.component, getattr(other, "sensor", None)) and same[2] is not None


def _along(one: Effect, kind: type[Effect], other: Effect) -> bool:
    """Whether an effect is of a kind, and of the same component and axis as another."""
    return (
        type(one) is kind
        and one.component == other.component
        and getattr(one, "axis", "") == getattr(other, "axis", "")
    )


def _at_one_temperature(readings: Readings, effect: Effect) -> bool:
    """Whether an effect follows temperatures that hardly changed in these readings."""
    sensors = set(readings.machine.sensor_names) & set(effect.channels(readings.machine))
    spans = [np.ptp(np.concatenate([s.channels[name] for s in readings.states])) for name in sensors]
    return bool(spans) and max(spans) < ONE_TEMPERATURE_K


def _looseness(work: _Work, by_all: Plain, whitener: Whitener, columns: Floats) -> list[float]:
    """Standard errors that the numbers of each effect may move; 1 where these readings show no change of them.

    One effect after the other, the one first whose change makes the readings likeliest. Both kinds of least squares
    must see it: noise of a sensor pulls quick changes, slow drift pulls slow ones, and a number that has changed
    changes both. What follows a temperature that was one and the same comes after a shape without it that does as well.
    """
    known = len(work.known)
    loose = [LOOSE if i in work.delays else 1.0 for i in range(known)] + [LOOSE] * (len(work.start) - known)
    # One that a new effect follows changes by that.
    followed = {place for place, _ in work.followed}
    unchanged = {
        i for i, f in enumerate(work.known) if f.errors and loose[i] == 1.0 and followed.isdisjoint(_places(work, [i]))
    }
    both = [_Evidence.of(work, by, columns) for by in (by_all, whitener)]
    behind = [CHANGED * _at_one_temperature(work.readings, f.effect) for f in work.known]
    while unchanged:
        now = [e.under(_prior(work, loose)) for e in both]
        tried = []
        for i in unchanged:
            ways = [[*loose[:i], much, *loose[i + 1 :]] for much in LOOSENESS]
            gains = np.array([[e.under(_prior(work, way)) for e in both] for way in ways]) - now
            tried.append((float(gains.max(axis=0).min()), i, ways[int(np.argmax(gains.sum(axis=1)))]))
        changed, way = next(
            (
                (i, way)
                for gain, i, way in sorted(tried, key=lambda t: t[0] - behind[t[1]], reverse=True)
                if gain > CHANGED and _moves_far(work, by_all, columns, i, way)
            ),
            (None, loose),
        )
        if changed is None:
            break
        loose = way
        unchanged.discard(changed)
    return loose


def _numbers(work: _Work, found: _Numbers) -> tuple[tuple[FittedEffect, ...], tuple[int, ...], ErrorCorrelation]:
    """Effects with their refitted numbers and standard errors; those of which only the sum is determined; and the
    correlation of the errors.
    """
    effects, readings, prior = work.start, work.readings, found.prior
    machine, at = readings.machine, 0
    columns, thetas, values = found.columns, found.thetas, found.values
    filled: list[FittedEffect] = []
    for f, theta in zip(effects, thetas, strict=True):
        linear, _ = names_of(f.effect, machine)
        part = values[at : at + len(linear)]
        at += len(linear)
        filled.append(FittedEffect(f.effect, dict(zip(linear, map(float, part), strict=True)), dict(theta)))
    slopes, owner = [], []
    for i, f in enumerate(filled):
        for name in (p.name for k, p in found.free if k == i):
            slopes.append(slope(f, readings, name, np.array(list(f.values.values()))))
            owner.append((i, name))
    whole = np.concatenate([columns, *[s[:, None] for s in slopes]], axis=1)
    tight = np.zeros((whole.shape[1], whole.shape[1]))
    tight[: columns.shape[1], : columns.shape[1]] = prior.plain_rows
    known = covariance(found.weights, whole, tight)
    errors = np.sqrt(np.maximum(np.diag(known), 0.0))
    shown = np.abs(whole).max(axis=0, initial=0.0) > 0.0
    shown[: len(prior.held)] &= ~prior.held
    errors = np.where(shown, errors, np.nan)
    out, at = [], 0
    for i, (f, before) in enumerate(zip(filled, effects, strict=True)):
        places = {name: at + k for k, name in enumerate(f.values)}
        at += len(f.values)
        places |= {name: columns.shape[1] + k for k, (j, name) in enumerate(owner) if j == i}
        out.append(FittedEffect(f.effect, f.values, f.theta, _errors_of(before, errors, places)))
    of = np.repeat(np.arange(len(filled)), [len(f.values) for f in filled])
    terms = np.append(np.arange(len(of)), columns.shape[1] + np.arange(len(owner)))
    of = np.append(of, np.array([i for i, _ in owner], dtype=np.int64))
    mine = known[np.ix_(terms, terms)]
    names = [number_name(i, f.effect, n) for i, f in enumerate(filled, 1) for n in f.values]
    names += [number_name(i + 1, filled[i].effect, n) for i, n in owner]
    ends = itertools.accumulate(len(f.values) for f in filled)
    phases = [
        pair
        for f, end in zip(filled, ends, strict=True)
        for pair in phases_of(f.effect, range(end - len(f.values), end))
    ]
    loose = _undetermined(readings, found, whole[:, terms], mine, of, phases)
    return tuple(out), loose, ErrorCorrelation.of(names, mine)


def _undetermined(
    readings: Readings,
    found: _Numbers,
    columns: Floats,
    known: Floats,
    of: Ints,
    phases: Collection[tuple[int, int]],
) -> tuple[int, ...]:
    """Effects of which only the sum with others is determined.

    Args:
        readings: of the fit.
        found: the fit.
        columns: of coefficients, then slopes, (m, k).
        known: their covariance, (k, k).
        of: number of the effect of each, (k,).
        phases: coefficients in pairs: of one wave, at two phases.
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
    return tuple(undetermined(gram[:, :-1, :-1], values, known, of, gram[:, -1, -1], phases))


def _errors_of(before: FittedEffect, errors: Floats, places: Mapping[str, int]) -> dict[str, float]:
    """Standard errors by name; a number that the readings do not see or that was not searched keeps its earlier one."""
    out = {n: e for n, e in before.errors.items() if n in before.theta and n not in places}
    for name, place in places.items():
        error = errors[place] if np.isfinite(errors[place]) else before.errors.get(name, 0.0)
        if error > 0.0:
            out[name] = float(error)
    return out

"""Refits the best candidates together with the noise: each beside the model, and each beside another one."""

import itertools
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from rtec.arrays import Bools, Floats, Ints
from rtec.diagnosis.search.confounded import (
    ANOTHER,
    FEIGNED,
    SAME,
    WITHIN,
    coincides,
    cosine,
    directness,
    diverse,
    elsewhere,
    period_mm,
    plausibility,
    unheard_of,
)
from rtec.diagnosis.search.polish import Theta, at_instant, live_columns, polished
from rtec.diagnosis.search.prepared import Prepared
from rtec.diagnosis.search.screen import Bank, Projected, Screen, orthonormal, screen, screen_all
from rtec.diagnosis.search.shapes import Ground
from rtec.diagnosis.search.unnamed import Shaped
from rtec.effects import Effect
from rtec.effects.cyclic import Cyclic
from rtec.estimation.candidates import REAL, EffectCandidate
from rtec.estimation.gls import ROUNDS, Fit, HeldOutGain, bic_cost, fit_columns, held_out_gain, solve, without_nuisance
from rtec.estimation.noise import Whitener, find_noise, without_drift
from rtec.estimation.readings import Readings, looked_at
from rtec.estimation.targets import WAVES, predicts_targets
from rtec.parallel import each


def effective(whitener: Whitener, base: Floats, columns: Floats) -> Floats:
    """Number of independent readings that determine each column equally well, (k,): at least two, at most all.

    Args:
        whitener: the noise without the columns.
        base: columns of the current model, (m, p).
        columns: of a candidate, (m, k).
    """
    readings = whitener.readings
    q, plain = (orthonormal(without_nuisance(readings, base)), without_nuisance(readings, columns))
    plain = (plain - q @ (q.T @ plain)) / whitener.floor[readings.series_of][:, None]
    each_one = np.mean((plain - plain.mean(axis=0)) ** 2, axis=0)
    explained = np.sum(Projected.of(whitener, base, readings.values).take_out(whitener(columns)) ** 2, axis=0)
    return np.asarray(np.clip(explained / np.maximum(each_one, 1e-300), 2.0, float(len(readings))))


QUICKEST, HALF_WAVES = 3.0, 60
"""A drift changes by half-waves down to its memory over the first; at most this many, so that long records fit."""


FINENESS = ("knots_mm", "degrees")
"""Arguments that say only how fine the curve of an effect is."""


def same_but_finer(one: Effect, other: Effect) -> bool:
    """Whether two are one effect with other knots or degrees: no two causes."""
    if type(one) is not type(other) or one == other:
        return False
    mine, its = (e.model_dump(exclude=set(FINENESS)) for e in (one, other))
    return mine == its


def slow_slopes(noise: Whitener, first: int = 0) -> Floats:
    """Columns of a slope along each axis that moves within runs, which changes as slowly as the drift, (m, p).

    Args:
        noise: its drift of each series has a memory; a short one allows each of few runs a slope of its own.
        first: half-wave that is the first; from 1 on without a slope that stays.
    """
    readings, out = noise.readings, []
    for s, n in zip(noise.readings.series, noise.noises, strict=True):
        places = readings.poses_mm[s.source][s.row]
        middle = np.stack([np.bincount(s.run, p) for p in places.T], axis=1) / np.bincount(s.run)[:, None]
        slopes = places - middle[s.run]
        slopes = slopes[:, np.sqrt(np.mean(slopes**2, axis=0)) > REAL["mm"]]
        waves = min(int(s.run[-1]) + 1, math.ceil(QUICKEST * s.pace_s[0] / n.tau_s) + 1, HALF_WAVES)
        when = np.outer((s.time_s - s.time_s[0]) / s.pace_s[0], np.pi * np.arange(first, waves))
        own = (np.cos(when)[:, :, None] * slopes[:, None, :]).reshape(len(s), -1)
        whole = np.zeros((len(readings), own.shape[1]))
        whole[s.part] = own / np.maximum(np.sqrt(np.mean(own**2, axis=0)), REAL["mm"])
        out.append(whole)
    return np.concatenate(out, axis=1)


@dataclass(frozen=True, eq=False)
class Refitted:
    """A candidate fitted together with the current model and with its own noise. `==` compares by identity."""

    number: int
    theta: Mapping[str, float]
    columns: Floats
    fit: Fit
    log_evidence: float
    drop: float
    gain: float
    within: float = 0.0
    """Relative fall of the mean square on held-out runs about the mean of each; NaN of an event between two runs."""
    before: int | None = None
    """Number of columns before this candidate's in the fit; None for those of the current model."""
    rivals: tuple[int, ...] = ()
    """Numbers of the candidates that the readings cannot distinguish from it beside the same effects."""

    @property
    def holds(self) -> bool:
        """Whether held-out runs are predicted better, both whitened and in their unit, or else about their means."""
        return self.gain > 0.0 and max(self.drop, self.within) > 0.0


NOTHING_MUCH = 0.02
"""A relative fall of the mean square on held-out runs below this is not worth an addition."""
FAR = 0.5
"""Of two that explain the readings, one leads if its held-out mean square is below this share of the other's."""


BETTER = 0.9
"""One predicts better than another where its mean square on held-out runs is below this share of the other's."""


class Judged(Protocol):
    """A fit judged by held-out runs."""

    @property
    def drop(self) -> float:
        """Relative fall of the mean square."""

    @property
    def within(self) -> float:
        """Relative fall of the mean square about the mean of each run."""


def far_better(one: Judged, other: Judged) -> bool:
    """Whether one predicts held-out runs far better than another."""
    return predicts_better(one, other, FAR)


def predicts_better(one: Judged, other: Judged, share: float = BETTER) -> bool:
    """Whether one leaves less than this share of the mean square that another leaves on held-out runs.

    Not where the other is the better one about the mean of each run: then one may follow a drift from run to run.
    """
    feigned = 1.0 - other.within < BETTER * (1.0 - one.within)
    return 1.0 - one.drop < share * (1.0 - other.drop) and not feigned


Stage = Callable[[str, int, int], None]

BY_CHANCE = 0.01
"""Numbers of files follow a channel as well by chance less often than this."""


def _follow(levels: Sequence[Floats | None], numbers: Floats) -> bool:
    """Whether one number of each file, (files,), is a straight line over the median of a channel there."""
    from scipy.stats import linregress

    if len(levels) < 3 or any(v is None for v in levels):
        return False
    at = np.array([float(np.nanmedian(v)) for v in levels if v is not None])
    return bool(np.ptp(at) > 0.0 and linregress(at, numbers).pvalue < BY_CHANCE)


PART, UNSURE = 0.01, math.log(20.0)
"""A candidate is a case of another that leaves less than this share of it, by norm; and the evidence that further
numbers must add to be significant."""


def led(refitted: list[Refitted], bar: float, base: Floats, readings: Readings) -> list[Refitted]:
    """The best first: the likeliest, or a significant one that predicts held-out runs far better.

    Drift that is free to follow the readings absorbs much of what an effect does not explain, but it predicts nothing
    of held-out runs. Where a case with fewer numbers is nearly as likely, that one leads.

    Args:
        refitted: the likeliest first.
        bar: evidence from which a candidate is significant.
        base: columns of the current model, (m, p).
        readings: the readings.
    """
    if not refitted or not refitted[0].holds:
        return refitted
    first = refitted[0]
    sure = [t for t in refitted if t.holds and t.log_evidence > bar and far_better(t, first)]
    lead = max(sure, key=lambda t: t.log_evidence, default=first)
    known = Projected.of(lead.fit.whitener, base, readings.values)
    leaner = [
        t
        for t in refitted
        if t.holds and lead.log_evidence - t.log_evidence < UNSURE and _is_case(t.columns, lead.columns, known)
    ]
    lead = max(leaner, key=lambda t: t.log_evidence, default=lead)
    return [lead, *(t for t in refitted if t is not lead)]


def _is_case(lean: Floats, rich: Floats, known: Projected) -> bool:
    """Whether the columns `lean`, (m, k), are in the span of `rich`, to the precision of these readings."""
    if lean.shape[1] >= rich.shape[1]:
        return False
    mine, whole = (known.take_out(known.whitener(c)) for c in (lean, rich))
    q = orthonormal(whole)
    return float(np.linalg.norm(mine - q @ (q.T @ mine))) < PART * float(np.linalg.norm(mine))


TOP, OF_A_KIND, MOST = 7, 3, 14
"""Number of candidates that are refitted, and of those at most this many of one effect of one component with other
arguments. With those that the screen cannot distinguish from the best, never more than the last."""
DISTINCT, ONE = 80, 0.9999
"""Number of the best that are searched for identical shapes, and the cosine from which shapes are identical."""
BESIDE = 3
"""Effects that are tried beside the best before a shape without a name replaces it."""


AGAIN = 0.5
"""Where a second jump is larger than this share of the first, neither is a single event."""
MOST_TOGETHER = 6
"""Largest number of effects that are named together."""
EXCHANGES = 4
"""Rounds in which each of several effects may be replaced by another."""
MORE = 0.05
"""Relative fall of the mean square on held-out runs that each further effect must bring, and that an exchange for a
likelier one may lose."""


STAYS = 3.0
"""Slopes stay where columns that change them gain less than chance does, by this many of its standard deviations."""


class Refits:
    """Fits of candidates to readings, each with the noise estimated in the same fit.

    Args:
        prepared: readings, their noise, the model's columns.
        candidates: all effects that are searched.
        stage: progress callback: called with the stage, steps done, steps in total.

    Attributes:
        alternatives: number of candidates of each effect of a component.
        bank: columns of all candidates at the readings of a screen.
    """

    def __init__(self, prepared: Prepared, candidates: Sequence[EffectCandidate], stage: Stage) -> None:
        self.prepared, self.readings, self.candidates, self.stage = prepared, prepared.readings, candidates, stage
        self.alternatives = Counter((c.effect.effect, c.effect.component) for c in candidates)
        self.bank = Bank(self.readings, candidates, self.subset[0])
        self._refitted_beside: dict[int, list[Refitted]] = {}
        self._screened_beside: dict[int, Screen] = {}

    @cached_property
    def current(self) -> Fit:
        """The fit of the current model alone."""
        return self.fit(self.prepared.base)

    def refitted(self, found: Screen, driftless: Screen) -> list[Refitted]:
        """Fit the best of both screens together with the noise; best first."""
        base = self.prepared.base
        current = self.current
        chosen = [(found, i) for i in self._top(found)]
        seen = {i for _, i in chosen}
        again = [i for i in self._top(driftless) if i in found.best]
        chosen += [(driftless, i) for i in again if i not in seen or self._at_another_instant(i, found, driftless)]
        counted = itertools.count()

        def refit(which: tuple[Screen, int]) -> Refitted:
            self.stage("refitting the best", next(counted), len(chosen))
            weighed, number = which
            theta, columns, fit, likely = self._fitted(weighed, number, base)
            judged = self._judged(number, theta, fit.whitener, base, columns)
            return Refitted(number, theta, columns, fit, likely - current.log_likelihood, *judged)

        # A candidate that predicts held-out runs worse is no winner, whatever its evidence.
        ordered = sorted(each(refit, chosen, len(self.readings)), key=lambda t: (not t.holds, -t.log_evidence))
        best: dict[int, Refitted] = {}
        for t in ordered:
            best.setdefault(t.number, t)
        return self._by_sensor(list(best.values()))

    def _by_sensor(self, refitted: list[Refitted]) -> list[Refitted]:
        """The same in order, where the first has rivals that are the same effect by another sensor and about as likely:
        their non-linear parameters are refined again, each under the noise that was estimated beside it.

        Under a noise that has absorbed a part of the effect the sensors look alike at values that are not their own.
        """
        machine = self.readings.machine

        def name(t: Refitted) -> tuple[str, str]:
            effect = self.candidates[t.number].effect
            return effect.effect, effect.component

        def read(t: Refitted) -> frozenset[str]:
            return frozenset(self.candidates[t.number].effect.channels(machine))

        first = refitted[0] if refitted else None
        if first is None or not self.candidates[first.number].effect.nonlinear(machine):
            return refitted
        near = [t for t in refitted if name(t) == name(first) and first.log_evidence - t.log_evidence < 2.0 * WITHIN]
        if len({read(t) for t in near}) < 2:
            return refitted
        again = {t.number: self._refined_again(t) for t in near}
        return sorted((again.get(t.number, t) for t in refitted), key=lambda t: (not t.holds, -t.log_evidence))

    def _refined_again(self, t: Refitted) -> Refitted:
        """A candidate with its non-linear parameters refined under the noise beside it, where that is likelier."""
        base, grid = self.prepared.base, self.candidates[t.number].thetas
        nearest = min(range(len(grid)), key=lambda i: sum(abs(grid[i][k] - v) for k, v in t.theta.items()))
        theta = self._polished(t.number, nearest, t.fit.whitener, base)
        columns = self._columns(t.number, theta)
        fit = self.fit(np.concatenate([base, columns], axis=1))
        gain = fit.log_likelihood - t.fit.log_likelihood
        if gain <= 0.0:
            return t
        drop, held, within = self._judged(t.number, theta, fit.whitener, base, columns)
        return replace(
            t,
            theta=theta,
            columns=columns,
            fit=fit,
            log_evidence=t.log_evidence + gain,
            drop=drop,
            gain=held,
            within=within,
        )

    def _at_another_instant(self, number: int, one: Screen, other: Screen) -> bool:
        """Whether two screens find an event at different instants; a refit does not get from one to the other."""
        if not self.at_instant(number):
            return False
        return bool(one.variants[one.best[number]].theta != other.variants[other.best[number]].theta)

    def weigh(self, now: Whitener, base: Floats) -> Screen:
        """Screen of all candidates beside columns, (m, p), under a noise; of very many readings, on some."""
        return screen(self.bank, self._projected(now, base))

    def weigh_all(self, projected: Projected) -> Screen:
        """Screen of all candidates on all readings; keeps the columns for later screens."""
        return screen_all(self.bank, projected, lambda d, t: self.stage("weighing candidates", d, t))

    def _projected(self, now: Whitener, base: Floats) -> Projected:
        """The readings of a screen, whitened, less columns, (m, p)."""
        keep, subset = self.subset
        return Projected.of(Whitener(subset, now.noises, now.run_variances, now.least), base[keep], subset.values)

    def weigh_without_drift(self) -> Screen:
        """The same screen under nearly no drift: the estimated noise may have absorbed a missing effect."""
        return self.weigh(self._driftless, self.prepared.base)

    def fit(self, columns: Floats) -> Fit:
        """Fit from the estimated noise and from nearly no drift; the likelier of the two."""
        # One round shows which is the likelier; only that one is iterated further.
        starts = (self.prepared.whitener, self._driftless)
        best = max((fit_columns(w, columns, 1) for w in starts), key=lambda f: f.log_likelihood)
        return fit_columns(best.whitener, columns, ROUNDS - 1, values=best.values)

    @cached_property
    def _driftless(self) -> Whitener:
        """The noise with nearly no drift."""
        return without_drift(self.prepared.whitener)

    def beside(self, first: Refitted) -> list[Refitted]:
        """The best effects beside a first one, each fitted together with it; the evidence is that of both."""
        if first.number not in self._refitted_beside:
            self._refitted_beside[first.number] = self._refit_beside(first)
        return self._refitted_beside[first.number]

    def these_beside(self, first: Refitted, numbers: Sequence[int]) -> list[Refitted]:
        """Those of some candidates that explain anything beside a first one, each fitted together with it; the evidence
        is that of both.
        """
        there = {t.number: t for t in self._refitted_beside.get(first.number, ())}
        others = [n for n in numbers if n not in there and n in self.screen_beside(first).best]
        there |= {t.number: t for t in (self._refit_beside(first, others) if others else ())}
        return [there[n] for n in numbers if n in there]

    def screen_beside(self, first: Refitted) -> Screen:
        """Screen of all candidates beside a first one."""
        if first.number not in self._screened_beside:
            self._screened_beside[first.number] = self.weigh(first.fit.whitener, first.fit.columns)
        return self._screened_beside[first.number]

    def _refit_beside(self, first: Refitted, numbers: Sequence[int] | None = None) -> list[Refitted]:
        """These candidates beside a first one, or without any numbers the best."""
        width = self.prepared.base.shape[1]
        base, found = first.fit.columns, self.screen_beside(first)

        def refit(number: int) -> Refitted:
            theta, columns, fit, likely = self._fitted(found, number, base)
            evidence = first.log_evidence + likely - first.fit.log_likelihood
            judged = self._judged(number, theta, fit.whitener, base, fit.columns[:, width:])
            return Refitted(number, theta, columns, fit, evidence, *judged, base.shape[1])

        return self._with_rivals(
            found,
            each(refit, self._distinct(found)[:BESIDE] if numbers is None else numbers, len(self.readings)),
            [self._name(first.number)],
        )

    def _fitted(self, found: Screen, number: int, base: Floats) -> tuple[Theta, Floats, Fit, float]:
        """A candidate beside columns, (m, p): its non-linear parameters, its columns, the fit, and the log likelihood
        less the cost of the candidate's numbers, of the choice among its like, and of an unusual size.

        Args:
            found: screen of all candidates beside the same columns.
            number: of the candidate.
            base: the columns.
        """
        variant = found.variants[found.best[number]]
        theta = self._polished(number, variant.theta, found.projected.whitener, base)
        columns = self._columns(number, theta)
        fit = self.fit(np.concatenate([base, columns], axis=1))
        cost = self._cost(columns, variant.count) + found.search_cost(number) + self._choice_cost(number)
        cost -= plausibility(self.candidates[number].effect, fit.values[base.shape[1] :], self.readings.machine)
        return theta, columns, fit, fit.log_likelihood - cost

    def _with_rivals(
        self, found: Screen, refitted: Sequence[Refitted], there: Sequence[tuple[str, str]]
    ) -> list[Refitted]:
        """The same, each with those of another name that are nearly as likely or have the same shape.

        Args:
            found: screen of all candidates beside the effects in `there`.
            refitted: these candidates, each with its fit.
            there: effects and components that are already fitted.
        """
        out = []
        for t in refitted:
            others = {*there, self._name(t.number)}
            out.append(
                replace(t, rivals=tuple(i for i in self._near(found, t, refitted) if self._name(i) not in others))
            )
        return out

    def _near(self, found: Screen, t: Refitted, refitted: Sequence[Refitted]) -> list[int]:
        machine = self.readings.machine
        near = {o.number for o in refitted if o.holds and t.log_evidence - o.log_evidence < WITHIN}
        shape, width = found.contribution(t.number), found.variants[found.best[t.number]].count
        least = found.score[t.number] - self._choice_cost(t.number) - WITHIN
        for number in found.order[:DISTINCT]:
            likely = found.score[number] - self._choice_cost(number) > least
            lean = found.variants[found.best[number]].count <= width
            if likely or (lean and cosine(shape, found.contribution(number)) > SAME):
                near.add(number)
        near = {i for i in near if i == t.number or not self.of_no_machine(found, i, t.number)}
        thetas = {i: self.candidates[i].thetas[found.variants[found.best[i]].theta] for i in near}
        thetas |= {o.number: o.theta for o in (*refitted, t)}

        def by_chance(i: int) -> bool:
            return coincides(self.candidates[i].effect, thetas[i], machine)

        return [i for i in found.order if i in near and (i == t.number or by_chance(t.number) or not by_chance(i))]

    def of_no_machine(self, found: Screen, number: int, other: int) -> bool:
        """Whether a candidate would have a size that no machine has, and another one would not."""

        def unheard(i: int) -> bool:
            effect, at = self.candidates[i].effect, found.projected
            theta = self.candidates[i].thetas[found.variants[found.best[i]].theta]
            white = at.take_out(at.whitener(live_columns(effect, theta, at.whitener.readings)))
            values = np.asarray(np.linalg.lstsq(white, at.left, rcond=None)[0], dtype=np.float64)
            return unheard_of(effect, values, self.readings.machine)

        return unheard(number) and not unheard(other)

    def chain(self, first: Sequence[Refitted], bar: float, may: Callable[[Effect], bool]) -> list[Refitted]:
        """Effects and those that the readings require beside them, one after the other; the evidence is that of all.

        Each further one must be as significant as a first one, and lower the error on held-out runs by `MORE`. Then
        each may be exchanged; what is exchanged may need others beside it.

        Args:
            first: fitted beside the model; each further one beside those before it.
            bar: least gain of evidence by each.
            may: which effects may be taken.
        """
        out = self._grown([*first], bar, may)
        for _ in range(MOST_TOGETHER):
            exchanged = self._exchanged(out, bar, may)
            if {t.number for t in exchanged} == {t.number for t in out}:
                return exchanged
            out = self._grown(exchanged, bar, may)
        return out

    def beside_shape(
        self, columns: Floats, evidence: float, bar: float, may: Callable[[Effect], bool]
    ) -> list[Refitted]:
        """Effects that the readings require beside a shape without a name; the evidence is that of all.

        Args:
            columns: of the shape, (m, k).
            evidence: log evidence of the shape alone.
            bar: least gain of evidence by each.
            may: which effects may be taken.
        """
        width, base = self.prepared.base.shape[1], np.concatenate([self.prepared.base, columns], axis=1)
        now = self.fit(base)
        found = self.weigh(without_drift(now.whitener), base)
        tried: list[Refitted] = []
        for number in self._few(found, may, []):
            theta, own, fit, likely = self._fitted(found, number, base)
            gain = likely - now.log_likelihood
            judged = self._judged(number, theta, fit.whitener, base, fit.columns[:, width:])
            if gain > bar:
                tried.append(Refitted(number, theta, own, fit, evidence + gain, *judged, base.shape[1]))
        return self._grown([self._plainest(self._with_rivals(found, tried, []))], bar, may) if tried else []

    def instead_of_shape(
        self, members: Sequence[Refitted], shape: Fit, evidence: float, bar: float, may: Callable[[Effect], bool]
    ) -> list[Refitted]:
        """The same effects without the shape, and those that the readings then require beside them.

        Args:
            members: as of `beside_shape`.
            shape: fit of the shape alone.
            evidence, bar, may: as for `beside_shape`.
        """
        before, alone = (
            [(shape.log_likelihood, evidence), *((t.fit.log_likelihood, t.log_evidence) for t in members)],
            [],
        )
        for t, (likely, found) in zip(members, before, strict=False):
            cost = (t.fit.log_likelihood - likely) - (t.log_evidence - found)
            alone.append(replace(t, log_evidence=t.fit.log_likelihood - cost))
        return self._grown(self.in_order(alone), bar, may)

    def without_shape(self, members: Sequence[Refitted], columns: Floats) -> list[Refitted]:
        """Effects beside a shape, (m, k), judged on held-out runs without it."""
        width = self.prepared.base.shape[1] + columns.shape[1]
        judged = [self.held_out_gain(t.fit.whitener, t.fit.columns[:, width:]) for t in members]
        return [replace(t, drop=j.drop, within=j.within) for t, j in zip(members, judged, strict=True)]

    def _grown(self, out: list[Refitted], bar: float, may: Callable[[Effect], bool]) -> list[Refitted]:
        """The same effects and those that the readings require beside them."""
        width = self.prepared.base.shape[1]
        while len(out) < MOST_TOGETHER:
            last = out[-1]
            found = self.weigh(without_drift(last.fit.whitener), last.fit.columns)
            there = [self._name(t.number) for t in out]
            more: list[Refitted] = []
            for number in self._few(found, may, there):
                theta, columns, fit, likely = self._fitted(found, number, last.fit.columns)
                if any(self._same_wave(number, theta, t) for t in out):
                    continue
                gain = likely - last.fit.log_likelihood
                judged = self._judged(number, theta, fit.whitener, last.fit.columns, fit.columns[:, width:])
                if gain > bar and 1.0 - judged.drop < (1.0 - MORE) * (1.0 - last.drop):
                    evidence = last.log_evidence + gain
                    more.append(Refitted(number, theta, columns, fit, evidence, *judged, last.fit.columns.shape[1]))
            if not more:
                break
            out = [*out, self._plainest(self._with_rivals(found, more, there))]
        return out

    def _same_wave(self, number: int, theta: Mapping[str, float], other: Refitted) -> bool:
        """Whether a candidate is a wave that another effect is already: two near periods make one wave that beats."""
        one, two = self.candidates[number].effect, self.candidates[other.number].effect
        if not (isinstance(one, Cyclic) and isinstance(two, Cyclic)) or one.component != two.component:
            return False
        mine, its = period_mm(one, theta) or math.nan, period_mm(two, other.theta) or math.nan
        return one.grows_with == two.grows_with and abs(mine / its - 1.0) < ANOTHER

    def _few(self, found: Screen, may: Callable[[Effect], bool], there: Sequence[tuple[str, str]]) -> list[int]:
        """The best few candidates beside effects that are already fitted, one of each effect of a component.

        One effect of one component by two sensors is that effect of a body without a sensor of its own. One by the
        sensor of another axis is followed by the same effect by the axis' own, which may be as good.
        """
        order = [i for i in self._distinct(found) if may(self.candidates[i].effect) and self._name(i) not in there]
        few = diverse(order, [" ".join(self._name(i)) for i in range(len(self.candidates))], BESIDE, 1)
        return [*dict.fromkeys(n for i in few for n in (i, *self._by_own(i, found.order)))]

    def _by_own(self, number: int, order: Sequence[int]) -> list[int]:
        """The best candidate of the same effect by no sensor of another axis, where a candidate is by one."""
        machine, effects = self.readings.machine, self.candidates
        if not elsewhere(effects[number].effect, machine):
            return []
        own = (i for i in order if self._name(i) == self._name(number) and not elsewhere(effects[i].effect, machine))
        return [*itertools.islice(own, 1)]

    def _exchanged(self, members: list[Refitted], bar: float, may: Callable[[Effect], bool]) -> list[Refitted]:
        """Several effects, each replaced by what is likelier beside the others; the same where nothing is.

        What was chosen while others were still missing explains parts of these as well: a fading reversal error of X
        stands for the backlash of Y. The evidence is that of all up to each one.

        Args:
            members: effects that are named together.
            bar: least gain of evidence by each.
            may: which effects may replace one.
        """
        if len(members) < 2:
            return members
        chosen, now, before = list(members), members[-1].fit, [0]
        for _ in range(EXCHANGES):
            numbers = [t.number for t in chosen]
            if numbers == before:
                break
            before = numbers
            for mine in list(chosen):
                others = [t for t in chosen if t is not mine]
                base = np.concatenate([self.prepared.base, *[t.columns for t in others]], axis=1)
                found = self.weigh(without_drift(now.whitener), base)
                there = [self._name(t.number) for t in others]
                tried = [
                    Refitted(n, *self._fitted(found, n, base), drop=1.0, gain=1.0)
                    for n in dict.fromkeys([mine.number, *self._few(found, may, there)])
                    if n in found.best
                ]
                without = self.fit(base)
                tried = [t for t in tried if t.log_evidence - without.log_likelihood > bar]
                best = [self._plainest(self._with_rivals(found, tried, there))] if tried else []
                at = chosen.index(mine)
                chosen[at : at + 1] = best
                now = best[0].fit if best else without
        ordered, same = self.in_order(chosen, bar), [t.number for t in chosen] == [t.number for t in members]
        no_worse = ordered and 1.0 - ordered[-1].drop <= (1.0 + MORE) * (1.0 - members[-1].drop)
        if no_worse and len(ordered) == len(chosen):
            return ordered
        if same:
            return [replace(t, rivals=c.rivals) for t, c in zip(members, chosen, strict=True)]
        return ordered if no_worse else members

    def _plainest(self, tried: Sequence[Refitted]) -> Refitted:
        """The likeliest; of those that are nearly as likely, one that shows most directly, then what fewest drive."""
        top = max(t.log_evidence for t in tried)
        near = [t for t in tried if top - t.log_evidence < WITHIN]
        machine = self.readings.machine

        def plain(t: Refitted) -> tuple[int, int, float]:
            effect = self.candidates[t.number].effect
            return directness(effect, machine), len(effect.channels(machine)), -t.log_evidence

        first = min(near, key=plain)
        if not elsewhere(self.candidates[first.number].effect, machine):
            return first
        # Two screws that warm alike: the sensor of another axis is as good on this day only.
        mine = (t for t in tried if self._name(t.number) == self._name(first.number))
        own = [t for t in mine if not elsewhere(self.candidates[t.number].effect, machine)]
        near = [t for t in own if top - t.log_evidence < FEIGNED]
        return max(near, key=lambda t: t.log_evidence, default=first)

    def in_order(self, members: Sequence[Refitted], bar: float = -math.inf) -> list[Refitted]:
        """Effects one after the other, the one first that lowers the error on held-out runs most beside those before.

        Args:
            members: each fitted beside all others; the evidence of each is the log likelihood less its cost.
            bar: one that gains less evidence is omitted.
        """
        costs = {t.number: t.fit.log_likelihood - t.log_evidence for t in members}
        width, base, left, out = self.prepared.base.shape[1], self.prepared.base, list(members), list[Refitted]()
        evidence = -self.current.log_likelihood
        while left:
            tried = []
            for t in left:
                fit = self.fit(np.concatenate([base, t.columns], axis=1))
                judged = self._judged(t.number, t.theta, fit.whitener, base, fit.columns[:, width:])
                before = base.shape[1] if out else None
                likely = evidence + fit.log_likelihood - costs[t.number]
                tried.append(replace(t, fit=fit, log_evidence=likely, before=before, **judged._asdict()))
            least = bar + (out[-1].log_evidence if out else 0.0)
            best = max((t for t in tried if t.log_evidence > least), key=lambda t: t.drop, default=None)
            if best is None:
                break
            out.append(best)
            base, evidence = best.fit.columns, evidence - costs[best.number]
            left = [t for t in left if t.number != best.number]
        return out

    def _name(self, number: int) -> tuple[str, str]:
        """Effect and component of a candidate."""
        effect = self.candidates[number].effect
        return effect.effect, effect.component

    def _cost(self, columns: Floats, count: int) -> float:
        """Cost of a candidate's numbers: half the logarithm of the number of readings that determine each.

        An effect that changes only from run to run is determined by the runs, however many readings each has.
        """
        return 0.5 * count * float(np.mean(np.log(effective(self.current.whitener, self.prepared.base, columns))))

    def _polished(self, number: int, theta: int, now: Whitener, base: Floats) -> Mapping[str, float]:
        """Non-linear parameters of a candidate, refined beside a base from the grid's values."""
        candidate = self.candidates[number]
        return polished(candidate.effect, candidate.thetas, theta, self.subset[1], lambda: self._projected(now, base))

    def _columns(self, number: int, theta: Mapping[str, float]) -> Floats:
        """Columns of a candidate, (m, k)."""
        return live_columns(self.candidates[number].effect, theta, self.readings)

    def _top(self, found: Screen) -> list[int]:
        """The best few of different kinds, and those that the screen cannot distinguish from the best."""
        if not found.order:
            return []
        order = self._distinct(found)
        kinds = [c.effect.effect for c in self.candidates]
        top = diverse(order, kinds, TOP, OF_A_KIND)
        best = found.score[found.order[0]]
        near = [i for i in order[:MOST] if best - found.score[i] < WITHIN]
        return list(dict.fromkeys([*top, *near]))[:MOST]

    def _distinct(self, found: Screen) -> list[int]:
        """Candidates by evidence, each shape of an effect once: the most direct of the components that the readings
        cannot separate represents all.

        By another sensor an effect may have the same shape at a value of the grid, and another one at its own value.
        """
        machine, out = self.readings.machine, []
        shapes_of: dict[tuple[str, frozenset[str]], list[Floats]] = {}
        for i in sorted(found.order[:DISTINCT], key=lambda i: (-round(found.score[i], 3),
                        directness(self.candidates[i].effect, machine))):  # fmt: skip
            mine = found.contribution(i)
            mine /= max(float(np.sqrt(mine @ mine)), 1e-300)
            effect = self.candidates[i].effect
            read = frozenset(effect.channels(machine) if effect.nonlinear(machine) else ())
            same = shapes_of.setdefault((effect.effect, read), [])
            if all(abs(float(mine @ other)) < ONE for other in same):
                same.append(mine)
                out.append(i)
        return out

    def beside_columns(self, t: Refitted, columns: Floats) -> float:
        """Log evidence of a candidate where the readings contain other columns, (m, k), as well."""
        return self._evidence_beside(t, np.concatenate([self.prepared.base, columns], axis=1), self.readings)

    def beside_slopes(self, t: Refitted) -> float:
        """Log evidence of a candidate where slopes along each axis that moves in a run change as slowly as the drift.

        Heat that no sensor recorded causes such slopes; an effect that only follows them may be such heat.
        """
        return self.beside_columns(t, slow_slopes(t.fit.whitener))

    def slopes_stay(self, t: Refitted) -> bool:
        """Whether slopes along the axes do not change slowly, beside a candidate.

        Then the drift shifts all places alike, and what stays along an axis is no part of it.
        """
        slopes = slow_slopes(t.fit.whitener, first=1)
        if not slopes.shape[1]:
            return False
        count = slopes.shape[1]
        gain = self.fit(np.concatenate([t.fit.columns, slopes], axis=1)).log_likelihood - t.fit.log_likelihood
        return bool(2.0 * gain < count + STAYS * math.sqrt(2.0 * count))

    def beside_files(self, t: Refitted, others: Floats | None = None, cost: float | None = None) -> float | None:
        """Log evidence of a candidate where each file has a number of its own for the same shape at constant channels.

        Args:
            t: the candidate.
            others: columns that are there without it, (m, p); None for those of the model.
            cost: of its numbers and its choice; None where it was fitted beside the model alone.

        Returns:
            None where only one file shows it, where it depends only on positions, directions and time, or where the own
            numbers of three files or more follow its channel: then files are to it what runs are in one of them.
        """
        readings, effect = self.readings, self.candidates[t.number].effect
        source, files = self._files(t.columns)
        given = self.given & set(effect.channels(readings.machine))
        if len(files) < 2 or not given:
            return None
        shapes = [readings.at_constant(effect, t.theta, channel) for channel in sorted(given)]
        own = np.concatenate([shape * (source == k)[:, None] for shape in shapes for k in files], axis=1)
        base = self.prepared.base if others is None else others
        whole = np.concatenate([base, own], axis=1)
        if own.shape[1] == len(files):
            levels = [readings.states[k].channels.get(next(iter(given))) for k in files]
            if _follow(levels, solve(t.fit.whitener(whole), t.fit.whitener(readings.values))[base.shape[1] :]):
                return None
        return self._evidence_beside(t, whole, readings, cost)

    @cached_property
    def given(self) -> set[str]:
        """Channels that a day gives: temperatures, load and spindle speed."""
        return {"spindle_rpm", "load_kg", "force_n", *self.readings.machine.sensor_names}

    def _files(self, columns: Floats) -> tuple[Ints, Ints]:
        """Number of the file of each reading, (m,), and those files whose readings columns move."""
        source = np.array([s.source for s in self.readings.series])[self.readings.series_of]
        return source, np.unique(source[np.abs(columns).max(axis=1) > 0.0])

    def only_between_files(self, top: Shaped) -> tuple[str, ...]:
        """Temperatures, loads and speeds of a shape without a name that explains only differences between files.

        Beside curves over its other variables, of each file its own, neither it nor a plane over the same variables
        is significant. Empty where one is, where only one file shows it, or where it depends on none of these.
        """
        shape, ground = top.shape, Ground(self.readings)
        source, files = self._files(top.columns)
        given = tuple(v for v in shape.over if v in self.given)
        if len(files) < 2 or not given:
            return ()
        others = [replace(shape, over=(v,), fine=(n,)) for v, n in zip(shape.over, shape.fine, strict=True)]
        others = [s for s in others if s.over[0] not in given]
        own = [np.ones((len(source), 1)), *map(ground.columns, others)]
        apart = [np.concatenate(own, axis=1) * (source == k)[:, None] for k in files]
        base = np.concatenate([self.prepared.base, *apart], axis=1)
        plane = replace(shape, fine=(1,) * len(shape.fine)) if shape.period is None else shape
        for columns in (top.columns, ground.columns(plane)):
            cost = bic_cost(columns.shape[1], len(self.readings))
            if self._gain_beside(base, columns, self.readings) - cost > UNSURE:
                return ()
        return given

    def _evidence_beside(self, t: Refitted, base: Floats, readings: Readings, cost: float | None = None) -> float:
        """Log evidence of a candidate beside columns other than the model's, (m, p)."""
        cost = t.fit.log_likelihood - self.current.log_likelihood - t.log_evidence if cost is None else cost
        return self._gain_beside(base, t.columns, readings) - cost

    def _gain_beside(self, base: Floats, columns: Floats, readings: Readings) -> float:
        """Gain in log likelihood by columns, (m, k), beside others, (m, p), under the noise found with the latter."""
        noise = find_noise(readings, base, least=self.prepared.whitener.least)
        without, with_it = (
            fit_columns(noise, c).log_likelihood for c in (base, np.concatenate([base, columns], axis=1))
        )
        return with_it - without

    def at_instant(self, number: int) -> bool:
        """Whether a candidate is an event at one instant."""
        return any(map(at_instant, self.candidates[number].effect.nonlinear(self.readings.machine)))

    def jumps_again(self, t: Refitted) -> bool:
        """Whether an event at one instant repeats at others, at least half as large: a set-up that moves."""
        candidate = self.candidates[t.number]
        if not self.at_instant(t.number):
            return False
        known = self._projected(without_drift(t.fit.whitener), t.fit.columns)
        columns = [live_columns(candidate.effect, theta, self.subset[1])[:, :1] for theta in candidate.thetas]
        white = known.take_out(known.whitener(np.concatenate(columns, axis=1)))
        squares, along = np.sum(white**2, axis=0), white.T @ known.left
        best = int(np.argmax(along**2 / np.maximum(squares, 1e-12)))
        first = t.fit.values[self.prepared.base.shape[1]]
        return bool(abs(along[best]) > AGAIN * abs(first) * max(float(squares[best]), 1e-12))

    def of_curves(self, curves: Sequence[Floats], beside: Sequence[Floats] = ()) -> tuple[float, Floats]:
        """Log evidence of the best of several curves over the current model, and its columns.

        Args:
            curves: columns for each value of the two searched parameters, (m, k) each.
            beside: columns of effects beside them, which cost nothing, (m, k) each.
        """
        base, best = np.concatenate([self.prepared.base, *beside], axis=1), (-math.inf, curves[0])
        for noise in (self.prepared.whitener, self._driftless):
            known = Projected.of(noise, base, self.readings.values)
            squares = [float(np.sum((orthonormal(known.take_out(noise(c))).T @ known.left) ** 2)) for c in curves]
            columns = curves[int(np.argmax(squares))]
            fit = self.fit(np.concatenate([base, columns], axis=1))
            gain = fit.log_likelihood - self._cost(columns, columns.shape[1] + 2)
            best = max(best, (gain - self.current.log_likelihood, columns), key=lambda b: b[0])
        return best

    def _judged(self, number: int, theta: Theta, whitener: Whitener, beside: Floats, columns: Floats) -> HeldOutGain:
        """`held_out_gain`; the fall is zero for a shape along an axis that does not predict the held-out targets.

        Args:
            number: of the candidate.
            theta: its non-linear parameters, refined from the grid's values.
            whitener: the noise.
            beside: columns without the candidate, (m, p).
            columns: beyond the current model, with it, (m, k).
        """
        judged = self.held_out_gain(whitener, columns)
        candidate = self.candidates[number]
        # A wave of any period fits some targets. A bump between two places of the grid is found only where it is.
        thetas = candidate.thetas if isinstance(candidate.effect, WAVES) else (*candidate.thetas, theta)
        falls = max(judged.drop, judged.within) > 0.0
        if falls and not predicts_targets(self.readings, beside, candidate.effect, thetas):
            return HeldOutGain(0.0, min(judged.gain, 0.0), 0.0)
        return judged._replace(within=math.nan) if self.at_instant(number) else judged

    def held_out_gain(self, whitener: Whitener, columns: Floats) -> HeldOutGain:
        """What columns, (m, k), beside the current model improve on held-out runs."""
        return held_out_gain(whitener, self.prepared.base, columns, self.prepared.kept)

    @cached_property
    def subset(self) -> tuple[Bools, Readings]:
        """Which readings a screen uses, (m,), and these readings."""
        keep = looked_at(self.readings)
        return keep, self.readings if keep.all() else self.readings.without(~keep)

    def _choice_cost(self, number: int) -> float:
        """Cost of the choice among sensors: every effect of a component has the same prior, whatever sensors it takes.

        Otherwise an effect of any pair of eight sensors would be 28 times as likely as one of a single sensor.
        """
        mine = self.candidates[number].effect
        return math.log(self.alternatives[mine.effect, mine.component])

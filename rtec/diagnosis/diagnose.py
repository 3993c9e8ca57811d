"""Finds the effect that a model misses: whiten, evidence, refit, veto, alias, adequacy.

The steps are those of `docs/diagnose.md`. Ranking is easy, refusing is hard: a name is given only where chance is
unlikely (family-wise), the evidence holds with the noise found anew, and runs that were left out get better.
"""

import itertools
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis import words
from rtec.diagnosis.absent import SURE
from rtec.diagnosis.alias import WITHIN, cosine, directness, diverse, plausibility
from rtec.diagnosis.answer import Searched, answer
from rtec.diagnosis.at_once import MANY, each
from rtec.diagnosis.candidates import library
from rtec.diagnosis.noise import Whitener, without_drift
from rtec.diagnosis.polish import live_columns, polished
from rtec.diagnosis.readings import Readings
from rtec.diagnosis.refit import ROUNDS, Fit, fit_columns, held_out
from rtec.diagnosis.result import Diagnosis, Number, Unknown
from rtec.diagnosis.screen import Memory, Projected, Screen, screen
from rtec.diagnosis.thin import looked_at
from rtec.diagnosis.tried import Tried, prepare
from rtec.diagnosis.unnamed import Shaped, adequacy, best_shapes
from rtec.diagnosis.usable import check_enough
from rtec.metrology.characterise.threads import one_blas_thread
from rtec.metrology.measurement import Measurement
from rtec.model import Model

Floats = NDArray[np.float64]
Stage = Callable[[str, int, int], None]

TOP = 7
OF_A_KIND = 3
"""At most so many of the top are the same effect of the same component with other arguments."""
DISTINCT, ONE = 80, 0.9999
"""So many of the best are looked through for shapes that are one and the same, and what counts as that."""
OVERWHELMING = math.log(50.0)
"""Posterior odds, as a logarithm, that need no draws of chance; a name needs `SURE` of them."""
FEW = 40.0
"""With so few readings beyond the numbers found, any fit looks too good, and only draws of chance count."""
BESIDE = 3
"""Effects that are tried beside the best, before it is given up for a shape without a name."""
ADEQUATE, LEAST = 0.95, 0.7
"""An effect that explains this share of what the best shape explains describes it, though the shape be likelier; and
one below the least describes nothing."""
LITTLE = 0.25
"""A fall of the mean square on runs left out below this is little."""
MOSTLY = 0.5
"""Two effects that only help together must take away at least this share of the mean square on runs left out."""
MOST = 14
"""And never more than so many."""
ALPHA, DRAWS = 0.05, 400


def diagnose(
    model: Model,
    measurements: Sequence[Measurement],
    *,
    seed: int = 1,
    alpha: float = ALPHA,
    draws: int = DRAWS,
    only: Sequence[str] | None = None,
    explain: bool = False,
    stage: Stage | None = None,
) -> Diagnosis:
    """Find what a model misses.

    Args:
        model: the current model.
        measurements: of its machine, by any instruments.
        seed: of the draws of chance.
        alpha: family-wise probability of a false name that is put up with.
        draws: how often chance is drawn.
        only: names of effects to look for; None for the whole catalogue.
        explain: work out what only people want to know, which takes a second or more: which test of this machine tells
            confusions apart, and what speaks up beside what was named.
        stage: told how far it is.

    Raises:
        MeasurementError: the measurements do not fit together, are too few, or lack a channel that the model needs.
    """
    check_enough(measurements)
    with one_blas_thread():
        return _Search(model, measurements, seed, alpha, draws, only, explain, stage or (lambda *_: None)).diagnosis()


class _Search:
    def __init__(
        self,
        model: Model,
        measurements: Sequence[Measurement],
        seed: int,
        alpha: float,
        draws: int,
        only: Sequence[str] | None,
        explain: bool,
        stage: Stage,
    ) -> None:
        self.model, self.seed, self.alpha, self.draws, self.stage = model, seed, alpha, draws, stage
        self.explain = explain
        stage("reading, finding the noise", 0, 1)
        self.prepared = prepare(model, measurements)
        self.readings = self.prepared.readings
        known = [f.effect for f in model.effects]
        candidates, self.untried = library(self.readings, only)
        self.candidates = [c for c in candidates if c.effect not in known]
        self._alternatives = Counter((c.effect.effect, c.effect.component) for c in self.candidates)
        self.rng = np.random.default_rng([seed, 400])
        self._top_shape: Shaped | None = None
        self._columns_of_few: Memory = {}
        self._found_beside: dict[int, list[Tried]] = {}

    def diagnosis(self) -> Diagnosis:
        """Go through the steps."""
        prepared, readings = self.prepared, self.readings
        projected = self._projected
        same = self._columns_of_few if self._few[1] is readings else None
        found = screen(readings, self.candidates, projected, lambda d, t: self.stage("weighing candidates", d, t), same)
        self.stage("what chance can do", 0, 1)
        p, _ = found.family_p(self.draws, self.rng)
        tried = self._refit(found, self._second_look())
        best = tried[0] if tried else None
        accepted = best is not None and self._accepts(best, p)
        named, share, unknown = self._adequate(best if accepted else None)
        # One that brings next to nothing alone, and is named for what it does beside another, is half of a pair.
        half = best is not None and named and best.drop < LITTLE and share is not None and share < LEAST
        pair = None if accepted and named and not half else self._pair(tried)
        if pair is not None:
            numbers = [t.number for t in pair]
            tried = [*pair, *(t for t in tried if t.number not in numbers)]
            accepted, named, share, unknown = True, True, 1.0, None
        return answer(
            Searched(
                self.model, prepared, self.candidates, self.untried, self._prior_odds, projected, found, self._without,
                tried, pair[1].number if pair is not None else None, p, accepted and named, share, unknown,
                self._top_shape, self.seed, self.explain, self._next(tried, pair, accepted and named),
            )
        )  # fmt: skip

    def _next(self, tried: Sequence[Tried], pair: Sequence[Tried] | None, named: bool) -> Screen | None:
        """All candidates beside what was named; of very many readings only some are looked at, which tells no sizes."""
        if not self.explain or not named or self._few[1] is not self.readings:
            return None
        fit = (pair[1] if pair is not None else tried[0]).fit
        return self._look(lambda w: w, fit.whitener, fit.columns)

    def _accepts(self, best: Tried, p: float) -> bool:
        """Chance is unlikely, or the evidence with the noise found anew is overwhelming; and left-out runs agree.

        The draws of chance know only the noise that was found without the effect; where that noise swallowed it, they
        make chance look better than it is.
        """
        beyond = best.log_evidence - self._prior_odds
        return best.holds and beyond > SURE and (p < self.alpha or (beyond > OVERWHELMING and self._many))

    @cached_property
    def _projected(self) -> Projected:
        """The readings, whitened, less the current model."""
        return Projected.of(self.prepared.whitener, self.prepared.base, self.readings.values)

    @property
    def _many(self) -> bool:
        """Whether there are so many readings beyond the numbers found that a likelihood is worth what it says."""
        return self._projected.freedom > FEW

    @property
    def _prior_odds(self) -> float:
        """Log of how much likelier nothing is than any one effect of one component, before the readings."""
        return math.log(max(len(self._alternatives), 2))

    def _second_look(self) -> Screen:
        """The same weighing as if there were hardly any drift: the noise may have swallowed what is looked for."""
        return self._look(without_drift, self.prepared.whitener, self.prepared.base)

    def _look(self, change: Callable[[Whitener], Whitener], now: Whitener, base: Floats) -> Screen:
        """Weigh all candidates beside columns, (m, p), under a noise; of very many readings on some."""
        keep, few = self._few
        noise = change(Whitener(few, now.noises, now.wides, now.least))
        return screen(few, self.candidates, Projected.of(noise, base[keep], few.values), memory=self._columns_of_few)

    @cached_property
    def _few(self) -> tuple[NDArray[np.bool_], Readings]:
        """Which readings a look takes, (m,), and these."""
        keep = looked_at(self.readings)
        return keep, self.readings if keep.all() else self.readings.without(~keep)

    def _choice_cost(self, number: int) -> float:
        """What the choice among sensors takes off: every effect of a component is as likely before, whatever it takes.

        Else an effect that may use any pair of eight sensors would be 28 times as likely as one that uses one.
        """
        mine = self.candidates[number].effect
        return math.log(self._alternatives[mine.effect, mine.component])

    def _fit(self, columns: Floats) -> Fit:
        """Fit from the noise that was found, and from hardly any drift; the likelier of the two."""
        many = len(self.readings) > MANY
        noises = (self.prepared.whitener, without_drift(self.prepared.whitener))
        best = max((fit_columns(w, columns, 1 if many else ROUNDS) for w in noises), key=lambda f: f.log_likelihood)
        # So many readings tell after one round which is the likelier; the rest is for that alone.
        return fit_columns(best.whitener, columns, ROUNDS - 1) if many else best

    def _refit(self, found: Screen, calm: Screen) -> list[Tried]:
        """Fit the best of both weighings anew, noise and all; best first."""
        base = self.prepared.base
        self._without = without = self._fit(base)
        looks = [(found, i) for i in self._top(found)]
        seen = {i for _, i in looks}
        looks += [(calm, i) for i in self._top(calm) if i not in seen and i in found.best]
        n = math.log(len(self.readings))
        counted = itertools.count()

        def tried(which: tuple[Screen, int]) -> Tried:
            self.stage("fitting the best anew", next(counted), len(looks))
            look, number = which
            variant = look.variants[look.best[number]]
            theta = self._polished(number, variant.theta, look.projected.whitener, base)
            columns = self._columns(number, theta)
            fit = self._fit(np.concatenate([base, columns], axis=1))
            evidence = fit.log_likelihood - without.log_likelihood - 0.5 * variant.count * n
            evidence -= look.search_cost(number) + self._choice_cost(number)
            evidence += plausibility(self.candidates[number].effect, fit.values[base.shape[1] :], self.model.machine)
            return Tried(number, theta, columns, fit, evidence, *self._left_out(fit.whitener, columns))

        # What does worse on runs left out is no winner, whatever its evidence.
        return sorted(each(tried, looks, len(self.readings)), key=lambda t: (not t.holds, -t.log_evidence))

    def _polished(self, number: int, theta: int, now: Whitener, base: Floats) -> Mapping[str, float]:
        """Non-linear parameters of a candidate at their best beside a base, from those that were tried."""
        candidate = self.candidates[number]
        keep, few = self._few
        noise = Whitener(few, now.noises, now.wides, now.least)
        return polished(
            candidate.effect, candidate.thetas, theta, few, lambda: Projected.of(noise, base[keep], few.values)
        )

    def _columns(self, number: int, theta: Mapping[str, float]) -> Floats:
        """Columns of a candidate, (m, k)."""
        return live_columns(self.candidates[number].effect, theta, self.readings)

    def _top(self, found: Screen) -> list[int]:
        """The best few of different kinds, and what the screen does not tell from the best."""
        if not found.order:
            return []
        order = self._distinct(found)
        kinds = [c.effect.effect for c in self.candidates]
        top = diverse(order, kinds, TOP, OF_A_KIND)
        best = found.score[found.order[0]]
        near = [i for i in order[:MOST] if best - found.score[i] < WITHIN]
        return list(dict.fromkeys([*top, *near]))[:MOST]

    def _distinct(self, found: Screen) -> list[int]:
        """Candidates by evidence, each shape of an effect once: of components that the readings cannot tell apart
        the most direct stands for all.
        """
        machine, out = self.model.machine, []
        shapes_of: dict[str, list[tuple[int, Floats]]] = {}
        for i in sorted(found.order[:DISTINCT], key=lambda i: (-round(found.score[i], 3),
                        directness(self.candidates[i].effect, machine))):  # fmt: skip
            mine = found.contribution(i)
            same = shapes_of.setdefault(self.candidates[i].effect.effect, [])
            if all(cosine(mine, other) < ONE for _, other in same):
                same.append((i, mine))
                out.append(i)
        return out

    def _left_out(self, whitener: Whitener, columns: Floats) -> tuple[float, float]:
        """Relative fall of the mean square on runs left out, and the gain in whitened squares for each fold."""
        base = self.prepared.base
        without = held_out(whitener, base)
        with_it = held_out(whitener, np.concatenate([base, columns], axis=1))
        gain = float(np.mean(without.white - with_it.white))
        return 1.0 - with_it.square / max(without.square, 1e-300), gain

    def _adequate(self, best: Tried | None) -> tuple[bool, float | None, Unknown | None]:
        """Is the best effect as good as a shape without a name; and if none is, what is there?"""
        self.stage("shapes without a name", 0, 1)
        tops = self._shapes(best)
        top = max(tops, key=lambda t: t.log_evidence, default=None)
        self._top_shape = top
        if best is None:
            sure = top is not None and top.log_evidence > OVERWHELMING and self._many
            return False, None, self._unknown(top) if sure and top is not None else None
        share = adequacy(best.columns, tops, self.prepared.base, self.readings)
        if top is None or top.log_evidence < best.log_evidence + WITHIN:
            bar = best.log_evidence + WITHIN if top is None else top.log_evidence + WITHIN
            return share >= LEAST or self._with_another(best) > bar, share, None
        # A shape without a name is likelier; where the effect is almost that shape, or is one of two that together are
        # likelier than it, the name is the better answer still.
        named = share >= ADEQUATE or self._with_another(best) > top.log_evidence
        return named, share, None if named else self._unknown(top)

    def _with_another(self, best: Tried) -> float:
        """Log evidence of the best effect together with the best one beside it."""
        return max((t.log_evidence for t in self._beside(best)), default=-math.inf)

    def _beside(self, first: Tried) -> list[Tried]:
        """The best beside an effect, each fitted together with it; the evidence is that of both."""
        if first.number not in self._found_beside:
            self._found_beside[first.number] = self._look_beside(first)
        return self._found_beside[first.number]

    def _look_beside(self, first: Tried) -> list[Tried]:
        width = self.prepared.base.shape[1]
        base = np.concatenate([self.prepared.base, first.columns], axis=1)
        found = self._look(lambda w: w, first.fit.whitener, base)

        def tried(number: int) -> Tried:
            variant = found.variants[found.best[number]]
            theta = self._polished(number, variant.theta, found.projected.whitener, base)
            columns = self._columns(number, theta)
            fit = self._fit(np.concatenate([base, columns], axis=1))
            gain = fit.log_likelihood - first.fit.log_likelihood - 0.5 * variant.count * math.log(len(self.readings))
            evidence = first.log_evidence + gain - found.search_cost(number) - self._choice_cost(number)
            drop, left_out = self._left_out(fit.whitener, fit.columns[:, width:])
            return Tried(number, theta, columns, fit, evidence, drop, left_out, base.shape[1])

        return each(tried, self._distinct(found)[:BESIDE], len(self.readings))

    def _pair(self, tried: Sequence[Tried]) -> tuple[Tried, Tried] | None:
        """Two effects of which each alone makes runs left out no better, and which together leave little.

        Such are an effect at once and the same effect late with the other sign: a part that bends while it is being
        warmed through. Asked for only where one is sure of itself but for the runs left out, and only where no shape
        without a name comes near.
        """
        if not self._many:
            return None
        width, bar = self.prepared.base.shape[1], self._prior_odds + OVERWHELMING
        best: tuple[Tried, Tried] | None = None
        firsts = [t for t in sorted(tried, key=lambda t: -t.log_evidence)[:BESIDE] if t.log_evidence >= bar]
        for first, seconds in zip(firsts, each(self._beside, firsts, len(self.readings)), strict=True):
            for second in seconds:
                sure = second.holds and second.log_evidence - first.log_evidence > bar and second.drop > MOSTLY
                if sure and (best is None or second.log_evidence > best[1].log_evidence):
                    both = replace(second, number=first.number, theta=first.theta, columns=first.columns, before=width)
                    best = both, second
        if best is None or (self._top_shape and self._top_shape.log_evidence + WITHIN > best[1].log_evidence):
            return None
        return best

    def _shapes(self, best: Tried | None) -> list[Shaped]:
        """The best shapes without a name, looked for under the noise that is known best and as if without drift."""
        known = best.fit.whitener if best is not None else self.prepared.whitener
        noises = (known, without_drift(self.prepared.whitener))
        return best_shapes(self.readings, self.prepared.base, noises, self._fit, self._without, self._left_out)

    def _unknown(self, top: Shaped) -> Unknown:
        shape = top.shape
        period = None
        if shape.period is not None:
            period = Number(shape.period, None, words.unit_of_channel(shape.variables[0]))
        chance = math.exp(-min(top.log_evidence, 50.0))
        return Unknown(shape.group, shape.variables, shape.kind, period, chance, top.drop)

"""Fits what looks best anew, noise and all: each candidate beside the model, and each beside another one."""

import itertools
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis.search.candidates import Candidate
from rtec.diagnosis.search.confounded import WITHIN, cosine, directness, diverse, plausibility
from rtec.diagnosis.search.polish import live_columns, polished
from rtec.diagnosis.search.screen import Memory, Projected, Screen, screen
from rtec.diagnosis.search.tried import Prepared, Tried
from rtec.estimation.gls import ROUNDS, Fit, fit_columns, held_out
from rtec.estimation.noise import Whitener, without_drift
from rtec.estimation.readings import Readings, looked_at
from rtec.parallel import MANY, each

Floats = NDArray[np.float64]
Stage = Callable[[str, int, int], None]

TOP, OF_A_KIND, MOST = 7, 3, 14
"""So many of the best are fitted anew, at most so many of them one effect of one component with other arguments.

With those that the screen does not tell from the best, never more than the last."""
DISTINCT, ONE = 80, 0.9999
"""So many of the best are looked through for shapes that are one and the same, and what counts as that."""
BESIDE = 3
"""Effects that are tried beside the best, before it is given up for a shape without a name."""


class Refits:
    """Fits of candidates to readings, each with the noise found along with it.

    Args:
        prepared: readings, their noise, the model's columns.
        candidates: all effects that are looked for.
        stage: told how far it is.

    Attributes:
        alternatives: how many candidates there are of an effect of a component.
        columns_of_few: whitened columns that were made already.
    """

    def __init__(self, prepared: Prepared, candidates: Sequence[Candidate], stage: Stage) -> None:
        self.prepared, self.readings, self.candidates, self.stage = prepared, prepared.readings, candidates, stage
        self.alternatives = Counter((c.effect.effect, c.effect.component) for c in candidates)
        self.columns_of_few: Memory = {}
        self._found_beside: dict[int, list[Tried]] = {}

    @cached_property
    def without(self) -> Fit:
        """The model as it is."""
        return self.fit(self.prepared.base)

    def anew(self, found: Screen, calm: Screen) -> list[Tried]:
        """Fit the best of both weighings anew, noise and all; best first."""
        base = self.prepared.base
        without = self.without
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
            fit = self.fit(np.concatenate([base, columns], axis=1))
            evidence = fit.log_likelihood - without.log_likelihood - 0.5 * variant.count * n
            evidence -= look.search_cost(number) + self._choice_cost(number)
            evidence += plausibility(self.candidates[number].effect, fit.values[base.shape[1] :], self.readings.machine)
            return Tried(number, theta, columns, fit, evidence, *self.left_out(fit.whitener, columns))

        # What does worse on runs left out is no winner, whatever its evidence.
        return sorted(each(tried, looks, len(self.readings)), key=lambda t: (not t.holds, -t.log_evidence))

    def look(self, change: Callable[[Whitener], Whitener], now: Whitener, base: Floats) -> Screen:
        """Weigh all candidates beside columns, (m, p), under a noise; of very many readings on some."""
        keep, few = self.few
        noise = change(Whitener(few, now.noises, now.wides, now.least))
        return screen(few, self.candidates, Projected.of(noise, base[keep], few.values), memory=self.columns_of_few)

    def second_look(self) -> Screen:
        """The same weighing as if there were hardly any drift: the noise may have swallowed what is looked for."""
        return self.look(without_drift, self.prepared.whitener, self.prepared.base)

    def fit(self, columns: Floats) -> Fit:
        """Fit from the noise that was found, and from hardly any drift; the likelier of the two."""
        many = len(self.readings) > MANY
        noises = (self.prepared.whitener, without_drift(self.prepared.whitener))
        best = max((fit_columns(w, columns, 1 if many else ROUNDS) for w in noises), key=lambda f: f.log_likelihood)
        # So many readings tell after one round which is the likelier; the rest is for that alone.
        return fit_columns(best.whitener, columns, ROUNDS - 1) if many else best

    def beside(self, first: Tried) -> list[Tried]:
        """The best beside an effect, each fitted together with it; the evidence is that of both."""
        if first.number not in self._found_beside:
            self._found_beside[first.number] = self._look_beside(first)
        return self._found_beside[first.number]

    def _look_beside(self, first: Tried) -> list[Tried]:
        width = self.prepared.base.shape[1]
        base = np.concatenate([self.prepared.base, first.columns], axis=1)
        found = self.look(lambda w: w, first.fit.whitener, base)

        def tried(number: int) -> Tried:
            variant = found.variants[found.best[number]]
            theta = self._polished(number, variant.theta, found.projected.whitener, base)
            columns = self._columns(number, theta)
            fit = self.fit(np.concatenate([base, columns], axis=1))
            gain = fit.log_likelihood - first.fit.log_likelihood - 0.5 * variant.count * math.log(len(self.readings))
            evidence = first.log_evidence + gain - found.search_cost(number) - self._choice_cost(number)
            drop, left_out = self.left_out(fit.whitener, fit.columns[:, width:])
            return Tried(number, theta, columns, fit, evidence, drop, left_out, base.shape[1])

        return each(tried, self._distinct(found)[:BESIDE], len(self.readings))

    def _polished(self, number: int, theta: int, now: Whitener, base: Floats) -> Mapping[str, float]:
        """Non-linear parameters of a candidate at their best beside a base, from those that were tried."""
        candidate = self.candidates[number]
        keep, few = self.few
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
        machine, out = self.readings.machine, []
        shapes_of: dict[str, list[tuple[int, Floats]]] = {}
        for i in sorted(found.order[:DISTINCT], key=lambda i: (-round(found.score[i], 3),
                        directness(self.candidates[i].effect, machine))):  # fmt: skip
            mine = found.contribution(i)
            same = shapes_of.setdefault(self.candidates[i].effect.effect, [])
            if all(cosine(mine, other) < ONE for _, other in same):
                same.append((i, mine))
                out.append(i)
        return out

    def left_out(self, whitener: Whitener, columns: Floats) -> tuple[float, float]:
        """Relative fall of the mean square on runs left out, and the gain in whitened squares for each fold."""
        base = self.prepared.base
        without = held_out(whitener, base)
        with_it = held_out(whitener, np.concatenate([base, columns], axis=1))
        gain = float(np.mean(without.white - with_it.white))
        return 1.0 - with_it.square / max(without.square, 1e-300), gain

    @cached_property
    def few(self) -> tuple[NDArray[np.bool_], Readings]:
        """Which readings a look takes, (m,), and these."""
        keep = looked_at(self.readings)
        return keep, self.readings if keep.all() else self.readings.without(~keep)

    def _choice_cost(self, number: int) -> float:
        """What the choice among sensors takes off: every effect of a component is as likely before, whatever it takes.

        Else an effect that may use any pair of eight sensors would be 28 times as likely as one that uses one.
        """
        mine = self.candidates[number].effect
        return math.log(self.alternatives[mine.effect, mine.component])

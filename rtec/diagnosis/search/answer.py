"""The answer of a search: findings with their rivals, numbers with their errors, and the verdict."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rtec.arrays import Bools, Floats
from rtec.diagnosis import words
from rtec.diagnosis.doubts.doubt import BESIDE_A_NAME, Doubt
from rtec.diagnosis.doubts.record import runs_too_few, scatters, swings, too_few, unexplained
from rtec.diagnosis.heat import (
    beam_in_air,
    drift_by_far,
    heat_by_time,
    lag_assumed,
    substitute_sensor,
    unrecorded_heat,
)
from rtec.diagnosis.plan.separating import fitted_to, with_gains
from rtec.diagnosis.result import REFIT, Alike, Diagnosis, Finding, Member, Number, Picture, RunsDiffer, Unknown
from rtec.diagnosis.search import picture
from rtec.diagnosis.search.confounded import (
    APART,
    FEIGNED,
    SAME,
    WITHIN,
    alike,
    bent_part,
    coincides,
    cosine,
    curve_or_wave,
    fold,
    pitch_in_doubt,
)
from rtec.diagnosis.search.expressions import Typed, propose
from rtec.diagnosis.search.not_found import SURE, absent_effects, significant, untestable
from rtec.diagnosis.search.one_feed import TEST, as_place, not_separated, of_places
from rtec.diagnosis.search.prepared import Prepared
from rtec.diagnosis.search.refit import BETTER, NOTHING_MUCH, Refits, Refitted, predicts_better
from rtec.diagnosis.search.run_drift import run_drifts
from rtec.diagnosis.search.screen import Projected, Screen
from rtec.diagnosis.search.unnamed import Shaped
from rtec.effects import Effect, Parameter
from rtec.effects.cyclic import Cyclic
from rtec.errors import RtecError
from rtec.estimation import floor
from rtec.estimation.candidates import EffectCandidate, Untried, same_effects
from rtec.estimation.columns import slope
from rtec.estimation.gls import inverse, resolved, solve
from rtec.estimation.judge import Judgement
from rtec.estimation.noise import Whitener
from rtec.estimation.outliers import outlier_words
from rtec.model import FittedEffect, Model

DECIDED = 0.99
"""A number has no standard error where the readings determine a smaller share of it than this by themselves."""
MOSTLY_NAMED = 0.5
"""A file that the model meets far worse than those of its fit may be of another machine. The answer does not ask so
where what is named removes this share of the mean square on held-out runs: it is the reason."""
UNHEARD = 100.0
"""A standard error this many times the number and its usual size means that the number is not determined."""
TINY = 1e-12
LOOKED_AT = 60
"""Candidates whose shape is compared with the winner's."""


@dataclass(frozen=True)
class SearchResult:
    """Everything that the answer is made from.

    Attributes:
        model: the current model.
        prepared: readings, base and noise.
        candidates, untried: effects that were searched, and those that could not be.
        prior_odds: log of the prior odds of "nothing" against any one effect.
        projected, found: the readings less the base, and the evidence of all candidates.
        refits: fits of candidates along with the model.
        refitted: refitted candidates, best first.
        partner: number of the one that has to be added with the first, if any.
        p: family-wise probability by noise alone.
        accepted: whether the first is named.
        adequacy: share of what the best shape explains that the first explains too.
        unknown, shape: the error without a name, where there is one, and its shape.
        judged: the current model, judged on these readings.
        doubts: about the record itself.
        chain: effects that are named together though part of the residual has no name; the first is that of
            `refitted`.
        undecided: differences between runs that the first may explain though it is not named.
        seed: of the random draws.
        explain: whether to work out explanations for people: which test separates confounded effects.
        beside: evidence of all candidates beside the named one; None where none is named, or it was not requested.
    """

    model: Model
    prepared: Prepared
    candidates: Sequence[EffectCandidate]
    untried: Sequence[Untried]
    prior_odds: float
    projected: Projected
    found: Screen
    refits: Refits
    refitted: Sequence[Refitted]
    partner: int | None
    p: float
    accepted: bool
    adequacy: float | None
    unknown: Unknown | None
    shape: Shaped | None
    seed: int
    explain: bool
    beside: Screen | None
    judged: Judgement
    doubts: tuple[Doubt, ...]
    chain: tuple[Refitted, ...] = ()
    undecided: RunsDiffer | None = None


def determined(p: Parameter, value: float, se: float) -> bool:
    """Whether the readings determine a number better than its search range, or its usual size, does."""
    span = p.high - p.low
    return se < (span if math.isfinite(span) else UNHEARD * max(abs(value), p.typical))


def answer(searched: SearchResult) -> Diagnosis:
    """Diagnosis from the results of a search."""
    return _Answer(searched).diagnosis()


class _Answer:
    def __init__(self, searched: SearchResult) -> None:
        self.s = searched
        self.readings = searched.prepared.readings

    def diagnosis(self) -> Diagnosis:
        findings = self._findings(self.s.found, list(self.s.refitted), self.s.p, self.s.accepted)
        if self.s.partner is not None:
            findings = (replace(findings[0], partner=findings[1]), *findings[1:])
        return self._answer(self.s.found, findings, self.s.adequacy, self.s.unknown)

    def _findings(self, found: Screen, refitted: list[Refitted], p: float, accepted: bool) -> tuple[Finding, ...]:
        if not refitted:
            return ()
        same = [t.number != self.s.partner and self._rivals(found, refitted[0], t) for t in refitted]
        mine = found.contribution(refitted[0].number)
        besides = [
            accepted and s and cosine(mine, found.contribution(t.number)) < APART
            for t, s in zip(refitted, same, strict=True)
        ]
        refitted, same, besides = self._beside_first(refitted, same, besides)
        # An effect that explains another part is no rival but may be missing too: its probability is among its like.
        among = np.array(besides)
        odds = np.array(
            [t.log_evidence if t.before is None or b else -np.inf for t, b in zip(refitted, besides, strict=True)]
        )
        posterior = np.where(among, self._posterior(odds, among), self._posterior(odds, ~among))
        confused = tuple(self._alikes(found, [t.number for t, b in zip(refitted, besides, strict=True) if b]))
        return tuple(
            self._finding(rank, t, p, float(posterior[i]), accepted, same[i], besides[i], confused)
            for rank, (i, t) in enumerate(enumerate(refitted), 1)
        )

    def _beside_first(
        self, refitted: list[Refitted], same: list[bool], besides: list[bool]
    ) -> tuple[list[Refitted], list[bool], list[bool]]:
        """The same; what explains another part than the first is fitted and judged beside it, the likeliest first.

        Alone, a form with a number of its own takes up a part of the first as well.

        Args:
            refitted: candidates, the first one first.
            same: whether each is a rival of the first, or may be missing besides.
            besides: whether each may be missing besides.
        """
        if not self.s.explain or self.s.partner is not None or not any(besides):
            return refitted, same, besides
        first, left = refitted[0], max(1.0 - refitted[0].drop, TINY)
        whole = self.s.refits.these_beside(first, [t.number for t, b in zip(refitted, besides, strict=True) if b])
        each = {
            t.number: replace(t, log_evidence=t.log_evidence - first.log_evidence, drop=1.0 - (1.0 - t.drop) / left)
            for t in sorted(whole, key=lambda t: -t.log_evidence)
        }
        out, at = [*refitted], [i for i, t in enumerate(refitted) if t.number in each]
        for i, t in zip(at, each.values(), strict=True):
            out[i] = t
        holds = [t.number in each and t.holds and t.drop > 0.0 and t.log_evidence > 0.0 for t in out]
        return out, [s and (h or not b) for s, h, b in zip(same, holds, besides, strict=True)], holds

    def _posterior(self, odds: Floats, among: Bools) -> Floats:
        """Probability of each of these candidates against the others of them and "nothing"."""
        every = np.append(np.where(among, odds, -np.inf), self.s.prior_odds)
        weights = np.exp(every - every.max())
        share: Floats = (weights / weights.sum())[:-1]
        return share

    def _finding(
        self,
        rank: int,
        t: Refitted,
        p: float,
        share: float,
        accepted: bool,
        same: bool,
        beside: bool,
        confused: tuple[Alike, ...],
    ) -> Finding:
        candidate = self.s.candidates[t.number]
        numbers, size = self._numbers(candidate.effect, t.theta, t)
        return Finding(
            rank=rank,
            effect=candidate.effect,
            theta=t.theta,
            parameters=numbers,
            channels=candidate.effect.channels(self.s.model.machine),
            heldout_drop=t.drop,
            confidence=share,
            log_evidence=t.log_evidence,
            p=p,
            size_um=size,
            accepted=accepted and rank == 1,
            group=accepted and (rank == 1 or same),
            confused_with=confused if rank == 1 and accepted else (),
            why_not="" if rank == 1 else self._why_not(t, same and accepted, beside),
            same_components=tuple(same_effects(self.readings, candidate.effect, self.s.model.effects)),
        )

    def _why_not(self, t: Refitted, same: bool, beside: bool) -> str:
        if t.number == self.s.partner:
            return words.TOGETHER
        if beside:
            return words.BESIDE
        if any(t.number == c.number for c in self.s.chain[1:]):
            return words.AMONG
        whole = self.s.chain[-1].log_evidence if self.s.chain else None
        if t.before is not None and not self.s.chain:
            return words.NO_BETTER_BESIDE
        found, winner = self.s.found, self.s.refitted[0]
        one_shape = cosine(found.contribution(winner.number), found.contribution(t.number)) > SAME
        if one_shape and self._of_no_machine(found, t.number):
            return words.OF_NO_MACHINE
        return words.why_not(t.log_evidence, winner.log_evidence, t.gain, same, whole)

    def _rivals(self, found: Screen, winner: Refitted, other: Refitted) -> bool:
        """Whether another candidate may be missing as well as the winner, by these readings and by its size."""
        either = self._same(found, winner, other) or self._disputes(found, winner, other)
        return either and not self._of_no_machine(found, other.number)

    def _same(self, found: Screen, winner: Refitted, other: Refitted) -> bool:
        """Whether these readings cannot distinguish another candidate from the winner."""
        if winner.number == other.number:
            return True
        if self._by_chance(winner, other.number, other.theta):
            return False
        if self.s.chain:
            return cosine(found.contribution(winner.number), found.contribution(other.number)) > SAME
        if other.number == self.s.partner:
            return False
        if winner.log_evidence - other.log_evidence < WITHIN:
            return True
        one = found.variants[found.best[winner.number]]
        two = found.variants[found.best[other.number]]
        if two.count > one.count:
            return False  # it contains the winner, and the rest explains nothing more
        cos = cosine(found.contribution(winner.number), found.contribution(other.number))
        return cos > SAME and winner.log_evidence - other.log_evidence < 2.0 * WITHIN

    def _of_no_machine(self, found: Screen, number: int) -> bool:
        """Whether a candidate would have a size that no machine has, unlike the first."""
        return self.s.refits.of_no_machine(found, number, self.s.refitted[0].number)

    def _by_chance(self, winner: Refitted, number: int, theta: Mapping[str, float]) -> bool:
        """Whether another wave is the winner's only because its free period happens to be that of the screw."""
        mine, other = (self.s.candidates[n].effect for n in (winner.number, number))
        machine = self.s.model.machine
        wave = isinstance(mine, Cyclic) and not coincides(mine, winner.theta, machine)
        return wave and coincides(other, theta, machine)

    def _disputes(self, found: Screen, winner: Refitted, other: Refitted) -> bool:
        """Whether held-out runs favour an effect that the evidence ranks behind the winner; or hardly distinguish the
        two, and the evidence does so only by what another sensor may feign.

        One that is not significant by itself must explain the same part of the readings.
        """
        if self.s.chain or not other.holds or other.log_evidence <= 0.0:
            return False
        sure = other.log_evidence - self.s.prior_odds > SURE
        if not sure and cosine(found.contribution(winner.number), found.contribution(other.number)) < APART:
            return False
        near = winner.log_evidence - other.log_evidence < FEIGNED
        if predicts_better(other, winner):
            return sure or near
        sensors = set(self.readings.machine.sensor_names)
        one, two = (
            sensors & set(self.s.candidates[t.number].effect.channels(self.readings.machine)) for t in (winner, other)
        )
        alike = 1.0 - winner.drop > BETTER * (1.0 - other.drop)
        return bool(one and two) and one != two and near and alike

    def _alikes(self, found: Screen, besides: Sequence[int]) -> list[Alike]:
        """Effects confounded with the first: the refitted ones by evidence, the others by shape.

        Args:
            found: screen of all candidates.
            besides: numbers of those that may be missing besides, the likeliest first.
        """
        refitted, winner = self.s.refitted, self.s.refitted[0]
        mine = self.s.candidates[winner.number].effect
        shape = found.contribution(winner.number)
        width = found.variants[found.best[winner.number]].count
        # One of each name: each sensor has a name of its own; of pairs of sensors that move together one is enough.
        out: dict[tuple[str, str, str], tuple[Alike, int]] = {}
        fitted = {t.number: t for t in refitted}
        for number in found.order[:LOOKED_AT]:
            if number == winner.number:
                continue
            other = self.s.candidates[number].effect
            cos = cosine(shape, found.contribution(number))
            if number in fitted:
                same = self._rivals(found, winner, fitted[number])
                behind = winner.log_evidence - fitted[number].log_evidence
            else:
                same = cos > SAME and found.variants[found.best[number]].count <= width
                same = same and not self._by_chance(winner, number, self._theta(found, number))
                same = same and not self._of_no_machine(found, number)
                behind = 0.0
            if same:
                name = other.effect, other.component, getattr(other, "sensor", None) or ""
                fitted_as = FittedEffect(other, {}, self._theta(found, number))
                out.setdefault(name, (replace(alike(mine, other, cos, behind), fitted=fitted_as), number))
        rivals = [r for r in out.values() if not r[0].apart]
        listed = self._separated(found, winner, rivals) if self.s.explain else [a for a, _ in rivals]
        if of_places(mine, self.readings):
            listed = [
                replace(a, separating_test=TEST)
                if a.fitted is not None and not_separated(a.fitted.effect, self.readings) is not None
                else a
                for a in listed
            ]
        apart = {n: a for a, n in out.values() if a.apart}
        listed += [apart[n] for n in besides if n in apart]
        part = winner.columns @ winner.fit.values[self._first(winner) :][: winner.columns.shape[1]]
        if getattr(mine, "grows_with", None) is not None:
            return listed  # the model has the wave itself: its period is not in question
        asked = (
            fold(self.readings, self.s.prepared.base, mine, winner.theta, part),
            curve_or_wave(self.readings, self.s.prepared.base, mine, part),
            self._pitch(winner),
            as_place(mine, self.readings),
            bent_part(mine, self._coefficient(winner), self._beside(winner, refitted)),
        )
        return [*listed, *(a for a in asked if a is not None)]

    def _theta(self, found: Screen, number: int) -> Mapping[str, float]:
        """The best non-linear parameters of a candidate in the screen."""
        return self.s.candidates[number].thetas[found.variants[found.best[number]].theta]

    def _coefficient(self, t: Refitted) -> float:
        """The first number of a candidate."""
        return float(t.fit.values[self._first(t)])

    def _beside(self, winner: Refitted, refitted: Sequence[Refitted]) -> list[tuple[Effect, float]]:
        """Effects that are named with the winner, and those of the model, with their first coefficients."""
        named = [t for t in (*refitted, *self.s.chain[1:]) if t.number == self.s.partner or t in self.s.chain[1:]]
        out = [(self.s.candidates[t.number].effect, self._coefficient(t)) for t in named if t.number != winner.number]
        return out + [(f.effect, next(iter(f.values.values()), 0.0)) for f in self.s.model.effects]

    def _first(self, t: Refitted) -> int:
        """Place of a candidate's first number in its fit."""
        return self.s.prepared.base.shape[1] if t.before is None else t.before

    def _pitch(self, winner: Refitted) -> Alike | None:
        """The screw of another pitch that may cause the winner's wave, where the machine file's pitch does not."""
        effect = self.s.candidates[winner.number].effect
        axis = getattr(effect, "axis", None)
        if getattr(effect, "grows_with", None) is not None or any(
            f.effect.effect == "cyclic_screw" and getattr(f.effect, "axis", None) == axis for f in self.s.model.effects
        ):
            return None  # the model has the wave once a turn: the pitch is right
        first = self._first(winner)
        numbers = winner.fit.values[first : first + winner.columns.shape[1]]
        return pitch_in_doubt(effect, winner.theta, self.s.model.machine, numbers)

    def _doubts(self, findings: Sequence[Finding]) -> tuple[Doubt, ...]:
        """Doubts about the record, and about the machine file where the finding raises them."""
        if not (findings and findings[0].accepted):
            slow = (
                unrecorded_heat(self.readings, self.s.refits.current) or self._heat_by_time() or self._drift(findings)
            )
            return (*self.s.doubts, *([slow] if slow is not None else []))
        first, out = self.s.refitted[0], list(self.s.doubts)
        asked = self._pitch(first)
        if asked is not None:
            message = f"Is pitch_mm right? The wave that is missing is that of a screw: {asked.why}."
            out.append(Doubt("wrong_pitch", message, words.sentence(asked.separating_test)))
        effect, machine = self.s.candidates[first.number].effect, self.s.model.machine
        substitute, slow = substitute_sensor(self.readings, effect, [f.effect for f in self.s.model.effects]), None
        named = [
            first.number,
            *([self.s.partner] if self.s.partner is not None else []),
            *(t.number for t in self.s.chain),
        ]
        prompt = [n for n in named if not self._delayed(n)] or named
        read = {c for n in prompt for c in self.s.candidates[n].effect.channels(machine)}
        if {"spindle_rpm", "time_s", *machine.sensor_names}.isdisjoint(read):
            slow = self._slow_beside(first, findings[0].size_um)
        slow = slow or self._heat_by_time()
        air = beam_in_air(self.readings, [self.s.candidates[n].effect for n in named])
        return (*out, *(d for d in (substitute, slow, air) if d is not None))

    def _drift(self, findings: Sequence[Finding]) -> Doubt | None:
        """Doubt where nothing is named, and a drift by many times the noise, or anything else, stays unexplained."""
        nothing = self.s.unknown is None and self.s.undecided is None and not any(d.fatal for d in self.s.doubts)
        judged = self.s.judged
        if not nothing:
            return None
        if (noise := scatters(judged)) is not None:
            return swings(judged) or noise  # what swings within minutes is no scatter
        if judged.refitted < REFIT * judged.residual:
            return runs_too_few(judged, self._likeliest(findings))
        slow = swings(judged) or drift_by_far(judged, self.s.refits.current)
        rest = unexplained(judged)
        if slow is None and rest is not None and findings and findings[0].heldout_drop > MOSTLY_NAMED:
            return too_few(judged, findings[0].label, findings[0].size_um, findings[0].heldout_drop)
        return slow or rest or runs_too_few(judged, self._likeliest(findings))

    def _likeliest(self, findings: Sequence[Finding]) -> str:
        """The effect of the most evidence, where that is beyond doubt, in words; two runs choose no sensor."""
        first = max(findings, key=lambda f: f.log_evidence, default=None)
        if first is None or first.log_evidence < self.s.prior_odds + SURE:
            return ""
        heat = set(self.s.model.machine.sensor_names) & set(first.effect.channels(self.s.model.machine))
        kind = f"{first.effect.effect} of {first.effect.component}"
        return f"{kind} by a temperature" if heat else kind

    def _heat_by_time(self) -> Doubt | None:
        """Doubt that what has no name is heat: it depends on time, and no temperature changed."""
        unknown = self.s.unknown
        return heat_by_time(self.readings) if unknown is not None and "time_s" in unknown.channels else None

    def _slow_beside(self, first: Refitted, size_um: float) -> Doubt | None:
        """Doubt where more grows and falls slowly than the named effects explain, even if a candidate explains a part.

        An effect that is as significant where slopes change as slowly, or that moves other readings, is no part of that
        growth; it is then reported beside it.
        """
        refits, odds = self.s.refits, self.s.prior_odds
        # A temperature that is delayed at will may stand for heat that nothing recorded.
        chain = list(itertools.takewhile(lambda t: not self._delayed(t.number), self.s.chain))
        last = chain[-1] if chain else first
        slow = unrecorded_heat(self.readings, last.fit, size_um)
        if slow is None:
            return None
        if not self.s.chain and self.s.partner is None:
            sure = [t for t in refits.beside(first) if t.holds and t.log_evidence > first.log_evidence + odds + SURE]
            best = max(sure, key=lambda t: t.log_evidence, default=first)
            slow = slow if best is first else unrecorded_heat(self.readings, best.fit, size_um)
        apart = first.drop >= NOTHING_MUCH and refits.beside_slopes(first) - odds >= SURE
        named = np.concatenate([t.columns for t in chain or [first]], axis=1)
        apart |= unrecorded_heat(self.readings, last.fit, size_um, named) is None or refits.slopes_stay(last)
        return replace(slow, fatal=False) if slow is not None and apart else slow

    def _delayed(self, number: int) -> bool:
        return bool(getattr(self.s.candidates[number].effect, "lag", False))

    def _separated(self, found: Screen, winner: Refitted, alikes: Sequence[tuple[Alike, int]]) -> list[Alike]:
        """The same, each with the shortest test that this machine can take and that separates them."""
        whitener, base = self.s.prepared.whitener, self.s.prepared.base

        def fitted(number: int, theta: Mapping[str, float]) -> FittedEffect:
            return fitted_to(whitener, base, self.s.candidates[number].effect, theta)

        mine = fitted(winner.number, winner.theta)
        known = {n: self._theta(found, n) for _, n in alikes}
        known |= {t.number: t.theta for t in self.s.refitted}
        others = [(a, fitted(n, known[n])) for a, n in alikes]
        try:
            return list(with_gains(others, mine, self.s.model, whitener))
        except RtecError:  # a machine that no planned test can be simulated on: the catalogue's words stay
            return [a for a, _ in alikes]

    def _numbers(self, effect: Effect, theta: Mapping[str, float], t: Refitted) -> tuple[dict[str, Number], float]:
        machine = self.s.model.machine
        at = dict(theta)
        linear = effect.coefficients(machine)
        first = self._first(t)
        values = t.fit.values[first : first + len(linear)]
        fitted = FittedEffect(effect, {p.name: float(v) for p, v in zip(linear, values, strict=True)}, at)
        slopes = [slope(fitted, self.readings, name, values) for name in at]
        whole = np.concatenate([t.fit.columns, *[s[:, None] for s in slopes]], axis=1)
        white = t.fit.whitener(whole)
        # Where others can replace a number, the pseudo-inverse knows only the share that it assigned to it.
        spread = np.where(resolved(white) > DECIDED, np.sqrt(np.maximum(np.diag(inverse(white)), 0.0)), 0.0)
        spread = np.concatenate([spread[first : first + len(linear)], spread[t.fit.columns.shape[1] :]])
        numbers = {
            p.name: Number(v, float(se) if se > 0.0 and determined(p, v, float(se)) else None, p.unit)
            for p, v, se in zip(
                (*linear, *effect.nonlinear(machine)), (*map(float, values), *at.values()), spread, strict=True
            )
        }
        part = t.columns @ values
        # What the current model could have explained is no part of the effect's contribution.
        base = self.s.prepared.base
        part = part - base @ solve(t.fit.whitener(base), t.fit.whitener(part))
        part = floor.cleaned(self.readings, part)
        return numbers, self.s.judged.pooled(part)

    def _noise(self, findings: Sequence[Finding]) -> Whitener:
        """The best estimate of the noise: with the named effects in the mean."""
        accepted = bool(findings) and findings[0].accepted
        return self.s.refitted[0].fit.whitener if accepted and self.s.refitted else self.s.prepared.whitener

    def _answer(
        self,
        found: Screen,
        findings: tuple[Finding, ...],
        adequacy: float | None,
        unknown: Unknown | None,
    ) -> Diagnosis:
        readings, prepared, judged = self.readings, self.s.prepared, self.s.judged
        accepted = bool(findings) and findings[0].accepted
        doubts = self._doubts(findings)
        if accepted and any(d.kind == "no_temperature" and d.fatal for d in doubts):
            verdict = "undecided"  # the effect may be part of a larger slow change that is unexplained
        elif accepted:
            verdict = "missing_effect"
        elif unknown is not None:
            verdict = "unknown_effect"
        elif self.s.undecided is not None or any(d.decides_nothing for d in doubts):
            verdict = "undecided"
        else:
            verdict = "nothing_missing"
        beside = self.s.beside or found
        significant_too = [self.s.candidates[i].effect.label for i in significant(beside, self.s.prior_odds)]
        absent, unseen = absent_effects((found, beside), findings if accepted else (), self.s.prior_odds)
        smallest = float(np.median([a.smallest for a in absent])) if absent else math.nan
        shown = self._shown(findings, unknown)
        draft = Diagnosis(
            verdict=verdict,  # type: ignore[arg-type]
            sentence="",
            unit=judged.unit,
            rms_residual=judged.residual,
            noise_floor=judged.noise_floor,
            adequacy=adequacy,
            findings=findings,
            unknown=self._located(unknown),
            not_testable=(*untestable(self.s.untried, found), *unseen),
            absent=absent,
            notes=(
                *(d.words for d in doubts),
                *(lag_assumed(readings, findings[0].effect, findings[0].theta) if accepted else ()),
                *(words.beside(significant_too) if self.s.beside is not None else ()),
                *run_drifts(readings, (self.s.refitted[0].fit if accepted else self.s.refits.current).left),
                *outlier_words(prepared.wrong),
                *words.notes(
                    [m.name for m in readings.measurements],
                    any(t in state.channels for state in readings.states for t in readings.machine.sensor_names),
                ),
            ),
            noise=tuple(
                n.words(f"{readings.measurements[s.source].name} {s.column}", s.unit)
                for s, n in zip(readings.series, self._noise(findings).noises, strict=True)
            ),
            seed=self.s.seed,
            picture=shown,
            together=tuple(self._member(t) for t in self.s.chain),
            refit=judged.refitted,
            judged=judged,
            doubts=doubts,
            runs=self.s.undecided,
        )
        if verdict == "missing_effect" and len(words.indistinguishable(draft)) > 1:
            draft = replace(draft, verdict="ambiguous")
        fatal = [d.words for d in draft.doubts if d.fatal]
        asks = draft.named_drop < MOSTLY_NAMED  # a named effect answers the question whose file it is
        foreign = [d.words for d in draft.doubts if d.kind == "other_machine"] if asks else []
        foreign += [d.words for d in draft.doubts if d.kind in BESIDE_A_NAME and not d.fatal]
        return words.with_sentence(draft, smallest, fatal, foreign)

    def _member(self, t: Refitted) -> Member:
        effect, machine = self.s.candidates[t.number].effect, self.s.model.machine
        linear = [p.name for p in effect.coefficients(machine)]
        values = dict(zip(linear, map(float, t.fit.values[self._first(t) :][: len(linear)]), strict=True))
        rivals = tuple(dict.fromkeys(self.s.candidates[i].effect.label for i in t.rivals))
        return Member(FittedEffect(effect, values, dict(t.theta)), t.drop, rivals)

    @cached_property
    def _typed(self) -> Typed | None:
        """The error without a name, as an expression for `--expr`."""
        if self.s.unknown is None or self.s.shape is None or not self.s.explain:
            return None
        return propose(self.readings, self.s.prepared.base, self.s.shape)

    def _located(self, unknown: Unknown | None) -> Unknown | None:
        if unknown is None or self._typed is None:
            return unknown
        t = self._typed
        if self._heat_by_time() is not None:
            return replace(unknown, where=t.where)  # the time of this record is no channel of another day
        return replace(
            unknown, where=t.where, expression=t.expression, parameters=t.parameters, feeds=t.component,
            within=self._within(t.effect),
        )  # fmt: skip

    def _within(self, effect: Effect) -> tuple[tuple[str, float, float], ...]:
        """Range of these readings, of each temperature, load and speed that an effect reads."""
        machine = self.s.model.machine
        given = {"spindle_rpm", "load_kg", "force_n", *machine.sensor_names}
        values = {n: self.readings.channel(n) for n in effect.channels(machine) if n in given}
        return tuple((n, float(np.nanmin(v)), float(np.nanmax(v))) for n, v in values.items())

    def _shown(self, findings: Sequence[Finding], unknown: Unknown | None) -> Picture | None:
        """Figure of the named effect or of the shape without a name."""
        if unknown is not None and not self.s.chain:
            shape = self.s.shape
            if shape is None:
                return None
            if self._typed is not None:
                label = f"{self._typed.component}: {self._typed.where or 'what has no name'}"
                return picture.of_effect(
                    self.readings, self.s.prepared.base, shape.fit.whitener, label, self._typed.effect,
                    self._typed.theta,
                )  # fmt: skip
            return picture.of_shape(
                self.readings, self.s.prepared.base, self.s.prepared.whitener, shape.columns, shape.shape.variables
            )
        if findings and findings[0].accepted:
            first, mine = findings[0], self.s.refitted[0].number
            beside = [self._member(t).fitted for t in self.s.chain if t.number != mine]
            return picture.of_effect(
                self.readings, self.s.prepared.base, self._noise(findings), first.label, first.effect, first.theta,
                beside,
            )  # fmt: skip
        return None

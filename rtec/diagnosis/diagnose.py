"""Finds the effect that a model misses: whiten, evidence, refit, veto, alias, adequacy.

The steps are those of `docs/diagnose.md`. Ranking is easy, refusing is hard: a name is given only where chance is
unlikely (family-wise), the evidence holds with the noise found anew, and runs that were left out get better.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis import floor, picture, shapes, words
from rtec.diagnosis.alias import SAME, WITHIN, alike, cosine, directness, diverse, plausibility
from rtec.diagnosis.base import base_of, slope, spikes
from rtec.diagnosis.candidates import Untried, library
from rtec.diagnosis.noise import Whitener, find_noise, without_drift
from rtec.diagnosis.readings import Readings, read
from rtec.diagnosis.refit import Fit, fit_columns, held_out, inverse, solve
from rtec.diagnosis.result import Absent, Alike, Diagnosis, Finding, NotTestable, Number, Picture, Unknown
from rtec.diagnosis.screen import UNMOVED, Projected, Screen, screen
from rtec.effects import Effect
from rtec.metrology.characterise.threads import one_blas_thread
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model

Floats = NDArray[np.float64]
Stage = Callable[[str, int, int], None]

TOP = 7
OF_A_KIND = 3
"""At most so many of the top are the same effect of the same component with other arguments."""
DISTINCT, ONE = 80, 0.9999
"""So many of the best are looked through for shapes that are one and the same, and what counts as that."""
LOOKED_AT = 60
"""Candidates whose shape is compared with the winner's."""
SURE, OVERWHELMING = math.log(20.0), math.log(50.0)
"""Posterior odds, as logarithms, that a name needs; and that need no draws of chance."""
BESIDE = 3
"""Effects that are tried beside the best, before it is given up for a shape without a name."""
SHAPES = 4
"""Shapes without a name that are fitted anew, of each of the two looks."""
ADEQUATE, LEAST = 0.95, 0.7
"""An effect that explains this share of what the best shape explains describes it, though the shape be likelier; and
one below the least describes nothing."""
MOST = 14
"""And never more than so many."""
ALPHA, DRAWS = 0.05, 400


@dataclass(frozen=True)
class Prepared:
    """Readings without spikes, the current model's columns, and the noise.

    Attributes:
        readings: temperatures smoothed.
        base: columns of the current model, (m, p).
        predicted: what it says, (m,).
        whitener: the noise.
        spikes: how many readings were left out.
    """

    readings: Readings
    base: Floats
    predicted: Floats
    whitener: Whitener
    spikes: int


def prepare(model: Model, measurements: Sequence[Measurement]) -> Prepared:
    """Read, leave out spikes, find the noise."""
    readings = read(measurements, model.reference_degc)
    base = base_of(model, readings)
    left = floor.cleaned(readings, readings.values - base.columns @ solve(base.columns, readings.values))
    lonely = spikes(readings, left)
    if lonely.any():
        readings = readings.without(lonely)
        base = base_of(model, readings)
    return Prepared(readings, base.columns, base.predicted, find_noise(readings, base.columns), int(lonely.sum()))


def diagnose(
    model: Model,
    measurements: Sequence[Measurement],
    *,
    seed: int = 1,
    alpha: float = ALPHA,
    draws: int = DRAWS,
    only: Sequence[str] | None = None,
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
        stage: told how far it is.

    Raises:
        MeasurementError: the measurements do not fit together, or lack a channel that the model needs.
    """
    with one_blas_thread():
        return _Search(model, measurements, seed, alpha, draws, only, stage or (lambda *_: None)).diagnosis()


@dataclass(frozen=True)
class Tried:
    """A candidate fitted along with the current model and a noise found anew."""

    number: int
    theta: int
    columns: Floats
    fit: Fit
    log_evidence: float
    drop: float
    gain: float

    @property
    def holds(self) -> bool:
        """Whether runs that were left out get better, whitened and as they stand."""
        return self.gain > 0.0 and self.drop > 0.0


@dataclass(frozen=True)
class Shaped:
    """A shape without a name, fitted along with the current model and a noise found anew."""

    shape: shapes.Shape
    fit: Fit
    log_evidence: float
    drop: float
    gain: float

    @property
    def holds(self) -> bool:
        """Whether runs that were left out get better."""
        return self.gain > 0.0 and self.drop > 0.0


class _Search:
    def __init__(
        self,
        model: Model,
        measurements: Sequence[Measurement],
        seed: int,
        alpha: float,
        draws: int,
        only: Sequence[str] | None,
        stage: Stage,
    ) -> None:
        self.model, self.seed, self.alpha, self.draws, self.stage = model, seed, alpha, draws, stage
        stage("reading, finding the noise", 0, 1)
        self.prepared = prepare(model, measurements)
        self.readings = self.prepared.readings
        known = [f.effect for f in model.effects]
        candidates, self.untried = library(self.readings, only)
        self.candidates = [c for c in candidates if c.effect not in known]
        self._alternatives = Counter((c.effect.effect, c.effect.component) for c in self.candidates)
        self.rng = np.random.default_rng([seed, 400])
        self._shape: shapes.Shape | None = None
        self._tried: list[Tried] = []
        self._top_shape: Shaped | None = None

    def diagnosis(self) -> Diagnosis:
        """Go through the steps."""
        prepared, readings = self.prepared, self.readings
        projected = Projected.of(prepared.whitener, prepared.base, readings.values)
        found = screen(readings, self.candidates, projected, lambda d, t: self.stage("weighing candidates", d, t))
        self.stage("what chance can do", 0, 1)
        p, _ = found.family_p(self.draws, self.rng)
        tried = self._refit(found, self._second_look())
        self._tried = tried
        best = tried[0] if tried else None
        accepted = best is not None and self._accepts(best, p)
        named, adequacy, unknown = self._adequate(projected, best if accepted else None)
        findings = self._findings(found, tried, p, accepted and named)
        return self._answer(projected, found, findings, adequacy, unknown)

    def _accepts(self, best: Tried, p: float) -> bool:
        """Chance is unlikely, or the evidence with the noise found anew is overwhelming; and left-out runs agree.

        The draws of chance know only the noise that was found without the effect; where that noise swallowed it, they
        make chance look better than it is.
        """
        beyond = best.log_evidence - self._prior_odds
        return best.holds and beyond > SURE and (p < self.alpha or beyond > OVERWHELMING)

    @property
    def _prior_odds(self) -> float:
        """Log of how much likelier nothing is than any one effect of one component, before the readings."""
        return math.log(max(len(self._alternatives), 2))

    def _second_look(self) -> Screen:
        """The same weighing as if there were hardly any drift: the noise may have swallowed what is looked for."""
        calm = without_drift(self.prepared.whitener)
        projected = Projected.of(calm, self.prepared.base, self.readings.values)
        return screen(self.readings, self.candidates, projected)

    def _choice_cost(self, number: int) -> float:
        """What the choice among sensors takes off: every effect of a component is as likely before, whatever it takes.

        Else an effect that may use any pair of eight sensors would be 28 times as likely as one that uses one.
        """
        mine = self.candidates[number].effect
        return math.log(self._alternatives[mine.effect, mine.component])

    def _fit(self, columns: Floats) -> Fit:
        """Fit from the noise that was found, and from hardly any drift; the likelier of the two."""
        fits = [fit_columns(w, columns) for w in (self.prepared.whitener, without_drift(self.prepared.whitener))]
        return max(fits, key=lambda f: f.log_likelihood)

    def _refit(self, found: Screen, calm: Screen) -> list[Tried]:
        """Fit the best of both weighings anew, noise and all; best first."""
        base = self.prepared.base
        self._without = without = self._fit(base)
        looks = [(found, i) for i in self._top(found)]
        seen = {i for _, i in looks}
        looks += [(calm, i) for i in self._top(calm) if i not in seen and i in found.best]
        n = math.log(len(self.readings))
        out = []
        for done, (look, number) in enumerate(looks):
            self.stage("fitting the best anew", done, len(looks))
            variant = look.variants[look.best[number]]
            candidate = self.candidates[number]
            columns = self._columns(number, variant.theta)
            fit = self._fit(np.concatenate([base, columns], axis=1))
            evidence = fit.log_likelihood - without.log_likelihood - 0.5 * variant.count * n
            evidence -= look.search_cost(number) + self._choice_cost(number)
            evidence += plausibility(candidate.effect, fit.values[base.shape[1] :], self.model.machine)
            drop, gain = self._left_out(fit.whitener, columns)
            out.append(Tried(number, variant.theta, columns, fit, evidence, drop, gain))
        # What does worse on runs left out is no winner, whatever its evidence.
        return sorted(out, key=lambda t: (not t.holds, -t.log_evidence))

    def _columns(self, number: int, theta: int) -> Floats:
        """Columns of a candidate; one that hardly moves the readings at its usual size is nothing but rounding."""
        effect = self.candidates[number].effect
        columns = self.readings.columns(effect, self.candidates[number].thetas[theta])
        usual = np.array([p.typical for p in effect.coefficients(self.model.machine)])
        live = np.sqrt(np.mean(columns**2, axis=0)) * usual > UNMOVED
        return np.asarray(columns * live)

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

    def _adequate(self, projected: Projected, best: Tried | None) -> tuple[bool, float | None, Unknown | None]:
        """Is the best effect as good as a shape without a name; and if none is, what is there?"""
        self.stage("shapes without a name", 0, 1)
        tops = self._shapes(projected, best)
        top = max(tops, key=lambda t: t.log_evidence, default=None)
        self._top_shape = top
        if best is None:
            sure = top is not None and top.log_evidence > OVERWHELMING
            return False, None, self._unknown(top) if sure and top is not None else None
        adequacy = self._adequacy(best, tops)
        if top is None or top.log_evidence < best.log_evidence + WITHIN:
            return adequacy >= LEAST, adequacy, None
        # A shape without a name is likelier; where the effect is almost that shape, or is one of two that together are
        # likelier than it, the name is the better answer still.
        named = adequacy >= ADEQUATE or self._with_another(best) > top.log_evidence
        return named, adequacy, None if named else self._unknown(top)

    def _with_another(self, best: Tried) -> float:
        """Log evidence of the best effect together with the best one beside it."""
        base = np.concatenate([self.prepared.base, best.columns], axis=1)
        beside = Projected.of(best.fit.whitener, base, self.readings.values)
        found = screen(self.readings, self.candidates, beside)
        out = -math.inf
        for number in self._distinct(found)[:BESIDE]:
            variant = found.variants[found.best[number]]
            columns = self._columns(number, variant.theta)
            fit = self._fit(np.concatenate([base, columns], axis=1))
            gain = fit.log_likelihood - best.fit.log_likelihood - 0.5 * variant.count * math.log(len(self.readings))
            out = max(out, best.log_evidence + gain - found.search_cost(number) - self._choice_cost(number))
        return out

    def _shapes(self, projected: Projected, best: Tried | None) -> list[Shaped]:
        """The best shapes without a name, each fitted along with the model and a noise found anew."""
        base, values = self.prepared.base, self.readings.values
        known = Projected.of(best.fit.whitener, base, values) if best is not None else projected
        calm = Projected.of(without_drift(self.prepared.whitener), base, values)
        looks = [shapes.all_shapes(self.readings, p) for p in (known, calm)]
        picked: dict[tuple[str, tuple[str, ...], str], shapes.Weighed] = {}
        for weighed in looks:
            fresh = 0
            for w in sorted(weighed, key=lambda w: -w.log_evidence):
                key = (w.shape.group, w.shape.variables, w.shape.kind)
                if key not in picked and w.shape.raw.size:  # the columns of those far behind are forgotten
                    picked[key] = w
                    fresh += 1
                if fresh == SHAPES:
                    break
        count = max(len(looks[0]), 2)
        out = [self._shaped(w, count) for w in picked.values()]
        return [s for s in out if s.holds]

    def _shaped(self, w: shapes.Weighed, count: int) -> Shaped:
        fit = self._fit(np.concatenate([self.prepared.base, w.shape.raw], axis=1))
        evidence = fit.log_likelihood - self._without.log_likelihood
        evidence -= 0.5 * w.count * math.log(len(self.readings)) + math.log(count)
        drop, gain = self._left_out(fit.whitener, w.shape.raw)
        return Shaped(w.shape, fit, evidence, drop, gain)

    def _adequacy(self, best: Tried, tops: Sequence[Shaped]) -> float:
        """What the effect explains over what the best shape explains, under the noise of each shape."""
        out = 1.0
        for t in tops:
            known = Projected.of(t.fit.whitener, self.prepared.base, self.readings.values)
            mine = shapes.weigh(known, shapes.Shape("", (), "smooth", None, best.columns))
            its = shapes.weigh(known, t.shape)
            if its is not None and t.log_evidence > 0.0:
                out = min(out, (mine.explained if mine else 0.0) / max(its.explained, 1e-9))
        return out

    def _unknown(self, top: Shaped) -> Unknown:
        self._shape = shape = top.shape
        period = None
        if shape.period is not None:
            period = Number(shape.period, None, words.unit_of_channel(shape.variables[0]))
        chance = math.exp(-min(top.log_evidence, 50.0))
        return Unknown(shape.group, shape.variables, shape.kind, period, chance, top.drop)

    def _findings(self, found: Screen, tried: list[Tried], p: float, accepted: bool) -> tuple[Finding, ...]:
        if not tried:
            return ()
        odds = np.array([t.log_evidence for t in tried])
        top = max(float(odds.max()), self._prior_odds)
        weights, none = np.exp(odds - top), math.exp(self._prior_odds - top)
        posterior = weights / (weights.sum() + none)
        return tuple(
            self._finding(found, rank, t, tried, p, float(share), accepted)
            for rank, (t, share) in enumerate(zip(tried, posterior, strict=True), 1)
        )

    def _finding(
        self, found: Screen, rank: int, t: Tried, tried: Sequence[Tried], p: float, share: float, accepted: bool
    ) -> Finding:
        candidate, winner = self.candidates[t.number], tried[0]
        theta = candidate.thetas[t.theta]
        same = self._same(found, winner, t)
        confused = tuple(self._alikes(found, t, tried)) if rank == 1 and accepted else ()
        numbers, size = self._numbers(candidate.effect, theta, t)
        return Finding(
            rank=rank,
            effect=candidate.effect,
            theta=theta,
            parameters=numbers,
            channels=candidate.effect.channels(self.model.machine),
            heldout_drop=t.drop,
            confidence=share,
            log_evidence=t.log_evidence,
            p=p,
            size_um=size,
            accepted=accepted and rank == 1,
            group=accepted and (rank == 1 or same),
            confused_with=confused,
            why_not=words.why_not(t.log_evidence, winner.log_evidence, t.gain, same and accepted) if rank > 1 else "",
        )

    def _same(self, found: Screen, winner: Tried, other: Tried) -> bool:
        """Whether the readings cannot tell another candidate from the winner."""
        if winner.number == other.number:
            return True
        if winner.log_evidence - other.log_evidence < WITHIN:
            return True
        one = found.variants[found.best[winner.number]]
        two = found.variants[found.best[other.number]]
        if two.count > one.count:
            return False  # it holds the winner and more, and the more buys nothing
        cos = cosine(found.contribution(winner.number), found.contribution(other.number))
        return cos > SAME and winner.log_evidence - other.log_evidence < 2.0 * WITHIN

    def _alikes(self, found: Screen, winner: Tried, tried: Sequence[Tried]) -> list[Alike]:
        """What cannot be told from the winner: of those fitted anew by their evidence, of the others by their shape."""
        mine = self.candidates[winner.number].effect
        shape = found.contribution(winner.number)
        width = found.variants[found.best[winner.number]].count
        out: dict[tuple[str, str], Alike] = {}
        fitted = {t.number: t for t in tried}
        for number in found.order[:LOOKED_AT]:
            if number == winner.number:
                continue
            other = self.candidates[number].effect
            cos = cosine(shape, found.contribution(number))
            if number in fitted:
                same = self._same(found, winner, fitted[number])
                behind = winner.log_evidence - fitted[number].log_evidence
            else:
                same = cos > SAME and found.variants[found.best[number]].count <= width
                behind = 0.0
            if same:
                out.setdefault((other.effect, other.component), alike(mine, other, cos, behind))
        return list(out.values())

    def _numbers(self, effect: Effect, theta: Mapping[str, float], t: Tried) -> tuple[dict[str, Number], float]:
        machine = self.model.machine
        at = dict(theta)
        first = self.prepared.base.shape[1]
        values = t.fit.values[first:]
        linear = effect.coefficients(machine)
        fitted = FittedEffect(effect, {p.name: float(v) for p, v in zip(linear, values, strict=True)}, at)
        slopes = [slope(fitted, self.readings, name, values) for name in at]
        whole = np.concatenate([t.fit.columns, *[s[:, None] for s in slopes]], axis=1)
        spread = np.sqrt(np.maximum(np.diag(inverse(t.fit.whitener(whole))), 0.0))[first:]
        numbers = {
            p.name: Number(v, float(se), p.unit)
            for p, v, se in zip(
                (*linear, *effect.nonlinear(machine)), (*map(float, values), *at.values()), spread, strict=True
            )
        }
        part = t.columns @ values
        # What the current model could have taken up is not of the effect's making.
        base = self.prepared.base
        part = part - base @ solve(t.fit.whitener(base), t.fit.whitener(part))
        part = floor.cleaned(self.readings, part)
        scale = self._scale()
        return numbers, floor.pooled(self.readings, floor.rms_by_series(self.readings, part), scale)

    def _noise(self, findings: Sequence[Finding]) -> Whitener:
        """The noise as it is known best: with what was found in the mean."""
        accepted = bool(findings) and findings[0].accepted
        return self._tried[0].fit.whitener if accepted and self._tried else self.prepared.whitener

    def _scale(self) -> Floats:
        if floor.unit_of(self.readings) != "noise":
            return np.ones(len(self.readings.series))
        return 1.0 / np.maximum(floor.floors(self.prepared.whitener), 1e-12)

    def _answer(
        self,
        projected: Projected,
        found: Screen,
        findings: tuple[Finding, ...],
        adequacy: float | None,
        unknown: Unknown | None,
    ) -> Diagnosis:
        readings, prepared = self.readings, self.prepared
        scale = self._scale()
        left = floor.cleaned(readings, readings.values - prepared.predicted)
        rms = floor.pooled(readings, floor.rms_by_series(readings, left), scale)
        noise = min(floor.pooled(readings, floor.floors(self._noise(findings)), scale), rms)
        accepted = bool(findings) and findings[0].accepted
        group = [f for f in findings if f.group]
        if unknown is not None:
            verdict = "unknown_effect"
        elif accepted:
            verdict = "ambiguous" if len(group) > 1 or findings[0].confused_with else "missing_effect"
        else:
            verdict = "nothing_missing"
        unit = floor.unit_of(readings)
        absent = _absent(found, findings if accepted else (), projected)
        smallest = float(np.median([a.smallest for a in absent])) if absent else math.nan
        shown = self._shown(findings, unknown)
        draft = Diagnosis(
            verdict=verdict,  # type: ignore[arg-type]
            sentence="",
            unit=unit,
            rms_residual=rms,
            noise_floor=noise,
            adequacy=adequacy,
            findings=findings,
            unknown=unknown,
            not_testable=_untestable(self.untried, found),
            absent=absent,
            notes=words.notes(prepared.spikes, len(readings), [m.name for m in readings.measurements]),
            noise=tuple(
                n.words(f"{readings.measurements[s.source].name} {s.column}", s.unit)
                for s, n in zip(readings.series, self._noise(findings).noises, strict=True)
            ),
            seed=self.seed,
            picture=shown,
        )
        return words.with_sentence(draft, smallest)

    def _shown(self, findings: Sequence[Finding], unknown: Unknown | None) -> Picture | None:
        """The picture of what was found."""
        if unknown is not None:
            shape = self._shape
            if shape is None:
                return None
            return picture.of_shape(self.readings, self.prepared.base, self.prepared.whitener, shape)
        if findings and findings[0].accepted:
            first = findings[0]
            return picture.of_effect(
                self.readings, self.prepared.base, self.prepared.whitener, first.label, first.effect, first.theta
            )
        return None


def _untestable(untried: Sequence[Untried], found: Screen) -> tuple[NotTestable, ...]:
    from rtec.effects.registry import all_effects

    kinds = all_effects()
    out: dict[tuple[str, str], NotTestable] = {}
    for u in untried:
        test = f"measure with {', '.join(kinds[u.effect].about.seen_by)}" if kinds[u.effect].about.seen_by else ""
        out.setdefault((u.effect, u.why), NotTestable(u.effect, u.component, u.why, test))
    gone = {found.candidates[i].effect.effect for i in found.absorbed}
    there = {found.candidates[v.candidate].effect.effect for v in found.variants}
    for name in sorted(gone - there):
        why = "the current model, or what the instruments cannot know, takes up everything that it would do here"
        out.setdefault(
            (name, why), NotTestable(name, "", why, "vary what drives it, at other places and in other orders")
        )
    return tuple(out.values())


def _absent(found: Screen, findings: Sequence[Finding], projected: Projected) -> tuple[Absent, ...]:
    """The smallest size of each effect that would have been seen, root mean square in the readings."""
    named = {(f.effect.effect, f.effect.component) for f in findings if f.group}
    n, free = float(len(projected.left)), projected.freedom
    noise = projected.squares / free
    family = math.log(max(len(found.best), 2))
    best: dict[tuple[str, str], list[float]] = {}
    readings = projected.whitener.readings
    for i, v in enumerate(found.variants):
        candidate = found.candidates[v.candidate]
        key = (candidate.effect.effect, candidate.effect.component)
        if key in named or found.best[v.candidate] != i:
            continue
        # Evidence ln m needs a gain in log likelihood of ln m + ½ (k + n_θ) ln n.
        searched = math.log(len(candidate.thetas))
        need = 2.0 * (family + searched + 0.5 * v.count * math.log(n)) * noise
        columns = readings.columns(candidate.effect, candidate.thetas[v.theta])
        plain = np.sqrt(np.mean(columns**2, axis=0))
        seen = v.size[:, 1]
        good = seen > 0
        if good.any():
            best.setdefault(key, []).append(float((math.sqrt(need) * plain[good] / seen[good]).min()))
    units = {s.unit for s in readings.series}
    unit = "um" if units == {"um"} else "urad" if units == {"urad"} else "noise"
    return tuple(Absent(e, c, float(np.median(sizes)), unit) for (e, c), sizes in sorted(best.items()))

"""Finds the effect that a model misses: whiten, evidence, refit, veto, alias, adequacy.

The steps are those of `docs/diagnose.md`. An effect is named only where noise alone is an unlikely cause
(family-wise), the evidence holds with the refitted noise, and held-out runs are predicted better.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from rtec.arrays import Floats
from rtec.diagnosis import words
from rtec.diagnosis.doubts.doubt import Doubt
from rtec.diagnosis.doubts.edits import Edits
from rtec.diagnosis.doubts.not_read import as_well
from rtec.diagnosis.doubts.pre_travel import by_pre_travel
from rtec.diagnosis.doubts.record import doubts, few_runs, targets_apart
from rtec.diagnosis.heat import (
    dead_sensor,
    late_sensor,
    more_than_any_material,
    only_between_files,
    only_time,
    own_warm_up,
    sensor_offset,
    unrecorded_heat,
    warm_up_curves,
)
from rtec.diagnosis.result import Diagnosis, Number, RunsDiffer, Unknown
from rtec.diagnosis.search.answer import SearchResult, answer
from rtec.diagnosis.search.changes import with_changes
from rtec.diagnosis.search.confounded import (
    ALIASES,
    ANOTHER,
    FEIGNED,
    PERIODS,
    WITHIN,
    aliases_mm,
    away,
    cosine,
    step_mm,
)
from rtec.diagnosis.search.drift_alone import drift_makes
from rtec.diagnosis.search.not_found import ALPHA, SURE
from rtec.diagnosis.search.one_feed import not_separated, place_first
from rtec.diagnosis.search.prepared import prepare
from rtec.diagnosis.search.refit import (
    BESIDE,
    MORE,
    NOTHING_MUCH,
    ONE,
    Judged,
    Refits,
    Refitted,
    far_better,
    led,
    predicts_better,
    same_but_finer,
)
from rtec.diagnosis.search.run_drift import runs_differ
from rtec.diagnosis.search.screen import Projected, Screen
from rtec.diagnosis.search.shapes import groups
from rtec.diagnosis.search.unnamed import (
    FewTargets,
    Shaped,
    adequacy,
    best_shapes,
    by_own_sensors,
    curves_of,
    few_targets,
    over_time,
    without_idle,
)
from rtec.diagnosis.usable import check_enough
from rtec.effects import Effect
from rtec.effects.reversal import Backlash
from rtec.estimation.candidates import EffectCandidate, library
from rtec.estimation.given import given_to
from rtec.estimation.gls import along_runs, bic_cost, held_out_gain, solve
from rtec.estimation.judge import Judgement
from rtec.estimation.noise import without_drift
from rtec.estimation.outliers import Clean
from rtec.estimation.visible import behind_arm, read_directly
from rtec.estimation.warmth import EXPANDS
from rtec.machine import Machine
from rtec.machine.chain import component_unit
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.parallel import each, one_blas_thread

Stage = Callable[[str, int, int], None]

OVERWHELMING = math.log(50.0)
"""Log posterior odds above which no random draws are needed; a name needs `SURE` of them."""
FEW = 40.0
"""With so few readings per number any fit looks too good: only random draws under noise alone count."""
ADEQUATE, LEAST = 0.95, 0.7
"""From this share of what the best shape explains on, an effect describes it, even if the shape is likelier.
Below the lower share it describes nothing."""
LITTLE = 0.25
"""A fall of the mean square on held-out runs below this is little."""
MAIN = 0.75
"""An effect that removes more than this share of the held-out mean square is named first, the others after it."""
PLAIN, LEAN = 2, 3
"""Largest number of coefficients of a plain effect, and of one that may be overwhelming though chance is not excluded:
many follow any differences between a few runs."""
MAY = 0.3
"""A candidate that removes this share of the held-out mean square may be why the runs differ, even where too few
runs decide it."""
AS_GOOD = 1.1
"""Held-out mean squares within this factor are equally good."""
HALF = 0.5
"""From this share on it may be so even where a drift is likelier."""
MOSTLY = 0.5
"""Two effects that help only together must remove at least this share of the held-out mean square."""
SEEN = 1e-3
"""A column of which those of the model describe all but this share says nothing."""
OFF_K = 0.5
"""Largest difference, K, that the readings of one thermocouple may have between two files for no reason."""
TIGHT = 0.5
"""Below the temperature at which it is slack, a stretched screw grows less than this share of what it does above."""
HARDLY = 0.1
"""A new delay or place of an effect that the model has by the same sensor must remove this share of the held-out mean
square: sensors are read late and in steps."""
DRAWS = 400


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
    given: Clean | None = None,
    earlier: bool = False,
) -> Diagnosis:
    """Name the effect that a model misses.

    Args:
        model: the current model.
        measurements: of its machine, by any instruments.
        seed: of the random draws.
        alpha: accepted false-positive rate, family-wise.
        draws: number of random draws under noise alone.
        only: names of effects to search for; None for the whole catalogue.
        explain: also work out explanations for people, which takes a second or more: the test of this machine that
            separates confounded effects, and what is also significant beside the named effect.
        stage: progress callback: called with the stage, steps done, steps in total.
        given: the measurements, already read.
        earlier: whether the model's numbers come from other readings although it names these measurements.

    Raises:
        MeasurementError: the measurements do not fit together, are too few, or lack a channel that the model needs.
    """
    check_enough(measurements)
    with one_blas_thread():
        progress = stage or (lambda *_: None)
        progress("reading, finding the noise", 0, 1)
        there = given or given_to(model, measurements).without_ends()
        search = Search(model, there, seed, alpha, draws, only, explain, progress, earlier=earlier)
        found = instead_of_files(search, search.diagnosis())
        return with_changes(found, model, there) if explain else found


def instead_of_files(search: "Search", found: Diagnosis) -> Diagnosis:
    """The diagnosis; where something explains only differences between files, what explains them better without it.

    Two files at two offsets of the instrument differ by the arm of an angle. Their temperatures differ as well.
    """
    if not search.between or not any(d.kind == "between_files" and d.fatal for d in found.doubts):
        return found
    sensors = set(search.model.machine.sensor_names)
    read = {c for _, channels in search.between for c in channels} & search.refits.given
    again = search.without(read | sensors if read & sensors else read)
    other = again.diagnosis()
    return other if other.named_drop > max(d for d, _ in search.between) else found


def _beside(candidate: EffectCandidate, model: Model) -> EffectCandidate | None:
    """A wave of an effect that the model has, at periods other than the model's; None for anything else."""
    there = [f.theta for f in model.effects if f.effect == candidate.effect]

    def apart(theta: Mapping[str, float]) -> bool:
        names = [n for n in theta if n in PERIODS]
        return bool(names) and all(any(abs(t[n] / theta[n] - 1.0) > ANOTHER for n in names) for t in there)

    thetas = tuple(t for t in candidate.thetas if apart(t))
    return replace(candidate, thetas=thetas) if thetas else None


def beats_drift(one: Judged, top: Shaped | None) -> bool:
    """Whether an effect predicts held-out runs far better than the best shape without a name, which is a drift."""
    return top is not None and "time_s" in top.shape.variables and far_better(one, top)


def leaner_first(
    refitted: list[Refitted], effects: Mapping[int, Effect], machine: Machine, bar: float
) -> list[Refitted]:
    """The same; first a significant rival by other sensors that has fewer numbers and predicts held-out runs as well.

    A lag feigns what a sensor lacks. A law by the speed of the spindle knows nothing of the hours before the record.

    Args:
        refitted: the best first.
        effects: by the number of the candidate.
        machine: whose sensors are meant.
        bar: evidence from which a candidate is significant.
    """
    first, sensors = refitted[0], set(machine.sensor_names)

    def read(t: Refitted) -> set[str]:
        return sensors & set(effects[t.number].channels(machine))

    heated = "spindle_rpm" in effects[first.number].channels(machine) and bool(first.theta)

    def numbers(t: Refitted) -> int:
        return int(t.columns.shape[1]) + len(t.theta)

    def farther(t: Refitted) -> bool:
        return away(effects[t.number], machine) > away(effects[first.number], machine)

    rivals = [
        t
        for t in refitted
        if t.holds and t.log_evidence > bar and first.log_evidence - t.log_evidence < FEIGNED
        and numbers(t) < numbers(first) and 1.0 - t.drop <= AS_GOOD * (1.0 - first.drop)
        and (heated or read(first)) and read(t) not in (set(), read(first)) and not farther(t)
    ]  # fmt: skip
    lead = max(rivals, key=lambda t: t.log_evidence, default=first)
    return [lead, *(t for t in refitted if t is not lead)]


def _first(members: Sequence[Refitted], refitted: Sequence[Refitted]) -> list[Refitted]:
    """Candidates in their order, but for some that come first."""
    numbers = [t.number for t in members]
    return [*members, *(t for t in refitted if t.number not in numbers)]


def _rich(members: Sequence[Refitted]) -> bool:
    """Whether one of several effects has many numbers."""
    return any(t.columns.shape[1] > PLAIN for t in members)


class Search:
    """One search for what a model lacks; `diagnose` says what the arguments are."""

    def __init__(
        self,
        model: Model,
        given: Clean,
        seed: int,
        alpha: float,
        draws: int,
        only: Sequence[str] | None,
        explain: bool,
        stage: Stage,
        *,
        earlier: bool = False,
    ) -> None:
        self.model, self.seed, self.alpha, self.draws, self.stage = model, seed, alpha, draws, stage
        self.explain = explain
        self.prepared = prepare(model, given, earlier)
        self.judged = Judgement(model, given)
        self.doubts = doubts(self.judged)
        self.readings = self.prepared.readings
        known = [f.effect for f in model.effects]
        candidates, self.untried = library(self.readings, only, model.effects)
        # A wave may be there twice: with its harmonic.
        self.candidates = [
            c for c in (_beside(c, model) if c.effect in known else c for c in candidates) if c is not None
        ]
        self.refits = Refits(self.prepared, self.candidates, stage)
        self.rng = np.random.default_rng([seed, 400])
        self._top_shape: Shaped | None = None
        self._tops: list[Shaped] = []
        self._few: FewTargets | None = None
        # What explains only differences between files: the share of the mean square that it removes, and its channels.
        self.between: list[tuple[float, frozenset[str]]] = []
        self._offsets = set[str]()  # component errors that a sensor's offset in one of several files explains
        self._earlier = earlier
        self._asked = (model, given, seed, alpha, draws, only, explain, stage)

    def without(self, channels: Collection[str]) -> "Search":
        """The same search among the effects that read none of some channels."""
        return self._among(lambda effect: not set(channels) & set(effect.channels(self.model.machine)))

    def _among(self, may_be: Callable[[Effect], bool]) -> "Search":
        """The same search among some effects."""
        other = Search(*self._asked, earlier=self._earlier)
        other.candidates = [c for c in other.candidates if may_be(c.effect)]
        other.refits = Refits(other.prepared, other.candidates, other.stage)
        return other

    def diagnosis(self) -> Diagnosis:
        """Run the steps and return the answer."""
        projected = self._projected
        found = self.refits.weigh_all(projected)
        self.stage("what chance can do", 0, 1)
        p, _ = found.family_p(self.draws, self.rng)
        refitted, accepted = self._in_order(found, p)
        bar = self._prior_odds + SURE
        if any(t.log_evidence > bar and not self._of_a_material(t) for t in refitted):
            return self._among(lambda effect: not getattr(effect, "stretched", False)).diagnosis()
        best = refitted[0] if refitted else None
        accepted = accepted and not self._of_few_targets(refitted[0])
        named, share, unknown = self._adequate(best if accepted else None)
        pair: tuple[Refitted, Refitted] | None = None
        chain: list[Refitted] = []
        if self._doubted:
            named, unknown = False, None
        else:
            # An effect that explains next to nothing alone, and is named for what it does beside another, is half a
            # pair.
            half = named and refitted[0].drop < LITTLE and share is not None and share < LEAST
            pair, chain, unknown = self._together(refitted, p, unknown, half or not named)
        if best is not None and named and pair is None and not chain and not self._doubted:
            chain = self._by_direction(best, refitted) or self._simple_ones(best, refitted)
        named = named and not self._doubted
        refitted = _first(pair or (), _first(chain[:1], refitted))
        if pair is not None:
            share, unknown = 1.0, None
        if unknown is not None and not chain and self._of_no_machine(unknown, best if accepted else None):
            unknown = None
        named = named or bool(chain) or pair is not None
        if self._few is not None and unknown is None and not named:
            self.doubts = (*self.doubts, targets_apart(self._few.channels, self._few.at_mm.tolist()))
        self.doubts = (*self.doubts, *self._by_probe(chain))
        undecided = None if named else self._undecided(refitted)
        if undecided is not None and (unknown is None or beats_drift(undecided[1], self._top_shape)):
            unknown, refitted = None, _first(undecided[1:], refitted)
        else:
            undecided = None
        return answer(
            SearchResult(
                model=self.model, prepared=self.prepared, candidates=self.candidates, untried=self.untried,
                prior_odds=self._prior_odds, projected=projected, found=found, refits=self.refits,
                refitted=refitted, partner=pair[1].number if pair is not None else None, p=p, accepted=named,
                adequacy=share, unknown=unknown, shape=self._top_shape, seed=self.seed, explain=self.explain,
                beside=self._next(refitted, pair, named), judged=self.judged, doubts=self.doubts,
                chain=tuple(chain), undecided=undecided[0] if undecided is not None else None,
            )
        )  # fmt: skip

    def _by_probe(self, members: Sequence[Refitted]) -> tuple[Doubt, ...]:
        """Doubt that a touch probe's pre-travel makes reversals of one size in all directions; empty for none."""
        plays = dict[str, float]()
        for t in members:
            effect, first = (
                self.candidates[t.number].effect,
                self.prepared.base.shape[1] if t.before is None else t.before,
            )
            if isinstance(effect, Backlash):
                plays[effect.axis] = float(members[-1].fit.values[first])
        return by_pre_travel(self.readings, plays)

    def _in_order(self, found: Screen, p: float) -> tuple[list[Refitted], bool]:
        """Refitted candidates, the one to be named first; and whether noise alone is an unlikely cause of it."""
        again = self.refits.refitted(found, self.refits.weigh_without_drift())
        ordered = led(again, self._prior_odds + SURE, self.prepared.base, self.readings)
        refitted = self._place_first(self._direct_first(self._apart_from_warm_up(self._possible_first(ordered))))
        accepted = bool(refitted) and self._accepts(refitted[0], p)
        return self._direct_first(self._leaner_first(refitted)) if accepted else refitted, accepted

    def _together(
        self, refitted: list[Refitted], p: float, unknown: Unknown | None, seek: bool
    ) -> tuple[tuple[Refitted, Refitted] | None, list[Refitted], Unknown | None]:
        """A pair that helps only together, effects that are missing together, and what has no name beside them.

        Args:
            refitted: candidates, the first one first.
            p: of noise alone.
            unknown: what has no name if nothing is missing together.
            seek: whether no single effect is the answer.
        """
        pair, chain = self._pair(refitted) if seek else (None, [])
        rich, along = pair is not None and _rich(pair), None
        if not chain and unknown is not None and pair is None:
            chain, along = self._beside_curve(p)
        if along is not None:
            unknown = self._of_shape(along)
        elif chain:
            unknown = None
        elif rich or (unknown is not None and pair is None):
            chain = self._chain(refitted, p)
            if chain and unknown is not None and (self._shape_beside(chain) or 0.0) < self._prior_odds + SURE:
                unknown = None  # what stayed beside the best single effect has names, too
        if pair is not None and chain and chain[-1].log_evidence > pair[1].log_evidence - WITHIN:
            pair = None  # two simple effects explain as much as a pair with a complex one
        so_far = [*refitted[:1], *(pair or ()), *chain]
        if p < self.alpha and (unknown is not None or _rich(so_far)):
            shape = [self._top_shape] if self._top_shape is not None else []
            if lean := self._leaner(refitted, max(t.log_evidence for t in (*so_far, *shape))):
                pair, chain, unknown, along = None, lean, None, None
        chain = self._without_instrument(chain)
        if any(self._component(t) in self._offsets for t in (*(pair or ()), *chain)):
            pair, chain = None, []
        self._doubt_files(chain, along)
        return (None, [], None) if self._doubted else (pair, chain, unknown)

    def _direct_first(self, refitted: list[Refitted]) -> list[Refitted]:
        """The same; of one shape and as many numbers a shift that the readings show first, no angle of the same axis.

        With one arm alone nothing separates an angle from a shift. Elsewhere on the machine the angle moves the tool as
        well, in two directions that nobody measured. So a shift by one temperature is before an angle by two, too: the
        difference of two temperatures follows many curves.
        """
        shown = self._shown
        turns = bool(refitted) and component_unit(self._component(refitted[0])) == "urad"
        if not turns or self._component(refitted[0]) in shown:
            return refitted
        lead, width, at = refitted[0], self.prepared.base.shape[1], self._projected

        def part(t: Refitted) -> Floats:
            values = t.fit.values[width : width + t.columns.shape[1]]
            return at.take_out(at.whitener(t.columns @ values)[:, None])[:, 0]

        def stands_for_it(t: Refitted) -> bool:
            near = (
                t.holds and lead.log_evidence - t.log_evidence < WITHIN and t.columns.shape[1] <= lead.columns.shape[1]
            )
            own = self._component(t) in shown and self._component(t)[2:] == self._component(lead)[2:]
            return near and own and cosine(part(t), part(lead)) > ONE

        first = next((t for t in refitted[1:] if stands_for_it(t)), None) or self._by_fewer(refitted) or lead
        return [first, *(t for t in refitted if t is not first)]

    def _by_fewer(self, refitted: list[Refitted]) -> Refitted | None:
        """A shift of the axis of the first angle that the readings show, by fewer channels and no more numbers."""
        lead, machine = refitted[0], self.model.machine

        def rank(t: Refitted) -> tuple[int, int]:
            effect = self.candidates[t.number].effect
            return len(effect.channels(machine)), t.columns.shape[1] + len(t.theta)

        (channels, numbers), mine = rank(lead), self._component(lead)[2:]
        near = [
            (rank(t)[1], -t.log_evidence, i)
            for i, t in enumerate(refitted)
            if t.holds
            and lead.log_evidence - t.log_evidence < WITHIN
            and self._component(t) in self._shown
            and self._component(t)[2:] == mine
            and rank(t)[0] < channels
            and rank(t)[1] <= numbers
            and not self._beyond_materials(t)
        ]
        return refitted[min(near)[2]] if near else None

    def _possible_first(self, refitted: list[Refitted]) -> list[Refitted]:
        """The same; first an effect as likely as one that no material allows, by another sensor.

        Of two or three runs each alone predicts the others badly: there held-out runs decide nothing.
        """
        if not refitted or not self._beyond_materials(refitted[0]):
            return refitted
        few = bool(few_runs(self.readings))
        near = (t for t in refitted if (few or t.holds) and refitted[0].log_evidence - t.log_evidence < WITHIN)
        first = next((t for t in near if not self._beyond_materials(t)), refitted[0])
        return [first, *(t for t in refitted if t is not first)]

    def _of_a_material(self, t: Refitted) -> bool:
        """Whether a candidate may be what it says: a kink in another curve is no screw that is slack from there on.

        Below that temperature a screw hardly grows, and above it no more than a material does.
        """
        effect, values = self.candidates[t.number].effect, t.fit.values
        if not getattr(effect, "stretched", False):
            return True
        slack = abs(float(values[self.prepared.base.shape[1]]))
        below = sum(abs(float(values[i])) for i, n in enumerate(self.judged.base.names) if n == f"{effect.label} k")
        return slack <= EXPANDS and below < TIGHT * slack

    def _beyond_materials(self, t: Refitted) -> Doubt | None:
        effect, width = self.candidates[t.number].effect, self.prepared.base.shape[1]
        return more_than_any_material(self.readings, effect, t.fit, width)

    def _component(self, t: Refitted) -> str:
        return self.candidates[t.number].effect.component

    def _place_first(self, refitted: list[Refitted]) -> list[Refitted]:
        def effect_of(t: Refitted) -> Effect:
            return self.candidates[t.number].effect

        return place_first(refitted, effect_of, self.readings, self._prior_odds + SURE, AS_GOOD)

    def _leaner_first(self, refitted: list[Refitted]) -> list[Refitted]:
        effects = {t.number: self.candidates[t.number].effect for t in refitted}
        return leaner_first(refitted, effects, self.model.machine, self._prior_odds + SURE)

    def _undecided(self, refitted: Sequence[Refitted]) -> tuple[RunsDiffer, Refitted] | None:
        """Differences between runs, and the likeliest effect that may explain them though too few runs decide."""
        most = [t for t in refitted if t.holds and t.drop >= MAY and t.log_evidence > -SURE]
        may = [t for t in most if t.log_evidence > 0.0 or t.drop >= HALF]
        if self._doubted or not may:
            return None
        found = runs_differ(self.readings, self.refits.current.left, self.judged.scale)
        if found is None:
            return None
        first = max(may, key=lambda t: t.log_evidence)
        first = max((t for t in may if far_better(t, first)), key=lambda t: t.log_evidence, default=first)
        return RunsDiffer(*found, type(self.candidates[first.number].effect).about.reveal), first

    def _next(self, refitted: Sequence[Refitted], pair: Sequence[Refitted] | None, named: bool) -> Screen | None:
        """All candidates beside the named one; of very many readings some are skipped, and sizes are then unknown."""
        if not self.explain or not named or self.refits.subset[1] is not self.readings:
            return None
        if pair is None:
            return self.refits.screen_beside(refitted[0])
        return self.refits.weigh(pair[1].fit.whitener, pair[1].fit.columns)

    def _accepts(self, best: Refitted, p: float) -> bool:
        """Noise alone is unlikely, or the evidence of a lean effect overwhelming with the refitted noise; and held-out
        runs agree.

        The random draws know only the noise that was estimated without the effect. Where that noise absorbed the
        effect, they make noise alone look likelier than it is.
        """
        beyond = best.log_evidence - self._prior_odds
        if self._doubted or self._hardly_refines(best):
            return False
        if unrecorded_heat(self.readings, self.refits.current) is not None and (
            best.drop < NOTHING_MUCH or self.refits.beside_slopes(best) - self._prior_odds < SURE
        ):
            return False  # heat that no sensor recorded bends and stretches as much
        likely = beyond > OVERWHELMING and self._many and best.columns.shape[1] <= LEAN
        sure = best.holds and beyond > SURE and (p < self.alpha or likely)
        if sure and self._warm_up(best) is not None:
            self._doubt_warm_up(best, fatal=True)
            return False
        if sure and (found := self._instead(best)) is not None:
            self.doubts = (*self.doubts, found)
            sure = not found.fatal
        return sure and not self.refits.jumps_again(best)

    def _hardly_refines(self, best: Refitted) -> bool:
        """Whether an effect only changes how the model follows a temperature, and hardly changes it."""

        def by(effect: Effect) -> tuple[str, str, frozenset[str]]:
            sensors = frozenset(self.model.machine.sensor_names) & set(effect.channels(self.model.machine))
            return effect.effect, effect.component, sensors

        mine = by(self.candidates[best.number].effect)
        known = any(by(f.effect) == mine for f in self.model.effects)
        return known and bool(mine[-1]) and max(best.drop, best.within) < HARDLY

    def _instead(self, best: Refitted) -> Doubt | None:
        """Doubt that something else than an effect of the machine explains the readings; None for none."""
        effect, known = self.candidates[best.number].effect, [f.effect for f in self.model.effects]
        return (
            self._beyond_materials(best)
            or dead_sensor(self.readings, effect, known)
            or self._late_sensor(best)
            or self._between_files(best)
            or self._sensor_offset(best)
            or as_well(self.judged, self.readings, self.prepared.base, best.columns, effect.label)
        )

    def _late_sensor(self, best: Refitted) -> Doubt | None:
        """Doubt that a sensor of the model is late; none where the effect removes most of the held-out mean square."""
        if best.drop >= HALF:
            return None
        effect, value = self.candidates[best.number].effect, float(best.fit.values[self.prepared.base.shape[1]])
        return late_sensor(effect, best.theta.get("tau", math.inf), value, self.model.effects)

    def _sensor_offset(self, best: Refitted) -> Doubt | None:
        """Doubt where a sensor that reads a little more or less in one of several files explains the readings as well.

        The model reads the sensor, so its offset turns and bends the prediction of that file. An angle that only beams
        at two offsets show may be that difference. What all files have in common is no doubt about the component that
        the model has: it must go into the model, whatever it comes from.
        """
        same = self._component(best) in {f.effect.component for f in self.model.effects}
        names, columns = Edits(self.model, self.readings, self.judged.scale).by_offsets(first=1 if same else 0)
        if not names:
            return None
        white = self.prepared.whitener(columns)
        seen = np.linalg.norm(self._projected.take_out(white), axis=0) > SEEN * np.linalg.norm(white, axis=0)
        names, columns = [n for n, s in zip(names, seen, strict=True) if s], columns[:, seen]
        if not names or self.refits.beside_columns(best, columns) - self._prior_odds >= SURE:
            return None
        whole, noise = np.concatenate([self.prepared.base, columns], axis=1), best.fit.whitener
        off_k = solve(noise(whole), noise(self.readings.values))[self.prepared.base.shape[1] :]
        if np.abs(off_k).max() > OFF_K:
            return None
        most = int(np.abs(off_k).argmax())
        self._offsets.add(self._component(best))
        return sensor_offset(self.readings, self.candidates[best.number].effect.label, *names[most], float(off_k[most]))

    def _between_files(self, best: Refitted) -> Doubt | None:
        """Doubt where an effect explains only differences between files: a change of the machine explains them too."""
        beside = self.refits.beside_files(best)
        if beside is None or beside - self._prior_odds >= SURE:
            return None
        return self._files_differ(best)

    def _files_differ(self, t: Refitted) -> Doubt:
        self.between.append((t.drop, frozenset(self._channels(t))))
        return only_between_files(self.readings, self.candidates[t.number].effect.label, self._channels(t))

    def _doubt_files(self, members: Sequence[Refitted], along: Shaped | None = None) -> None:
        """Doubt each of several effects that explains only differences between files beside the others.

        Args:
            members: each fitted beside those before it; the evidence of each is that of all up to it.
            along: a shape without a name beside which they were fitted.
        """
        before, evidence = (self.refits.current.log_likelihood, 0.0)
        if along is not None:
            before, evidence = along.fit.log_likelihood, along.log_evidence
        for t in members:
            cost = (t.fit.log_likelihood - before) - (t.log_evidence - evidence)
            before, evidence = t.fit.log_likelihood, t.log_evidence
            first = self.prepared.base.shape[1] if t.before is None else t.before
            others = np.delete(members[-1].fit.columns, np.s_[first : first + t.columns.shape[1]], axis=1)
            beside = self.refits.beside_files(t, others, cost)
            if beside is not None and beside - self._prior_odds < SURE:
                self.doubts = (*self.doubts, self._files_differ(t))

    def _warm_up(self, best: Refitted) -> Floats | None:
        """Curves of an instrument that warms up, (m, k), where they explain the readings nearly as well; or None."""
        width = self.prepared.base.shape[1]
        part = best.columns @ best.fit.values[width : width + best.columns.shape[1]]
        curves = warm_up_curves(self.readings, self._channels(best), part)
        if not curves:
            return None
        evidence, columns = self.refits.of_curves(curves)
        return columns if best.log_evidence - evidence < SURE else None

    def _without_instrument(self, members: list[Refitted]) -> list[Refitted]:
        """Effects that are named together, less those that an instrument that warms up explains nearly as well.

        None remains where the others are not significant beside the instrument: they only corrected what it explains.
        Where one of them is a shift that no instrument explains, no instrument is in doubt.
        """
        start = before = self.refits.current.log_likelihood
        evidence, out, costs = 0.0, list[Refitted](), 0.0
        instruments, curves = list[Refitted](), list[Sequence[Floats]]()
        for t in members:
            cost = (t.fit.log_likelihood - before) - (t.log_evidence - evidence)
            before, evidence = t.fit.log_likelihood, t.log_evidence
            last, first = members[-1], self.prepared.base.shape[1] if t.before is None else t.before
            part = t.columns @ last.fit.values[first : first + t.columns.shape[1]]
            mine = warm_up_curves(self.readings, self._channels(t), part)
            others = [o.columns for o in members if o is not t]
            whole = last.fit.log_likelihood - start - last.log_evidence
            curves += [mine] if mine else []
            if mine and last.log_evidence - self.refits.of_curves(mine, others)[0] + (whole - cost) < SURE:
                instruments.append(t)
            else:
                out.append(replace(t, log_evidence=t.fit.log_likelihood - cost))
                costs += cost
        if not instruments:
            self.doubts = tuple(d for d in self.doubts if not curves or d.kind != "instrument_warm_up")
            return members
        beside = self.refits.of_curves(curves[-1], [t.columns for t in out])[0] - costs
        if beside - self.refits.of_curves(curves[-1])[0] < len(out) * (self._prior_odds + SURE):
            return []
        self._doubt_warm_up(instruments[0], fatal=not out)
        return self.refits.in_order(out)

    def _channels(self, t: Refitted) -> tuple[str, ...]:
        return self.candidates[t.number].effect.channels(self.model.machine)

    def _of_no_machine(self, unknown: Unknown, best: Refitted | None) -> bool:
        """Whether the instrument, a change between files, or where no effect is accepted slow drift, makes a shape.

        Nor do two or three runs decide which temperature it follows.
        """
        by_heat = bool(set(unknown.channels) & {*self.model.machine.sensor_names, "time_s"})
        if self._of_instrument(unknown) or self._of_files(unknown) or (by_heat and few_runs(self.readings)):
            return True
        return best is None and self._top_shape is not None and drift_makes(self._top_shape, self.refits, self.rng)

    def _of_instrument(self, unknown: Unknown) -> bool:
        """Whether what has no name follows the time alone, or no better than an instrument that warms up: a doubt."""
        top, width = self._top_shape, self.prepared.base.shape[1]
        if unknown.shape != "smooth" or top is None:
            return False
        if set(unknown.channels) == {"time_s"}:
            self.doubts = (*self.doubts, only_time(self.readings))
            return True
        part = top.columns @ top.fit.values[width : width + top.columns.shape[1]]
        curves = warm_up_curves(self.readings, unknown.channels, part)
        if not curves or top.log_evidence - self.refits.of_curves(curves)[0] >= SURE:
            return False
        self.doubts = (*self.doubts, own_warm_up(f"A curve over {' and '.join(unknown.channels)}"))
        return True

    def _of_files(self, unknown: Unknown) -> bool:
        """Whether what has no name explains only differences between files, and no warm day and cold one: a doubt."""
        given = self.refits.only_between_files(self._top_shape) if self._top_shape is not None else ()
        if not given:
            return False
        form, over = (
            "wave" if unknown.shape == "periodic" else "curve",
            " and ".join(map(words.named, unknown.channels)),
        )
        self.doubts = (*self.doubts, found := only_between_files(self.readings, f"A {form} over {over}", given))
        return found.fatal

    def _doubt_warm_up(self, t: Refitted, fatal: bool = False) -> None:
        """Doubt that an instrument explains a candidate; once."""
        doubt = replace(own_warm_up(self.candidates[t.number].effect.label), fatal=fatal)
        self.doubts = (*(d for d in self.doubts if d.kind != doubt.kind), doubt)

    def _apart_from_warm_up(self, refitted: list[Refitted]) -> list[Refitted]:
        """The same; where the first may be an instrument that warms up, an effect first that is none."""
        curves = self._warm_up(refitted[0]) if refitted and refitted[0].holds else None
        if curves is None:
            return refitted
        bar = self._prior_odds + SURE
        sure = [
            t for t in refitted if t.holds and self.refits.beside_columns(t, curves) > bar and self._warm_up(t) is None
        ]
        if not sure:
            return refitted
        first = max(sure, key=lambda t: t.log_evidence)
        self._doubt_warm_up(refitted[0])
        return [first, *(t for t in refitted if t is not first)]

    @property
    def _doubted(self) -> bool:
        """Whether the doubts about the record rule out any conclusion about the machine."""
        return any(d.blames_no_effect for d in self.doubts)

    @cached_property
    def _projected(self) -> Projected:
        """Whitened readings, less the current model."""
        return Projected.of(self.prepared.whitener, self.prepared.base, self.readings.values)

    @property
    def _many(self) -> bool:
        """Whether there are enough readings per number for a likelihood to be reliable."""
        return self._projected.freedom > FEW

    @property
    def _prior_odds(self) -> float:
        """Log of the prior odds of "nothing" against any one effect of one component."""
        return math.log(max(len(self.refits.alternatives), 2))

    def _adequate(self, best: Refitted | None) -> tuple[bool, float | None, Unknown | None]:
        """Whether the best effect is as good as a shape without a name; its adequacy; that shape where it is not."""
        self.stage("shapes without a name", 0, 1)
        shapes = self._shapes(best)
        if best is None:
            likeliest = max(shapes, key=lambda t: t.log_evidence, default=None)
            sure = likeliest is not None and likeliest.log_evidence > OVERWHELMING
            self._doubt_targets([likeliest.few] if likeliest is not None and sure else [])
        tops = [t for t in shapes if t.few is None and (best is None or not far_better(best, t))]
        top = max(tops, key=lambda t: t.log_evidence, default=None)
        self._top_shape = top
        self._tops = tops
        if best is None:
            sure = top is not None and top.log_evidence > OVERWHELMING and self._many
            return False, None, self._unknown(top) if sure and top is not None else None
        share = adequacy(best.columns, tops, self.prepared.base, self.readings)
        local = self._simpler(best, tops)
        if local is not None:
            self._top_shape = local
            return False, share, self._unknown(local)
        if top is None or top.log_evidence < best.log_evidence + WITHIN:
            bar = best.log_evidence + WITHIN if top is None else top.log_evidence + WITHIN
            named = share >= LEAST or self._with_more(best, top) > bar
            return named, share, None if named or top is None else self._unknown(top)
        # A shape without a name is likelier. Where the effect is almost that shape, or is one of two that together are
        # likelier than the shape, its name is still the better answer.
        named = share >= ADEQUATE or self._with_more(best, top) > top.log_evidence
        return named, share, None if named else self._unknown(top)

    def _of_few_targets(self, best: Refitted) -> bool:
        """Whether only one or two targets show an effect of many numbers along axes."""
        effect, machine = self.candidates[best.number].effect, self.model.machine
        read = effect.channels(machine)
        if best.columns.shape[1] + len(effect.nonlinear(machine)) <= PLAIN or not set(read) <= {
            c for a in machine.axes for c in a.moving_channels
        }:
            return False
        along = [a.channel for a in machine.axes if a.channel in read]
        few = few_targets(self.readings, self.prepared.base, best.columns, best.fit.whitener, along)
        self._doubt_targets([few])
        return few is not None

    def _doubt_targets(self, found: Sequence[FewTargets | None]) -> None:
        """Keep which targets stand out, where most of their readings do."""
        self._few = self._few or next((t for t in found if t is not None and t.recur), None)

    def _simpler(self, best: Refitted, tops: Sequence[Shaped]) -> Shaped | None:
        """A hump, a step or several that is likelier than an effect with more numbers; None where there is none."""
        width = best.columns.shape[1]
        places = [t for t in tops if t.shape.places and len(t.shape.places) + t.shape.searched < width]
        local = max(places, key=lambda t: t.log_evidence, default=None)
        return local if local is not None and local.log_evidence > best.log_evidence + WITHIN else None

    def _with_more(self, best: Refitted, top: Shaped | None) -> float:
        """Log evidence of the best effect together with the best one, or with a drift, beside it."""
        return max(self._with_another(best, top), self._with_drift(best, top))

    def _with_another(self, best: Refitted, top: Shaped | None) -> float:
        """Log evidence of the best effect together with the best one beside it; minus infinity where there is none.

        Where a shape without a name predicts far better than the pair, the pair is no explanation.
        """
        pairs = [t for t in self.refits.beside(best) if top is None or not far_better(top, t)]
        return max((t.log_evidence for t in pairs), default=-math.inf)

    def _with_drift(self, best: Refitted, top: Shaped | None) -> float:
        """Log evidence of the best effect, which acts along the runs, beside a curve over the time, which is a drift.

        Minus infinity for other effects, and where the shape does not read the time, or the effect does.
        """
        timed = self._of_time(self.candidates[best.number].effect)
        if top is None or timed or not along_runs(self.readings, best.columns):
            return -math.inf
        cost = best.fit.log_likelihood - best.log_evidence
        found = [-math.inf]
        for curve in over_time(top, self.readings):
            fit = self.refits.fit(np.concatenate([self.prepared.base, best.columns, curve], axis=1))
            found.append(fit.log_likelihood - cost - bic_cost(curve.shape[1], len(self.readings)))
        return max(found)

    def _pair(self, refitted: Sequence[Refitted]) -> tuple[tuple[Refitted, Refitted] | None, list[Refitted]]:
        """Two effects that are significant only together, and leave little residual.

        An example is an immediate effect and the same effect, delayed, with the other sign: a part that bends while it
        warms through. Another is a load and a tilt that each change from run to run: what the one leaves looks like
        runs that differ by chance. The evidence must exceed the prior odds of both. They are searched for only where no
        shape without a name comes near.

        Returns:
            Both where neither improves held-out runs alone, or None; and else the effects that are missing together.
        """
        best: tuple[Refitted, Refitted] | None = None
        bar = self._prior_odds + OVERWHELMING
        firsts = [t for t in sorted(refitted, key=lambda t: -t.log_evidence)[:BESIDE] if t.log_evidence > 0.0]
        firsts = firsts if self._many else []
        for first, seconds in zip(firsts, each(self.refits.beside, firsts, len(self.readings)), strict=True):
            for second in seconds:
                rich = _rich((first, second))
                sure = second.log_evidence - first.log_evidence > bar and second.log_evidence > bar + self._prior_odds
                sure = sure and second.holds and second.drop > MOSTLY and (not rich or first.log_evidence > bar)
                # An event at an instant helps by itself, or not at all.
                sure = sure and not self.refits.at_instant(second.number)
                one, other = (self.candidates[t.number].effect for t in (first, second))
                sure = sure and not same_but_finer(one, other)
                if sure and (best is None or second.log_evidence > best[1].log_evidence):
                    best = first, second
        top = self._top_shape
        if best is None or (top and (top.log_evidence + WITHIN > best[1].log_evidence or far_better(top, best[1]))):
            return None, []
        first, second = best
        if first.holds and not _rich(best):
            return None, self.refits.chain(best, bar, lambda e: not self._of_time(e) and self._separate(e))
        apart = self._without_instrument([first, second])
        if len(apart) < len(best):
            return None, apart
        if self._warms_up_together(first, second):
            self._doubt_warm_up(first, fatal=True)
            return None, []
        self._doubt_files(apart)
        width = self.prepared.base.shape[1]
        both = replace(second, number=first.number, theta=first.theta, columns=first.columns, before=width)
        return (both, second), []

    def _warms_up_together(self, first: Refitted, second: Refitted) -> bool:
        """Whether two effects in one explain the readings no better than an instrument that warms up.

        Two causes are less likely beforehand than one.
        """
        width = self.prepared.base.shape[1]
        part = second.fit.columns[:, width:] @ second.fit.values[width:]
        curves = warm_up_curves(self.readings, (*self._channels(first), *self._channels(second)), part)
        return bool(curves) and second.log_evidence - self.refits.of_curves(curves)[0] < self._prior_odds + SURE

    def _leaner(self, refitted: Sequence[Refitted], evidence: float) -> list[Refitted]:
        """Plain effects that are together likelier than an answer with many numbers; empty where none are.

        A curve of many knots takes up a scale and a backlash, too.
        """
        bar = self._prior_odds + SURE
        sure = [t for t in refitted if t.holds and not _rich([t]) and t.log_evidence > bar]
        first = max(sure, key=lambda t: t.log_evidence, default=None)
        if first is None:
            return []

        def plain(effect: Effect) -> bool:
            few = len(effect.coefficients(self.model.machine)) <= PLAIN
            return few and not self._of_time(effect) and self._separate(effect)

        chain = self._without_instrument(self.refits.chain([first], bar, plain))
        return chain if len(chain) > 1 and chain[-1].log_evidence > evidence else []

    def _separate(self, effect: Effect) -> bool:
        """Whether the readings may separate an effect from one of the place, and from one that they read directly."""
        return not_separated(effect, self.readings) is None and not self._behind_arm(effect)

    def _behind_arm(self, effect: Effect) -> bool:
        """Whether an effect is an angle that is read only at one lever arm, as a shift along the same axis."""
        return behind_arm(effect.component, self._shown, self.readings.arms)

    @cached_property
    def _shown(self) -> Collection[str]:
        return read_directly(self.readings.measurements)

    def _of_time(self, effect: Effect) -> bool:
        return "time_s" in effect.channels(self.model.machine)

    def _chain(self, refitted: Sequence[Refitted], p: float) -> list[Refitted]:
        """Simple, significant effects that remove much of the residual, though a shape without a name removes more.

        A shape that may take any form also contains a squareness. So a plain effect of one or two numbers is named
        where it is significant and removes a good part of the held-out mean square; the residual is reported
        separately.
        """
        local = self._top_shape is not None and self._top_shape.shape.place is not None
        if not self._many or p >= self.alpha or local:
            return []
        bar = self._prior_odds + SURE

        machine = self.model.machine
        shape = self._top_shape.shape.variables if self._top_shape is not None else ()
        followed, sensors = set(shape) - {c for a in machine.axes for c in a.moving_channels}, set(machine.sensor_names)
        # A surface over two temperatures, or one and the time, is hardly a law: a thermal effect makes it, beside drift
        # or an instrument that warms up.
        drifts = bool(followed & sensors) and len(followed) > 1 and followed <= {*sensors, "time_s"}
        followed = set() if drifts else followed | (sensors if followed & sensors else set())

        def plain(effect: Effect) -> bool:
            read = set(effect.channels(machine))
            places = {a.channel for a in machine.axes} & read
            few = len(places) <= 1 and len(effect.coefficients(machine)) <= PLAIN and not effect.nonlinear(machine)
            # A straight line through a curve over a temperature is no cause.
            return few and not read & followed and not self._behind_arm(effect)

        sure = [t for t in refitted if t.holds and t.log_evidence > bar and plain(self.candidates[t.number].effect)]
        first = max(sure, key=lambda t: t.drop, default=None)
        chain = self.refits.chain([first], bar, plain) if first is not None else []
        if not chain or chain[-1].drop < LITTLE or self._top_shape is None:
            return chain if chain and chain[-1].drop >= LITTLE else []
        if chain[-1].drop <= MAIN and (drifts or not self._simplify(chain, self._top_shape)):
            return []
        if drifts:
            return chain
        # What reads anything beyond the shape must be as significant beside it: else it only follows the shape.
        places = {c for a in machine.axes for c in (a.channel, *a.moving_channels)}
        for t in chain:
            beyond = set(self.candidates[t.number].effect.channels(machine)) - places - set(shape)
            if beyond and self.refits.beside_columns(t, self._top_shape.columns) < bar:
                return []
        return chain

    def _simplify(self, chain: Sequence[Refitted], top: Shaped) -> bool:
        """Whether effects and the best shape of what they leave are likelier than the best shape of everything.

        A plain effect takes a part of nearly any shape; if the shape of the rest needs as much, the effect is no cause.
        """
        best = self._shape_beside(chain)
        return best is None or chain[-1].log_evidence + best > top.log_evidence

    def _shape_beside(self, chain: Sequence[Refitted]) -> float | None:
        """Log evidence of the best shape of the residual beside effects; None where no shape is found."""
        base, fit = chain[-1].fit.columns, chain[-1].fit
        noises = fit.whitener, without_drift(fit.whitener)
        rest = best_shapes(
            self.readings,
            base,
            noises,
            self.refits.fit,
            fit,
            lambda noise, columns: held_out_gain(noise, base, columns),
        )
        return max((t.log_evidence for t in rest if t.few is None), default=None)

    def _beside_curve(self, p: float) -> tuple[list[Refitted], Shaped | None]:
        """Effects beside a curve over one variable, and that curve, where both are likelier than the best shape.

        No curve where an effect with a name is likelier than it.

        They must predict held-out runs as well as that shape, a surface over this and another variable.
        """
        top, best, curve = self._top_shape, list[Refitted](), None
        if top is None or p >= self.alpha or not self._many:
            return [], None

        places = {a.channel for a in self.model.machine.axes}

        def plain(effect: Effect) -> bool:
            read = set(effect.channels(self.model.machine))
            # A curve over one position completes any surface.
            return not self._of_time(effect) and len(read & places) <= 1 and self._separate(effect)

        bar = self._prior_odds + SURE
        for one in curves_of(
            top, self.readings, self.prepared.base, self.refits.fit, self.refits.current, self.refits.held_out_gain
        ):
            chain = self.refits.beside_shape(one.columns, one.log_evidence, bar, plain)
            if chain and (not best or chain[-1].log_evidence > best[-1].log_evidence):
                best, curve = chain, one
        least = (1.0 + MORE) * (1.0 - top.drop)
        if curve is None or best[-1].log_evidence <= top.log_evidence or 1.0 - best[-1].drop > least:
            return [], None
        alone = self.refits.instead_of_shape(best, curve.fit, curve.log_evidence, bar, plain)
        if alone and alone[-1].log_evidence > best[-1].log_evidence and 1.0 - alone[-1].drop <= least:
            return alone, None  # the curve has a name, too
        alone = self.refits.without_shape(best, curve.columns)
        # Without the curve, which no model gets, they must help as well.
        return (alone, curve) if alone[-1].drop > 0.0 else ([], None)

    def _by_direction(self, best: Refitted, refitted: Sequence[Refitted]) -> list[Refitted]:
        """Shifts that the readings show, in place of an angle that shows only through its arms; else empty.

        A tilt of the spindle moves probes in two directions at once, so it is the best single effect where both grow.
        Each then needs a delay of its own beside it. The shifts together must be as likely as the angle with what it
        needs.
        """
        if component_unit(self._component(best)) != "urad" or self._component(best) in self._shown:
            return []
        bar = self._prior_odds + SURE

        def direct(effect: Effect) -> bool:
            return effect.component in self._shown and not self._of_time(effect) and self._separate(effect)

        sure = [t for t in refitted if t.holds and t.log_evidence > bar and direct(self.candidates[t.number].effect)]
        first = max(sure, key=lambda t: t.log_evidence, default=None)
        chain = self.refits.chain([first], bar, direct) if first is not None else []
        if len({self._component(t) for t in chain}) < 2:
            return []
        whole = self.refits.chain([best], bar, self._separate)
        likely = chain[-1].log_evidence > whole[-1].log_evidence - WITHIN
        return chain if likely and not predicts_better(whole[-1], chain[-1]) else []

    def _simple_ones(self, best: Refitted, refitted: Sequence[Refitted]) -> list[Refitted]:
        """Simple effects that are missing together; empty where the best alone, or with others later, is the answer.

        An effect of many numbers, or one whose shape is searched, can stand for several causes. They are named where
        they are likelier than the best with what it needs beside it; and where the best is one of them, if only
        together they predict held-out runs far better. Each must be as significant as a first one.
        """
        bar, machine = self._prior_odds + SURE, self.model.machine

        def linear(effect: Effect) -> bool:
            few = len(effect.coefficients(machine)) <= PLAIN and not effect.nonlinear(machine)
            return few and not self._behind_arm(effect)

        sure = [t for t in refitted if t.log_evidence > bar and linear(self.candidates[t.number].effect)]
        first = max(sure, key=lambda t: t.log_evidence, default=None)
        chain = self.refits.chain([first], bar, linear) if first is not None else []
        if len(chain) < 2 or chain[-1].drop < best.drop or chain[-1].log_evidence <= best.log_evidence:
            chain = []
        if not chain and best.drop > LITTLE:
            return []
        # What the best needs beside it may replace it, and may have more numbers.
        whole = self.refits.chain([best], bar, self._separate)
        known = self.doubts
        chain = self._without_instrument(max(chain or whole, whole, key=lambda c: c[-1].log_evidence))
        worse = not chain or chain[-1].drop < best.drop or chain[-1].log_evidence <= best.log_evidence
        there = best.number in [t.number for t in chain]
        if worse or (there and (best.drop > MAIN or not far_better(chain[-1], best))):
            self.doubts, chain = known, []
        self._doubt_files(chain)
        return [] if self._doubted else chain

    def _shapes(self, best: Refitted | None) -> list[Shaped]:
        """The best shapes without a name, searched under the best estimate of the noise and under one without drift."""
        known = best.fit.whitener if best is not None else self.prepared.whitener
        noises = (known, without_drift(self.prepared.whitener))
        return best_shapes(
            self.readings, self.prepared.base, noises, self.refits.fit, self.refits.current, self.refits.held_out_gain
        )

    def _unknown(self, top: Shaped) -> Unknown:
        """The error without a name, of the variables that it needs."""
        own = by_own_sensors(top, self._tops, self.model.machine)
        needed = without_idle(
            own, self._tops, self.readings, self.prepared.base, self.refits.fit, self.refits.held_out_gain
        )
        return self._of_shape(needed, "time_s" in top.shape.variables)

    def _of_shape(self, top: Shaped, by_time: bool = False) -> Unknown:
        """The error without a name of a shape.

        Args:
            top: the shape.
            by_time: whether time was one of its variables before those that it does not need were dropped.
        """
        self._top_shape, shape = top, top.shape
        period, step = None, None
        if shape.period is not None:
            period = Number(shape.period, None, words.unit_of_channel(shape.variables[0]))
            if shape.variables[0] in [a.channel for a in self.model.machine.axes]:
                step = step_mm(self.readings, shape.variables[0], groups(self.readings)[shape.group])
        others = aliases_mm(shape.period, step)[:ALIASES] if shape.period and step else ()
        chance = math.exp(-min(top.log_evidence, 50.0))
        by_time &= "time_s" not in top.shape.variables and top.shape.variables[0] in self.model.machine.sensor_names
        return Unknown(
            shape.group, shape.variables, shape.kind, period, chance, top.drop,
            with_time=by_time, step_mm=step, aliases_mm=others,
        )  # fmt: skip

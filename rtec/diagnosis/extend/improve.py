"""Diagnose and add in turn until nothing significant is missing or the error is at the noise floor."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, ClassVar, Literal

from rtec.diagnosis.extend.add import (
    CLEARLY,
    WORTH,
    Added,
    PassedOver,
    add,
    far_apart,
    gains,
    in_doubt,
    is_there,
    moves_far,
    new_effect,
    residual_size,
    rival_notes,
    rivals_of,
)
from rtec.diagnosis.extend.history import Errors
from rtec.diagnosis.extend.record_event import RecordEvent, has_instant, of_record, taken_out
from rtec.diagnosis.extend.temperatures import fixed_end, further_temperatures, hardly_varied
from rtec.diagnosis.result import AT_FLOOR, Diagnosis, Finding, Unknown
from rtec.diagnosis.search.changes import AS_WELL, VISIBLE, expansions_instead, with_changes
from rtec.diagnosis.search.diagnose import DRAWS, diagnose
from rtec.diagnosis.search.not_found import ALPHA, SURE
from rtec.diagnosis.usable import check_enough
from rtec.diagnosis.words import named, of_warmth
from rtec.effects.expression import expression_from_text
from rtec.errors import ModelError
from rtec.estimation.given import given_to
from rtec.estimation.judge import Judgement
from rtec.estimation.one_pass import one_pass
from rtec.estimation.outliers import Clean
from rtec.machine import Machine
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from rtec.result import Result
from rtec.wording import percent

Stage = Callable[[str, int, int], None]
Reason = Literal[
    "nothing_missing",
    "undecided",
    "unknown_effect",
    "ambiguous",
    "stopped",
    "at_floor",
    "no_gain",
    "narrow_range",
    "steps",
]

MOST = 8
DETERMINED = 3.0
"""Standard errors from zero of each number of a further temperature: less certain ones cancel others on one day."""
LOOSER = 3.0
"""By this factor a further temperature may enlarge the standard error of a number that is then near zero, or moves by
`DETERMINED` standard errors."""
MOSTLY, NEARLY = 0.75, 1.1
"""The nearest effect to what has no name, or its shape along axes, is added where it removes this share of the held-out
mean square error; the shape only where the effect leaves more than this many times as much."""
TRIED = 6
"""This many further temperatures are added on trial."""
BY_FAR = 0.95
"""What a diagnosis names goes before a further temperature where it leaves less than this share of what that leaves."""
NEAREST = "no effect of the catalogue describes what is missing"
SHAPE = "nothing of the catalogue describes what is missing"
FURTHER = (
    "this is a further temperature of an effect that the model has, for a body between several sensors; it was taken "
    "because it predicts held-out runs better, and it names no cause of its own"
)


@dataclass(frozen=True)
class ProposedStep:
    """The question before an effect is added.

    Attributes:
        diagnosis: with all candidates.
        finding: the proposed one.
        number: of the step, from 1.
    """

    diagnosis: Diagnosis
    finding: Finding
    number: int


@dataclass(frozen=True)
class Improved(Result):
    """A model improved step by step.

    Attributes:
        model: the last one.
        steps: what was added, in order.
        diagnoses: one for each step, and the last, which named nothing more or was not followed.
        reason: why the search ended.
        refit: of the model's own numbers before all steps, where it lowered the held-out error.
        cancelling: effects of which these readings determine only the sum, where that refused the last addition.
        impossible: numbers that no machine has, in words, where they refused it.
        events: what happened in one record; no term of the model.
    """

    page_maker: ClassVar[str] = "rtec.report.history:improved_page"

    model: Model
    steps: tuple[Added, ...]
    diagnoses: tuple[Diagnosis, ...]
    reason: Reason
    refit: Added | None = None
    cancelling: tuple[str, ...] = ()
    impossible: tuple[str, ...] = ()
    events: tuple[RecordEvent, ...] = ()

    def rows(self) -> list[Mapping[str, Any]]:
        """One row for each added effect, with the error on held-out runs before and after it."""
        return [
            {
                "added": ", ".join(s.labels),
                "before": s.before.held_out,
                "after": s.after.held_out,
                "noise_floor": s.floor,
                "unit": s.unit,
            }
            for s in self.steps
        ]

    def facts(self) -> dict[str, Any]:
        """The result as plain data, for JSON."""
        return {
            "reason": self.reason,
            "refit": self.refit.facts() if self.refit else None,
            "steps": [s.facts() for s in self.steps],
            "events": [vars(e) for e in self.events],
            "last_diagnosis": self.diagnoses[-1].facts() if self.diagnoses else None,
            "model_sha256": self.model.hash,
        }


def improve(
    model: Model,
    measurements: Sequence[Measurement],
    *,
    ask: Callable[[ProposedStep], Finding | None] | None = None,
    ask_made: Callable[[Added], bool] | None = None,
    seed: int = 1,
    alpha: float = ALPHA,
    draws: int = DRAWS,
    stage: Stage | None = None,
    step: Callable[[Added], None] | None = None,
) -> Improved:
    """Refit the model's own numbers where they are out of date, then add effects until none is missing.

    Args:
        model: the current model.
        measurements: of its machine.
        ask: returns the candidate to add, None to stop. Without it the best is added where the readings decide, and
            also where several cannot be distinguished (they predict the same here); its notes and its entry of the
            history list the rivals.
        ask_made: returns whether to keep an improvement that names no cause: a refit (no labels), a further
            temperature; without it, it is kept.
        seed, alpha, draws: of the diagnosis.
        stage: progress callback: called with the stage, steps done, steps in total.
        step: called with the refit and each addition.

    Raises:
        MeasurementError: as of `diagnose`, or there are too few readings.
    """
    check_enough(measurements)
    given = given_to(model, measurements).without_ends()
    growth = _Growth(measurements, given, model, (seed, alpha, draws), stage, step)
    done = _improved(growth, model, ask, ask_made, step)
    if done.reason in GOES_ON and growth.earlier is not None and not growth.events and not growth.declined:
        # What the model had known of its numbers may have held them back. Now these readings are its own, too.
        own = {**done.model.measurements, **{m.name: m.fingerprint for m in measurements}}
        grown = replace(done.model, measurements=own)
        growth = _Growth(measurements, given, grown, (seed, alpha, draws), stage, step, least_fall=CLEAR_FALL)
        done = _joined(done, _once_more(growth, grown, done, ask, ask_made, step))
    if done.reason == "unknown_effect":
        *before, last = done.diagnoses
        done = replace(done, diagnoses=(*before, replace(last, unknown=growth.unknown(done.model))))
    return replace(done, events=tuple(growth.events))


MOVED = 0.25
"""A refit in which no number moves by more than this share of its standard error is none."""
GOES_ON: tuple[Reason, ...] = ("no_gain", "nothing_missing")
"""Reasons for which a search may end too early."""
SET_FREE, CLEAR_FALL = 0.5, 0.1
"""Numbers are set free only where that leaves less than this share of the mean square on held-out runs: a drift, which
free numbers follow, leaves more. What is added beside free numbers lowers it by the second share at least."""


def _once_more(
    growth: "_Growth",
    model: Model,
    done: Improved,
    ask: Callable[[ProposedStep], Finding | None] | None,
    ask_made: Callable[[Added], bool] | None,
    step: Callable[[Added], None] | None,
) -> Improved:
    """What a second call would do after the first: add what is still missing, or refit what is still out of date."""
    if not done.diagnoses[-1].out_of_date:
        return growth.grown(model, ask, ask_made) if done.steps else done
    refit = growth.refit(model, ask_made is None)
    if refit is None or refit.after.held_out**2 > SET_FREE * refit.before.held_out**2:
        return done
    if ask_made is not None and not ask_made(refit):
        return done
    if step:
        step(refit)
    return replace(growth.grown(refit.model, ask, ask_made), refit=refit)


def _joined(one: Improved, other: Improved) -> Improved:
    """An improvement and the one that followed it."""
    if other is one or (not other.steps and other.refit is None):
        return one
    refit = one.refit
    if not one.steps and other.refit is not None:
        refit = other.refit if refit is None else replace(other.refit, before=refit.before)
    steps, diagnoses = (*one.steps, *other.steps), (*one.diagnoses[:-1], *other.diagnoses)
    return replace(other, steps=steps, diagnoses=diagnoses, refit=refit)


def _improved(
    growth: "_Growth",
    model: Model,
    ask: Callable[[ProposedStep], Finding | None] | None,
    ask_made: Callable[[Added], bool] | None,
    step: Callable[[Added], None] | None,
) -> Improved:
    """Refit, then add; arguments as of `improve`."""
    refit = growth.refit(model, ask_made is None)
    if refit is None:
        done = growth.grown(model, ask, ask_made)
        if not growth.events or done.steps or done.reason != "nothing_missing":
            return done
        refit = growth.refit(model, ask_made is None)  # the event may have hidden that numbers are out of date
        if refit is None:
            return done
    found = growth.diagnosed(model)
    while growth.takes_out(found, model):
        refit = growth.refit(model, ask_made is None)
        if refit is None:
            return growth.grown(model, ask, ask_made)
        found = growth.diagnosed(model)
    if found.verdict == "undecided" and not _only_changed(refit, with_changes(found, model, growth.given)):
        return Improved(model, (), (found,), "undecided")
    if found.verdict == "nothing_missing" and not found.refit_fits:  # nor are they refitted to a drift
        return Improved(model, (), (found,), "nothing_missing")
    holding = growth.holding(model, found)
    if holding is not None:
        return growth.grown(model, ask, ask_made, holding)
    warm = growth.expansion_instead(model, refit)
    if warm is not None and (ask_made is None or ask_made(warm)):
        return growth.grown(model, ask, ask_made, first=warm)
    if ask_made is None and found.changes_slowly:
        return growth.grown(model, ask, ask_made, found)  # nor to a slow change without a name, of instrument or heat
    if ask_made is not None and not ask_made(refit):
        growth.declined = True
        return growth.grown(model, ask, ask_made, found)
    if step:
        step(refit)
    growth.own = 0
    return replace(growth.grown(refit.model, ask, ask_made), refit=refit)


def _only_changed(refit: Added, found: Diagnosis) -> bool:
    """Whether a refit moves only numbers that a diagnosis says have changed; others would absorb an unknown cause."""
    return found.refits_changed and {c.effect for c in refit.changed} <= {c.effect for c in found.changed}


class _Growth:
    """One search: the same readings and the same measure throughout.

    Args:
        measurements: as given.
        given: their readings, wrong ones already rejected.
        start: the first model.
        chance: seed, alpha and draws of the diagnosis.
        stage, step: as of `improve`.
        least_fall: share of the mean square on held-out runs that an addition removes at least; by default `gains`
            alone decides.

    Attributes:
        declined: whether the user declined refitted numbers.
    """

    def __init__(
        self,
        measurements: Sequence[Measurement],
        given: Clean,
        start: Model,
        chance: tuple[int, float, int],
        stage: Stage | None,
        step: Callable[[Added], None] | None,
        least_fall: float = -math.inf,
    ) -> None:
        self.cancelling: tuple[str, ...] = ()
        self.impossible: tuple[str, ...] = ()
        self.events: list[RecordEvent] = []
        self.declined = False
        self.least_fall = least_fall
        self.measurements, self.given, self.chance, self.stage, self.step = measurements, given, chance, stage, step
        self.best, self.shown = self._sizes(start)
        again = any(m.fingerprint in start.measurements.values() for m in measurements)
        # Effects whose numbers were not fitted to these readings.
        self.own = 0 if again else len(start.effects)
        self.earlier = None if again else start
        self._unknown: dict[str, Unknown | None] = {}

    def refit(self, model: Model, alone: bool) -> Added | None:
        """The model with refitted numbers; None where that lowers the error on held-out runs by little.

        Args:
            model: the model.
            alone: whether no user is asked.
        """
        if not model.effects or any(d.kind != "wrong_scale" for d in in_doubt(Judgement(model, self.given))):
            return None  # the diagnosis reports the doubts; nothing is fitted to a doubtful record
        made = add(model, [], self.measurements, stage=self.stage, given=self.given)
        if made.impossible or not gains(made.before, made.after, len(self.given.readings)) or not self._no_worse(made):
            return None
        if alone and one_pass(self.given.readings) and not _at_floor(made):
            return None  # the numbers would absorb the missing effect: position, direction and heat are confounded
        if not _moves(model, made.model):
            return None  # with other weights the error is lower, but the numbers are the same
        return made

    def diagnosed(self, model: Model, explain: bool = False) -> Diagnosis:
        """What a model misses; also explained, as by `diagnose`."""
        seed, alpha, draws = self.chance
        return diagnose(
            model,
            self.measurements,
            seed=seed,
            alpha=alpha,
            draws=draws,
            explain=explain,
            stage=self.stage,
            given=self.given,
            earlier=self.earlier is not None,
        )

    def unknown(self, model: Model) -> Unknown | None:
        """What a model misses that has no name, with its expression."""
        if model.hash not in self._unknown:
            self._unknown[model.hash] = self.diagnosed(model, explain=True).unknown
        return self._unknown[model.hash]

    def takes_out(self, found: Diagnosis, model: Model, chosen: Finding | None = None) -> bool:
        """Whether an effect of the time is named: then the readings get it as an unknown of their record.

        Args:
            found: the diagnosis.
            model: what it diagnosed.
            chosen: the candidate in question; None for the first one where it was accepted.
        """
        if chosen is None and found.verdict in ("missing_effect", "ambiguous") and found.findings[0].accepted:
            chosen = found.findings[0]
        if chosen is None or not of_record(chosen.effect, model.machine) or len(self.events) >= MOST:
            return False
        if not has_instant(chosen) and any(f.group and not of_record(f.effect, model.machine) for f in found.findings):
            return (
                False  # a slow change that may as well be heat: taken out, other effects would make up for its absence
            )
        readings = self.given.readings
        out, events = taken_out(readings, Judgement(model, self.given).left, chosen)
        self.given = replace(self.given, readings=out)
        self.events += events
        self.best, self.shown = self._sizes(model)
        return bool(events)

    def grown(
        self,
        model: Model,
        ask: Callable[[ProposedStep], Finding | None] | None,
        ask_made: Callable[[Added], bool] | None,
        known: Diagnosis | None = None,
        first: Added | None = None,
    ) -> Improved:
        """Diagnose and add in turn.

        Args:
            model: the model.
            ask, ask_made: as of `improve`.
            known: the diagnosis of the model, where it is known.
            first: what is added before anything is diagnosed.
        """
        steps: list[Added] = []
        diagnoses: list[Diagnosis] = []
        declined = False
        self._size_of(model)
        model = self._taken(first, steps) if first is not None else model
        while len(steps) < MOST:
            further, known = self._further_first(model, steps, bool(ask), known) if not declined else (None, known)
            if further is not None and ask_made is not None:
                declined = not ask_made(further)
            if further is not None and not declined:
                model = self._taken(further, steps)
                continue
            found, known = known or self.diagnosed(model), None
            diagnoses.append(found)
            unasked = model if ask else self._unasked(model, found, steps)
            if unasked is not model:
                model = unasked
                continue
            if not _proposes(found):
                return Improved(model, tuple(steps), tuple(diagnoses), _ended(found, steps))
            if not ask and found.verdict == "undecided":
                return Improved(model, tuple(steps), tuple(diagnoses), "undecided")
            choice = found.findings[0] if ask else _taken_alone(found, model.machine)
            if choice is None:
                return Improved(model, tuple(steps), tuple(diagnoses), "ambiguous")
            picked = ask(ProposedStep(found, choice, len(steps) + 1)) if ask else choice
            if picked is None:
                return Improved(model, tuple(steps), tuple(diagnoses), "stopped")
            if self.takes_out(found, model, picked):
                continue
            alone = all(of_record(f.effect, model.machine) for f in found.group)
            if of_record(picked.effect, model.machine) and (ask or alone):
                return Improved(model, tuple(steps), tuple(diagnoses), "no_gain")
            added = self._first_gain(model, found, [picked] if ask else _choices(found, picked))
            if added is None:
                narrow = hardly_varied(model, picked.effect, self.given.readings)
                reason: Reason = "narrow_range" if narrow else "no_gain"
                ended = Improved(model, tuple(steps), tuple(diagnoses), reason)
                return ended if narrow else replace(ended, cancelling=self.cancelling, impossible=self.impossible)
            model = self._taken(added, steps)
        return Improved(model, tuple(steps), tuple(diagnoses), "steps")

    def _taken(self, added: Added, steps: list[Added]) -> Model:
        """Report a step and keep it."""
        end = fixed_end(added.model)
        added = added if end is None or end in added.notes else replace(added, notes=(end, *added.notes))
        steps.append(added)
        self.own = added.own_kept
        if self.step:
            self.step(added)
        self._size_of(added.model)
        return added.model

    def _further(self, model: Model) -> Added | None:
        """A further temperature of an effect of the model, where it predicts held-out runs better."""
        for new in islice(further_temperatures(Judgement(model, self.given)), TRIED):
            try:
                added = self._adding(model, [new], self.own)
            except ModelError:
                continue
            fall = added.before.held_out**2 - added.after.held_out**2
            sound = _between(added) and _determined(model, added)
            if sound and fall > (VISIBLE * added.floor) ** 2 and self._gains(added):
                return replace(added, notes=(fixed_end(added.model) or FURTHER, *added.notes))
        return None

    def _further_first(
        self, model: Model, steps: Sequence[Added], asked: bool, known: Diagnosis | None
    ) -> tuple[Added | None, Diagnosis | None]:
        """A further temperature, where nothing that a diagnosis names predicts better; and the diagnosis if it does."""
        if known is not None or not steps or _at_floor(steps[-1]):
            return None, known
        further = self._further(model)
        if further is None or asked:
            return further, None
        found = self.diagnosed(model)
        return (None, found) if self._predicts_better(model, found, further) else (further, None)

    def _predicts_better(self, model: Model, found: Diagnosis, further: Added) -> bool:
        """Whether what a diagnosis names predicts held-out runs clearly better than a further temperature."""
        if found.verdict not in ("missing_effect", "ambiguous") or not _proposes(found):
            return False
        added = self._first_gain(model, found, [found.findings[0]])
        return added is not None and added.after.held_out < BY_FAR * further.after.held_out

    def holding(self, model: Model, found: Diagnosis) -> Diagnosis | None:
        """The same, the candidate first beside which the model's own numbers hold, though they look out of date.

        Of several that cannot be distinguished by these readings alone, the numbers that the model has from others
        decide; one with more numbers than the first takes up what makes them look out of date, and decides nothing.
        None where the numbers are out of date beside each.
        """
        first = _taken_alone(found, model.machine) if _proposes(found) and found.verdict != "undecided" else None
        if first is None or self.own < len(model.effects):
            return None

        def hold(new: Sequence[FittedEffect]) -> bool:
            added = self._gaining(model, new)
            return added is not None and (added.own_kept > 0 or not moves_far(model, added))

        if len(found.together) > 1:
            members = [m.fitted for m in found.together]
            return found if hold([new_effect(f.effect, model, f.theta, f.values) for f in members]) else None
        # Of those of one shape in these readings the diagnosis fitted one.
        alike = [a.fitted for a in first.confused_with if not a.apart and a.fitted is not None]
        same = [replace(first, effect=f.effect, theta=f.theta, parameters={}, partner=None) for f in alike]
        known = [f.effect for f in found.findings]
        choices = [*_choices(found, first), *(f for f in same if f.effect not in known)]
        most = sum(len(f.values) for f in _new_effects(first, model))
        lean = (f for f in choices if sum(len(n.values) for n in _new_effects(f, model)) <= most)
        lead = next((f for f in lean if hold(_new_effects(f, model))), None)
        if lead is None:
            return None
        ordered = [replace(lead, accepted=found.findings[0].accepted), *(f for f in found.findings if f is not lead)]
        return replace(found, findings=tuple(replace(f, rank=i) for i, f in enumerate(ordered, 1)))

    def expansion_instead(self, model: Model, refit: Added) -> Added | None:
        """The model with an expansion in place of a scale error that a refit changes; None where none is likelier."""
        for new, number in expansions_instead(
            model, self.given, refit.changed, Judgement(refit.model, self.given).residual
        ):
            if number.warmer is None or number.warmer.sure:
                added, bound = self._gaining(model, [new]), refit.after.held_out
            else:  # today shows only the sum of both: the model keeps its scale error
                made = _from(refit.before, self._adding(model, [new], len(model.effects), held=True))
                added, bound = made if self._gains(made) else None, AS_WELL * refit.after.held_out
            if added is not None and added.after.held_out < bound:
                note = of_warmth([number]).strip().rstrip(".")
                return replace(added, notes=(note, *added.notes), in_place_of=number.effect)
        return None

    def _unasked(self, model: Model, found: Diagnosis, steps: list[Added]) -> Model:
        """The model with the shape of what has no name, or with effects that are named together; else as it is."""
        shape = self._shape(model, found)
        if shape is not None:
            return self._taken(shape, steps)
        decided = _proposes(found) and found.verdict != "undecided" and _taken_alone(found, model.machine) is not None
        alone = any(d.kind == "one_pass" for d in found.doubts)
        return self._several(model, found, steps) if decided and not alone else model

    def _shape(self, model: Model, found: Diagnosis) -> Added | None:
        """What has no name as an expression along axes, where it removes most; None where an effect does as well.

        A shape over a temperature, the load or the time holds on this day only.
        """
        machine = model.machine
        places = {c for a in machine.axes for c in (a.channel, a.direction_channel)}
        if found.unknown is None or not set(found.unknown.channels) <= places or _in_doubt(found):
            return None
        unknown = self.unknown(model)
        if unknown is None or not unknown.expression:
            return None
        effect = expression_from_text(unknown.expression, unknown.parameters, unknown.feeds, machine)
        added = self._gaining(model, [new_effect(effect, model)])
        if added is None:
            return None
        before, after = (max(e.held_out**2 - added.floor**2, 0.0) for e in (added.before, added.after))
        nearest = self._first_gain(model, found, [found.findings[0]]) if _proposes(found) else None
        as_good = nearest is not None and nearest.after.held_out <= NEARLY * added.after.held_out
        if after > (1.0 - MOSTLY) * before or as_good:
            return None
        over = " and ".join(map(named, unknown.channels))
        shape = f"{SHAPE}; this is its shape over {over}, as it was read, and names no cause"
        return replace(added, notes=(shape, *added.notes))

    def _several(self, model: Model, found: Diagnosis, steps: list[Added]) -> Model:
        """The model with the effects that are named together, in turn; one that gains nothing alone waits for the next.

        Chosen one by one, the second could explain a part of the third.
        """
        waiting: list[FittedEffect] = []
        members = [m for m in found.together if not of_record(m.fitted.effect, model.machine)]
        for member in members if len(members) > 1 else ():
            waiting.append(new_effect(member.fitted.effect, model, member.fitted.theta, member.fitted.values))
            added = self._gaining(model, waiting)
            if added is not None:
                rivals = tuple(PassedOver(label, None, "") for label in member.rivals)
                model, waiting = self._taken(_passed_over(added, rivals), steps), []
        return model

    def _first_gain(self, model: Model, found: Diagnosis, findings: Sequence[Finding]) -> Added | None:
        """The first addition that predicts held-out runs better on the channels that the loop has."""
        for finding in findings:
            added = self._gaining(model, _new_effects(finding, model))
            if added is not None:
                rivals = rivals_of(found, finding)
                notes = rival_notes(finding, rivals) if rivals else _nearest_note(found)
                return replace(_passed_over(added, rivals), notes=(*notes, *added.notes))
        return None

    def _gaining(self, model: Model, new: Sequence[FittedEffect]) -> Added | None:
        """The model with effects, where they are worth it and not confounded with it on the loop's channels."""
        if any(is_there(model, n) or hardly_varied(model, n.effect, self.given.readings) for n in new):
            return None
        if any(of_record(n.effect, model.machine) for n in new):
            return None
        try:
            added = self._added(model, new)
        except ModelError:
            return None
        self.cancelling, self.impossible = added.undetermined, added.impossible
        return added if self._gains(added) else None

    def _added(self, model: Model, new: Sequence[FittedEffect]) -> Added:
        """The model with effects; it keeps its own numbers where the readings determine only the sum of both."""
        added = self._adding(model, new, self.own)
        if added.undetermined and self.own < len(model.effects):
            kept = self._adding(model, new, len(model.effects))
            added = added if kept.undetermined else kept
        return added

    def _adding(self, model: Model, new: Sequence[FittedEffect], own: int, held: bool = False) -> Added:
        """The model with effects, of which the first `own` are not fitted to these readings yet, or not to be."""
        return add(
            model, new, self.measurements, stage=self.stage, given=self.given, own=own, earlier=self.earlier, held=held
        )

    def _gains(self, added: Added) -> bool:
        """Whether an addition is worth it: it predicts held-out runs better, cancels no effect of the model, and gives
        no part an expansion that no material has.
        """
        return (
            not added.undetermined
            and not added.impossible
            and added.after.held_out**2 <= (1.0 - self.least_fall) * added.before.held_out**2
            and gains(added.before, added.after, len(self.given.readings))
            and self._no_worse(added)
        )

    def _no_worse(self, added: Added) -> bool:
        """Whether the residual of a model is no larger than that of the start and of every earlier step.

        It is measured relative to the readings of each instrument, and as it is shown, in µm or µrad.
        """
        best, shown = self._sizes(added.model)
        return best <= (1.0 + WORTH) * self.best and shown <= (1.0 + CLEARLY) * self.shown

    def _sizes(self, model: Model) -> tuple[float, float]:
        judged = Judgement(model, self.given)
        best = residual_size(model.effects, self.given.readings)
        return best, best if judged.unit == "noise" else judged.residual

    def _size_of(self, model: Model) -> None:
        """Remember the residual of a model that is kept."""
        best, shown = self._sizes(model)
        self.best, self.shown = min(self.best, best), min(self.shown, shown)


def _proposes(found: Diagnosis) -> bool:
    """Whether the first candidate was accepted; or is the nearest to what has no name, and removes most of it."""
    if not found.findings or found.findings[0].accepted:
        return bool(found.findings)
    unnamed = found.verdict == "unknown_effect" and found.adequacy is not None
    return unnamed and found.findings[0].heldout_drop >= MOSTLY and not _in_doubt(found)


def _in_doubt(found: Diagnosis) -> bool:
    """Whether something about the record itself is in doubt."""
    return any(d.kind != "other_machine" for d in found.doubts)


def _nearest_note(found: Diagnosis) -> tuple[str, ...]:
    """Note that an added effect is only the nearest to what has no name."""
    if found.verdict != "unknown_effect" or found.adequacy is None or found.findings[0].accepted:
        return ()
    return (f"{NEAREST}; this is the nearest, and explains {percent(found.adequacy)} of what can be explained",)


def _new_effects(finding: Finding, model: Model) -> list[FittedEffect]:
    """The effect of a candidate, and its partner, with the numbers that the diagnosis found."""
    pair = [finding] if finding.partner is None else [finding, finding.partner]
    return [new_effect(f.effect, model, f.theta, {k: n.value for k, n in f.parameters.items()}) for f in pair]


def _choices(found: Diagnosis, first: Finding) -> list[Finding]:
    """A candidate and those that may replace it.

    These are effects that these data cannot distinguish from it. Where several are missing together, the first alone
    may gain nothing: then any of the sure ones may begin. Of a pair, each alone.
    """
    if first.partner is not None:
        return [first, first.partner, replace(first, partner=None)]
    others = [f for f in found.findings if (f.group or found.together) and f.log_evidence > SURE]
    return [first, *(f for f in others if f is not first and f.heldout_drop > 0.0)]


def _same_body(one: FittedEffect, other: FittedEffect) -> bool:
    """Whether two effects are the same one, perhaps by different temperatures."""
    return (one.effect.effect, one.effect.component) == (other.effect.effect, other.effect.component)


def _between(added: Added) -> bool:
    """Whether a further temperature by another sensor acts in the direction of the others.

    The temperature of a body is a mean of those around it, with weights above zero. One sensor with two delays may have
    both signs: a body leads or lags.
    """
    *others, last = added.model.effects
    mine = getattr(last.effect, "sensor", None)
    body = [f for f in others if _same_body(f, last) and getattr(f.effect, "sensor", None) is not None]
    if mine is None or mine in [getattr(f.effect, "sensor", None) for f in body]:
        return True
    return sum(f.values[n] * v for f in body for n, v in last.values.items()) >= 0.0


def _from(before: Errors, added: Added) -> Added:
    """An addition with other errors before it: of the model as it was, whose numbers it keeps."""
    entry = {**added.model.history[-1], "rms_before": before.held_out}
    return replace(added, before=before, model=replace(added.model, history=(*added.model.history[:-1], entry)))


def _moves(before: Model, after: Model) -> bool:
    """Whether a refit moves a number by more than `MOVED` of its standard error."""
    return any(
        abs(now.values[n] - was.values[n]) > MOVED * now.errors.get(n, 0.0)
        for was, now in zip(before.effects, after.effects, strict=True)
        for n in now.values
    )


def _determined(before: Model, added: Added) -> bool:
    """Whether the numbers of a further temperature are determined, and those of other effects as well as before it.

    Of the temperatures of one body only the sum needs to be.
    """
    *others, last = added.model.effects

    def known(f: FittedEffect, name: str) -> bool:
        return abs(f.values[name]) > DETERMINED * f.errors.get(name, 0.0)

    def as_before(was: FittedEffect, now: FittedEffect, name: str) -> bool:
        near = known(now, name) and not far_apart(was, now, name, DETERMINED)
        return near or now.errors.get(name, 0.0) <= LOOSER * was.errors.get(name, math.inf)

    apart = [(w, now) for w, now in zip(before.effects, others, strict=True) if not _same_body(now, last)]
    as_well = all(as_before(was, now, n) for was, now in apart for n in now.values)
    return as_well and all(known(last, n) for n in last.values)


def _passed_over(added: Added, rivals: tuple[PassedOver, ...]) -> Added:
    """The same with its rivals in the history."""
    if not rivals:
        return added
    entry = {**added.model.history[-1], "passed_over": [r.facts() for r in rivals]}
    model = replace(added.model, history=(*added.model.history[:-1], entry))
    return replace(added, model=model, passed_over=rivals)


def _taken_alone(found: Diagnosis, machine: Machine) -> Finding | None:
    """The candidate that is added if nobody is asked; None where one pass of an axis cannot decide.

    A single reversal does not show how reversals change. One number of geometry is added even if something else is as
    likely: every machine has it, and a mistake about it does the least harm.
    """
    first = found.findings[0]
    if not any(d.kind == "one_pass" for d in found.doubts):
        return first
    ways, places = {a.direction_channel for a in machine.axes}, {a.channel for a in machine.axes}

    def plain(f: Finding) -> bool:
        one = len(f.effect.coefficients(machine)) == 1 and f.partner is None
        return one and set(f.effect.channels(machine)) <= ways | places

    if len(found.group) > 1 or first.confused_with:
        return next((f for f in found.group if plain(f)), None)
    read = set(first.effect.channels(machine))
    return None if read & ways and read - ways else first


def _ended(last: Diagnosis, steps: Sequence[Added]) -> Reason:
    """Why the search ended where nothing was named.

    The floor alone is no reason to stop: a noise fitted while an effect is missing contains part of that effect.
    """
    if last.verdict in ("unknown_effect", "undecided"):
        return last.verdict
    return "at_floor" if steps and _at_floor(steps[-1]) else "nothing_missing"


def _at_floor(step: Added) -> bool:
    """Whether a step led to the noise floor, as far as held-out runs show."""
    return step.after.held_out <= AT_FLOOR * step.floor

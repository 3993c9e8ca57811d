"""Diagnose and add, again and again, until nothing significant is left or the error is at the noise floor."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

from rtec.diagnosis.extend.add import WORTH, Added, add, in_doubt, is_there, new_effect, residual_size, rivals_of, said
from rtec.diagnosis.extend.temperatures import further_temperature
from rtec.diagnosis.result import Diagnosis, Finding
from rtec.diagnosis.search.diagnose import DRAWS, diagnose
from rtec.diagnosis.search.not_found import ALPHA
from rtec.diagnosis.usable import check_enough
from rtec.errors import ModelError
from rtec.estimation.judge import Judgement
from rtec.estimation.one_pass import one_pass
from rtec.estimation.outliers import Clean, clean
from rtec.machine import Machine
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.result import Result

Stage = Callable[[str, int, int], None]
Reason = Literal[
    "nothing_missing", "undecided", "unknown_effect", "ambiguous", "stopped", "at_floor", "no_gain", "steps"
]

AT_FLOOR = 1.05
"""Held-out error over the noise floor up to which a model is said to be at it."""
LITTLE = 0.02
"""A relative fall of the held-out error below this is not worth an effect."""
MOST = 8
DETERMINED = 3.0
"""Standard errors from zero of each number of a further temperature: what is less sure cancels others on one day."""
FURTHER = (
    "this is a further temperature of an effect that the model has, for a body between several sensors; it was taken "
    "because it predicts held-out runs better, and it names no cause of its own"
)


@dataclass(frozen=True)
class ProposedStep:
    """What is asked before an effect is added.

    Attributes:
        diagnosis: with its candidates.
        finding: proposed.
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
        diagnoses: one for each step, and the last, which found nothing more or was not followed.
        reason: why it ended.
        refit: the model's own numbers fitted anew before all steps, where that was worth it.
    """

    page_maker: ClassVar[str] = "rtec.report.additions:improved_page"

    model: Model
    steps: tuple[Added, ...]
    diagnoses: tuple[Diagnosis, ...]
    reason: Reason
    refit: Added | None = None

    def rows(self) -> list[Mapping[str, Any]]:
        """One for each effect that was added, with the error on held-out runs before and after it."""
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
    """Fit the model's own numbers anew where they are out of date, then add what is missing until nothing is.

    Args:
        model: the current model.
        measurements: of its machine.
        ask: which candidate to add, None to stop; without it the best is added where the readings decide, and also
            where several cannot be told apart (they predict the same here); the rivals are told in its notes and
            its entry of the history.
        ask_made: whether to keep what is worth it and names no cause: a refit (no labels), a further temperature;
            without it, it is kept.
        seed, alpha, draws: of the diagnosis.
        stage: told how far it is.
        step: given the refit and each addition as soon as it is made.

    Raises:
        MeasurementError: as `diagnose`, or there are too few readings.
    """
    check_enough(measurements)
    given = clean(measurements, model.reference_degc).without_ends()
    growth = _Growth(measurements, given, model, (seed, alpha, draws), stage, step)
    refit = growth.refit(model, ask_made is None)
    if refit is None:
        return growth.grown(model, ask, ask_made)
    found = growth.diagnosed(model)
    if found.verdict == "undecided":  # numbers that are refitted would take up what nobody knows yet
        return Improved(model, (), (found,), "undecided")
    if found.verdict == "nothing_missing" and not found.out_of_date:  # nor do they follow a drift
        return Improved(model, (), (found,), "nothing_missing")
    if ask_made is not None and not ask_made(refit):
        return growth.grown(model, ask, ask_made)
    if step:
        step(refit)
    growth.own = 0
    return replace(growth.grown(refit.model, ask, ask_made), refit=refit)


class _Growth:
    """One search: the same readings and the same measure from beginning to end.

    Args:
        measurements: as given.
        given: their readings, wrong ones left out once and for all.
        start: the model that it began with.
        chance: seed, alpha and draws of the diagnosis.
    """

    def __init__(
        self,
        measurements: Sequence[Measurement],
        given: Clean,
        start: Model,
        chance: tuple[int, float, int],
        stage: Stage | None,
        step: Callable[[Added], None] | None,
    ) -> None:
        self.measurements, self.given, self.chance, self.stage, self.step = measurements, given, chance, stage, step
        self.best = residual_size(start.effects, given.readings)
        again = any(m.fingerprint in start.measurements.values() for m in measurements)
        # Effects whose numbers were not fitted to these readings.
        self.own = 0 if again else len(start.effects)

    def refit(self, model: Model, alone: bool) -> Added | None:
        """The model's own numbers refitted; None where that lowers the error on held-out runs by little.

        Args:
            model: the model.
            alone: nobody is asked.
        """
        if not model.effects or any(d.kind != "wrong_scale" for d in in_doubt(Judgement(model, self.given))):
            return None  # of a record in doubt the diagnosis says what is wrong, and nothing is fitted to it
        made = add(model, [], self.measurements, stage=self.stage, given=self.given)
        if made.after.held_out > (1.0 - LITTLE) * made.before.held_out or not self._no_worse(made):
            return None
        if alone and one_pass(self.given.readings) and not _at_floor(made):
            return None  # the numbers would take up what is missing, and position, direction and heat are one here
        return made

    def diagnosed(self, model: Model) -> Diagnosis:
        """What a model misses."""
        seed, alpha, draws = self.chance
        return diagnose(
            model, self.measurements, seed=seed, alpha=alpha, draws=draws, stage=self.stage, given=self.given
        )

    def grown(
        self,
        model: Model,
        ask: Callable[[ProposedStep], Finding | None] | None,
        ask_made: Callable[[Added], bool] | None,
    ) -> Improved:
        """Diagnose and add, again and again."""
        steps: list[Added] = []
        diagnoses: list[Diagnosis] = []
        declined = False
        self.best = min(self.best, residual_size(model.effects, self.given.readings))
        while len(steps) < MOST:
            worth = bool(steps) and not declined and not _at_floor(steps[-1])
            further = self._further(model) if worth else None
            if further is not None and ask_made is not None:
                declined = not ask_made(further)
            if further is not None and not declined:
                model = self._taken(further, steps)
                continue
            found = self.diagnosed(model)
            diagnoses.append(found)
            if not found.findings or not found.findings[0].accepted:
                return Improved(model, tuple(steps), tuple(diagnoses), _ended(found, steps))
            if not ask and found.verdict == "undecided":
                return Improved(model, tuple(steps), tuple(diagnoses), "undecided")
            if not ask and _inseparable(found, model.machine):
                return Improved(model, tuple(steps), tuple(diagnoses), "ambiguous")
            choice = found.findings[0]
            picked = ask(ProposedStep(found, choice, len(steps) + 1)) if ask else choice
            if picked is None:
                return Improved(model, tuple(steps), tuple(diagnoses), "stopped")
            # What these data cannot distinguish from it may take its place, but for what happened at an instant.
            others = [f for f in found.findings[1:] if f.group and f.heldout_drop > 0.0 and "t0" not in f.theta]
            if choice.partner is not None:  # of two, each alone
                others = [choice.partner, replace(choice, partner=None)]
            others = [] if ask else others
            added = self._first_gain(model, found, [picked, *others])
            if added is None:
                return Improved(model, tuple(steps), tuple(diagnoses), "no_gain")
            model = self._taken(added, steps)
        return Improved(model, tuple(steps), tuple(diagnoses), "steps")

    def _taken(self, added: Added, steps: list[Added]) -> Model:
        """A step is made."""
        steps.append(added)
        self.own = added.own_kept
        if self.step:
            self.step(added)
        self.best = min(self.best, residual_size(added.model.effects, self.given.readings))
        return added.model

    def _further(self, model: Model) -> Added | None:
        """A further temperature of an effect that is there, where it predicts held-out runs better."""
        new = further_temperature(Judgement(model, self.given))
        if new is None:
            return None
        try:
            added = add(model, [new], self.measurements, stage=self.stage, given=self.given, own=self.own)
        except ModelError:
            return None
        last = added.model.effects[-1]
        known = all(abs(v) > DETERMINED * last.errors.get(n, 0.0) for n, v in last.values.items())
        return replace(added, notes=(FURTHER, *added.notes)) if known and self._gains(added) else None

    def _first_gain(self, model: Model, found: Diagnosis, findings: Sequence[Finding]) -> Added | None:
        """Add the first that predicts held-out runs better on the channels as the loop has them."""
        for finding in findings:
            pair = [finding] if finding.partner is None else [finding, finding.partner]
            new = [new_effect(f.effect, model, f.theta, {k: n.value for k, n in f.parameters.items()}) for f in pair]
            if any(is_there(model, n) for n in new):
                continue
            try:
                added = add(model, new, self.measurements, stage=self.stage, given=self.given, own=self.own)
            except ModelError:
                continue  # on the channels as the loop has them it is confounded with what the model has
            if self._gains(added):
                return _with_rivals(added, found, finding)
        return None

    def _gains(self, added: Added) -> bool:
        """Whether an addition is worth its place: it predicts held-out runs, and cancels nothing that is there."""
        return (
            not added.undetermined
            and added.after.held_out <= (1.0 - LITTLE) * added.before.held_out
            and self._no_worse(added)
        )

    def _no_worse(self, added: Added) -> bool:
        """Whether a model leaves no more of the readings than the start did, and than every step before it."""
        return residual_size(added.model.effects, self.given.readings) <= (1.0 + WORTH) * self.best


def _with_rivals(added: Added, found: Diagnosis, taken: Finding) -> Added:
    """The same with what was passed over: in the notes and in the history."""
    rivals = rivals_of(found, taken)
    if not rivals:
        return added
    entry = {**added.model.history[-1], "passed_over": [r.facts() for r in rivals]}
    model = replace(added.model, history=(*added.model.history[:-1], entry))
    return replace(added, model=model, notes=(*said(taken, rivals), *added.notes), passed_over=rivals)


def _inseparable(found: Diagnosis, machine: Machine) -> bool:
    """Whether an axis went its way only once, and what is named may as well be something else.

    A single reversal does not show how reversals change. One number of geometry is added even if something else is as
    likely: it is what every machine has, and the least that can be wrong.
    """
    if not any(d.kind == "one_pass" for d in found.doubts):
        return False
    first = found.findings[0]
    read, ways = set(first.effect.channels(machine)), {a.direction_channel for a in machine.axes}
    plain = len(first.effect.coefficients(machine)) == 1 and first.partner is None
    plain = plain and read <= ways | {a.channel for a in machine.axes}
    return bool(read & ways and read - ways) or (found.verdict == "ambiguous" and not plain)


def _ended(last: Diagnosis, steps: Sequence[Added]) -> Reason:
    """Why it ended where nothing was named.

    The floor alone is no reason to stop looking: a noise fitted while something is missing holds part of that.
    """
    if last.verdict in ("unknown_effect", "undecided"):
        return last.verdict
    return "at_floor" if steps and _at_floor(steps[-1]) else "nothing_missing"


def _at_floor(step: Added) -> bool:
    """Whether a step led to the noise floor, as far as held-out runs show."""
    return step.after.held_out <= AT_FLOOR * step.floor

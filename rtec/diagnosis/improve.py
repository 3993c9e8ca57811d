"""Diagnose and add, again and again, until nothing significant is left or the error is at the noise floor."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from rtec.diagnosis.absent import SURE
from rtec.diagnosis.add import Added, add, new_effect
from rtec.diagnosis.diagnose import ALPHA, DRAWS, diagnose
from rtec.diagnosis.result import Diagnosis, Finding
from rtec.metrology.measurement import Measurement
from rtec.model import Model

Stage = Callable[[str, int, int], None]
Reason = Literal["nothing_missing", "unknown_effect", "ambiguous", "stopped", "at_floor", "no_gain", "steps"]

AT_FLOOR = 1.05
"""Held-out error over the noise floor up to which a model is said to be at it."""
LITTLE = 0.02
"""A relative fall of the held-out error below this is not worth an effect."""
MOST = 8


@dataclass(frozen=True)
class Choice:
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
class Improved:
    """A model improved step by step.

    Attributes:
        model: the last one.
        steps: what was added, in order.
        diagnoses: one for each step, and the last, which found nothing more or was not followed.
        reason: why it ended.
    """

    model: Model
    steps: tuple[Added, ...]
    diagnoses: tuple[Diagnosis, ...]
    reason: Reason

    def facts(self) -> dict[str, Any]:
        """The result as plain data, for JSON."""
        return {
            "reason": self.reason,
            "steps": [s.facts() for s in self.steps],
            "last_diagnosis": self.diagnoses[-1].facts() if self.diagnoses else None,
            "model_sha256": self.model.hash,
        }


def improve(
    model: Model,
    measurements: Sequence[Measurement],
    *,
    ask: Callable[[Choice], Finding | None] | None = None,
    seed: int = 1,
    alpha: float = ALPHA,
    draws: int = DRAWS,
    stage: Stage | None = None,
    step: Callable[[Added], None] | None = None,
) -> Improved:
    """Add what is missing until nothing significant is.

    Args:
        model: the current model.
        measurements: of its machine.
        ask: which candidate to add, None to stop; without it the best is added where the readings decide, and also
            where several cannot be told apart (they predict the same here).
        seed, alpha, draws: of the diagnosis.
        stage: told how far it is.
        step: given each addition as soon as it is made.

    Raises:
        MeasurementError: as `diagnose`.
    """
    steps: list[Added] = []
    diagnoses: list[Diagnosis] = []
    while len(steps) < MOST:
        found = diagnose(model, measurements, seed=seed, alpha=alpha, draws=draws, stage=stage)
        diagnoses.append(found)
        if not found.findings or not found.findings[0].accepted:
            return Improved(model, tuple(steps), tuple(diagnoses), _ended(found, steps))
        choice = found.findings[0]
        picked = ask(Choice(found, choice, len(steps) + 1)) if ask else choice
        if picked is None:
            return Improved(model, tuple(steps), tuple(diagnoses), "stopped")
        others = [] if ask else [f for f in found.findings[1:] if f.log_evidence > SURE and f.heldout_drop > 0.0]
        added = _first_gain(model, [picked, *others], measurements, stage)
        if added is None:
            return Improved(model, tuple(steps), tuple(diagnoses), "no_gain")
        steps.append(added)
        if step:
            step(added)
        model = added.model
    return Improved(model, tuple(steps), tuple(diagnoses), "steps")


def _first_gain(
    model: Model, findings: Sequence[Finding], measurements: Sequence[Measurement], stage: Stage | None
) -> Added | None:
    """Add the first that makes runs left out better on the channels as the loop has them."""
    for finding in findings:
        pair = [finding] if finding.partner is None else [finding, finding.partner]
        new = [new_effect(f.effect, model, f.theta, {k: n.value for k, n in f.parameters.items()}) for f in pair]
        added = add(model, new, measurements, stage=stage)
        if added.after.held_out <= (1.0 - LITTLE) * added.before.held_out:
            return added
    return None


def _ended(last: Diagnosis, steps: Sequence[Added]) -> Reason:
    """Why it ended where nothing was named.

    The floor alone is no reason to stop looking: a noise fitted while something is missing holds part of that.
    """
    if last.verdict == "unknown_effect":
        return "unknown_effect"
    at_floor = bool(steps) and steps[-1].after.held_out <= AT_FLOOR * steps[-1].floor
    return "at_floor" if at_floor else "nothing_missing"

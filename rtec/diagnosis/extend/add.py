"""Adds effects to a model, refits everything, and reports the error on held-out runs before and after.

A user requests an effect by its name, a component and its arguments.

Where the readings cannot separate the added effect from others, those rivals are recorded.
"""

import math
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from rtec.arrays import Floats
from rtec.diagnosis.doubts.doubt import Doubt
from rtec.diagnosis.doubts.record import doubts
from rtec.diagnosis.extend.history import Errors, entry_of, notes_of, ranges_of
from rtec.diagnosis.extend.parameter_scan import scan_ranges
from rtec.diagnosis.extend.record_event import note_of, of_record
from rtec.diagnosis.result import Alike, Diagnosis, Finding
from rtec.diagnosis.usable import check_enough, check_finite, unsure
from rtec.diagnosis.words import labels
from rtec.effects import Effect, all_effects, effect_class
from rtec.effects.cyclic import Cyclic
from rtec.effects.registry import check_effect
from rtec.errors import ModelError
from rtec.estimation import floor
from rtec.estimation.floor import Unit
from rtec.estimation.given import given_to
from rtec.estimation.gls import held_out, solve, without_nuisance
from rtec.estimation.joint import ChangedNumber, Joint, changed_between, joint_fit
from rtec.estimation.judge import Judgement
from rtec.estimation.kinds import spreads
from rtec.estimation.noise import least_noise
from rtec.estimation.outliers import Clean
from rtec.estimation.readings import Readings
from rtec.estimation.unmeasured import UnmeasuredMotion, unmeasured_motions
from rtec.estimation.warmth import differs_from_fit_day, expands_much
from rtec.estimation.wrong_scale import check_scales
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from rtec.model.model import names_of
from rtec.parallel import one_blas_thread
from rtec.result import Result
from rtec.tomlfile import nearest, validated
from rtec.wording import percent, significant, two_numbers

TOLD = 4


@dataclass(frozen=True)
class PassedOver:
    """An effect that explains the readings equally well.

    Attributes:
        label: short name.
        confidence: its posterior probability; None where it was not fitted.
        test: the measurement that separates it from the added effect; empty where none is known.
    """

    label: str
    confidence: float | None
    test: str

    def facts(self) -> dict[str, Any]:
        """As plain data, without unknown items."""
        out: dict[str, Any] = {"effect": self.label}
        if self.confidence is not None:
            out["confidence"] = self.confidence
        return out | ({"separating_test": self.test} if self.test else {})


def rivals_of(found: Diagnosis, taken: Finding) -> tuple[PassedOver, ...]:
    """All effects that these readings cannot distinguish from the added one, likeliest first.

    An effect that explains another part of the readings is no rival: the next search considers it again.

    Args:
        found: the diagnosis that proposed it.
        taken: the added one of its findings.
    """
    if not found.findings or not found.findings[0].accepted:
        return ()
    known = {(a.effect, a.component): a for a in found.findings[0].confused_with}
    apart = {key for key, a in known.items() if a.apart} if taken is found.findings[0] else set()
    partner = taken.partner.effect if taken.partner else None
    group = [
        (f, label)
        for f, label in zip(found.findings, labels(found.findings), strict=True)
        if f.group and f is not taken and f.effect != partner and _key(f) not in apart
    ]
    out = [PassedOver(label, f.confidence, _test(known.get(_key(f)))) for f, label in group]
    there = {_key(taken), *(_key(f) for f, _ in group)} | apart
    others = [a for key, a in known.items() if key not in there]
    out += [PassedOver(a.label or f"{a.effect}({a.component})", None, _test(a)) for a in others]
    return tuple(out)


def _key(finding: Finding) -> tuple[str, str]:
    return finding.effect.effect, finding.effect.component


def _test(alike: Alike | None) -> str:
    return alike.separating_test if alike is not None else ""


def rival_notes(taken: Finding, rivals: Sequence[PassedOver]) -> tuple[str, ...]:
    """Note that the readings did not decide, with the rivals and the test that separates each."""
    named = ", ".join(
        r.label + (f" ({percent(r.confidence)})" if r.confidence is not None else "") for r in rivals[:TOLD]
    )
    more = f" and {len(rivals) - TOLD} more" if len(rivals) > TOLD else ""
    taken_so = f"{taken.label} ({percent(taken.confidence)}) was taken"
    first = f"{taken_so}, but these data cannot distinguish it from {named}{more}"
    return (first, *(f"to separate it from {r.label}: {r.test}" for r in rivals[:TOLD] if r.test))


Stage = Callable[[str, int, int], None]

WORTH = 1e-3
"""A smaller relative fall of the held-out error counts as none: free numbers always lower it a little."""
CLEARLY = 0.02
"""A fall of the error on held-out runs by more than this share is clear: then a model keeps its own numbers, or gets an
effect."""
HOLDS, NEARLY = 0.95, 1.1
"""A model keeps its own numbers where they are no reason for its residual. Beside them, the addition must remove this
share of what it removes of the mean square with all numbers refitted, and predict held-out runs within the second
factor. Slow drift, which the numbers follow, does not count."""
FAR = 5.0
"""A number that moves by this many standard errors is another one."""
SHARPER, SURELY = 0.1, 10.0
"""Beyond slow drift, a fall of the mean square on held-out runs by more than this share and of the logarithm of the
likelihood by more than the second is clear."""
ROUNDING = 1e-9
"""A column is absorbed by the instrument's own unknowns where they leave less than this share of it."""


@dataclass(frozen=True)
class Added(Result):
    """A model with effects added.

    Attributes:
        model: refitted, with its history.
        labels: of the added effects.
        before: errors of the model before, refitted to the same measurements.
        after: errors with the new effects.
        floor: noise floor, as in `compare`.
        unit: "um", "urad", or "noise" (multiples of it).
        better: whether the error on held-out runs fell by more than `WORTH`.
        smoothed: held-out error with temperatures smoothed both ways in time, which the loop cannot do.
        notes: further remarks, in words.
        floor_from: "repeats", "short-time differences", or both.
        passed_over: effects that these readings cannot distinguish from the added one.
        undetermined: effects that cancel each other since the addition: only their sum is determined.
        doubts: about the record, in words, where they rule out fitting any number of the model to it.
        impossible: numbers that no machine has, or that this one had not on the day of the fit, in words.
        own_kept: number of effects of the model, from the first on, that have kept their numbers.
        changed: numbers of the model that have changed since the readings that it was fitted to.
        unmeasured: motions of the tool that the added effects bring along and that no reading shows.
        in_place_of: label of the effect whose change it replaces; empty for none.
    """

    page_maker: ClassVar[str] = "rtec.report.history:added_page"

    model: Model
    labels: tuple[str, ...]
    before: Errors
    after: Errors
    floor: float
    unit: Unit
    better: bool
    smoothed: float
    notes: tuple[str, ...] = ()
    floor_from: str = ""
    passed_over: tuple[PassedOver, ...] = ()
    undetermined: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    impossible: tuple[str, ...] = ()
    own_kept: int = 0
    changed: tuple[ChangedNumber, ...] = ()
    unmeasured: tuple[UnmeasuredMotion, ...] = ()
    in_place_of: str = ""

    @property
    def question(self) -> str:
        """What a user is asked before it is kept."""
        if not self.labels:
            return "Refit the model's own numbers?"
        how = f"in place of the change of {self.in_place_of}" if self.in_place_of else "a further temperature"
        return f"Add {', '.join(self.labels)}, {how}?"

    def rows(self) -> list[Mapping[str, Any]]:
        """The error before and after."""
        return [{"when": "before", **vars(self.before)}, {"when": "after", **vars(self.after)}]

    def facts(self) -> dict[str, Any]:
        """The result as plain data, for JSON."""
        return {
            "added": list(self.labels),
            "unit": self.unit,
            "before": vars(self.before),
            "after": vars(self.after),
            "noise_floor": self.floor,
            "noise_floor_um": self.floor,
            "noise_floor_from": self.floor_from,
            "better": self.better,
            "held_out_with_smoothed_temperatures": self.smoothed,
            "passed_over": [r.facts() for r in self.passed_over],
            "undetermined": list(self.undetermined),
            "changed": [asdict(c) for c in self.changed],
            "unmeasured": [vars(u) for u in self.unmeasured],
            "doubts": list(self.doubts),
            "impossible": list(self.impossible),
            "notes": list(self.notes),
            "history": [dict(h) for h in self.model.history],
            "model_sha256": self.model.hash,
        }


def new_effect(
    effect: Effect, model: Model, theta: Mapping[str, float] | None = None, values: Mapping[str, float] | None = None
) -> FittedEffect:
    """A new effect: non-linear parameters at their start or as given, coefficients zero or as given.

    A wave that grows starts with the period of the same wave of constant size where the model has one.

    Raises:
        ModelError: it does not fit the machine, or has no number of this name.
    """
    check_effect(effect, model.machine, "add")
    linear, free = names_of(effect, model.machine)
    same = (f.theta for f in model.effects if isinstance(effect, Cyclic) and f.effect == effect.steady)
    given = {**next(same, {}), **(theta or {}), **(values or {})}
    wrong = [n for n in given if n not in (*linear, *free)]
    if wrong:
        raise ModelError(f"add: {effect.effect} has no number {wrong[0]!r}; it has: {', '.join((*linear, *free))}")
    start = {p.name: float(given.get(p.name, p.start)) for p in effect.nonlinear(model.machine)}
    return FittedEffect(effect, {n: float(given.get(n, 0.0)) for n in linear}, start)


def add(
    model: Model,
    new: Sequence[FittedEffect],
    measurements: Sequence[Measurement],
    *,
    stage: Stage | None = None,
    given: Clean | None = None,
    own: int | None = None,
    earlier: Model | None = None,
    held: bool = False,
) -> Added:
    """Add effects and refit everything, on the channels that the loop has.

    Where the model was not fitted to these readings before, and held-out runs are predicted better if it keeps its own
    numbers, only the new effects are fitted: numbers that few runs or a large drift determine badly would hide them.

    Args:
        model: the current model.
        new: effects to add, from `new_effect`; empty for a mere refit.
        measurements: of its machine.
        stage: progress callback: called with the stage, steps done, steps in total.
        given: the measurements, already read; the caller has checked the record for doubts.
        own: number of effects of the model, from the first on, whose numbers were not fitted to these readings; by
            default all, or none if the model names one of the measurements.
        earlier: the model before any of its numbers was fitted to these readings; by default the model itself, unless
            it names one of the measurements.
        held: whether the first `own` effects keep their numbers in any case.

    Raises:
        MeasurementError: a channel is missing, or readings have the wrong sign or unit.
        ModelError: a new effect is in the model already, or no reading shows it.
    """
    progress = stage or (lambda *_: None)
    with one_blas_thread():
        again = any(m.fingerprint in model.measurements.values() for m in measurements)
        kept = own if own is not None else 0 if again else len(model.effects)
        before = earlier if earlier is not None else None if again else model
        return _add(model, new, measurements, progress, given, kept, before, held)


def _add(
    model: Model,
    new: Sequence[FittedEffect],
    measurements: Sequence[Measurement],
    progress: Stage,
    given: Clean | None,
    own: int,
    earlier: Model | None,
    held: bool,
) -> Added:
    _check_new(model, new)
    check_enough(measurements)
    progress("refitting the model as it is", 0, 3)
    there = given or given_to(model, measurements).without_ends()
    readings = there.readings
    wrong = in_doubt(Judgement(model, there)) if given is None else ()
    if all(d.kind == "wrong_scale" for d in wrong):
        check_scales(readings, predicted(model.effects, readings))
    before = joint_fit(model.effects, readings, earlier=earlier)
    progress("refitting with what is new" if new else "refitting", 1, 3)
    after, searched = _with_new(model, new, before, readings, earlier) if new else (no_worse(model, before), ())
    progress("held-out runs", 2, 3)
    made, freely = _judged(model, new, measurements, there, (before, after), own, 0), after
    if new and own:
        kept = _with_own(model, after, own, readings)
        other = _judged(model, new, measurements, there, (before, kept), own, own)
        settles = bool(after.undetermined) and not kept.undetermined and other.better
        lower, n = other.after.held_out < (1.0 - CLEARLY) * made.after.held_out, len(readings)
        clearly = lower and not (sharper(other.after, made.after, n) and gains(made.before, made.after, n))
        if held or settles or clearly or _holds(model, there, made, other):
            after, made = kept, other
    if new and not held and not gains(made.before, made.after, len(readings)):
        # Numbers held near what earlier readings made them hide what free ones show before and after.
        free = _judged(model, new, measurements, there, (before, freely), own, 0, alike=True)
        if gains(free.before, free.after, len(readings)) and _settled_gain(model, there, before, freely):
            after, made = freely, free
    worse = not held and _size(readings, freely.left) > (1.0 + WORTH) * _size(readings, before.left)
    if new and earlier is not None and worse and not gains(made.before, made.after, len(readings)):
        # Numbers that have changed without what is new were held beside it: these readings alone determine both.
        alone, words = _with_new(model, new, before, readings, None)
        free = _judged(model, new, measurements, there, (before, alone), own, 0)
        if gains(free.before, free.after, len(readings)):
            after, made, searched = alone, free, words
    progress("held-out runs", 3, 3)
    named, before_it = labels(after.effects), set(before.undetermined if new else after.undetermined)
    cancelling = tuple(named[i] for i in after.undetermined if i not in before_it)
    other_day = differs_from_fit_day(earlier, made.model) if earlier is not None else ()
    much = (*_beyond_materials(model.effects, made.model.effects), *other_day)
    better = made.better and not cancelling and not wrong and not much
    return replace(
        made,
        notes=(*made.notes, *searched),
        undetermined=cancelling,
        better=better,
        doubts=tuple(d.words for d in wrong),
        impossible=much,
        changed=changed_between(model, after, readings) if earlier is model else (),
        unmeasured=unmeasured_motions(after.effects, readings, len(model.effects)),
    )


def far_apart(was: FittedEffect, now: FittedEffect, name: str, far: float = FAR) -> bool:
    """Whether a number of an effect moved by `far` standard errors, its own and the new one's together.

    A number without a standard error is known too little for that.
    """
    known, error = was.errors.get(name, 0.0), now.errors.get(name, 0.0)
    return known > 0.0 and abs(now.values[name] - was.values[name]) > far * math.hypot(known, error)


def moves_far(model: Model, made: Added) -> bool:
    """Whether a refit moves a number of a model far from what it was known to be."""
    pairs = zip(model.effects, made.model.effects, strict=False)
    return any(far_apart(was, now, n) for was, now in pairs for n in was.values)


def _holds(model: Model, given: Clean, made: Added, kept: Added) -> bool:
    """Whether what is new explains what the model leaves nearly as well if the model keeps its own numbers.

    This is asked only where the refit moves them far from what they were known to be.

    Args:
        model: the model before.
        given: the readings.
        made: with all numbers refitted.
        kept: with the model's own numbers.
    """
    if not moves_far(model, made) or not kept.better or kept.after.held_out > NEARLY * made.after.held_out:
        return False
    free, fixed = made.after.beyond_drift, kept.after.beyond_drift
    there = Judgement(model, given).beyond_drift(Judgement(made.model, given).flexible, range(kept.own_kept))
    return there**2 - fixed**2 >= HOLDS * (there**2 - free**2)


def in_doubt(judged: Judgement) -> tuple[Doubt, ...]:
    """Reasons why no number of a model should be fitted to a record; empty where there are none."""
    return tuple(d for d in doubts(judged) if d.blames_no_effect)


NEAR = 0.02
"""Periods and time constants within this relative difference are one."""
TAKEN_UP = 1e-3
"""A column is confounded with the model's own where they leave less than this share of its norm."""


def _near(one: float, other: float) -> bool:
    return abs(one - other) <= NEAR * max(abs(one), abs(other))


def _taken_up(columns: Floats, before: Joint) -> bool:
    """Whether the model's own columns, (m, p), explain all of the new ones, (m, k)."""
    readings = before.weights.readings
    mine, base = (without_nuisance(readings, c) for c in (columns, before.columns))
    left = mine - base @ np.column_stack([solve(base, c) for c in mine.T])
    size = np.linalg.norm(mine, axis=0)
    return bool(np.all(np.linalg.norm(left, axis=0) <= TAKEN_UP * np.maximum(size, 1e-300)))


def no_worse(model: Model, refitted: Joint) -> Joint:
    """The refit where its residual is no larger than the model's as it is; else the ordinary fit; else no refit."""
    readings = refitted.weights.readings
    stands = readings.values - predicted(model.effects, readings)
    bound = (1.0 + ROUNDING) * residual_size(model.effects, readings)
    fits = [refitted, *([refitted.plain] if refitted.plain is not None else [])]
    good = [f for f in fits if _size(readings, f.left) <= bound]
    as_it_is = replace(refitted, effects=model.effects, left=stands, correlation=model.correlation)
    return good[0] if good else as_it_is


def residual_size(effects: Sequence[FittedEffect], readings: Readings) -> float:
    """Residual of effects in the readings' own units, relative to the readings; the measure of `improve`."""
    return _size(readings, readings.values - predicted(effects, readings))


def _size(readings: Readings, left: Floats) -> float:
    """Root mean square of residuals, (m,), each series relative to the spread of the readings of equal instruments."""
    spread = spreads(readings, floor.cleaned(readings, readings.values))
    return floor.pooled(
        readings, floor.rms_by_series(readings, floor.cleaned(readings, left)), 1.0 / np.maximum(spread, 1e-12)
    )


def _moves(readings: Readings, column: Floats) -> bool:
    """Whether a column, (m,), is larger than rounding once the instruments' own unknowns are removed."""
    return bool(np.abs(floor.cleaned(readings, column)).max() > ROUNDING * np.abs(column).max())


def _with_new(
    model: Model, new: Sequence[FittedEffect], before: Joint, readings: Readings, earlier: Model | None
) -> tuple[Joint, tuple[str, ...]]:
    """Refit with the new effects; also notes on the search of their parameters, in words."""
    found: list[FittedEffect] = []
    words: list[str] = []
    for fitted in new:
        placed, scan_notes = scan_ranges(fitted, before, readings)
        columns = check_finite(placed, readings)
        if not any(_moves(readings, column) for column in columns.T):
            raise ModelError(f"add: no reading shows {fitted.label}; nothing that it depends on was moved")
        if before.columns.shape[1] and _taken_up(columns, before):
            raise ModelError(
                f"add: {fitted.label} cannot be distinguished from what the model has already (confounded); measure "
                "where they differ"
            )
        found.append(placed)
        words += scan_notes
    least = least_noise(readings, floor.cleaned(readings, before.left))
    return joint_fit((*model.effects, *found), readings, earlier=earlier, least=least), tuple(words)


def _with_own(model: Model, refitted: Joint, own: int, readings: Readings) -> Joint:
    """Fit what is new, and effects that were added before, while the first effects keep their numbers.

    Args:
        model: the model before.
        refitted: with what is new, all numbers refitted.
        own: effects that keep their numbers.
        readings: the readings.
    """
    known = len(model.effects)
    alone = replace(readings, values=readings.values - predicted(model.effects[:own], readings))
    fresh = [replace(f, errors={}) for f in refitted.effects[known:]]
    least = least_noise(readings, floor.cleaned(readings, refitted.left))
    fit = joint_fit((*model.effects[own:], *fresh), alone, least=least)
    undetermined = tuple(own + i for i in fit.undetermined)
    effects = (*model.effects[:own], *fit.effects)
    return replace(fit, effects=effects, undetermined=undetermined, correlation=model.correlation, settled=())


def _judged(
    model: Model,
    new: Sequence[FittedEffect],
    measurements: Sequence[Measurement],
    given: Clean,
    fits: tuple[Joint, Joint],
    fresh: int,
    own: int,
    alike: bool = False,
) -> Added:
    """Residual before and after, and the model with its history.

    Args:
        model: the model before.
        new: the added effects.
        measurements, given: the readings.
        fits: of the model before, and with what is new.
        fresh: number of effects whose numbers were not fitted to these readings before: for them all runs are held out.
        own: number of effects that keep their numbers in the fit.
        alike: predict held-out runs after the addition as before it, by numbers refitted to all others.
    """
    (refitted, after), effects = fits, fits[1].effects
    ranges = ranges_of(model, effects, given.readings)
    grown = replace(model, effects=effects, valid_range=ranges, correlation=after.correlation)
    now, kept = Judgement(grown, given), set[int]() if alike else {*range(own), *after.settled}
    was = Judgement(model, given, tuple(now.scale))
    ways = [range(0), range(fresh), refitted.settled] if new else [range(len(model.effects))]
    held, sharp = min(map(was.with_own, ways)), min(was.beyond_drift(now.flexible, kept) for kept in ways)
    before = Errors(was.residual, was.residual, held, sharp)
    after_it = Errors(None, now.residual, now.with_own(kept), now.beyond_drift(now.flexible, kept))
    noise, added = now.noise_floor, tuple(labels(effects)[len(model.effects) :])
    entry = entry_of(
        added, before, after_it, (noise, now.floor_from), now.unit, measurements, len(given.readings), model
    )
    made = replace(
        grown,
        noise_um=noise if now.unit == "um" else model.noise_um,
        measurements={**model.measurements, **{m.name: m.fingerprint for m in measurements}},
        history=(*model.history, entry),
    )
    better = after_it.held_out < (1.0 - WORTH) * before.held_out or gains(before, after_it, len(given.readings))
    smooth = _with_smooth(after, now.scale)
    of_time = (note_of(f.effect) for f in new if of_record(f.effect, model.machine))
    hidden = _hidden_by_drift(before, after_it, len(given.readings))
    notes = (*of_time, *hidden, *after.disputed, *unsure(effects[len(model.effects) :]), *notes_of(model, measurements))
    return Added(made, added, before, after_it, noise, now.unit, better, smooth, notes, now.floor_from, own_kept=own)


def _settled_gain(model: Model, given: Clean, before: Joint, after: Joint) -> bool:
    """Whether held-out runs are predicted better beside what earlier readings determined, refined in both fits."""
    one, two = (Judgement(replace(model, effects=f.effects), given).with_own(f.settled) for f in (before, after))
    return two < (1.0 - WORTH) * one


def _hidden_by_drift(before: Errors, after: Errors, readings: int) -> tuple[str, ...]:
    """Note where only the error beyond slow drift falls, in words."""
    if after.held_out <= (1.0 - CLEARLY) * before.held_out or not gains(before, after, readings):
        return ()
    one, two = two_numbers(before.beyond_drift, after.beyond_drift)
    return (
        "the error on held-out runs is mostly slow drift that no recorded channel explains; beyond that drift it falls "
        f"from {one} to {two} times the noise",
    )


def gains(before: Errors, after: Errors, readings: int) -> bool:
    """Whether held-out runs are predicted clearly better: as they are, or beyond a slow drift that hides it."""
    if after.held_out <= (1.0 - CLEARLY) * before.held_out:
        return True
    return after.held_out <= (1.0 + CLEARLY) * before.held_out and sharper(before, after, readings)


def sharper(before: Errors, after: Errors, readings: int) -> bool:
    """Whether the error on held-out runs beyond slow drift falls clearly."""
    fall = before.beyond_drift**2 - after.beyond_drift**2
    return fall > SHARPER * before.beyond_drift**2 and 0.5 * fall * readings > SURELY


def not_determined(names: Sequence[str]) -> str:
    """What readings do not determine of effects, one or several that cancel each other, in words."""
    if len(names) == 1:
        wave = issubclass(all_effects().get(names[0].split("(")[0], Effect), Cyclic)
        why = ": the targets show too little of its turn; measure at unequal steps" if wave else ""
        return f"these readings do not determine {names[0]} beside the other effects of the model{why}"
    return f"these readings determine only what {' and '.join(names)} make together"


def refused(added: Added) -> str:
    """Why an addition does not improve the model enough, in words."""
    if added.impossible:
        return "; ".join(added.impossible)
    if added.doubts:
        return f"the record is in doubt: {' '.join(added.doubts)}".rstrip(".")
    if added.undetermined:
        if len(added.undetermined) == 1:
            return f"{not_determined(added.undetermined)}: it is uncertain by more than was read"
        return (
            f"{not_determined(added.undetermined)}; what each makes alone is uncertain by more than was read, and on "
            "another day they no longer cancel"
        )
    before, after = two_numbers(added.before.held_out, added.after.held_out)
    if added.after.held_out < added.before.held_out:
        return f"the error on held-out runs falls from {before} to {after}, which is less than 0.1 %"
    return f"the error on held-out runs rises from {before} to {after}"


def predicted(effects: Sequence[FittedEffect], readings: Readings) -> Floats:
    """Prediction of effects, (m,)."""
    out = np.zeros(len(readings))
    for f in effects:
        columns = readings.columns(f.effect, f.theta)
        out += columns @ np.array([f.values[p.name] for p in f.effect.coefficients(readings.machine)])
    return out


def is_there(model: Model, fitted: FittedEffect) -> bool:
    """Whether a model already has an effect; a wave with another period is a different one, and a delay likewise."""
    same = [f for f in model.effects if f.effect == fitted.effect]
    return any(not f.theta or all(_near(f.theta[n], fitted.theta[n]) for n in f.theta) for f in same)


def _beyond_materials(before: Sequence[FittedEffect], after: Sequence[FittedEffect]) -> tuple[str, ...]:
    """Expansions that are more than those of any material, and were not before, in words."""

    def much(f: FittedEffect) -> bool:
        return "k" in f.values and expands_much(f.effect, f.values["k"], f.errors.get("k", 0.0))

    there = {f.label for f in before if much(f)}
    return tuple(
        f"{f.label} would have k = {significant(f.values['k'])} µm/(m·K), and no material of a machine expands so much"
        for f in after
        if much(f) and f.label not in there
    )


def _check_new(model: Model, new: Sequence[FittedEffect]) -> None:
    for fitted in new:
        if is_there(model, fitted):
            raise ModelError(
                f"add: {fitted.label} is in the model already; its numbers are refitted whenever something is added"
            )


def _with_smooth(joint: Joint, scale: Floats) -> float:
    smooth = joint.weights.readings.smoothed()
    columns = [smooth.columns(f.effect, f.theta) for f in joint.effects]
    whole = np.concatenate([np.zeros((len(smooth), 0)), *columns, smooth.setup], axis=1)
    return held_out(joint.weights, whole, scale).rms


def asked_effect(name: str, component: str | None, given: Mapping[str, Any], model: Model) -> FittedEffect:
    """Build an effect from its name, a component and what else it needs.

    An axis that is not given is the component's own. Coefficients and time constants may be given as a start.

    Raises:
        ModelError: an argument is missing or wrong; the message lists what is allowed.
    """
    name = name.lower() if name.lower() in all_effects() else name
    where = f"effect {name!r}"
    kind = effect_class(name, "rtec add")
    if component is None:
        raise ModelError(f"{where}: say which component error it feeds: --component EXX (`rtec effects {name}` tells)")
    arguments = {k: v for k, v in given.items() if k in kind.model_fields}
    if "axis" in kind.model_fields and "axis" not in arguments:
        own = component[2:].removeprefix("0")
        if own in model.machine.axis_names:
            arguments["axis"] = own
    _needed(kind, arguments, model, where)
    effect = validated(kind, {"effect": name, "component": component, **arguments}, where, ModelError)
    numbers = {k: _number(k, v, where) for k, v in given.items() if k not in arguments}
    return new_effect(effect, model, values=numbers)


def check_one(name: str | None, expr: str | None, refit: bool) -> None:
    """Check that one thing was requested: a name, an expression, or a refit.

    Raises:
        ModelError: more than one; a file in the place of the name belongs to `--data A B C`.
    """
    named = name is not None and name.lower() in all_effects() and not Path(name).exists()
    requested = [f"effect {name!r}"] * named + ["--expr"] * (expr is not None) + ["--refit"] * refit
    if len(requested) > 1:
        raise ModelError(f"add: {' and '.join(requested)} together: give either a name, or --expr, or --refit")


def settings_of(texts: Sequence[str], where: str) -> dict[str, Any]:
    """Settings from `key=value` texts; values as in TOML, or plain words.

    Raises:
        ModelError: a text is no `key=value`.
    """
    return dict(_pair(text, where) for text in texts)


def _pair(text: str, where: str) -> tuple[str, Any]:
    key, mark, value = text.partition("=")
    if not mark or not key.strip():
        raise ModelError(f"{where}: --set {text!r} is no key=value; for example --set sensor=T_bed")
    try:
        return key.strip(), tomllib.loads(f"value = {value.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        return key.strip(), value.strip()


def _needed(kind: type[Effect], arguments: dict[str, Any], model: Model, where: str) -> None:
    """Raise an error that names the missing arguments and what the machine has to offer."""
    machine = model.machine
    offers = {"sensor": machine.sensor_names, "front": machine.sensor_names, "back": machine.sensor_names}
    offers["axis"] = machine.axis_names
    for key, field in kind.model_fields.items():
        if key in arguments or not field.is_required() or key in ("effect", "component"):
            continue
        offer = f"; one of: {', '.join(offers[key])}" if key in offers else ""
        raise ModelError(f"{where}: --set {key}=… is missing{offer}")
    for key in ("sensor", "front", "back", "axis"):
        if key in arguments and isinstance(arguments[key], str) and arguments[key] not in offers[key]:
            raise ModelError(f"{where}: {key} {arguments[key]!r} is none{nearest(arguments[key], offers[key])}")


def _number(key: str, value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ModelError(f"{where}: {key} is {value!r}, which is no number")
    return float(value)

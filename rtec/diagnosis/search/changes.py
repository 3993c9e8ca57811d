"""Numbers of a model that have changed since its fit, and what only looks like a change.

Where a part is warmer or colder than at the fit, a scale error seems to have changed. A sensor that hardly moves today
but is degrees from all that it was at the fit shows by how much its part grew since. The scale error of the fit
contains the expansion up to its own temperature, so either one number explains the day in much the same way; how the
readings follow the temperature within the day decides.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

from rtec.diagnosis import words
from rtec.diagnosis.result import Diagnosis
from rtec.effects import Effect
from rtec.effects.geometry import Scale
from rtec.effects.thermal import AxisExpansion
from rtec.errors import RtecError
from rtec.estimation.joint import ChangedNumber, changed_numbers, joint_fit
from rtec.estimation.judge import Judgement
from rtec.estimation.outliers import Clean
from rtec.estimation.warmth import EXPANDS, FAR_K, MATERIAL, Warmer, off_along
from rtec.machine import Machine
from rtec.model import FittedEffect, Model

AS_WELL = 1.25
"""A residual within this factor of another one is as good: a sensor that is read in steps adds to it."""
AT_NOISE = 1.1
"""A residual within this factor of the noise floor says nothing about numbers that have changed."""
VISIBLE = 0.35
"""What an effect explains must be more than this multiple of the noise floor, in squares: what hides in the noise is
not worth an effect that names no cause and may act more strongly on another day."""
MOST_RIVALS = 2
MOSTLY = 0.5
"""Share of the change of a number without an effect by which it changes beside it, where it has changed of its own."""


def with_changes(found: Diagnosis, model: Model, given: Clean) -> Diagnosis:
    """The diagnosis, also with numbers of the model that have changed since the readings that it was fitted to.

    Beside a doubt about a slow change these are numbers of reversals alone.
    """
    again = any(m.fingerprint in model.measurements.values() for m in given.readings.measurements)
    known = any(f.errors for f in model.effects)
    doubted = [d for d in found.doubts if d.fatal]
    certain = all(d.changes_slowly for d in doubted) and found.rms_residual > AT_NOISE * found.noise_floor
    if again or not known or not certain:
        return found
    changed, effects = changed_numbers(model, given.readings)
    beside: tuple[ChangedNumber, ...] = ()
    if doubted:
        turned = {f.label for f in model.effects if _of_reversal(f.effect, model.machine)}
        changed = tuple(c for c in changed if c.effect in turned)
        pairs = zip(model.effects, effects, strict=True)
        effects = tuple(now if now.label in turned else was for was, now in pairs)
    if found.group:
        # A number that holds beside what is named, or mostly holds, only made up for its absence.
        still = {(c.effect, c.name): c for c in changed_numbers(model, given.readings, _named(found, model))[0]}
        changed = tuple(c for c in changed if _goes_on(c, still.get((c.effect, c.name))))
        before = {(c.effect, c.name) for c in changed}
        beside = tuple(c for key, c in still.items() if key not in before)
    left = Judgement(replace(model, effects=effects), given, tuple(found.judged.scale) if found.judged else None)
    if beside and not doubted:
        found = words.with_changes_beside(found, beside)
    if not changed:
        # Unlike `known`: a number without an error may be any.
        return words.within_errors(found) if not doubted and all(f.errors for f in model.effects) else found
    changed = with_expansions(changed, expansions_instead(model, given, changed, left.residual))
    kept = [i for i, f in enumerate(model.effects) if f.label not in {c.effect for c in changed}]
    return words.with_changes(found, changed, left.residual, left.with_own(kept))


def _goes_on(alone: ChangedNumber, beside: ChangedNumber | None) -> bool:
    """Whether a number has changed beside what is named, and by most of what it changes by without it."""
    return beside is not None and abs(beside.now - beside.was) > MOSTLY * abs(alone.now - alone.was)


def _of_reversal(effect: Effect, machine: Machine) -> bool:
    """Whether an effect depends on a direction, and on nothing that changes over hours."""
    read = set(effect.channels(machine))
    return bool(read & {a.direction_channel for a in machine.axes}) and not read & {*machine.sensor_names, "time_s"}


def _named(found: Diagnosis, model: Model) -> list[FittedEffect]:
    """What a diagnosis names, with coefficients zero."""
    first = found.findings[0]
    there = [(f.effect, f.theta) for f in (first, first.partner) if f is not None]
    there = [(m.fitted.effect, m.fitted.theta) for m in found.together] or there
    zero = [dict.fromkeys([p.name for p in effect.coefficients(model.machine)], 0.0) for effect, _ in there]
    return [FittedEffect(effect, values, dict(theta)) for (effect, theta), values in zip(there, zero, strict=True)]


def expansions_instead(
    model: Model, given: Clean, changed: Sequence[ChangedNumber], refitted: float
) -> list[tuple[FittedEffect, ChangedNumber]]:
    """Expansions that explain these readings better than a changed scale error, or as well and as a material expands.

    The best comes first.

    Args:
        model: with its own numbers, of an earlier day.
        given: today's readings.
        changed: numbers that seem to have changed.
        refitted: residual with these refitted.

    Returns:
        Each effect, its coefficient zero; and the number with the sensor, by how much it is warmer, and what it leaves.
    """
    bar = refitted**2 - (VISIBLE * Judgement(model, given).noise_floor) ** 2
    out: list[tuple[float, FittedEffect, ChangedNumber]] = []
    for c, new, by_k in _offered(model, given, changed):
        try:
            fit = joint_fit((*model.effects, new), given.readings, earlier=model)
        except RtecError:
            continue
        k, sensor = fit.effects[-1].values["k"], str(getattr(new.effect, "sensor", ""))
        size = Judgement(replace(model, effects=fit.effects), given).residual
        sure = 0.0 < k <= EXPANDS and size**2 < bar
        usual = not sure and c.warmer is not None and c.warmer.sensor == sensor and _is_usual(c.warmer)
        if usual and c.warmer is not None:  # with the model's own numbers, and what looks like their change
            k = c.warmer.growth
            grown = replace(new, values={"k": k})
            size = Judgement(replace(model, effects=(*model.effects, grown)), given).residual
        if sure or (usual and size < AS_WELL * refitted):
            warm = Warmer(sensor, by_k, k, new.label, size, sure=sure)
            out.append((size, new, replace(c, warmer=warm)))
    return [(new, c) for _, new, c in sorted(out, key=lambda f: f[0])]


def _is_usual(w: Warmer) -> bool:
    """Whether what looks like another scale error is what a screw or scale of a usual material grows by."""
    return abs(w.by_k) >= FAR_K and MATERIAL[0] <= w.growth <= MATERIAL[1]


def with_expansions(
    changed: Sequence[ChangedNumber], found: Sequence[tuple[FittedEffect, ChangedNumber]]
) -> tuple[ChangedNumber, ...]:
    """Changed numbers, each with the best expansion in its place and the rivals of that, where there is one."""
    out = []
    for c in changed:
        mine = [(new.label, n.warmer) for new, n in found if n.effect == c.effect]
        best = mine[0][1] if mine else c.warmer
        rivals = tuple(label for label, _ in mine[1 : 1 + MOST_RIVALS])
        out.append(replace(c, warmer=replace(best, rivals=rivals) if best is not None else None))
    return tuple(out)


def _offered(
    model: Model, given: Clean, changed: Sequence[ChangedNumber]
) -> Iterator[tuple[ChangedNumber, FittedEffect, float]]:
    """Expansions in place of each changed scale error: that number, the effect, and how much warmer its sensor is."""
    scales = {f.label: f.effect for f in model.effects if isinstance(f.effect, Scale) and f.errors}
    for c in changed:
        if (scale := scales.get(c.effect)) is None:
            continue
        for sensor, by_k in off_along(model, given.readings, scale.axis).items():
            grows = AxisExpansion(component=scale.component, axis=scale.axis, sensor=sensor)
            yield c, FittedEffect(grows, {"k": 0.0}), by_k

"""Adds effects to a model, refits everything, and says what it bought on runs that were left out."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis.extend.history import Errors, entry_of, notes_of, ranges_of
from rtec.diagnosis.extend.joint import LOOSE, Joint, joint_fit
from rtec.diagnosis.extend.parameter_scan import ranged
from rtec.diagnosis.extend.rivals import Rival
from rtec.diagnosis.usable import apart, check_enough, check_finite, unsure
from rtec.diagnosis.wrong_scale import check_scales
from rtec.effects import Effect
from rtec.errors import ModelError
from rtec.estimation import floor
from rtec.estimation.columns import spikes
from rtec.estimation.floor import Unit
from rtec.estimation.gls import held_out
from rtec.estimation.noise import least_noise
from rtec.estimation.readings import Readings, read
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from rtec.model.fit import Margin
from rtec.model.model import names_of
from rtec.parallel import one_blas_thread

Floats = NDArray[np.float64]
Stage = Callable[[str, int, int], None]

WORTH = 1e-3
"""A relative fall of the held-out error of less is none: numbers that are free to move always find a little."""
ROUNDING = 1e-9
"""What is left of a column that the instrument's own unknowns take up entirely, as a share of it, is no more."""


@dataclass(frozen=True)
class Added:
    """A model with effects added.

    Attributes:
        model: refitted, with its history.
        labels: what was added.
        before: the model as it was, refitted to the same measurements.
        after: with the new effects.
        floor: what noise alone leaves, as `compare` has it.
        unit: "um", "urad", or "noise" (multiples of it).
        better: whether the error on runs left out fell, by more than nothing.
        smoothed: held-out error with temperatures smoothed both ways in time, which the loop cannot do.
        notes: what else is to be known, in words.
        floor_from: "repeats", "fitted noise model", or both.
        passed_over: what these readings cannot tell from what was added.
    """

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
    passed_over: tuple[Rival, ...] = ()

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
            "notes": list(self.notes),
            "history": [dict(h) for h in self.model.history],
            "model_sha256": self.model.hash,
        }


def new_effect(
    effect: Effect, model: Model, theta: Mapping[str, float] | None = None, values: Mapping[str, float] | None = None
) -> FittedEffect:
    """An effect to be added: non-linear parameters at their start or as given, coefficients zero or as given.

    Raises:
        ModelError: it does not fit the machine, or a number is none of its own.
    """
    effect.check(model.machine, "add")
    linear, free = names_of(effect, model.machine)
    given = {**(theta or {}), **(values or {})}
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
    margin: Margin | None = None,
    stage: Stage | None = None,
) -> Added:
    """Add effects and refit everything on the channels as the loop sees them.

    Args:
        model: the current model.
        new: effects to add, from `new_effect`; none to only refit.
        measurements: of its machine.
        margin: how far valid ranges reach beyond the readings.
        stage: told how far it is.

    Raises:
        MeasurementError: a channel is missing, or readings have the wrong sign or unit.
        ModelError: a new effect is in the model already, or no reading shows it.
    """
    tell = stage or (lambda *_: None)
    with one_blas_thread():
        return _add(model, new, measurements, margin or Margin(), tell)


def _add(
    model: Model, new: Sequence[FittedEffect], measurements: Sequence[Measurement], margin: Margin, tell: Stage
) -> Added:
    _check_new(model, new)
    check_enough(measurements)
    tell("refitting the model as it is", 0, 3)
    readings = clean_readings(model, measurements)
    check_scales(readings, predicted(model.effects, readings))
    # Readings that the model was fitted to before say nothing new of how sure its numbers are.
    again = any(m.sha256 in model.measurements.values() for m in measurements)
    loose = LOOSE if again else None
    before = joint_fit(model.effects, readings, loose=loose)
    tell("refitting with what is new" if new else "refitting", 1, 3)
    after, searched = (before, ()) if not new else _with_new(model, new, before, readings, loose)
    tell("runs left out", 2, 3)
    made = _judged(model, new, measurements, readings, (before, after), margin)
    tell("runs left out", 3, 3)
    return replace(made, notes=(*made.notes, *searched))


def _moves(readings: Readings, column: Floats) -> bool:
    """Whether more of a column, (m,), than rounding is left once the instruments' own unknowns are taken out."""
    return bool(np.abs(floor.cleaned(readings, column)).max() > ROUNDING * np.abs(column).max())


def _with_new(
    model: Model, new: Sequence[FittedEffect], before: Joint, readings: Readings, loose: float | None
) -> tuple[Joint, tuple[str, ...]]:
    """Refit with what is new; also what its search is to be told of, in words."""
    found: list[FittedEffect] = []
    words: list[str] = []
    for fitted in new:
        placed, said = ranged(fitted, before, readings)
        columns = check_finite(placed, readings)
        if not any(_moves(readings, column) for column in columns.T):
            raise ModelError(f"add: no reading shows {fitted.label}; nothing that it depends on was moved")
        found.append(placed)
        words += said
    least = least_noise(readings, floor.cleaned(readings, before.left))
    return joint_fit((*model.effects, *found), readings, loose=loose, least=least), tuple(words)


def _judged(
    model: Model,
    new: Sequence[FittedEffect],
    measurements: Sequence[Measurement],
    readings: Readings,
    fits: tuple[Joint, Joint],
    margin: Margin,
) -> Added:
    """What both fits leave, and the model with its history."""
    after, unit = fits[1], floor.unit_of(readings)
    floors, sources = floor.as_compared(readings, floor.cleaned(readings, after.left), after.columns)
    scale = 1.0 / np.maximum(floors, 1e-12) if unit == "noise" else np.ones(len(floors))
    was, now = (_errors(j, after, readings, scale) for j in fits)
    left = floor.cleaned(readings, readings.values - predicted(model.effects, readings))
    given = floor.pooled(readings, floor.rms_by_series(readings, left), scale)
    # What a refit is compared with is the model as it stands.
    was = replace(was, as_given=given) if new else Errors(given, given, given)
    noise, source = floor.pooled(readings, floors, scale), " and ".join(sorted(set(sources)))
    labels = tuple(f.label for f in new)
    entry = entry_of(labels, was, now, (noise, source), unit, measurements, len(readings), model)
    made = replace(
        model,
        effects=after.effects,
        valid_range=ranges_of(model, after.effects, readings, margin),
        noise_um=noise if unit == "um" else model.noise_um,
        measurements={**model.measurements, **{m.name: m.sha256 for m in measurements if m.sha256}},
        history=(*model.history, entry),
    )
    better = now.held_out < (1.0 - WORTH) * was.held_out
    smooth = _with_smooth(after, measurements, model, scale)
    notes = (*unsure(after.effects[len(model.effects) :]), *notes_of(model, measurements))
    return Added(made, labels, was, now, noise, unit, better, smooth, notes, source)


def refused(added: Added) -> str:
    """Why an addition is not worth its place, in words."""
    before, after = apart(added.before.held_out, added.after.held_out)
    if added.after.held_out < added.before.held_out:
        return f"the error on runs left out falls from {before} to {after}, which is next to nothing"
    return f"the error on runs left out rises from {before} to {after}"


def clean_readings(model: Model, measurements: Sequence[Measurement]) -> Readings:
    """Readings with the channels as the loop sees them, without spikes."""
    readings = read(measurements, model.reference_degc, smooth=False)
    fit = joint_fit(model.effects, readings, search=False)
    lonely = spikes(readings, fit.left)
    return readings.without(lonely) if lonely.any() else readings


def predicted(effects: Sequence[FittedEffect], readings: Readings) -> Floats:
    """What effects say, (m,)."""
    out = np.zeros(len(readings))
    for f in effects:
        columns = readings.columns(f.effect, f.theta)
        out += columns @ np.array([f.values[p.name] for p in f.effect.coefficients(readings.machine)])
    return out


def _check_new(model: Model, new: Sequence[FittedEffect]) -> None:
    there = [f.effect for f in model.effects]
    for fitted in new:
        if fitted.effect in there:
            raise ModelError(
                f"add: {fitted.label} is in the model already; its numbers are refitted whenever something is added"
            )


def _errors(joint: Joint, after: Joint, readings: Readings, scale: Floats) -> Errors:
    """Both fits are judged under one noise, that of the better known model."""
    left = floor.cleaned(readings, joint.left)
    inside = floor.pooled(readings, floor.rms_by_series(readings, left), scale)
    return Errors(None, inside, held_out(after.whitener, joint.columns, scale).rms)


def _with_smooth(joint: Joint, measurements: Sequence[Measurement], model: Model, scale: Floats) -> float:
    smooth = read(measurements, model.reference_degc, smooth=True)
    there = joint.whitener.readings
    if len(smooth) != len(there):
        smooth = replace(there, states=smooth.states, _arms={})
    columns = [smooth.columns(f.effect, f.theta) for f in joint.effects]
    whole = np.concatenate([np.zeros((len(smooth), 0)), *columns, smooth.setup], axis=1)
    return held_out(joint.whitener, whole, scale).rms

"""Adds effects to a model, refits everything, and says what it bought on runs that were left out."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis import floor
from rtec.diagnosis.base import spikes
from rtec.diagnosis.entry import Errors, entry_of, notes_of, ranges_of
from rtec.diagnosis.floor import Unit
from rtec.diagnosis.joint import LOOSE, Joint, joint_fit
from rtec.diagnosis.noise import least_noise
from rtec.diagnosis.readings import Readings, read
from rtec.diagnosis.refit import held_out
from rtec.effects import Effect
from rtec.errors import ModelError
from rtec.metrology.characterise.threads import one_blas_thread
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from rtec.model.fit import Margin
from rtec.model.model import names_of

Floats = NDArray[np.float64]
Stage = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Added:
    """A model with effects added.

    Attributes:
        model: refitted, with its history.
        labels: what was added.
        before: the model as it was, refitted to the same measurements.
        after: with the new effects.
        floor: what noise alone leaves; never more than is left.
        unit: "um", "urad", or "noise" (multiples of it).
        better: whether the error on runs left out fell.
        smoothed: held-out error with temperatures smoothed both ways in time, which the loop cannot do.
        notes: what else is to be known, in words.
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

    def facts(self) -> dict[str, Any]:
        """The result as plain data, for JSON."""
        return {
            "added": list(self.labels),
            "unit": self.unit,
            "before": vars(self.before),
            "after": vars(self.after),
            "noise_floor": self.floor,
            "better": self.better,
            "held_out_with_smoothed_temperatures": self.smoothed,
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
        MeasurementError: a channel is missing.
        ModelError: a new effect is in the model already, or no reading shows it.
    """
    tell = stage or (lambda *_: None)
    with one_blas_thread():
        return _add(model, new, measurements, margin or Margin(), tell)


def _add(
    model: Model, new: Sequence[FittedEffect], measurements: Sequence[Measurement], margin: Margin, tell: Stage
) -> Added:
    _check_new(model, new)
    tell("refitting the model as it is", 0, 3)
    readings = clean_readings(model, measurements)
    # Readings that the model was fitted to before say nothing new of how sure its numbers are.
    again = any(m.sha256 in model.measurements.values() for m in measurements)
    loose = LOOSE if again else None
    before = joint_fit(model.effects, readings, loose=loose)
    for fitted in new:
        if not np.abs(readings.columns(fitted.effect, fitted.theta)).max(initial=0.0) > 0.0:
            raise ModelError(f"add: no reading shows {fitted.label}; nothing that it depends on was moved")
    tell("refitting with what is new", 1, 3)
    least = least_noise(readings, floor.cleaned(readings, before.left)) if new else ()
    after = joint_fit((*model.effects, *new), readings, loose=loose, least=least)
    tell("runs left out", 2, 3)
    scale = _scale(after, readings)
    pair = [_errors(j, after, readings, scale) for j in (before, after)]
    left = floor.cleaned(readings, readings.values - predicted(model.effects, readings))
    given = floor.pooled(readings, floor.rms_by_series(readings, left), scale)
    # A noise that has swallowed what is still missing would leave more than there is.
    noise = min(floor.pooled(readings, floor.floors(after.whitener), scale), pair[1].inside)
    labels = tuple(f.label for f in new)
    unit = floor.unit_of(readings)
    was = Errors(given, pair[0].inside, pair[0].held_out)
    entry = entry_of(labels, was, pair[1], noise, unit, measurements, len(readings))
    made = replace(
        model,
        effects=after.effects,
        valid_range=ranges_of(model, after.effects, readings, margin),
        noise_um=noise if unit == "um" else model.noise_um,
        measurements={**model.measurements, **{m.name: m.sha256 for m in measurements if m.sha256}},
        history=(*model.history, entry),
    )
    tell("runs left out", 3, 3)
    better = pair[1].held_out < pair[0].held_out
    return Added(
        made,
        labels,
        was,
        pair[1],
        noise,
        unit,
        better,
        _with_smooth(after, measurements, model, scale),
        notes_of(model, measurements),
    )


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


def _scale(joint: Joint, readings: Readings) -> Floats:
    if floor.unit_of(readings) != "noise":
        return np.ones(len(readings.series))
    return 1.0 / np.maximum(floor.floors(joint.whitener), 1e-12)


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

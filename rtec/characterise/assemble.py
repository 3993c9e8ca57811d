"""Assembles the result of a characterisation: model, errors per measurement, coefficients, warnings."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from rtec.characterise.choose import TermChoice
from rtec.characterise.result import (
    Characterisation,
    Coefficient,
    Correlated,
    MeasurementFit,
    SearchStep,
    UndecidedTerm,
)
from rtec.characterise.screen import Screened
from rtec.characterise.warnings import all_warnings
from rtec.estimation.gram.fit import Estimate
from rtec.estimation.gram.identifiable import label
from rtec.estimation.gram.source import Source
from rtec.estimation.gram.stream import Term
from rtec.estimation.judge import Judgement, MeasurementMet
from rtec.estimation.outliers import Clean
from rtec.estimation.warmth import recorded_degc
from rtec.machine import Machine
from rtec.model import FittedEffect, Model
from rtec.model.fit import valid_range
from rtec.model.model import ErrorCorrelation, number_name

TOLD = 5
"""Number of correlations that are shown for each component error."""


def assemble(
    fit: Estimate,
    screened: Screened | None,
    choice: TermChoice | None,
    given: Clean,
    name: str,
) -> Characterisation:
    """The result of a fit and of the choice before it, judged as by every command."""
    rivals = _rivals(fit, screened, choice)
    unused = screened.unused if screened else ()
    judged = Judgement(model_of(fit, name), given)
    met = judged.by_measurement
    table = tuple(_measurement(s, e) for s, e in zip(fit.sources, met, strict=True))
    model = _with_history(judged, fit)
    return Characterisation(
        model=model,
        judged=judged,
        measurements=table,
        coefficients=tuple(_coefficients(fit)),
        condition=fit.linear.condition(),
        inside_rms=judged.residual,
        held_out_rms=judged.held_out,
        unit=judged.unit,
        steps=_steps(choice),
        undecided=rivals,
        correlations=tuple(_correlations(screened)),
        outliers=given.wrong,
        warnings=tuple(all_warnings(fit, judged, rivals, _same_readings(fit, screened, choice), unused)),
        notes={m.name: tuple(m.notes) for m in given.readings.measurements if m.notes},
        residuals={
            s.measurement.name: (s.measurement.time_s / 3600.0, r)
            for s, r in zip(fit.sources, fit.residuals, strict=True)
        },
    )


def _rivals(fit: Estimate, screened: Screened | None, choice: TermChoice | None) -> tuple[UndecidedTerm, ...]:
    """Alternatives that explain the readings as well as terms that the fit kept."""
    if screened is None or choice is None:
        return ()
    effects = [t.effect for t in fit.terms]
    kept = {c.label for c in (screened.candidates[i] for i in choice.chosen) if c.term.effect in effects}
    return tuple(r for r in choice.rivals if r.instead_of in kept)


def _same_readings(
    fit: Estimate, screened: Screened | None, choice: TermChoice | None
) -> list[tuple[Term, Term, float]]:
    """Terms of the fit, each with a confounded one that was not chosen, and how much of it the coefficient contains.

    Of a term with several coefficients, each is a term of its own.
    """
    if screened is None or choice is None:
        return []
    every = [c.term for c in screened.candidates]
    machine = fit.sources[0].measurement.machine
    return [
        (_alone(every[i], place, machine), every[k], share)
        for i, place, k, share in choice.confounded
        if every[i] in fit.terms and label(every[i]) != label(every[k])
    ]


def _alone(term: Term, place: int, machine: Machine) -> Term:
    """The term with only one of its coefficients."""
    count = len(term.names(machine))
    return term if count == 1 else replace(term, only=((term.only or range(count))[place],))


def _measurement(source: Source, met: MeasurementMet) -> MeasurementFit:
    m = source.measurement
    return MeasurementFit(
        name=m.name,
        instrument=m.instrument.name,
        unit=met.unit,
        readings=met.readings,
        measured=met.measured,
        inside=met.residual,
        held_out=met.held_out,
        floor=met.floor,
        blocks=source.blocks.described,
    )


def _coefficients(fit: Estimate) -> list[Coefficient]:
    out = []
    for fitted in fitted_effects(fit):
        machine = fit.sources[0].measurement.machine
        effect = fitted.effect
        for p in (*effect.coefficients(machine), *effect.nonlinear(machine)):
            value = fitted.values.get(p.name, fitted.theta.get(p.name, 0.0))
            se = fitted.errors.get(p.name)
            t = value / se if se and p.name in fitted.values else None
            if not (se is None and value == 0.0):
                out.append(Coefficient(fitted.label, effect.component, p.name, value, se, t, p.unit))
    return out


def fitted_effects(fit: Estimate) -> list[FittedEffect]:
    """The terms as effects with numbers; coefficients that a term does not have are zero, without standard error."""
    machine = fit.sources[0].measurement.machine
    errors, out, k = fit.errors, [], 0
    slope_errors = {
        (fit.terms.index(s.term), s.name): float(e)
        for s, e in zip(fit.found.slopes, errors[fit.linear.width :], strict=True)
    }
    for i, term in enumerate(fit.terms):
        every = [p.name for p in term.effect.coefficients(machine)]
        have = term.names(machine)
        values = dict.fromkeys(every, 0.0) | {n: float(fit.values[k + j]) for j, n in enumerate(have)}
        known = {n: float(errors[k + j]) for j, n in enumerate(have)}
        known |= {n: e for (owner, n), e in slope_errors.items() if owner == i}
        out.append(FittedEffect(term.effect, values, dict(term.theta), known))
        k += len(have)
    return out


def _correlation(fit: Estimate) -> ErrorCorrelation:
    """ErrorCorrelation of the errors of all numbers of a fit."""
    machine, names = fit.sources[0].measurement.machine, list[str]()
    for i, term in enumerate(fit.terms, 1):
        names += [number_name(i, term.effect, n) for n in term.names(machine)]
    owners = [(fit.terms.index(s.term) + 1, s.name) for s in fit.found.slopes]
    names += [number_name(i, fit.terms[i - 1].effect, n) for i, n in owners]
    return ErrorCorrelation.of(names, fit.covariance)


def model_of(fit: Estimate, name: str) -> Model:
    """The model of a fit, without a history."""
    sources = fit.sources
    read = [(s.state, np.flatnonzero(s.weight.reshape(-1, s.count).any(axis=1)).astype(np.int64)) for s in sources]
    effects = fitted_effects(fit)
    model = Model(
        machine=sources[0].measurement.machine,
        effects=tuple(effects),
        name=name,
        reference_degc=sources[0].state.reference_degc,
        valid_range=valid_range([f.effect for f in effects], read),
        measurements={s.measurement.name: s.measurement.fingerprint for s in sources},
        correlation=_correlation(fit),
    )
    model.check(name)
    return model


def _with_history(judged: Judgement, fit: Estimate) -> Model:
    """The model with its errors in the history."""
    history: Mapping[str, Any] = {
        "change": "fit",
        **recorded_degc(judged.readings.measurements),
        "readings": len(judged.readings),
        "numbers": len(fit.errors),
        "rms_inside": judged.residual,
        "rms_held_out": judged.held_out,
        "unit": judged.unit,
        "left_out": sorted({s.blocks.described for s in fit.sources}),
    }
    noise_um = judged.noise_floor if judged.unit == "um" else None
    return replace(judged.model, history=(history,), noise_um=noise_um)


def _steps(choice: TermChoice | None) -> tuple[SearchStep, ...]:
    if choice is None:
        return ()
    whole = max(choice.steps[0].inside, 1e-300)
    return tuple(SearchStep(s.label, s.terms, s.inside / whole, s.held_out / whole) for s in choice.steps)


def _correlations(screened: Screened | None) -> list[Correlated]:
    if screened is None:
        return []
    out = []
    for seen in screened.seen:
        mine = [c for c in screened.correlations if c.candidate.component == seen.name]
        out += [
            Correlated(seen.name, c.candidate.feature, c.candidate.term.effect.effect, c.r, c.left, c.kept)
            for c in mine[:TOLD]
        ]
    return out

"""Puts the result of a characterisation together: model, errors per measurement, coefficients, warnings."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.characterise.choose import TermChoice
from rtec.characterise.result import Characterisation, Coefficient, Correlated, MeasurementFit, SearchStep
from rtec.characterise.screen import Screened
from rtec.characterise.warnings import all_warnings, outlier_warnings
from rtec.estimation.gram.fit import Estimate
from rtec.estimation.gram.weights import Outlier
from rtec.estimation.judge import Judgement
from rtec.estimation.outliers import Clean
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from rtec.model.fit import Margin, valid_range
from rtec.tomlfile import digest

Floats = NDArray[np.float64]
TOLD = 5
"""Correlations shown for each component error."""


def assemble(
    fit: Estimate,
    screened: Screened | None,
    choice: TermChoice | None,
    spikes: Sequence[Outlier],
    measurements: Sequence[Measurement],
    name: str,
    margin: Margin,
    given: Clean | None,
) -> Characterisation:
    """Give the result of a fit and of the choice before it; with the readings given, judged as by every command."""
    table = tuple(_measurement(fit, i) for i in range(len(fit.sources)))
    units = {t.unit for t in table}
    unit = units.pop() if len(units) == 1 else "noise"
    size = 1.0 if unit == "noise" else _pooled(fit, unit)
    inside, held_out = fit.inside * size / _unit_weight(fit, unit), fit.held_out * size / _unit_weight(fit, unit)
    rivals = choice.rivals if choice else ()
    unused = screened.unused if screened else ()
    model = _model(fit, measurements, name, margin, (inside, held_out, unit))
    judged = Judgement(model, given) if given is not None else None
    if judged is not None:
        inside, held_out, unit = judged.residual, judged.held_out, judged.unit
        model = _model(fit, measurements, name, margin, (inside, held_out, unit))
    return Characterisation(
        model=model,
        judged=judged,
        measurements=table,
        coefficients=tuple(_coefficients(fit)),
        condition=fit.linear.condition(),
        inside_rms=inside,
        held_out_rms=held_out,
        unit=unit,
        steps=_steps(choice),
        undecided=rivals,
        correlations=tuple(_correlations(screened)),
        outliers=(*spikes, *fit.outliers),
        warnings=(*all_warnings(fit, rivals, unused), *outlier_warnings(spikes, "stand out from their neighbours")),
        notes={m.name: tuple(m.notes) for m in measurements if m.notes},
        residuals={
            s.measurement.name: (s.measurement.time_s / 3600.0, r)
            for s, r in zip(fit.sources, fit.residuals, strict=True)
        },
    )


def _unit(columns: Sequence[str]) -> str:
    kinds = {"urad" if c.endswith("_urad") else "um" for c in columns}
    return kinds.pop() if len(kinds) == 1 else "noise"


def _sizes(fit: Estimate, i: int) -> Floats:
    """Noise that the weights of a measurement suppose, for each of its columns."""
    weight = fit.sources[i].weight.reshape(-1, fit.sources[i].count)
    return np.array([1.0 / w.max() if w.max() > 0 else 0.0 for w in weight.T])


def _measurement(fit: Estimate, i: int) -> MeasurementFit:
    source, (out, inside) = fit.sources[i], fit.cells
    m = source.measurement
    unit = _unit(m.instrument.columns())
    size = 1.0 if unit == "noise" else float(np.sqrt(np.mean(_sizes(fit, i) ** 2)))
    cells = [c for c in fit.linear.cells if c.source == i]
    whole = sum(c.gram[-1, -1] for c in cells) / sum(c.freedom for c in cells)
    return MeasurementFit(
        name=m.name,
        instrument=m.instrument.name,
        unit=unit,
        readings=int(np.count_nonzero(source.weight)),
        measured=float(np.sqrt(max(whole, 0.0))) * size,
        inside=fit.rms(inside, i) * size,
        held_out=fit.rms(out, i) * size,
        blocks=source.blocks.described,
    )


def _pooled(fit: Estimate, unit: str) -> float:
    """Root mean square of what the fit leaves in all readings of one unit, degrees of freedom counted."""
    squares, count = 0.0, 0
    for source, sigma in zip(fit.sources, fit.noise, strict=True):
        read = np.count_nonzero(source.weight.reshape(-1, source.count), axis=0)
        for name, s, n in zip(source.measurement.instrument.columns(), sigma, read, strict=True):
            if name.endswith(f"_{unit}"):
                squares, count = squares + float(s) ** 2 * int(n), count + int(n)
    return float(np.sqrt(squares / count)) if count else 0.0


def _unit_weight(fit: Estimate, unit: str) -> float:
    """In-sample error in units of the weights' noise, degrees of freedom counted: what `_pooled` is in µm."""
    normal = fit.linear
    squares = normal.squares(fit.values)
    return float(np.sqrt(max(squares, 1e-300) / max(normal.freedom, 1.0))) if unit != "noise" else 1.0


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


def _model(
    fit: Estimate, measurements: Sequence[Measurement], name: str, margin: Margin, error: tuple[float, float, str]
) -> Model:
    sources = fit.sources
    read = [(s.state, np.flatnonzero(s.weight.reshape(-1, s.count).any(axis=1)).astype(np.int64)) for s in sources]
    effects = fitted_effects(fit)
    noise_um = _pooled(fit, "um")
    history: Mapping[str, Any] = {
        "change": "fit",
        "readings": int(fit.linear.readings.sum()),
        "numbers": len(fit.errors),
        "rms_inside": error[0],
        "rms_held_out": error[1],
        "unit": error[2],
        "left_out": sorted({s.blocks.described for s in sources}),
    }
    model = Model(
        machine=sources[0].measurement.machine,
        effects=tuple(effects),
        name=name,
        reference_degc=sources[0].state.reference_degc,
        valid_range=valid_range([f.effect for f in effects], read, margin),
        noise_um=noise_um or None,
        measurements={m.name: m.sha256 or content_sum(m) for m in measurements},
        history=(history,),
    )
    model.check(name)
    return model


def content_sum(measurement: Measurement) -> str:
    """SHA-256 of a measurement that never was a file."""
    arrays = {**measurement.channels, **measurement.readings}
    plain = {name: [repr(float(v)) for v in values] for name, values in arrays.items()}
    return digest([measurement.name, measurement.run.tolist(), measurement.time_s.tolist(), plain])


def _steps(choice: TermChoice | None) -> tuple[SearchStep, ...]:
    if choice is None:
        return ()
    whole = max(choice.steps[0].inside, 1e-300)
    return tuple(SearchStep(s.label, s.inside / whole, s.held_out / whole) for s in choice.steps)


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

"""Compares a model with measurements: how wrong it is, against the noise floor, and where.

The model keeps its numbers, nothing is refitted, and it gets the temperatures as they were read, as in the loop.
The instruments' own unknowns (the zero of a run, a misalignment) are projected out of readings and predictions alike,
by least squares; so reading by reading, the measured value is the prediction plus the residual.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np

from rtec.arrays import Floats
from rtec.diagnosis.compare.bins import unit_of
from rtec.diagnosis.compare.locate import locate
from rtec.diagnosis.compare.result import Compared, Comparison, EffectShare, Outside, Region, Size, Traces
from rtec.diagnosis.compare.shape import drift_goes_with, shape_of
from rtec.diagnosis.doubts.record import doubts
from rtec.diagnosis.usable import check_enough
from rtec.errors import MeasurementError
from rtec.estimation.columns import effect_columns, ordered
from rtec.estimation.flexible import flexible_columns, unexplained
from rtec.estimation.floor import Floor, flattened, floors, tails_of
from rtec.estimation.given import given_to
from rtec.estimation.gls import solve
from rtec.estimation.judge import Judgement
from rtec.estimation.noise import Whitener
from rtec.estimation.outliers import outlier_words
from rtec.estimation.readings import Readings, Series
from rtec.estimation.visible import moves
from rtec.estimation.warm_start import without_starts
from rtec.machine import Machine
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.parallel import one_blas_thread

Stage = Callable[[str, int, int], None]

ABOVE = 1.1
"""Measured errors below this many times the floor give nothing to explain."""
WORSE = 2.0
"""A model makes the error worse where its residual has this many times the mean square of the readings."""
SURELY = 1.5
"""Noise alone never gives a residual of this many times the floor."""
UNKNOWN_START = "unknown start"
"""What follows from the states of delayed effects at the first reading, among the parts of a prediction."""
NO_ARM, NOTHING = 1e-12, 1e-9
SLOW = 0.5
"""A slow drift above this many times the floor is reported."""
FEWEST = 4
"""With fewer readings nothing is distinguishable from noise."""


def compare(
    model: Model,
    measurements: Sequence[Measurement],
    *,
    seed: int = 1,
    stage: Stage | None = None,
    residual: Callable[[Traces], None] | None = None,
) -> Comparison:
    """Compare a model with measurements.

    Args:
        model: keeps its numbers.
        measurements: of its machine, by any instruments.
        seed: of the random draws.
        stage: progress callback: called with the stage, steps done, steps in total.
        residual: called with the readings and the predictions as soon as they are known, before the noise is.

    Raises:
        MeasurementError: the measurements are of another machine, or lack a channel that the model needs.
    """
    progress = stage or (lambda *_: None)
    _check(model, measurements)
    check_enough(measurements, FEWEST)
    with one_blas_thread():
        progress("reading, predicting", 0, 1)
        judged = Judgement(model, given_to(model, measurements))
        readings, notes = judged.readings, outlier_words(judged.given.wrong)
        traces = _traces(model, readings)
        if residual is not None:
            residual(traces)
        progress("finding the noise", 0, 1)
        columns = flexible_columns(readings, judged.base.columns)
        whitener = _of_chance(readings, traces.left, judged.flexible, judged.noise)
        tails = tails_of(whitener, unexplained(readings, columns, traces.left))
        worst = locate(readings, traces.left, whitener, tails, seed, stage)
    items = tuple(
        _compared(model, traces, s, f, w, columns[s.part])
        for s, f, w in zip(readings.series, judged.floors, worst, strict=True)
    )
    doubted = doubts(judged)
    notes = (*(d.words for d in doubted), *_stuck(readings), *notes)
    return Comparison(model.name, items, notes, seed, judged, traces, doubted)


def _stuck(readings: Readings) -> tuple[str, ...]:
    """Words on each reading column that shows one value from beginning to end."""
    return tuple(
        f"{readings.measurements[s.source].name} {s.column}: the display does not move: all {len(s)} readings are "
        f"{readings.values[s.start]:.6g}; look at the instrument and its cable"
        for s in readings.series
        if float(np.ptp(readings.values[s.part])) == 0.0
    )


def _check(model: Model, measurements: Sequence[Measurement]) -> None:
    faults = [
        f"{m.name}: measured on machine {m.machine.name!r}, the model is of {model.machine.name!r} as it was at the fit"
        for m in measurements
        if m.machine.hash != model.machine.hash
    ]
    if faults:
        raise MeasurementError("\n".join(faults))


def _traces(model: Model, readings: Readings) -> Traces:
    names = [f.label for f in model.effects]
    labels = [n if names.count(n) == 1 else f"{n} #{names[: i + 1].count(n)}" for i, n in enumerate(names)]
    parts = {}
    known, starts = without_starts(readings)
    for label, fitted in zip(labels, model.effects, strict=True):
        columns, _, _ = effect_columns(fitted, readings)
        parts[label] = flattened(known, columns @ ordered(fitted, readings))
    predicted = np.sum(list(parts.values()), axis=0) if parts else np.zeros(len(readings))
    measured = flattened(known, readings.values)
    if starts.shape[1]:
        begun = flattened(known, starts)
        parts[UNKNOWN_START] = begun @ solve(begun, measured - predicted)
        predicted = predicted + parts[UNKNOWN_START]
    return Traces(readings, measured, predicted, parts)


def _of_chance(readings: Readings, left: Floats, flexible: Whitener, plain: Whitener) -> Whitener:
    """The noise for random draws.

    Normally it is the one that may contain what the model misses, for it gives fewer false alarms. But where the
    residual is far larger than any noise beside a smooth function, it is the one without that function: else a slow
    error would count as drift.
    """
    noises = []
    for s, f, p, floor in zip(readings.series, flexible.noises, plain.noises, floors(flexible), strict=True):
        noises.append(f if size_of(left[s.part]).rms > SURELY * floor else p)
    return plain.with_noises(noises)


def _compared(
    model: Model, traces: Traces, s: Series, noise: Floor, worst: tuple[Region, ...], smooth: Floats
) -> Compared:
    readings = traces.readings
    m = readings.measurements[s.source]
    measured, left = size_of(traces.measured[s.part]), size_of(traces.left[s.part])
    return Compared(
        m.name, s.column, m.instrument.name, "urad" if s.unit == "urad" else "um", len(s), int(s.run[-1]) + 1,
        measured, size_of(traces.predicted[s.part]), left, noise,
        explained(measured.rms, left.rms, noise.value), _sees(readings, s), _parts(model, traces, s),
        _outside(model, readings, s), worst,
        shape_of(readings, s, traces.left[s.part]) if left.rms > SURELY * noise.value else None,
        drift_goes_with(readings, s, traces.left[s.part], smooth) if noise.drift > SLOW * noise.value else "",
    )  # fmt: skip


def size_of(values: Floats) -> Size:
    """Root mean square and largest size."""
    return Size(float(np.sqrt(np.mean(values**2))), float(np.abs(values).max()))


def explained(measured: float, left: float, floor: float) -> float | None:
    """Share of the explainable mean square that is explained: 1 at the floor, 0 where nothing, at least -1.

    Args:
        measured, left, floor: root mean squares in one unit.

    Returns:
        None where the measured error is hardly above the floor.
    """
    if not measured > ABOVE * floor:
        # Nothing to explain; still, a prediction that is far too large makes the error worse.
        return -1.0 if left**2 > WORSE * max(measured, floor) ** 2 else None
    share = 1.0 - (left**2 - floor**2) / (measured**2 - floor**2)
    return min(max(share, -1.0), 1.0)


def _sees(readings: Readings, s: Series) -> tuple[str, ...]:
    """Component errors that a series sees: its own, or those of axes that moved, or of fixed links where none did."""
    measurement, machine = readings.measurements[s.source], readings.machine
    instrument = measurement.instrument
    if instrument.component is not None:
        return (instrument.component,)
    there = [c for c in machine.components if np.abs(readings.arms(c)[s.part]).max() > NO_ARM]
    moved = {a.name for a in machine.axes if moves(measurement, a, s.row)}
    by_motion = [c for c in there if c[2:] in moved]
    return tuple(by_motion or _of_fixed_links(there, machine))


def _of_fixed_links(there: Sequence[str], machine: Machine) -> list[str]:
    """Errors of the spindle where the machine names one, else of all links that are no axes."""
    fixed = [c for c in there if c[3:] not in machine.axis_names and c[2:] not in machine.axis_names]
    spindle = [c for c in fixed if "spindle" in c[3:].lower()]
    return spindle or fixed


def _parts(model: Model, traces: Traces, s: Series) -> tuple[EffectShare, ...]:
    out = []
    components = (*(f.effect.component for f in model.effects), "")  # an unknown start is of none
    for (label, values), component in zip(traces.parts.items(), components, strict=False):
        size = size_of(values[s.part])
        if size.rms > NOTHING:
            out.append(EffectShare(label, component, size.rms, size.most))
    return tuple(sorted(out, key=lambda p: -p.rms))


def _outside(model: Model, readings: Readings, s: Series) -> tuple[Outside, ...]:
    """Where the readings leave the valid range; an unrecorded channel is not checked."""
    state, out = readings.states[s.source], []
    for channel, (low, high) in model.valid_range.items():
        if not state.has(channel):
            continue
        value = state.value(channel)[s.row]
        # A file rounds the range; the readings have all digits.
        slack = 1e-6 * max(abs(low), abs(high), 1.0)
        n = int(((value < low - slack) | (value > high + slack)).sum())
        if n and math.isfinite(low) and math.isfinite(high):
            ends = float(np.nanmin(value)), float(np.nanmax(value))
            out.append(Outside(channel, unit_of(channel), float(low), float(high), *ends, n))
    return tuple(sorted(out, key=lambda o: -o.n))

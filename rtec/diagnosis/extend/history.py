"""What a change writes to the model file: its entry of the history, wider ranges, and notes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rtec.estimation.readings import Readings
from rtec.estimation.warmth import recorded_degc
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from rtec.model.fit import valid_range
from rtec.version import __version__


@dataclass(frozen=True)
class Errors:
    """Root mean squares, in the unit of the change.

    Attributes:
        as_given: residual of the model before any refit; None for a refitted model.
        inside: residual of the fitted readings.
        held_out: error on held-out runs.
        beyond_drift: error on held-out runs beyond slow drift, in multiples of the noise.
    """

    as_given: float | None
    inside: float
    held_out: float
    beyond_drift: float


def ranges_of(model: Model, effects: Sequence[FittedEffect], readings: Readings) -> dict[str, tuple[float, float]]:
    """Ranges of the model and of these readings, joined."""
    seen = [(m.state(model.reference_degc), np.arange(len(m))) for m in readings.measurements]
    out = dict(model.valid_range)
    for name, (low, high) in valid_range([f.effect for f in effects], seen).items():
        a, b = out.get(name, (low, high))
        out[name] = (min(a, low), max(b, high))
    return out


def entry_of(
    labels: Sequence[str],
    before: Errors,
    after: Errors,
    noise: tuple[float, str],
    unit: str,
    measurements: Sequence[Measurement],
    readings: int,
    model: Model,
) -> Mapping[str, Any]:
    """The entry of the history; `rms_before` and `rms_after` are errors on held-out runs.

    Args:
        labels: of what was added; none for a refit.
        before, after: errors; for a refit `before` is the residual of the model as it was.
        noise: its floor and the source of that.
        unit: of all of these.
        measurements: of this fit.
        readings: their number.
        model: before the change.
    """
    given, known = {m.fingerprint for m in measurements}, set(model.measurements.values())
    return {
        "change": "add" if labels else "refit",
        "effects": list(labels),
        "rms_as_given": before.as_given,
        "rms_before": before.held_out,
        "rms_after": after.held_out,
        "rms_inside_before": before.inside,
        "rms_inside": after.inside,
        "beyond_drift_before": before.beyond_drift,
        "beyond_drift_after": after.beyond_drift,
        "noise_floor": noise[0],
        "noise_floor_from": noise[1],
        "unit": unit,
        "readings": readings,
        "measurements": [m.name for m in measurements],
        **recorded_degc(measurements),
        "same_measurements": bool(known) and given == known,
        "rtec": __version__,
    }


def notes_of(model: Model, measurements: Sequence[Measurement]) -> tuple[str, ...]:
    """Measurements of earlier fits of the model that are not among these, in words."""
    given = {m.name for m in measurements}
    missing = [n for n in model.measurements if n not in given]
    if not missing:
        return ()
    return (f"the model was fitted on {', '.join(missing)} too, not given now: what only those show stays as it was",)

"""Readings made ready for the search, and candidates fitted along with the current model."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.estimation import floor
from rtec.estimation.columns import base_of, spikes
from rtec.estimation.gls import Fit, solve
from rtec.estimation.noise import Whitener, find_noise, least_noise
from rtec.estimation.readings import Readings, read
from rtec.metrology.measurement import Measurement
from rtec.model import Model

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Prepared:
    """Readings without spikes, the current model's columns, and the noise.

    Attributes:
        readings: temperatures smoothed.
        base: columns of the current model, (m, p).
        predicted: what it says, (m,).
        whitener: the noise.
        spikes: how many readings were left out.
    """

    readings: Readings
    base: Floats
    predicted: Floats
    whitener: Whitener
    spikes: int


def prepare(model: Model, measurements: Sequence[Measurement]) -> Prepared:
    """Read, leave out spikes, find the noise."""
    readings = read(measurements, model.reference_degc)
    base = base_of(model, readings)
    left = floor.cleaned(readings, readings.values - base.columns @ solve(base.columns, readings.values))
    lonely = spikes(readings, left)
    if lonely.any():
        readings = readings.without(lonely)
        base = base_of(model, readings)
        left = left[~lonely]
    whitener = find_noise(readings, base.columns, least=least_noise(readings, left))
    return Prepared(readings, base.columns, base.predicted, whitener, int(lonely.sum()))


@dataclass(frozen=True)
class Tried:
    """A candidate fitted along with the current model and a noise found anew."""

    number: int
    theta: Mapping[str, float]
    columns: Floats
    fit: Fit
    log_evidence: float
    drop: float
    gain: float
    before: int | None = None
    """Columns of the fit before this candidate's; None for those of the current model."""

    @property
    def holds(self) -> bool:
        """Whether runs that were left out get better, whitened and as they stand."""
        return self.gain > 0.0 and self.drop > 0.0

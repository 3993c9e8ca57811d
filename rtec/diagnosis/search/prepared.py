"""The readings, prepared for the search: temperatures smoothed, the model's columns, and the noise."""

from dataclasses import dataclass

from rtec.arrays import Floats
from rtec.estimation import floor
from rtec.estimation.columns import base_of
from rtec.estimation.gls import solve
from rtec.estimation.noise import Whitener, find_noise, least_noise
from rtec.estimation.outliers import Clean, WrongReading
from rtec.estimation.readings import Readings
from rtec.model import Model


@dataclass(frozen=True)
class Prepared:
    """The readings that count, the current model's columns, and the noise.

    Attributes:
        readings: temperatures smoothed.
        base: columns of the current model, (m, p).
        predicted: by the model, (m,).
        whitener: the noise.
        wrong: readings that were rejected.
        known: whether the model's numbers are from other readings, with their errors.
    """

    readings: Readings
    base: Floats
    predicted: Floats
    whitener: Whitener
    wrong: tuple[WrongReading, ...]
    known: bool = False

    @property
    def kept(self) -> Floats | None:
        """Prediction of the model with the numbers that it has from other readings, (m,); None where it has none."""
        return self.predicted if self.known else None


def prepare(model: Model, given: Clean, earlier: bool = False) -> Prepared:
    """Smoothed temperatures, the model's prediction, and the noise.

    Args:
        model: the current model.
        given: the readings.
        earlier: whether the model's numbers come from other readings although it names these.
    """
    readings = given.smoothed()
    base = base_of(model, readings, given.delays)
    left = floor.cleaned(readings, readings.values - base.columns @ solve(base.columns, readings.values))
    whitener = find_noise(readings, base.columns, least=least_noise(readings, left))
    again = any(m.fingerprint in model.measurements.values() for m in readings.measurements)
    known = (earlier or not again) and any(f.errors for f in model.effects)
    return Prepared(readings, base.columns, base.predicted, whitener, given.wrong, known)

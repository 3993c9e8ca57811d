"""Measurements as every command gives them to a model: without wrong readings, and with what only they show."""

from collections.abc import Sequence

from rtec.estimation.changed_delay import with_changed_delays
from rtec.estimation.outliers import Clean, clean
from rtec.estimation.warm_start import with_starts
from rtec.metrology.measurement import Measurement
from rtec.model import Model


def given_to(model: Model, measurements: Sequence[Measurement]) -> Clean:
    """Readings that count, with unknown starts of the model's delayed effects in records that begin warm.

    A delay of the model that is another one in these readings is among them, too.

    Raises:
        MeasurementError: as `clean`.
    """
    return with_changed_delays(model, with_starts(model, clean(measurements, model.reference_degc)))

"""Checks whether a fit is possible at all, and whether an added effect is significant."""

from collections.abc import Sequence

import numpy as np

from rtec.arrays import Floats
from rtec.errors import MeasurementError, ModelError
from rtec.estimation.readings import Readings
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect
from rtec.wording import with_error

FEWEST = 10
"""Readings below which a refit would follow the noise."""
SURE = 2.0
"""Standard errors from zero at which a number is significant."""


def check_enough(measurements: Sequence[Measurement], fewest: int = FEWEST) -> None:
    """Require a minimum number of readings for any judgement.

    Raises:
        MeasurementError: there are fewer than that in all measurements together.
    """
    n = sum(int(np.isfinite(m.matrix()).sum()) for m in measurements)
    if measurements and n < fewest:
        named = ", ".join(m.name for m in measurements)
        raise MeasurementError(f"{named}: too few readings: {n}, at least {fewest} are needed; measure more")


def check_finite(fitted: FittedEffect, readings: Readings) -> Floats:
    """Columns of an effect at its starting numbers, (m, coefficients).

    Raises:
        ModelError: some are no numbers, as where an expression divides by zero.
    """
    with np.errstate(all="ignore"):
        columns = readings.columns(fitted.effect, fitted.theta)
    bad = np.flatnonzero(~np.isfinite(columns).all(axis=1))
    if len(bad):
        what = f"expression {text!r}" if (text := getattr(fitted.effect, "expression", None)) else fitted.label
        raise ModelError(
            f"add: {what} is not finite at {len(bad)} of {len(columns)} readings"
            " (a division by zero, or the root or logarithm of a negative number)"
        )
    return columns


def unsure(added: Sequence[FittedEffect]) -> tuple[str, ...]:
    """A sentence for each effect without a significant coefficient."""
    out = []
    for f in added:
        known = {n: f.errors[n] for n in f.values if f.errors.get(n, 0.0) > 0.0}
        if len(known) == len(f.values) and all(abs(f.values[n]) < SURE * e for n, e in known.items()):
            numbers = ", ".join(f"{n} = {' ± '.join(with_error(f.values[n], e))}" for n, e in known.items())
            out.append(f"{f.label}: {numbers} is less than two standard errors from zero and may be noise")
    return tuple(out)

"""A reading explained by temperatures, some at once and some late: `y = c + Σ a_k T_k + Σ b_k lag(T_k, τ_k)`.

The lag is the one of the thermal effects, so what is found here goes into a model as it is.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from rtec.effects.derived import lag_track
from rtec.errors import MeasurementError
from rtec.metrology.procedures.fitting import SeparableFit, separable_fit
from tests.support.cyclic_turns import Number

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LagModel:
    """What was found.

    Attributes:
        offset_um: reading when every temperature is nil, µm.
        direct_um_per_degc: by temperature.
        lagged_um_per_degc: by temperature.
        tau_s: by temperature; its standard error is that of ln τ times τ.
        rms_um: of what is left.
        predicted_um: (n,).
        correlation: how many readings in a row count as one.
        words: what is doubtful.
    """

    offset_um: Number
    direct_um_per_degc: Mapping[str, Number]
    lagged_um_per_degc: Mapping[str, Number]
    tau_s: Mapping[str, Number]
    rms_um: float
    predicted_um: Floats
    correlation: float
    words: tuple[str, ...]


def lag_model(
    time_s: Floats,
    reading_um: Floats,
    temperatures_degc: Mapping[str, Floats],
    direct: Sequence[str],
    lagged: Sequence[str],
    tau_range_s: tuple[float, float] | None = None,
) -> LagModel:
    """Fit a reading to temperatures, the time constants along with it.

    Args:
        time_s: (n,), rising.
        reading_um: (n,); NaN where there is none: lags run on through such rows.
        temperatures_degc: by name, (n,), without gaps.
        direct, lagged: names of temperatures that act at once, and late.
        tau_range_s: bounds of the search; by default from the sampling interval to three times the record.

    Raises:
        MeasurementError: a name is not there, too few readings, or terms that cannot be told apart.
    """
    for name in (*direct, *lagged):
        if name not in temperatures_degc:
            raise MeasurementError(f"no temperature {name!r}; there are {', '.join(temperatures_degc)}")
    low, high = tau_range_s or (float(np.median(np.diff(time_s))), 3.0 * float(time_s[-1] - time_s[0]))
    known = ~np.isnan(reading_um)
    start = np.log(low), np.log(high)

    def design(theta: Floats) -> Floats:
        late = [lag_track(temperatures_degc[n], time_s, float(np.exp(x))) for n, x in zip(lagged, theta, strict=True)]
        return np.stack([np.ones(len(time_s)), *(temperatures_degc[n] for n in direct), *late], axis=1)

    def build(theta: Floats) -> tuple[Floats, Floats]:
        return design(theta)[known], np.zeros(int(known.sum()))

    places = [start[0] + share * (start[1] - start[0]) for share in (0.3, 0.75)]
    starts = [np.array(p) for p in product(places, repeat=len(lagged))] if lagged else []
    bounds = [np.full(len(lagged), b) for b in start]
    fit = separable_fit(build, reading_um[known], starts, *bounds)
    return _model(fit, direct, lagged, start, design(fit.theta) @ fit.values)


def _model(
    fit: SeparableFit, direct: Sequence[str], lagged: Sequence[str], bounds: tuple[float, float], predicted: Floats
) -> LagModel:
    numbers = [Number(float(v), float(e)) for v, e in zip(fit.values, fit.errors, strict=False)]
    first = 1 + len(direct)
    tau = {}
    words = []
    for name, x, error in zip(lagged, fit.theta, fit.errors[len(fit.values) :], strict=True):
        tau[name] = Number(float(np.exp(x)), float(np.exp(x) * error))
        if not bounds[0] + 0.01 < x < bounds[1] - 0.01:
            words.append(f"The time constant of {name} is on the bound of the search: this record does not tell it.")
        elif error > 0.5:
            words.append(f"The time constant of {name} is known to a factor of {np.exp(2 * error):.1f} only.")
    return LagModel(
        numbers[0],
        dict(zip(direct, numbers[1:first], strict=True)),
        dict(zip(lagged, numbers[first:], strict=True)),
        tau,
        fit.rms,
        predicted,
        fit.correlation,
        tuple(words),
    )

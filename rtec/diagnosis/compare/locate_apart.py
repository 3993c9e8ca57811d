"""Where the readings going + and those going - lie apart by the same amount everywhere: that is no place."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis.compare.bins import Variable
from rtec.diagnosis.compare.result import Bound, Region
from rtec.diagnosis.words import UNITS
from rtec.estimation.readings import Readings, Series

Floats = NDArray[np.float64]

STRETCHES, READINGS = 4, 3
"""Stretches of the way needed, and readings each way in each."""
EVEN = 0.25
"""Of the gap, by which it may differ from stretch to stretch, standard deviation."""
MOST_OF_IT = 0.5
"""Share of the mean square left that the gap makes up."""
LEVEL = 0.02


def both_ways(
    readings: Readings, series: Series, left: Floats, noise: Floats, fine: Sequence[Variable]
) -> Region | None:
    """The axis whose two ways lie apart by the same amount everywhere; None where no axis does, or places tell more.

    Args:
        readings: that were compared.
        series: reading column.
        left: measured minus predicted, (n,).
        noise: drawn, (n, draws).
        fine: channels of the series, cut.
    """
    by_name = {v.name: v for v in fine}
    found = [
        region
        for axis in readings.machine.axes
        if (place := by_name.get(axis.channel)) is not None and (way := by_name.get(axis.direction_channel)) is not None
        if (region := _of_axis(axis.name, place, way, left, noise, series.unit, _several(fine))) is not None
    ]
    return min(found, key=lambda r: r.elsewhere, default=None)


def _several(fine: Sequence[Variable]) -> bool:
    return sum(v.name.startswith("d_") for v in fine) > 1


def _of_axis(
    name: str, place: Variable, way: Variable, left: Floats, noise: Floats, unit: str, several: bool
) -> Region | None:
    sign = np.asarray(way.low)[way.code]
    plus, minus = sign > 0, sign < 0
    gaps = _gaps(place, plus, minus, left)
    if len(gaps) < STRETCHES:
        return None
    gap = float(np.mean(gaps))
    if float(np.std(gaps)) > EVEN * abs(gap):
        return None
    rest = left - 0.5 * gap * np.sign(sign)
    before, after = float(np.mean(left**2)), float(np.mean(rest**2))
    chance = np.abs(noise[plus].mean(axis=0) - noise[minus].mean(axis=0))
    p = (1.0 + float((chance >= abs(gap)).sum())) / (1.0 + noise.shape[1])
    if 1.0 - after / max(before, 1e-30) < MOST_OF_IT or p > LEVEL:
        return None
    of = f" of {name}" if several else ""
    words = f"moving + and moving −{of} lie {abs(gap):.3g} {UNITS.get(unit, unit)} apart everywhere"
    bound = Bound(way.name, -1.0, 1.0, way.unit)
    return Region((bound,), before**0.5, float(left.mean()), after**0.5, len(left), p, words, (), gap)


def _gaps(place: Variable, plus: NDArray[np.bool_], minus: NDArray[np.bool_], left: Floats) -> Floats:
    """Mean going + less mean going -, in each stretch of the way that holds enough of both."""
    sizes, sums = [], []
    for mask in (plus, minus):
        sizes.append(np.bincount(place.code[mask], minlength=len(place)))
        sums.append(np.bincount(place.code[mask], weights=left[mask], minlength=len(place)))
    full = (sizes[0] >= READINGS) & (sizes[1] >= READINGS)
    return np.asarray(sums[0][full] / sizes[0][full] - sums[1][full] / sizes[1][full])

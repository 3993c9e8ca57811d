"""Readings with the wrong sign or in the wrong unit: they equal the prediction times minus one, or times a thousand.

No machine changes like this between two measurements; a file does. A refit would reverse every number of the model,
and the loop would then double the error instead of removing it.
"""

import math
from collections.abc import Mapping

from rtec.arrays import Floats
from rtec.errors import MeasurementError
from rtec.estimation import floor
from rtec.estimation.floor import Unit
from rtec.estimation.readings import Readings

ALIKE = 0.8
"""Squared correlation of readings and prediction from which on one follows the other."""
NEAR = 0.2
"""Relative deviation of a factor from its nominal value, at most."""
INCH = 25.4
UNITS: Mapping[Unit, Mapping[float, str]] = {
    "um": {
        1e3: "mm",
        INCH: "thousandths of an inch",
        10.0: "hundredths of a mm",
        0.1 * INCH: "ten-thousandths of an inch",
        1e-3: "nm",
    },
    "urad": {1e3: "mrad", 4.848: "seconds of arc"},
}
"""Units of readings, by what one of them is, in the unit that they should have,"""
THAT = 0.05
"""within this relative difference."""
FACTORS = {
    -1.0: "is minus what {} predicts: is the sign of the readings right?",
    1e-3: "is a thousandth of what {} predicts: are the readings in mm?",
    -1e-3: "is minus a thousandth of what {} predicts: are the readings in mm, with the other sign?",
    1e3: "is a thousand times what {} predicts: are the readings in nm?",
    -1e3: "is minus a thousand times what {} predicts: are the readings in nm, with the other sign?",
    1.0 / INCH: "is 1/25.4 of what {} predicts: are the readings in thousandths of an inch?",
    -1.0 / INCH: "is -1/25.4 of what {} predicts: are they in thousandths of an inch, with the other sign?",
}  # fmt: skip


def odd_scales(readings: Readings, measured: Floats, predicted: Floats, by: str = "the model") -> tuple[str, ...]:
    """Words on each reading column that follows a prediction by a factor that only a file can have.

    Args:
        readings: the readings.
        measured, predicted: less what the instruments cannot know, (m,).
        by: what predicts, in words.
    """
    out = []
    for s in readings.series:
        fault = _factor(measured[s.part], predicted[s.part])
        if fault:
            out.append(f"{readings.measurements[s.source].name} {s.column}: what is measured {fault.format(by)}")
    return tuple(out)


def _factor(measured: Floats, predicted: Floats) -> str:
    cross, own, other = float(measured @ predicted), float(predicted @ predicted), float(measured @ measured)
    if not own * other > 0.0 or cross * cross < ALIKE * own * other:
        return ""
    factor = cross / own
    return next((words for f, words in FACTORS.items() if abs(factor / f - 1.0) < NEAR), "")


def unit_of(factor: float, unit: Unit) -> tuple[float, str]:
    """The known unit of readings that become `unit` times a factor, and that factor; an empty name for none."""
    known = ((math.copysign(f, factor), name) for f, name in UNITS.get(unit, {}).items())
    return next(((f, name) for f, name in known if abs(factor / f - 1.0) < THAT), (factor, ""))


def check_scales(readings: Readings, predicted: Floats) -> None:
    """Refuse to fit a model to readings of the wrong sign or unit.

    Args:
        readings: the readings.
        predicted: by the model, (m,).

    Raises:
        MeasurementError: some readings have a wrong sign or unit.
    """
    odd = odd_scales(readings, floor.cleaned(readings, readings.values), floor.cleaned(readings, predicted))
    if odd:
        way = "correct it in the file; if the model was wrong, refit it with `rtec fit`"
        raise MeasurementError("\n".join(f"{fault} Nothing was fitted: {way}" for fault in odd))

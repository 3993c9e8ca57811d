"""The registry: every effect by name, literally."""

from rtec.effects.base import Effect
from rtec.effects.cyclic import CyclicScrew
from rtec.effects.expression import Expression
from rtec.effects.geometric import Parallelism, PiecewisePosition, PolynomialPosition, Scale, Squareness
from rtec.effects.reversal import Backlash, BacklashPosition
from rtec.effects.thermal import (
    AmbientDrift,
    AxisExpansion,
    AxisExpansionNonuniform,
    ColumnTilt,
    MountExpansion,
    SpindleGrowth,
    SpindleTilt,
)
from rtec.errors import ModelError
from rtec.tomlfile import nearest

EFFECTS: dict[str, type[Effect]] = {
    "scale": Scale,
    "polynomial_position": PolynomialPosition,
    "piecewise_position": PiecewisePosition,
    "squareness": Squareness,
    "parallelism": Parallelism,
    "cyclic_screw": CyclicScrew,
    "backlash": Backlash,
    "backlash_position": BacklashPosition,
    "axis_expansion": AxisExpansion,
    "axis_expansion_nonuniform": AxisExpansionNonuniform,
    "mount_expansion": MountExpansion,
    "ambient_drift": AmbientDrift,
    "column_tilt": ColumnTilt,
    "spindle_growth": SpindleGrowth,
    "spindle_tilt": SpindleTilt,
    "expression": Expression,
}


def effect_class(name: str, where: str) -> type[Effect]:
    """Give the class of an effect.

    Raises:
        ModelError: there is none of that name; the message has the nearest.
    """
    if name not in EFFECTS:
        raise ModelError(f"{where}: no effect {name!r}{nearest(name, EFFECTS)}")
    return EFFECTS[name]

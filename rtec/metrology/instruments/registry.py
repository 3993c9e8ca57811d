"""The registry: a table of every instrument by name."""

from collections.abc import Mapping
from typing import Any

from rtec.errors import MeasurementError
from rtec.machine import Machine
from rtec.metrology.instruments.ball_bar import BallBar
from rtec.metrology.instruments.base import Instrument
from rtec.metrology.instruments.grid_encoder import GridEncoder
from rtec.metrology.instruments.laser import LaserAngular, LaserDiagonal, LaserLinear
from rtec.metrology.instruments.level import Level
from rtec.metrology.instruments.spindle_drift import SpindleDrift
from rtec.metrology.instruments.squareness import SquarenessProbe
from rtec.metrology.instruments.straightness import StraightnessProbe
from rtec.metrology.instruments.tool_tip import ToolTip, WorkPiece
from rtec.tomlfile import nearest, validated

INSTRUMENTS: dict[str, type[Instrument]] = {
    "laser_linear": LaserLinear,
    "laser_diagonal": LaserDiagonal,
    "laser_angular": LaserAngular,
    "level": Level,
    "straightness": StraightnessProbe,
    "squareness": SquarenessProbe,
    "spindle_drift": SpindleDrift,
    "tool_tip": ToolTip,
    "work_piece": WorkPiece,
    "ball_bar": BallBar,
    "grid_encoder": GridEncoder,
}


def make_instrument(
    name: str,
    setup_table: Mapping[str, Any],
    axis: str | None,
    component: str | None,
    machine: Machine,
    where: str,
) -> Instrument:
    """Make an instrument with its set-up on a machine.

    Args:
        name: key of `INSTRUMENTS`.
        setup_table: `[setup]` of the measurement's file.
        axis: axis that it follows, or None.
        component: component that it reads directly; None where it reads a point or a rotation through the chain.
        machine: the measured machine.
        where: file or option with the set-up, for messages.

    Raises:
        MeasurementError: the instrument or a key is unknown (with the nearest one), or the machine lacks something.
    """
    if name not in INSTRUMENTS:
        raise MeasurementError(f"{where}: [measurement] no instrument {name!r}{nearest(name, INSTRUMENTS)}")
    kind = INSTRUMENTS[name]
    setup = validated(kind.setup_model, dict(setup_table), f"{where}: [setup]", MeasurementError)
    instrument = kind(setup, axis, component)
    instrument.check(machine, where)
    return instrument

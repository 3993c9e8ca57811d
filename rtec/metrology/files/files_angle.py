"""Ball-bar tables: angles become positions, and what the circle says about the axes becomes channels."""

from collections.abc import Iterable

import numpy as np

from rtec.errors import MeasurementError
from rtec.machine import Machine
from rtec.metrology.files.table import Floats
from rtec.metrology.instruments.ball_bar import BallBar, BallBarSetup, axis_along, circle_channels, travelled_deg
from rtec.metrology.instruments.base import Instrument
from rtec.metrology.measurement import Ints

OFF_CIRCLE_MM = 0.05
"""Rounding of commanded positions stays far below this; feed-in and feed-out moves do not."""


def on_circle(
    instrument: Instrument, machine: Machine, channels: dict[str, Floats], run: Ints, where: str
) -> dict[str, Floats]:
    """Add what is missing of positions, angles, directions, velocities and accelerations; others' are left alone.

    Raises:
        MeasurementError: a ball bar without angles and positions, off its circle, or against its direction.
    """
    if not isinstance(instrument, BallBar):
        return channels
    setup = instrument.setup
    angle_deg = channels.get("angle_deg")
    if angle_deg is None:
        angle_deg = _angles(machine, setup, channels, where)
    _same_sense(setup, angle_deg, run, where)
    return circle_channels(machine, setup, np.deg2rad(angle_deg)) | channels | {"angle_deg": angle_deg}


def still_right(instrument: Instrument, notes: Iterable[str]) -> list[str]:
    """Notes on a table without those on missing positions, where the angles have given them."""
    return [n for n in notes if not (isinstance(instrument, BallBar) and n.startswith("no column "))]


def _angles(machine: Machine, setup: BallBarSetup, channels: dict[str, Floats], where: str) -> Floats:
    """Angle of commanded positions, degrees, (n,)."""
    beside: list[Floats] = []
    for letter, centre in zip(setup.letters[:2], (setup.centre_mm[i] for i in setup.rows[:2]), strict=True):
        axis = axis_along(machine, letter)
        if axis is None or axis.channel not in channels:
            name = f"{axis.channel}_mm" if axis else letter
            raise MeasurementError(
                f"{where}: neither column 'angle_deg' nor positions in both directions of plane {setup.plane} "
                f"({name!r} is missing); a ball bar needs one or the other"
            )
        same = [channels[a.channel] for a in machine.axes if a.direction == letter and a.channel in channels]
        beside.append(np.sum(same, axis=0) - centre)
    off = np.abs(np.hypot(beside[0], beside[1]) - setup.radius_mm)
    if off.max() > OFF_CIRCLE_MM:
        raise MeasurementError(
            f"{where}: {int((off > OFF_CIRCLE_MM).sum())} rows are off the circle about {list(setup.centre_mm)} of "
            f"radius {setup.radius_mm:g} mm, the first (row {int(np.argmax(off > OFF_CIRCLE_MM)) + 1}) by "
            f"{off[int(np.argmax(off > OFF_CIRCLE_MM))]:.3g} mm; leave feed-in and feed-out out, or correct "
            "centre_mm and radius_mm"
        )
    return np.asarray(np.rad2deg(np.arctan2(beside[1], beside[0])), dtype=np.float64)


def _same_sense(setup: BallBarSetup, angle_deg: Floats, run: Ints, where: str) -> None:
    way = travelled_deg(setup, angle_deg, run)
    for number in np.unique(run):
        rows = way[run == number]
        if len(rows) > 1 and rows[-1] < rows[0]:
            raise MeasurementError(
                f"{where}: run {number} goes {'cw' if setup.sense > 0 else 'ccw'}, but [setup] direction is "
                f"{setup.direction!r} (from {setup.letters[0]} towards {setup.letters[1]}); one file for each sense"
            )

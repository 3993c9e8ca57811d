"""Compares the frame of measured coordinates with the machine's: shifts and turns beyond what machines err."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from rtec.arrays import Floats
from rtec.errors import MeasurementError
from rtec.wording import listed

LARGEST_RAD: Final = 1e-3
"""The fit's rotations of an instrument are small: at this one a length is wrong by 0.5 µm a metre."""
LARGE_RAD: Final = 2e-4
"""Machines err by smaller angles."""
LARGE_MM: Final = 1.0
LEAST_MM: Final = 1.0
"""Root mean square of the travel in a direction, from which on its turn is known."""
LENGTH: Final = 0.01
"""A turn changes no length; where one changes by a larger share, the unit is wrong, or no positions were measured."""
FEWEST, ROUNDS, ODD = 4, 3, 10.0
"""Rows that are farther from the fit than the median by the last factor are left out of it."""


def of_frame(columns: Mapping[str, Floats], setup: Mapping[str, Any], source: str) -> list[str]:
    """Notes on a shift or a turn of measured coordinates against the machine's frame.

    Args:
        columns: columns of the measurement, (n,) each.
        setup: `[setup]` of the instrument.
        source: name of the file, for messages.

    Raises:
        MeasurementError: the turn is too large for the small rotations that a fit estimates.
    """
    letters = [c for c in "xyz" if {f"{c}_mm", f"reading_{c}_um"} <= columns.keys()]
    place = np.array([columns[f"{c}_mm"] for c in letters]).T
    off_mm = 1e-3 * np.array([columns[f"reading_{c}_um"] for c in letters]).T
    if len(letters) < 2 or (known := np.isfinite(place + off_mm).all(axis=1)).sum() < FEWEST:
        return []
    place, off_mm = place[known], off_mm[known]
    angle_rad = _turn_rad(place, place + off_mm)
    if angle_rad > LARGEST_RAD:
        raise MeasurementError(
            f"{source}: the measured positions are in another frame than the machine's: turned by {_angle(angle_rad)}, "
            f"or mirrored. A fit estimates turns of up to {_angle(LARGEST_RAD)} only. In the instrument's program, fit "
            "the measured points to the nominal ones, and export them in that frame"
        )
    notes = []
    if angle_rad > LARGE_RAD and setup.get("alignment", "none") == "none":
        way = 'with [setup] alignment = "setup" the fit estimates this'
        notes.append(f"doubtful: the readings are turned by {_angle(angle_rad)} against the machine; {way}")
    shift_mm = np.median(off_mm, axis=0)
    if np.abs(shift_mm).max() > LARGE_MM:
        shift = listed([f"{c.upper()} {v:.4g} mm" for c, v in zip(letters, shift_mm, strict=True)])
        way = "the fit takes this as the zero of each coordinate"
        way = 'with [setup] zero = "setup" the fit estimates this' if setup.get("zero") == "none" else way
        notes.append(f"the readings are shifted by {shift} against the machine; {way}")
    return notes


def _turn_rad(place: Floats, measured: Floats) -> float:
    """Largest angle between a direction of the travel and the same as measured; 0 where lengths differ, too."""
    keep = np.ones(len(place), dtype=np.bool_)
    for _ in range(ROUNDS):
        middle, end = place[keep].mean(axis=0), measured[keep].mean(axis=0)
        along, size, directions = np.linalg.svd(place[keep] - middle, full_matrices=False)
        moved = size > LEAST_MM * np.sqrt(keep.sum())
        slopes = (along.T @ (measured[keep] - end))[moved] / size[moved, None]
        rest = np.linalg.norm(measured - end - (place - middle) @ directions[moved].T @ slopes, axis=1)
        keep = rest <= ODD * np.median(rest) + 1e-6
    if not moved.any() or np.abs(np.linalg.norm(slopes, axis=1) - 1.0).max() > LENGTH:
        return 0.0
    same = (slopes * directions[moved]).sum(axis=1)
    across = np.linalg.norm(slopes - same[:, None] * directions[moved], axis=1)
    return float(np.arctan2(across, same).max())


def _angle(angle_rad: float) -> str:
    degrees = float(np.degrees(angle_rad))
    return f"{degrees:.3g}°" if degrees > 1.0 else f"{1e3 * angle_rad:.2g} mrad"

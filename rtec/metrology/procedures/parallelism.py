"""Parallelism of a motion to the axis of the spindle by best-fit circles [G 3.4-3.5].

Two probes 180° apart read a turning arbor at two or more places along the motion. Its mean over a turn frees a reading
from the arbor's eccentricity; the difference of the probes frees it from the arbor's taper. The straightness of the
motion at the places measured stays in (the text of [G 3.4] hopes otherwise): more places average it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.errors import MeasurementError
from rtec.metrology.procedures.fitting import best_line

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Circle:
    """Best-fit circle through one probe's readings over a turn, µm.

    Attributes:
        radius_um: R of [G 3.4], relative to the probe's zero.
        centre_um: eccentricity along 0° and 90°.
        roundness_um: largest minus smallest of what is left.
        se_um: standard error of `radius_um` if what is left were noise; a round that is none makes it too large.
    """

    radius_um: float
    centre_um: tuple[float, float]
    roundness_um: float
    se_um: float


@dataclass(frozen=True)
class Parallelism:
    """Parallelism of a motion to the spindle's axis, in the plane of the probes.

    Attributes:
        position_mm: places, (k,), rising.
        radius_um: best-fit radii, (2 probes, k).
        alpha_urad: α_p of [G 3.5]: slope of the spindle's axis seen from the motion, positive where the axis comes
            nearer to probe 1 as the position grows.
        motion_urad: slope of the motion seen from the spindle's axis, positive towards probe 1's side: -α_p.
        alpha_se_urad: standard error from what the circles leave, NaN if unknown.
        straightness_um: what is left of (R1 - R2)/2 about the line, (k,); nil for two places.
        taper_urad: change of the arbor's radius along the motion, per length.
        circles: by probe, then place.
        words: what the result holds.
    """

    position_mm: Floats
    radius_um: Floats
    alpha_urad: float
    motion_urad: float
    alpha_se_urad: float
    straightness_um: Floats
    taper_urad: float
    circles: tuple[tuple[Circle, ...], tuple[Circle, ...]]
    words: tuple[str, ...]


def best_circle(angle_deg: Floats, reading_um: Floats) -> Circle:
    """Limaçon through a turn: R + a cos φ + b sin φ by least squares; R = Σ r_i / n for equal steps [G 3.4].

    Args:
        angle_deg: of the spindle, (n,); need not be equally spaced.
        reading_um: (n,), NaN where missing.

    Raises:
        MeasurementError: too few readings, or they leave a gap of more than half a turn.
    """
    known = ~np.isnan(reading_um)
    angle, reading = angle_deg[known], reading_um[known]
    if len(angle) < 4:
        raise MeasurementError(f"{len(angle)} readings over a turn; a best-fit circle needs four, better 100 or more")
    turn = np.sort(np.mod(angle, 360.0))
    gap = float(np.diff(np.append(turn, turn[0] + 360.0)).max())
    if gap > 180.0:
        raise MeasurementError(
            f"the readings leave {gap:.0f}° of the turn unseen; a best-fit circle needs the whole turn"
        )
    phi = np.deg2rad(angle)
    design = np.stack([np.ones(len(phi)), np.cos(phi), np.sin(phi)], axis=1)
    values = np.linalg.lstsq(design, reading, rcond=None)[0]
    left = reading - design @ values
    free = len(reading) - 3
    se = np.sqrt(left @ left / free * np.linalg.inv(design.T @ design)[0, 0]) if free else np.nan
    return Circle(float(values[0]), (float(values[1]), float(values[2])), float(np.ptp(left)), float(se))


def parallelism(position_mm: Floats, angle_deg: Floats, probe1_um: Floats, probe2_um: Floats) -> Parallelism:
    """Parallelism from the readings of both probes, rows in any order.

    α_p = [(R1(2) - R1(1)) - (R2(2) - R2(1))] / 2Δz for two places [G 3.5]; for more the slope of the best-fit line
    through (R1 - R2)/2, which is the same for two.

    Args:
        position_mm: place of each reading, (n,).
        angle_deg: of the spindle, (n,).
        probe1_um, probe2_um: positive as the gap closes; probe 1 on the positive side, (n,).

    Raises:
        MeasurementError: fewer than two places, or a turn that gives no circle; the message names the place.
    """
    places = np.unique(position_mm)
    if len(places) < 2:
        raise MeasurementError("parallelism needs a turn of the arbor at two places at least")
    circles = tuple(
        tuple(_circle_at(z, k, position_mm, angle_deg, p) for z in places)
        for k, p in enumerate((probe1_um, probe2_um), 1)
    )
    radius = np.array([[c.radius_um for c in probe] for probe in circles])
    line = best_line(places, (radius[0] - radius[1]) / 2)
    lever = places - places.mean()
    point = np.array([np.hypot(a.se_um, b.se_um) / 2 for a, b in zip(*circles, strict=True)])
    noise = float(np.sqrt(((lever / (lever @ lever)) ** 2 * point**2).sum()))
    return Parallelism(
        position_mm=places,
        radius_um=radius,
        alpha_urad=line.slope * 1e3,
        motion_urad=-line.slope * 1e3,
        alpha_se_urad=(noise if len(places) == 2 else float(np.fmax(noise, line.slope_se))) * 1e3,
        straightness_um=-line.residual,
        taper_urad=best_line(places, radius.mean(axis=0)).slope * 1e3,
        circles=(circles[0], circles[1]),
        words=_words(places),
    )


def _circle_at(z: float, probe: int, position: Floats, angle: Floats, reading: Floats) -> Circle:
    rows = position == z
    try:
        return best_circle(angle[rows], reading[rows])
    except MeasurementError as e:
        raise MeasurementError(f"probe {probe} at {z:g} mm: {e}") from e


def _words(places: Floats) -> tuple[str, ...]:
    if len(places) > 2:
        return ("The line through more than two places averages the straightness of the motion.",)
    return (
        "Two places: the straightness of the motion between them is in the result. "
        f"1 µm of it counts as {1e3 / float(np.ptp(places)):.1f} µrad.",
    )

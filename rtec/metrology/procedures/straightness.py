"""Straightness with an artefact and its reversal [G 3.1-3.3], by a pair of probes, and on a turned face [G 3.6-3.8].

Probes read positive as the gap closes; probe 1 stands on the positive side of the arbor, probe 2 on the negative one.
Straightness is that of the probes' motion relative to the artefact, positive in the positive direction of the machine
coordinate. With probes that read positive as the gap opens, give the readings with the other sign.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rtec.errors import MeasurementError
from rtec.metrology.procedures.fitting import Line, best_line

Floats = NDArray[np.float64]
Method = Literal["reversal", "pair", "face"]


@dataclass(frozen=True)
class Straightness:
    """Straightness along one axis, best-fit line taken out.

    Attributes:
        method: how it was measured.
        position_mm: (n,), rising.
        straightness_um: (n,).
        artefact_um: profile of the arbor for reversal and pair, tilt of the face for face, (n,); its own best-fit
            line is taken out except for the face, where the line is what it shows.
        peak_to_valley_um: largest minus smallest straightness.
        rms_um: root mean square of the straightness.
        slope_urad: slope of the line that was taken out. For reversal and pair it is the misalignment of the arbor;
            for the face the orthogonality: of the motion to the spindle's axis, positive where the motion goes
            towards positive as the position grows.
        slope_se_urad: its standard error: straightness itself counts as scatter about the line, so it errs on the
            large side.
        point_se_um: standard error of one point from repeats or from the two halves of the pair; NaN where nothing
            was repeated.
        repeats: sets of readings.
        words: what the uncertainty rests on, and what this method cannot know.
    """

    method: Method
    position_mm: Floats
    straightness_um: Floats
    artefact_um: Floats
    peak_to_valley_um: float
    rms_um: float
    slope_urad: float
    slope_se_urad: float
    point_se_um: float
    repeats: int
    words: tuple[str, ...]


def reversal(position_mm: Floats, m1_um: Floats, m2_um: Floats) -> Straightness:
    """Straightness from probe 1 and, after the arbor was turned by 180°, probe 2 on the same line of the arbor.

    m1 = a - s [G 3.1], m2 = a + s [G 3.2], so s = (m2 - m1)/2 [G 3.3] and a = (m1 + m2)/2.

    Args:
        position_mm: (n,).
        m1_um, m2_um: readings, (n,) or (repeats, n).

    Raises:
        MeasurementError: fewer than three positions, or a reading is missing.
    """
    m1, m2 = _checked(position_mm, m1_um), _checked(position_mm, m2_um)
    words = ["The arbor turns with the spindle: an error of the spindle's 180° index counts as straightness."]
    return _result("reversal", position_mm, (m2 - m1) / 2, (m1 + m2) / 2, words)


def pair(position_mm: Floats, probe1_um: Floats, probe2_um: Floats) -> Straightness:
    """Straightness from two probes, both read before and after the arbor was turned by 180°.

    Each half turn gives reversal twice, with the arbor's two lines: s_a = (p2_180 - p1_0)/2 and s_b = (p2_0 -
    p1_180)/2. Their mean is the straightness; their difference, which should be nil, tells the uncertainty.

    Args:
        position_mm: (n,).
        probe1_um, probe2_um: readings before and after, (2, n) or (2, repeats, n).

    Raises:
        MeasurementError: as for `reversal`.
    """
    p1, p2 = (np.stack([_checked(position_mm, p) for p in probe]) for probe in (probe1_um, probe2_um))
    halves = np.concatenate([(p2[1] - p1[0]) / 2, (p2[0] - p1[1]) / 2])
    profile = np.concatenate([(p1[0] + p2[1]) / 2])
    words = ["Two probes read two opposite lines of the arbor: what the halves disagree by is in the uncertainty."]
    return _result("pair", position_mm, halves, profile, words)


def face(position_mm: Floats, m1_um: Floats, m2_um: Floats, profile_um: Floats | None = None) -> Straightness:
    """Straightness and orthogonality from one probe on a lapped face, before and after the spindle turned by 180°.

    m1 = -δ + e [G 3.6], m2 = -δ - e [G 3.7], so δ = -(m1 + m2)/2 [G 3.8] and e = (m1 - m2)/2; the slope of δ's
    best-fit line is the orthogonality.

    Args:
        position_mm: (n,).
        m1_um, m2_um: readings, (n,) or (repeats, n).
        profile_um: calibrated profile of the face under the probe before and after the turn, (2, n), µm out of the
            face; without it a perfect face is supposed.

    Raises:
        MeasurementError: as for `reversal`.
    """
    m1, m2 = _checked(position_mm, m1_um), _checked(position_mm, m2_um)
    words = []
    if profile_um is None:
        words.append("A perfect face is supposed: a hollow or crowned one counts as straightness. Have it calibrated.")
    else:
        m1, m2 = m1 - profile_um[0], m2 - profile_um[1]
    return _result("face", position_mm, -(m1 + m2) / 2, (m1 - m2) / 2, words)


def _checked(position_mm: Floats, reading_um: Floats) -> Floats:
    """Readings as (repeats, n)."""
    table = np.atleast_2d(reading_um)
    if len(position_mm) < 3:
        raise MeasurementError("straightness needs readings at three places at least")
    if table.shape[1] != len(position_mm):
        raise MeasurementError(f"{table.shape[1]} readings for {len(position_mm)} positions")
    if np.isnan(table).any():
        place = position_mm[int(np.argmax(np.isnan(table).any(axis=0)))]
        raise MeasurementError(f"a reading at {place:g} mm is missing; reversal needs both sets at each position")
    return table


def _result(method: Method, position_mm: Floats, sets: Floats, other: Floats, words: list[str]) -> Straightness:
    order = np.argsort(position_mm, kind="stable")
    position, sets, profile = position_mm[order], sets[:, order], other.mean(axis=0)[order]
    line = best_line(position, sets.mean(axis=0))
    point_se = _point_error(position, sets)
    if np.isnan(point_se):
        words = [*words, "One set of readings: it tells nothing about its own uncertainty. Repeat it three times."]
    return Straightness(
        method=method,
        position_mm=position,
        straightness_um=line.residual,
        artefact_um=profile - profile.mean() if method == "face" else best_line(position, profile).residual,
        peak_to_valley_um=float(np.ptp(line.residual)),
        rms_um=float(np.sqrt(np.mean(line.residual**2))),
        slope_urad=line.slope * 1e3,
        slope_se_urad=line.slope_se * 1e3,
        point_se_um=point_se,
        repeats=len(sets),
        words=tuple(words),
    )


def _point_error(position: Floats, sets: Floats) -> float:
    """Standard error of a point of the mean, each set's own line taken out; NaN from one set."""
    if len(sets) < 2:
        return float("nan")
    lines: list[Line] = [best_line(position, s) for s in sets]
    flat = np.stack([line.residual for line in lines])
    n = len(position)
    # Each set lost a line: n - 2 of its n values are free.
    variance = float(((flat - flat.mean(axis=0)) ** 2).sum()) / ((len(sets) - 1) * (n - 2))
    return float(np.sqrt(variance / len(sets)))

"""Straightness [G 3.1-3.3, 3.6-3.8] and parallelism to the spindle [G 3.4-3.5], with probes on an arbor or a face.

Straightness: an arbor and its reversal, a pair of probes, a turned face, or an artefact that is turned over. Probes
read positive as the gap closes; probe 1 is on the positive side of the arbor, probe 2 on the negative one. The result
is that of the probes' motion relative to the artefact, positive in the positive direction of the machine coordinate.
For probes that read positive as the gap opens, change the sign of the readings.

Parallelism: two probes 180° apart read a turning arbor at two or more places along the motion. The mean over a turn
removes the arbor's eccentricity; the difference of the probes removes the arbor's taper. The straightness of the motion
at the measured places remains (contrary to the text of [G 3.4]); more places reduce it by averaging.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np

from rtec.arrays import Floats
from rtec.errors import MeasurementError
from rtec.metrology.procedures.fitting import BestLine, best_line
from rtec.result import Result

Method = Literal["reversal", "pair", "face", "artefact"]


@dataclass(frozen=True)
class StraightnessResult(Result):
    """Straightness along one axis, relative to the best-fit line.

    Attributes:
        method: method of the measurement.
        position_mm: (n,), rising.
        straightness_um: (n,).
        artefact_um: profile of the arbor (reversal, pair) or artefact, tilt of the face for face, (n,); relative to its
            own best-fit line, except for the face, where the line is the result.
        peak_to_valley_um: largest minus smallest straightness.
        rms_um: root mean square of the straightness.
        slope_urad: slope of the subtracted line, positive where the deviation rises with the position. Where the
            spindle turns (reversal, pair, face) it is the slope of the motion relative to the spindle's axis: the seat
            of the arbor or disk in the spindle cancels like its form. For an artefact that is turned over by hand it is
            the alignment of the artefact, and no property of the machine.
        slope_se_urad: its standard error; too large rather than too small, as the straightness counts as scatter about
            the line.
        point_se_um: standard error of one point from repeats or from the two halves of the pair; NaN without repeats.
        repeats: number of sets of readings; a pair gives two each time.
        words: basis of the uncertainty, and limits of this method.
        name: name of the file or of the measurement.
        axis: the axis that moved.
        notes: notes of the measurements, by name: what is missing in them, and what was accepted.
    """

    page_maker: ClassVar[str] = "rtec.report.procedures:straightness_page"

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
    name: str = ""
    axis: str = ""
    notes: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def facts(self) -> dict[str, Any]:
        """The result as plain data; keys as in the documented JSON."""
        return self.own()

    def rows(self) -> Sequence[Mapping[str, Any]]:
        """One row a place."""
        columns = (self.position_mm, self.straightness_um, self.artefact_um)
        return [{"position_mm": x, "straightness_um": s, "artefact_um": a} for x, s, a in zip(*columns, strict=True)]


def reversal(position_mm: Floats, m1_um: Floats, m2_um: Floats) -> StraightnessResult:
    """Straightness from probe 1 and, after a turn of the arbor by 180°, probe 2 on the same line of the arbor.

    m1 = a - s [G 3.1], m2 = a + s [G 3.2], so s = (m2 - m1)/2 [G 3.3] and a = (m1 + m2)/2.

    Args:
        position_mm: (n,).
        m1_um, m2_um: readings, (n,) or (repeats, n).

    Raises:
        MeasurementError: there are fewer than three positions, or a reading is missing.
    """
    m1, m2 = _checked(position_mm, m1_um), _checked(position_mm, m2_um)
    words = ["The arbor turns with the spindle: an error of the spindle's 180° index counts as straightness."]
    return _result("reversal", position_mm, (m2 - m1) / 2, (m1 + m2) / 2, words)


def artefact(position_mm: Floats, m1_um: Floats, m2_um: Floats) -> StraightnessResult:
    """Straightness from one probe on an artefact before and after it was turned over: m1 = s + a, m2 = s - a.

    Args:
        position_mm: (n,).
        m1_um, m2_um: readings, positive as the tool moves to positive, (n,) or (repeats, n).

    Raises:
        MeasurementError: as for `reversal`.
    """
    m1, m2 = _checked(position_mm, m1_um), _checked(position_mm, m2_um)
    words = ["The slope of the line is how the artefact was set up: it says nothing of the machine."]
    return _result("artefact", position_mm, (m1 + m2) / 2, (m1 - m2) / 2, words)


def pair(position_mm: Floats, probe1_um: Floats, probe2_um: Floats) -> StraightnessResult:
    """Straightness from two probes, both read before and after the arbor was turned by 180°.

    Each half turn is a reversal with each of the arbor's two lines: s_a = (p2_180 - p1_0)/2 and s_b = (p2_0 -
    p1_180)/2. Their mean is the straightness; their difference, ideally zero, gives the uncertainty.

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


def face(position_mm: Floats, m1_um: Floats, m2_um: Floats, profile_um: Floats | None = None) -> StraightnessResult:
    """Straightness and orthogonality from one probe on a lapped face, before and after the spindle turned by 180°.

    m1 = -δ + e [G 3.6], m2 = -δ - e [G 3.7], so δ = -(m1 + m2)/2 [G 3.8] and e = (m1 - m2)/2; the slope of δ's
    best-fit line is the orthogonality.

    Args:
        position_mm: (n,).
        m1_um, m2_um: readings, (n,) or (repeats, n).
        profile_um: calibrated profile of the face under the probe before and after the turn, (2, n), µm out of the
            face; without it the face is taken as perfect.

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


def _result(method: Method, position_mm: Floats, sets: Floats, other: Floats, words: list[str]) -> StraightnessResult:
    order = np.argsort(position_mm, kind="stable")
    position, sets, profile = position_mm[order], sets[:, order], other.mean(axis=0)[order]
    line = best_line(position, sets.mean(axis=0))
    point_se = _point_error(position, sets)
    if np.isnan(point_se):
        words = [*words, "One set of readings: it tells nothing about its own uncertainty. Repeat it three times."]
    return StraightnessResult(
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
    """Standard error of a point of the mean, relative to each set's own line; NaN from one set."""
    if len(sets) < 2:
        return float("nan")
    lines: list[BestLine] = [best_line(position, s) for s in sets]
    flat = np.stack([line.residual for line in lines])
    n = len(position)
    # A line was subtracted from each set: n - 2 of its n values are independent.
    variance = float(((flat - flat.mean(axis=0)) ** 2).sum()) / ((len(sets) - 1) * (n - 2))
    return float(np.sqrt(variance / len(sets)))


@dataclass(frozen=True)
class Circle:
    """Best-fit circle through one probe's readings over a turn, µm.

    Attributes:
        radius_um: R of [G 3.4], relative to the probe's zero.
        centre_um: eccentricity along 0° and 90°.
        roundness_um: largest minus smallest residual.
        se_um: standard error of `radius_um` if the residual is noise; too large if the arbor is out of round.
    """

    radius_um: float
    centre_um: tuple[float, float]
    roundness_um: float
    se_um: float


@dataclass(frozen=True)
class ParallelismResult(Result):
    """Parallelism of a motion to the spindle's axis, in the plane of the probes.

    Attributes:
        position_mm: places, (k,), rising.
        radius_um: best-fit radii, (2 probes, k).
        alpha_urad: α_p of [G 3.5]: slope of the spindle's axis relative to the motion, positive where the axis
            approaches probe 1 as the position increases.
        motion_urad: slope of the motion relative to the spindle's axis, positive towards probe 1's side: -α_p.
        alpha_se_urad: standard error from the residuals of the circles, NaN if unknown.
        straightness_um: residual of (R1 - R2)/2 about the line, (k,); zero for two places.
        taper_urad: change of the arbor's radius along the motion, per length.
        circles: by probe, then place.
        words: remarks on the result.
        name: name of the file.
        axis: the axis that moved.
    """

    page_maker: ClassVar[str] = "rtec.report.procedures:parallelism_page"

    position_mm: Floats
    radius_um: Floats
    alpha_urad: float
    motion_urad: float
    alpha_se_urad: float
    straightness_um: Floats
    taper_urad: float
    circles: tuple[tuple[Circle, ...], tuple[Circle, ...]]
    words: tuple[str, ...]
    name: str = ""
    axis: str = ""

    def facts(self) -> dict[str, Any]:
        """The result as plain data; keys as in the documented JSON."""
        return self.own()

    def rows(self) -> Sequence[Mapping[str, Any]]:
        """One row a circle."""
        return [
            {"position_mm": z, "probe": probe, **asdict(circle)}
            for probe, circles in enumerate(self.circles, 1)
            for z, circle in zip(self.position_mm, circles, strict=True)
        ]


def best_circle(angle_deg: Floats, reading_um: Floats) -> Circle:
    """Limaçon through a turn: R + a cos φ + b sin φ by least squares; R = Σ r_i / n for equal steps [G 3.4].

    Args:
        angle_deg: angle of the spindle, (n,); need not be equally spaced.
        reading_um: (n,), NaN where missing.

    Raises:
        MeasurementError: there are too few readings, or they have a gap of more than half a turn.
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


def parallelism(position_mm: Floats, angle_deg: Floats, probe1_um: Floats, probe2_um: Floats) -> ParallelismResult:
    """Parallelism from the readings of both probes, rows in any order.

    α_p = [(R1(2) - R1(1)) - (R2(2) - R2(1))] / 2Δz for two places [G 3.5]; for more the slope of the best-fit line
    through (R1 - R2)/2, which is the same for two.

    Args:
        position_mm: place of each reading, (n,).
        angle_deg: angle of the spindle, (n,).
        probe1_um, probe2_um: positive as the gap closes; probe 1 on the positive side, (n,).

    Raises:
        MeasurementError: there are fewer than two places, or a turn gives no circle; the message names the place.
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
    return ParallelismResult(
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

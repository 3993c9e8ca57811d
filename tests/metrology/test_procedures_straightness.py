"""Straightness and parallelism against probes whose readings are found by intersecting rays with real bodies.

Oracle: no formula of [G 3] is used to make readings. The arbor is a solid turned by rotation matrices; a probe is a
point and a direction in space; its reading is how much nearer the surface is than at the start, found numerically.
"""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.errors import MeasurementError
from rtec.metrology.procedures.fitting import best_line
from rtec.metrology.procedures.straightness import best_circle, face, pair, parallelism, reversal

Floats = NDArray[np.float64]
Z = np.arange(0.0, 301.0, 20.0)
RADIUS_MM, STAND_MM = 40.0, 45.0


def flat(x: Floats, y: Floats) -> Floats:
    """y without its line, by numpy's own polynomial fit."""
    return y - np.polyval(np.polyfit(x, y, 1), x)


def bump(z: Floats | float, phi: Floats | float) -> Floats:
    """Radius of the arbor beyond nominal, mm, over place and angle in its own frame; no symmetry of any kind."""
    z, phi = np.asarray(z), np.asarray(phi)
    return np.asarray(
        1e-3 * (0.9 * np.sin(z / 45) * np.cos(phi) + 0.4 * np.cos(z / 30) + 0.3 * np.cos(3 * phi) + 0.002 * z)
    )


def slide(z: Floats | float) -> Floats:
    """Motion of the probes along x beside the straight line, mm."""
    z = np.asarray(z)
    return np.asarray(1e-3 * (1.8 * ((z - 150) / 150) ** 2 + 0.5 * np.sin(z / 25)))


def distance(side: float, z: float, turn_deg: float, tilt: float, ecc_mm: float, path_x_mm: float) -> float:
    """Distance from a probe at x = side · 45 mm + path, looking along -side · x, to the turned arbor.

    The arbor's body is eccentric by `ecc_mm` and tilted by `tilt` in its own frame, which turns about the spindle's
    axis z. Solved by fixed-point iteration for the ray's length.
    """
    turn = np.radians(turn_deg)
    back = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    length = STAND_MM - RADIUS_MM
    for _ in range(60):
        point = np.array([side * STAND_MM + path_x_mm - side * length, 0.0])
        own = back @ point - np.array([ecc_mm + tilt * z, 0.0])
        length += float(np.hypot(*own)) - (RADIUS_MM + float(bump(z, np.arctan2(own[1], own[0]))))
    return length


def reading(side: float, z: float, turn_deg: float, path: Callable[[float], float], tilt: float = 2e-6) -> float:
    """µm, positive as the gap closes."""
    return -1e3 * (distance(side, z, turn_deg, tilt, 0.003, path(z)) - (STAND_MM - RADIUS_MM))


def straight_path(z: float) -> float:
    return float(slide(z)) + 7e-6 * z


def scan(side: float, turn_deg: float, tilt: float = 2e-6) -> Floats:
    return np.array([reading(side, z, turn_deg, straight_path, tilt) for z in Z])


def test_reversal_recovers_slide_and_arbor() -> None:
    """The slide is found to 1 nm although the arbor is bent, tapered, eccentric and tilted; the sign is the slide's."""
    r = reversal(Z, scan(+1, 0), scan(-1, 180))
    np.testing.assert_allclose(r.straightness_um, flat(Z, 1e3 * slide(Z)), atol=1e-3)
    np.testing.assert_allclose(r.artefact_um, flat(Z, 1e3 * bump(Z, 0.0)), atol=2e-3)
    assert np.isnan(r.point_se_um)
    assert any("One set" in w for w in r.words)


def test_without_reversal_the_arbor_would_be_in_it() -> None:
    """Why the artefact is turned: probe 2 on the other line of the arbor gives another answer."""
    wrong = flat(Z, (scan(-1, 0) - scan(+1, 0)) / 2)
    assert np.abs(wrong - flat(Z, 1e3 * slide(Z))).max() > 0.5


def test_pair_agrees_with_itself() -> None:
    one, two = (np.stack([scan(side, 0), scan(side, 180)]) for side in (+1.0, -1.0))
    r = pair(Z, one, two)
    np.testing.assert_allclose(r.straightness_um, flat(Z, 1e3 * slide(Z)), atol=1e-3)
    assert r.point_se_um < 1e-3
    assert r.repeats == 2


def test_the_slope_is_of_the_motion_against_the_spindles_axis() -> None:
    """However the arbor sits in the spindle: half a turn takes its tilt out like its form. The path leans by 7 µrad."""
    leans = np.polyfit(Z, [1e6 * straight_path(z) for z in Z], 1)[0]
    for tilt in (2e-6, 40e-6):
        one, two = (np.stack([scan(side, 0, tilt), scan(side, 180, tilt)]) for side in (+1.0, -1.0))
        assert reversal(Z, one[0], two[1]).slope_urad == pytest.approx(leans, abs=1e-3)
        assert pair(Z, one, two).slope_urad == pytest.approx(leans, abs=1e-3)


def test_uncertainty_is_what_repeats_show() -> None:
    """Oracle: noise of 0.1 µm in both readings makes a point err by 0.1 / √2 / √repeats; 200 seeds."""
    true = flat(Z, 1e3 * slide(Z))
    told, made = [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        noise = rng.normal(0, 0.1, (2, 4, len(Z)))
        r = reversal(Z, -1e3 * slide(Z) + noise[0], 1e3 * slide(Z) + noise[1])
        told.append(r.point_se_um)
        made.append(np.sqrt(np.sum((r.straightness_um - true) ** 2) / (len(Z) - 2)))
    assert np.sqrt(np.mean(np.square(told))) == pytest.approx(0.1 / np.sqrt(2) / 2, rel=0.03)
    assert np.sqrt(np.mean(np.square(made))) == pytest.approx(0.1 / np.sqrt(2) / 2, rel=0.03)


X = np.arange(40.0, 121.0, 5.0)


def face_reading(x: float, turn_deg: float, delta_mm: float, lean: Floats) -> float:
    """Probe on the turret at x looks along -z onto a disk leaning by `lean`, turned with the spindle; µm."""
    turn = np.radians(turn_deg)
    spin = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1.0]])
    normal = spin @ np.array([-lean[0], -lean[1], 1.0])
    # Ray (x, 0, 10 + δ) + t (0, 0, -1) meets the plane through the origin.
    length = (normal[0] * x + normal[2] * (10 + delta_mm)) / normal[2]
    return -1e3 * float(length - 10)


def test_face_gives_straightness_and_orthogonality() -> None:
    """The disk leans by 120 µrad; x rises towards +z by 35 µrad with 0.6 µm of waviness."""
    delta = 35e-6 * X + 0.6e-3 * np.sin(X / 9)
    lean = np.array([120e-6, -80e-6])
    m1, m2 = (
        np.array([face_reading(x, turn, d, lean) for x, d in zip(X, delta, strict=True)]) for turn in (0.0, 180.0)
    )
    r = face(X, m1, m2)
    np.testing.assert_allclose(r.straightness_um, flat(X, 1e3 * delta), atol=1e-4)
    assert r.slope_urad == pytest.approx(1e6 * np.polyfit(X, delta, 1)[0], abs=1e-3)
    assert abs(np.polyfit(X, r.artefact_um, 1)[0] * 1e3) == pytest.approx(120, abs=0.01)


def test_a_calibrated_face_is_taken_out() -> None:
    """Oracle: a hollow face, the same before and after the turn, is added to a flat one's readings."""
    hollow = 1.5 * ((X - 80) / 40) ** 2
    r = face(X, hollow - 0.03 * X, hollow - 0.03 * X)
    assert r.peak_to_valley_um > 0.5
    mended = face(X, hollow - 0.03 * X, hollow - 0.03 * X, np.stack([hollow, hollow]))
    assert mended.peak_to_valley_um < 1e-9
    assert mended.slope_urad == pytest.approx(30.0)


ANGLES = np.arange(0.0, 360.0, 360 / 64)


def turns(places: Floats, path: Callable[[float], float]) -> tuple[Floats, Floats, Floats, Floats]:
    rows = [(z, a, reading(+1, z, a, path), reading(-1, z, a, path)) for z in places for a in ANGLES]
    z, angle, one, two = np.array(rows).T
    return z, angle, one, two


def test_parallelism_from_a_turning_arbor() -> None:
    """The motion leans by +25 µrad from the spindle's axis; the arbor is eccentric, tilted, tapered and not round."""
    r = parallelism(*turns(np.array([0.0, 300.0]), lambda z: 25e-6 * z))
    assert r.motion_urad == pytest.approx(25.0, abs=0.01)
    assert r.alpha_urad == -r.motion_urad
    # (3.5) as printed, from the plain means of (3.4)
    z, _, one, two = turns(np.array([0.0, 300.0]), lambda z: 25e-6 * z)
    mean = {(p, k): v[z == s].mean() for p, v in ((1, one), (2, two)) for k, s in ((1, 0.0), (2, 300.0))}
    alpha = ((mean[1, 2] - mean[1, 1]) - (mean[2, 2] - mean[2, 1])) / (2 * 300.0) * 1e3
    assert r.alpha_urad == pytest.approx(alpha, abs=1e-9)
    # 2 µm/m of radius, and what the other term of the profile adds between the two ends
    assert r.taper_urad == pytest.approx(2.0 + 0.4e3 * (np.cos(10) - 1) / 300, abs=0.02)


def test_straightness_stays_in_two_places_and_shows_in_more() -> None:
    """The algebra of (3.5) does not take the motion's straightness out, whatever the text beside it says."""
    bent = parallelism(*turns(np.array([0.0, 300.0]), lambda z: 25e-6 * z + 1e-3 * (z > 200)))
    assert bent.motion_urad == pytest.approx(25.0 + 1e3 / 300, abs=0.02)
    assert any("3.3 µrad" in w for w in bent.words)
    places = np.linspace(0, 300, 7)
    wave = 1e-3 * np.sin(places / 40)
    more = parallelism(*turns(places, lambda z: 25e-6 * z + float(np.interp(z, places, wave))))
    np.testing.assert_allclose(more.straightness_um, flat(places, 1e3 * wave), atol=5e-3)
    assert more.motion_urad == pytest.approx(25 + np.polyfit(places, 1e6 * wave, 1)[0], abs=0.02)


def test_circle_of_uneven_angles() -> None:
    """Oracle: the limaçon that was put in; a plain mean would be off by the eccentricity."""
    angle = np.sort(np.random.default_rng(3).uniform(0, 300, 90))
    values = 2.0 + 5.0 * np.cos(np.radians(angle)) - 3.0 * np.sin(np.radians(angle))
    c = best_circle(angle, values)
    assert c.radius_um == pytest.approx(2.0)
    np.testing.assert_allclose(c.centre_um, [5.0, -3.0])
    assert abs(values.mean() - 2.0) > 0.3
    with pytest.raises(MeasurementError, match="whole turn"):
        best_circle(angle[angle < 150], values[angle < 150])
    with pytest.raises(MeasurementError, match="probe 1 at 0 mm: 3 readings"):
        parallelism(np.repeat([0.0, 1.0], 3), np.tile([0.0, 120.0, 240.0], 2), np.zeros(6), np.zeros(6))


def test_best_line_against_numpy() -> None:
    """Oracle: numpy.polyfit with its covariance."""
    rng = np.random.default_rng(1)
    y = 0.3 * Z - 4 + rng.normal(0, 1, len(Z))
    line = best_line(Z, y)
    (slope, offset), cov = np.polyfit(Z, y, 1, cov=True)
    np.testing.assert_allclose([line.slope, line.offset, line.slope_se], [slope, offset, np.sqrt(cov[0, 0])])


@pytest.mark.parametrize(
    ("position", "m1", "said"),
    [
        (Z[:2], Z[:2], "three places"),
        (Z, Z[:-1], "15 readings for 16 positions"),
        (Z, np.where(Z == 40, np.nan, Z), "a reading at 40 mm is missing"),
    ],
)
def test_wrong_readings_are_told(position: Floats, m1: Floats, said: str) -> None:
    with pytest.raises(MeasurementError, match=said):
        reversal(position, m1, m1)

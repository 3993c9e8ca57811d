"""Circular tests after ISO 230-4: G, G(b), F, H, D; and harmonics of the circle.

All refer to the least-squares circle: its centre removes the eccentricity of the set-up. Readings are along the bar,
which is the radius only where the height is zero.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtec.arrays import Bools, Floats
from rtec.metrology.ball_bar.circle import CircleTest

SAME_MM = 1e-3


@dataclass(frozen=True)
class Roundness:
    """One test.

    Attributes:
        name: name of the test.
        g_um: circular deviation G, the largest of its runs.
        f_max_um, f_min_um: radial deviation F: about the centre of the least-squares circle where the circle is full,
            else about the centre as it was set up.
        radius_um: least-squares radius minus nominal.
        centre_um: centre of the least-squares circle, along the plane's two letters.
        about: "least-squares centre" or "centre as set up".
    """

    name: str
    g_um: float
    f_max_um: float
    f_min_um: float
    radius_um: float
    centre_um: tuple[float, float]
    about: str


@dataclass(frozen=True)
class BothWays:
    """A pair of tests in both senses on the same circle.

    Attributes:
        names: counter-clockwise, clockwise.
        g_b_um: bi-directional circular deviation G(b).
        h_um: circular hysteresis H, largest difference of the two paths at one angle.
        h_at_deg: that angle.
        d_um: mean bi-directional radial deviation D.
    """

    names: tuple[str, str]
    g_b_um: float
    h_um: float
    h_at_deg: float
    d_um: float


@dataclass(frozen=True)
class CircleHarmonic:
    """One order: amplitude, µm, and the angle at which it is largest, degrees."""

    order: int
    amplitude_um: float
    phase_deg: float


def roundness(circle: CircleTest) -> Roundness:
    """G and F of one test."""
    radius, first, second, left = least_squares_circle(circle.angle_rad, circle.reading_um)
    g = max(float(np.ptp(least_squares_circle(circle.angle_rad[k], circle.reading_um[k])[3])) for k in _runs(circle))
    radial = left + radius if circle.full else circle.reading_um
    about = "least-squares centre" if circle.full else "centre as set up"
    return Roundness(circle.name, g, float(radial.max()), float(radial.min()), radius, (first, second), about)


def both_ways(circles: Sequence[CircleTest]) -> tuple[BothWays, ...]:
    """G(b), H and D of every pair in both senses with the same centre, radius, height, feed and arc."""
    out = []
    for one in circles:
        for other in circles:
            if one.setup.sense > 0 > other.setup.sense and _same_circle(one, other):
                out.append(_pair(one, other))
    return tuple(out)


def harmonics(angle_rad: Floats, values_um: Floats, most: int = 15) -> tuple[CircleHarmonic, ...]:
    """Orders 0 … `most` of a full circle by least squares; angles need not be even."""
    turns = np.arange(1, most + 1)
    waves = np.concatenate([np.cos(np.outer(angle_rad, turns)), np.sin(np.outer(angle_rad, turns))], axis=1)
    design = np.concatenate([np.ones((len(angle_rad), 1)), waves], axis=1)
    coefficients = np.linalg.lstsq(design, values_um, rcond=None)[0]
    out = [CircleHarmonic(0, float(coefficients[0]), 0.0)]
    for k in turns:
        c, s = float(coefficients[k]), float(coefficients[most + k])
        out.append(CircleHarmonic(int(k), float(np.hypot(c, s)), float(np.rad2deg(np.arctan2(s, c)) / k)))
    return tuple(out)


def mean_path(circle: CircleTest, travel_deg: Floats) -> Floats:
    """Mean of the runs at given angles from the arc's start, µm, (m,)."""
    paths = [np.interp(travel_deg, circle.travel_deg[k], circle.reading_um[k]) for k in _runs(circle) if np.sum(k) > 1]
    return np.asarray(np.mean(paths, axis=0), dtype=np.float64)


def _pair(ccw: CircleTest, cw: CircleTest) -> BothWays:
    radius, _, _, left = least_squares_circle(
        np.concatenate([ccw.angle_rad, cw.angle_rad]), np.concatenate([ccw.reading_um, cw.reading_um])
    )
    count = max(min(len(ccw), len(cw)), 2)
    way = np.linspace(0.0, ccw.setup.arc_deg, count)
    angle_deg = ccw.setup.start_deg + way
    # The clockwise path meets the same angles from the other end.
    meet = (-(angle_deg - cw.setup.start_deg)) % 360.0 if ccw.closed else ccw.setup.arc_deg - way
    apart = np.abs(mean_path(ccw, way) - mean_path(cw, meet))
    apart[_without(ccw, way) | _without(cw, meet)] = 0.0
    worst = int(np.argmax(apart))
    at = float(angle_deg[worst] % 360.0)
    return BothWays((ccw.name, cw.name), float(np.ptp(left)), float(apart[worst]), at, radius)


def _without(circle: CircleTest, travel_deg: Floats) -> Bools:
    """Whether each angle is in a gap of the readings."""
    inside = [(low < travel_deg) & (travel_deg < high) for low, high in circle.gaps]
    return np.asarray(np.any([np.zeros(len(travel_deg), dtype=np.bool_), *inside], axis=0), dtype=np.bool_)


def _same_circle(one: CircleTest, other: CircleTest) -> bool:
    a, b = one.setup, other.setup
    numbers = [(a.radius_mm, b.radius_mm), (a.height_mm, b.height_mm), *zip(a.centre_mm, b.centre_mm, strict=True)]
    start = 0.0 if one.closed else a.start_deg + a.arc_deg - b.start_deg
    return (
        all(abs(x - y) < SAME_MM for x, y in numbers)
        and abs(a.feed_mm_min - b.feed_mm_min) < 1.0
        and abs(a.arc_deg - b.arc_deg) < SAME_MM
        and abs((start + 180.0) % 360.0 - 180.0) < 0.1
    )


def _runs(circle: CircleTest) -> list[Bools]:
    return [np.asarray(circle.run == r) for r in np.unique(circle.run)]


def least_squares_circle(angle_rad: Floats, reading_um: Floats) -> tuple[float, float, float, Floats]:
    """Radius and centre of the least-squares circle, µm, and the residual, (n,)."""
    design = np.stack([np.ones(len(angle_rad)), np.cos(angle_rad), np.sin(angle_rad)], axis=1)
    coefficients = np.linalg.lstsq(design, reading_um, rcond=None)[0]
    return float(coefficients[0]), float(coefficients[1]), float(coefficients[2]), reading_um - design @ coefficients

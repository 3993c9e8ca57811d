"""Noise of ball-bar readings; the oracle is the dense covariance matrix and what noise was made."""

import numpy as np
import pytest

from rtec.metrology.ball_bar.circle import CircleTest, circle_of
from rtec.metrology.ball_bar.noise import AngleNoise, find_noise
from tests.support.ball_bar_dynamic import wander
from tests.support.ball_bar_examples import bar, gantry, recorded


def circles(step_deg: float) -> tuple[CircleTest, ...]:
    m = gantry()
    angle = np.arange(0.0, 360.0, step_deg)
    made = [recorded(m, bar(m, direction=d), a, np.zeros(len(angle)), d) for d, a in (("ccw", angle), ("cw", -angle))]
    return tuple(circle_of(x) for x in made)


def covariance(tests: tuple[CircleTest, ...], noise: AngleNoise) -> np.ndarray:
    """Tests are independent; `d exp(-|Δζ| / τ)` within one, and the white part."""
    ends, out = np.cumsum([0, *(len(c) for c in tests)]), np.zeros((2 * len(tests[0]),) * 2)
    for c, start in zip(tests, ends[:-1], strict=True):
        at = slice(start, start + len(c))
        apart = np.abs(c.angle_rad[:, None] - c.angle_rad[None, :])
        white = np.where(c.near_quadrant(noise.window_deg), noise.near**-2.0, 1.0)
        out[at, at] = noise.share * np.exp(-apart / noise.way_rad) + np.diag(white)
    return out


@pytest.mark.parametrize("noise", [AngleNoise(), AngleNoise(2.0, 0.3), AngleNoise(0.5, 2.0, near=0.4, window_deg=7.0)])
def test_whitened_columns_have_the_inverse_covariance_as_their_metric(noise: AngleNoise) -> None:
    """Oracle: `Xᵀ C⁻¹ X` with the dense matrix; and the restricted likelihood by the book."""
    tests = circles(5.0)
    rng = np.random.default_rng(1)
    columns, reading = rng.standard_normal((2 * len(tests[0]), 4)), rng.standard_normal(2 * len(tests[0]))
    white, dense = noise.whiten(tests, columns), covariance(tests, noise)
    np.testing.assert_allclose(white.T @ white, columns.T @ np.linalg.solve(dense, columns), rtol=1e-9)
    normal = columns.T @ np.linalg.solve(dense, columns)
    found = np.linalg.solve(normal, columns.T @ np.linalg.solve(dense, reading))
    left = reading - columns @ found
    free = len(reading) - 4
    power = left @ np.linalg.solve(dense, left) / free
    wanted = np.linalg.slogdet(dense)[1] + np.linalg.slogdet(normal)[1] + free * np.log(power)
    assert noise.cost(tests, columns, reading) == pytest.approx(wanted, rel=1e-9)


def test_a_noise_that_wanders_is_told_from_a_white_one() -> None:
    """Oracle: the noise made. A circle holds some twenty turns of it, so its size is known to about a third."""
    tests = circles(0.5)
    rng = np.random.default_rng(2)
    n = len(tests[0])
    slow = np.concatenate([wander(rng, n, np.deg2rad(0.5), 0.3) for _ in tests])
    white = rng.standard_normal(2 * n)
    columns = np.ones((2 * n, 1))
    best, worst = find_noise(tests, columns, 2.0 * slow + white, 1.0, 5.0)
    assert best.share == pytest.approx(4.0, rel=0.6)
    assert best.way_rad == pytest.approx(0.3, rel=0.6)
    assert worst.share * worst.way_rad >= best.share * best.way_rad
    assert find_noise(tests, columns, white, 1.0, 5.0)[0].share < 0.05

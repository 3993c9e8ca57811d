"""Noise of ball-bar readings; the oracle is the dense covariance matrix and what noise was made."""

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.metrology.ball_bar.circle import CircleTest, circle_of, circles_of
from rtec.metrology.ball_bar.fit import Solution, allowing
from rtec.metrology.ball_bar.noise import WHITE, AngleNoise, find_noise
from tests.support.ball_bar_dynamic import wander
from tests.support.ball_bar_examples import bar, gantry, recorded
from tests.support.ball_bar_truth import THREE, TrueMachine, recordings


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


@pytest.mark.parametrize("there_um", [0.0, 0.06, 0.12])
def test_what_may_be_there_is_allowed_for_by_its_evidence(there_um: float) -> None:
    """Oracle: Bayes' rule integrated on a grid: a cause of 0 ± 1 µm at even odds beside one that is nearly as it."""
    angle = np.deg2rad(np.arange(0.5, 360.0, 1.0))
    circle = circles_of(recordings(TrueMachine("tool", "XY"), THREE[:1]))
    known, other = np.cos(2 * angle)[:, None], (0.45 * np.cos(2 * angle) + 0.2 * np.cos(4 * angle))[:, None]
    sigma, rng = 0.2, np.random.default_rng(3)
    reading = 0.3 * known[:, 0] + there_um * other[:, 0] + sigma * rng.standard_normal(len(angle))
    found = np.linalg.lstsq(known, reading, rcond=None)[0]
    alone = Solution(found, sigma**2 * np.linalg.inv(known.T @ known), sigma, 1.0, known, reading - known @ found)
    allowed = allowing(alone, [other], circle, WHITE)
    # The grid: of the cause in units of its usual size, and of the parameter about its value.
    unit = other[:, 0] / np.ptp(other)
    size, value = np.linspace(-6.0, 6.0, 4001), found[0] + np.linspace(-1.5, 1.5, 3001)
    a, b, c = known[:, 0] @ known[:, 0], known[:, 0] @ unit, unit @ unit
    left = [reading @ reading, reading @ known[:, 0], reading @ unit]

    def power(v: NDArray[np.float64], s: NDArray[np.float64]) -> NDArray[np.float64]:
        squares = left[0] - 2 * left[1] * v - 2 * left[2] * s + a * v**2 + 2 * b * v * s + c * s**2
        return np.asarray(np.exp(-0.5 * (squares - float(alone.residual @ alone.residual)) / sigma**2))

    without = power(value, np.zeros(1))
    prior = np.exp(-0.5 * size**2) / np.sqrt(2 * np.pi) * (size[1] - size[0])
    beside = np.array([float(power(v, size) @ prior) for v in value])
    weight = without + beside
    mean = float(weight @ value / weight.sum())
    assert allowed.coefficients[0] == pytest.approx(mean, abs=1e-4)
    assert allowed.errors[0] == pytest.approx(np.sqrt(float(weight @ (value - mean) ** 2 / weight.sum())), rel=1e-3)

"""Noise of ball-bar readings: a white part and a slow part along the circle; and whitening.

    reading = signal + w + g        w independent from reading to reading, variance 1 (over `near`² at the quadrants)
    g along the angle ζ:            Ornstein-Uhlenbeck, variance d, correlation length τ: cov = d exp(-|Δζ| / τ)

The whitened readings are a Kalman filter's innovations over their standard deviations, in one pass. d and τ have the
largest restricted likelihood, with all candidates in the mean. This accounts for the slow noise that a fit of forty
parameters absorbs, which the correlation of the residual would not show.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rtec.arrays import Floats
from rtec.jit import njit
from rtec.metrology.ball_bar.circle import CircleTest

NOISE_UM = 0.02
"""Lower bound of the noise; no ball bar reads finer."""
SHARES = (0.1, 1.0, 10.0)
WAYS_RAD = (0.05, 0.2, 0.8, 3.0)
"""Starts of the search for d and τ."""
LOWEST, HIGHEST = np.log([1e-3, 0.01]), np.log([1e3, 6.0])
STEPS = 24
LIKELY = 4.0
"""A noise is still likely if minus twice its log-likelihood exceeds the smallest one by less than this."""


@dataclass(frozen=True)
class AngleNoise:
    """Shape of the noise, without its size.

    Attributes:
        share: d, ratio of the variances: slow part over white part.
        way_rad: τ, rad.
        near: standard deviation of the white part elsewhere over that at the quadrants: 1, or less if it is larger
            there.
        window_deg: half-width of the quadrants.
    """

    share: float = 0.0
    way_rad: float = 1.0
    near: float = 1.0
    window_deg: float = 5.0

    def whiten(self, circles: Sequence[CircleTest], columns: Floats) -> Floats:
        """Whiten columns over all readings of the tests, (n, p); gives (n, p)."""
        return self._filter(circles, columns)[0]

    def _filter(self, circles: Sequence[CircleTest], columns: Floats) -> tuple[Floats, float]:
        out = np.ascontiguousarray(columns, dtype=np.float64).copy()
        white = np.concatenate([np.where(c.near_quadrant(self.window_deg), self.near**-2.0, 1.0) for c in circles])
        return out, float(_whiten(out, np.concatenate([c.apart_rad for c in circles]), white, self.share, self.way_rad))

    def cost(self, circles: Sequence[CircleTest], columns: Floats, reading: Floats) -> float:
        """Minus twice the restricted log-likelihood, without terms that are the same for all noises."""
        both, log_det = self._filter(circles, np.concatenate([columns, reading[:, None]], axis=1))
        size = np.linalg.norm(both[:, :-1], axis=0)
        normal = (both[:, :-1] / size).T @ (both / np.append(size, 1.0))
        lower = np.linalg.cholesky(normal[:, :-1])
        made = np.linalg.solve(lower, normal[:, -1])
        left = max(float(both[:, -1] @ both[:, -1] - made @ made), 1e-300)
        free = float(len(reading) - columns.shape[1])
        return log_det + 2.0 * float(np.log(np.diag(lower) * size).sum()) + free * math.log(left / free)


WHITE = AngleNoise()


def find_noise(
    circles: Sequence[CircleTest], columns: Floats, reading: Floats, near: float, window_deg: float
) -> tuple[AngleNoise, AngleNoise]:
    """The noise of the largest restricted likelihood, and of those still likely the one with the largest d τ.

    A circle has only a few periods of a slow noise, so that its size stays uncertain; a cause must be significant with
    the second noise, too.

    Args:
        circles: the tests.
        columns: independent columns of everything that the readings may contain, (n, p).
        reading: readings, (n,).
        near, window_deg: as in `AngleNoise`.
    """
    from scipy.optimize import minimize

    plain = AngleNoise(0.0, 1.0, near, window_deg)

    def noise(x: Floats) -> AngleNoise:
        inside = np.exp(np.clip(x, LOWEST, HIGHEST))
        return replace(plain, share=float(inside[0]), way_rad=float(inside[1]))

    tried: list[tuple[float, AngleNoise]] = [(plain.cost(circles, columns, reading), plain)]

    def cost(x: Floats) -> float:
        tried.append((noise(x).cost(circles, columns, reading), noise(x)))
        return tried[-1][0]

    starts = [np.log([share, way]) for share in SHARES for way in WAYS_RAD]
    start = min(starts, key=cost)
    minimize(cost, start, method="Nelder-Mead", options={"maxfev": STEPS, "initial_simplex": _simplex(start)})
    least, best = min(tried, key=lambda t: t[0])
    likely = [n for value, n in tried if value < least + LIKELY]
    return best, max(likely, key=lambda n: n.share * n.way_rad)


def _simplex(start: Floats) -> Floats:
    return np.asarray(start + np.diag([0.0, 1.0, 0.7])[:, 1:], dtype=np.float64)


@njit
def _whiten(columns: Floats, apart: Floats, white: Floats, share: float, way: float) -> float:
    """Whiten columns in place, (n, p); gives log det of the covariance."""
    n, p = columns.shape
    held = np.zeros(p)
    variance, total = 0.0, 0.0
    for i in range(n):
        ratio = apart[i] / way
        decay = math.exp(-ratio) if ratio < 25.0 else 0.0
        variance = decay * decay * variance + (1.0 - decay * decay) * share
        whole = variance + white[i]
        gain, scale = variance / whole, 1.0 / math.sqrt(whole)
        variance *= white[i] / whole
        total += math.log(whole)
        for j in range(p):
            before = decay * held[j]
            fresh = columns[i, j] - before
            held[j] = before + gain * fresh
            columns[i, j] = fresh * scale
    return total

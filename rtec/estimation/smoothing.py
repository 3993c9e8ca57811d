"""Smooths temperatures in time: otherwise the noise of a sensor would decide between similar thermal rivals.

A temperature creeps: its rate is a random walk whose speed makes the readings likeliest. The best curve under this
assumption is a cubic smoothing spline, computed by a Kalman filter and a backward pass (Rauch, Tung and Striebel 1965)
in time proportional to the number of readings. Where a temperature jumps, another curve begins.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtec.arrays import Bools, Floats, robust_sigma
from rtec.jit import njit

ABOUT = 5
"""Fewer readings give no curve."""
QUANTUM = 0.29
"""Standard deviation of rounding to steps of one, 1/√12."""
JUMP, LARGE = 30.0, 0.1
"""A jump: neighbours differ by this many standard deviations, and by this share of the sensor's whole range."""
MOST = 4000
"""This many readings determine the speed of the walk as well as all do."""
TRIED, CLOSE = 16, 0.1
"""Most values of the walk that are tried, and the tolerance of the logarithm of its time."""
FILLED_S = 960.0
"""A missing reading is filled where another is at most this far away, s."""


@dataclass(frozen=True)
class Windows:
    """Instants of readings.

    Attributes:
        time_s: not falling, (n,).
    """

    time_s: Floats


def smoothed(windows: Windows, value: Floats) -> Floats:
    """The likeliest creeping curve through readings; NaN readings are skipped.

    Args:
        windows: the n instants.
        value: (n,).

    Returns:
        (n,); a NaN reading is filled where it has neighbours.
    """
    time_s, good = windows.time_s, np.isfinite(value)
    seen = np.flatnonzero(good)
    if len(seen) < ABOUT:
        return value
    sigma = noise_of(value[seen])
    far = max(JUMP * sigma, LARGE * float(np.ptp(value[seen])))
    breaks = np.flatnonzero(np.abs(np.diff(value[seen])) > far) + 1
    edges = [0, *breaks.tolist(), len(seen)]
    parts = [(seen[a], seen[b - 1] + 1) for a, b in itertools.pairwise(edges) if b - a >= ABOUT]
    curves = [(time_s[a:b] - time_s[a], (value[a:b] - value[a]) / sigma) for a, b in parts if time_s[b - 1] > time_s[a]]
    if not curves:
        return value
    walk, out = _likeliest(curves), value.copy()
    for (a, b), curve in zip([p for p in parts if time_s[p[1] - 1] > time_s[p[0]]], curves, strict=True):
        made = spline(*curve, walk) * sigma + value[a]
        out[a:b] = np.where(good[a:b] | _near(time_s[a:b], good[a:b]), made, np.nan)
    return out


def _near(time_s: Floats, good: Bools) -> Bools:
    """Which instants have a reading nearby on either side, (n,); the first and last count as such."""
    seen = time_s[good]
    at = np.clip(np.searchsorted(seen, time_s), 1, len(seen) - 1)
    return np.asarray(np.minimum(np.abs(time_s - seen[at - 1]), np.abs(seen[at] - time_s)) <= FILLED_S)


def noise_of(value: Floats) -> float:
    """Noise of a series from how each reading differs from the middle of its neighbours, at least that of its steps."""
    bend = value[1:-1] - 0.5 * (value[:-2] + value[2:])
    steps: Floats = np.unique(np.round(np.abs(np.diff(value)), 9))
    quantum = float(steps[1]) if len(steps) > 1 and steps[0] == 0.0 else 0.0
    return float(max(robust_sigma(bend) / np.sqrt(1.5), QUANTUM * quantum, 1e-12))


def _likeliest(curves: Sequence[tuple[Floats, Floats]]) -> float:
    """Speed of the random walk of the rate that all curves share, in variance of the noise per second cubed."""
    from scipy.optimize import minimize_scalar

    step = -(-sum(len(t) for t, _ in curves) // MOST)
    few = [(t[::step].copy(), v[::step].copy()) for t, v in curves]
    few = [(t[np.isfinite(v)], v[np.isfinite(v)]) for t, v in few]
    few = [(t, v) for t, v in few if len(t) > 2 and t[-1] > t[0]]
    apart = np.concatenate([np.diff(t) for t, _ in few] or [np.ones(1)])
    shortest, span = float(np.median(apart[apart > 0.0])), max([float(t[-1]) for t, _ in few], default=1.0)
    nothing = np.empty((0, 5))
    # Over this time the walk bends a line by as much as the mean of its readings deviates.
    found = minimize_scalar(
        lambda x: sum(creep(t, v, shortest / np.exp(4.0 * x), nothing) for t, v in few),
        bounds=(np.log(shortest), np.log(max(span, 2.0 * shortest))),
        method="bounded",
        options={"maxiter": TRIED, "xatol": CLOSE},
    )
    return shortest / float(np.exp(4.0 * found.x))


@njit
def creep(time_s: Floats, value: Floats, walk: float, kept: Floats) -> float:
    """Filter forward; give −2 log likelihood, up to a constant, and store the state after each reading.

    Args:
        time_s: not falling, (n,).
        value: over the standard deviation of a reading; NaN where one is missing, never the first, (n,).
        walk: variance that the rate gains per second.
        kept: written: value, rate, and their variances and covariance, (n, 5); or empty, and nothing is stored.
    """
    n, keeps = len(time_s), len(kept) > 0
    start = 1
    while start < n - 1 and (time_s[start] <= time_s[0] or not np.isfinite(value[start])):
        start += 1
    dt = time_s[start] - time_s[0]
    x, rate = value[start], (value[start] - value[0]) / dt
    a, b, c = 1.0, 1.0 / dt, 2.0 / (dt * dt) + walk * dt / 3.0
    cost = 0.0
    for i in range(start, n):
        if i > start:
            dt = time_s[i] - time_s[i - 1]
            x += dt * rate
            a += dt * (2.0 * b + dt * c) + walk * dt**3 / 3.0
            b += dt * c + walk * dt**2 / 2.0
            c += walk * dt
            if np.isfinite(value[i]):
                off, s = value[i] - x, a + 1.0
                cost += np.log(s) + off * off / s
                x += a / s * off
                rate += b / s * off
                c -= b * b / s
                b -= a * b / s
                a -= a * a / s
        if keeps:
            kept[i, 0], kept[i, 1], kept[i, 2], kept[i, 3], kept[i, 4] = x, rate, a, b, c
    if keeps:
        kept[:start, 2] = -1.0
    return cost


@njit
def spline(time_s: Floats, value: Floats, walk: float) -> Floats:
    """The curve that is likeliest given all readings, (n,); arguments as of `creep`."""
    n = len(time_s)
    kept = np.empty((n, 5))
    creep(time_s, value, walk, kept)
    out = np.empty(n)
    x, rate = kept[n - 1, 0], kept[n - 1, 1]
    out[n - 1] = x
    for i in range(n - 2, -1, -1):
        dt = time_s[i + 1] - time_s[i]
        a, b, c = kept[i, 2], kept[i, 3], kept[i, 4]
        if a < 0.0:
            x -= dt * rate
            out[i] = x
            continue
        # The prediction at the next reading, and the gain of the information from all later readings.
        mine, its = kept[i, 0] + dt * kept[i, 1], kept[i, 1]
        p = a + dt * (2.0 * b + dt * c) + walk * dt**3 / 3.0
        q = b + dt * c + walk * dt**2 / 2.0
        r = c + walk * dt
        det = p * r - q * q
        if det <= 0.0:
            out[i] = kept[i, 0]
            x, rate = kept[i, 0], kept[i, 1]
            continue
        one, two = a + dt * b, b + dt * c
        g, h = (one * r - b * q) / det, (b * p - one * q) / det
        k, m = (two * r - c * q) / det, (c * p - two * q) / det
        dx, dr = x - mine, rate - its
        x = kept[i, 0] + g * dx + h * dr
        rate = kept[i, 1] + k * dx + m * dr
        out[i] = x
    return out

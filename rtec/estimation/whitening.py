"""Whitening in time proportional to the number of readings: a Kalman filter's innovations.

The noise of a series is white, plus a drift that forgets (Ornstein-Uhlenbeck, variance d, time constant τ), plus an
offset that each run has anew (variance r), plus what each run has anew and nobody knows (zero, slope: variance so
large that only the readings decide). With white variance one, the filter's innovations over their standard deviations
are `L⁻¹ y` with `L Lᵀ = Σ`, up to nothing: the same numbers as by a Cholesky factor, without the matrix.

The state is [drift, offset of the run, unknowns of the run …]; the gains do not depend on the readings, so they are
worked out once and then used on every column.
"""

import math

import numpy as np
from numpy.typing import NDArray

from rtec.jit import njit

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@njit
def gains(  # noqa: PLR0912
    time_s: Floats,
    run: Ints,
    unknown: Floats,
    drift: float,
    tau_s: float,
    offset: float,
    wide: Floats,
    decay: Floats,
    gain: Floats,
    scale: Floats,
) -> float:
    """Work out the filter of one series.

    Args:
        time_s: (n,), not falling.
        run: (n,), another number where a run begins.
        unknown: what each run has anew, (n, k).
        drift: variance of the drift over that of the white noise.
        tau_s: its time constant.
        offset: variance of the runs' offsets over that of the white noise.
        wide: variances of the unknowns, (k,).
        decay: written: how much of the drift is left since the last reading, (n,).
        gain: written: gain of each state, (n, 2 + k).
        scale: written: one over the standard deviation of the innovation, (n,).

    Returns:
        log det Σ.
    """
    n, size = len(time_s), 2 + unknown.shape[1]
    p = np.zeros((size, size))
    h = np.ones(size)
    ph = np.zeros(size)
    total = 0.0
    for i in range(n):
        if i == 0:
            decay[i] = 0.0
        else:
            ratio = (time_s[i] - time_s[i - 1]) / tau_s
            decay[i] = math.exp(-ratio) if ratio < 25.0 else 0.0
        if i == 0 or run[i] != run[i - 1]:
            # A new run: what belonged to the last one is forgotten.
            drift_left = p[0, 0]
            for a in range(size):
                for b in range(size):
                    p[a, b] = 0.0
            p[0, 0] = drift_left
            p[1, 1] = offset
            for a in range(2, size):
                p[a, a] = wide[a - 2]
        f = decay[i]
        for a in range(1, size):
            p[0, a] *= f
            p[a, 0] = p[0, a]
        p[0, 0] = f * f * p[0, 0] + (1.0 - f * f) * drift
        for a in range(2, size):
            h[a] = unknown[i, a - 2]
        s = 1.0
        for a in range(size):
            v = 0.0
            for b in range(size):
                v += p[a, b] * h[b]
            ph[a] = v
        for a in range(size):
            s += h[a] * ph[a]
        for a in range(size):
            gain[i, a] = ph[a] / s
        for a in range(size):
            for b in range(size):
                p[a, b] -= ph[a] * ph[b] / s
        scale[i] = 1.0 / math.sqrt(s)
        total += math.log(s)
    return total


@njit
def innovations(run: Ints, unknown: Floats, decay: Floats, gain: Floats, scale: Floats, columns: Floats) -> None:
    """Whiten columns in place, (n, p).

    Args:
        run: as in `gains`.
        unknown: as in `gains`.
        decay, gain, scale: from `gains`.
        columns: (n, p), rows one after the other in memory.
    """
    n, p = columns.shape
    size = gain.shape[1]
    x = np.zeros((size, p))
    for i in range(n):
        f = decay[i]
        fresh = i == 0 or run[i] != run[i - 1]
        for j in range(p):
            x[0, j] *= f
        if fresh:
            for a in range(1, size):
                for j in range(p):
                    x[a, j] = 0.0
        row = columns[i]
        for j in range(p):
            row[j] -= x[0, j] + x[1, j]
        for a in range(2, size):
            u = unknown[i, a - 2]
            for j in range(p):
                row[j] -= u * x[a, j]
        for a in range(size):
            g = gain[i, a]
            for j in range(p):
                x[a, j] += g * row[j]
        s = scale[i]
        for j in range(p):
            row[j] *= s


@njit
def drift_draws(time_s: Floats, tau_s: float, steps: Floats) -> None:
    """Turn independent standard normal numbers, (n, draws), into drifts of variance one, in place."""
    for i in range(1, len(time_s)):
        decay = math.exp(-min((time_s[i] - time_s[i - 1]) / tau_s, 25.0))
        fresh = math.sqrt(1.0 - decay * decay)
        for k in range(steps.shape[1]):
            steps[i, k] = decay * steps[i - 1, k] + fresh * steps[i, k]

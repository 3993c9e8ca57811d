"""Whitening in time proportional to the number of readings: a Kalman filter's innovations.

The noise of a series is white, plus a drift that forgets (Ornstein-Uhlenbeck, variance d, time constant τ), plus an
offset of each run (variance r), plus the unknowns of each run (zero, slope: variance so large that only the readings
determine them). With white variance one, the filter's innovations over their standard deviations are exactly `L⁻¹ y`
with `L Lᵀ = Σ`: the same numbers as by a Cholesky factor, without the matrix.

The state is [drift, offset of the run, unknowns of the run …]; the gains do not depend on the readings, so they are
computed once and then used on every column.

The module also estimates drift, memory and run offset of a series without a mean, in one compiled search.

A diagnosis re-estimates the noise for each of its best candidates, a few hundred times; each estimate is a Nelder-Mead
search over three logarithms, and runs here entirely without Python.
"""

import math

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.jit import njit


@njit
def gains(  # noqa: PLR0912
    time_s: Floats,
    run: Ints,
    unknown: Floats,
    drift: float,
    tau_s: float,
    offset: float,
    run_variance: Floats,
    decay: Floats,
    gain: Floats,
    scale: Floats,
) -> float:
    """Compute the filter of one series.

    Args:
        time_s: (n,), not falling.
        run: (n,), another number where a run begins.
        unknown: values of the unknowns of each run, (n, k).
        drift: variance of the drift over that of the white noise.
        tau_s: its time constant.
        offset: variance of the runs' offsets over that of the white noise.
        run_variance: variances of the unknowns, (k,).
        decay: written: share of the drift that remains since the last reading, (n,).
        gain: written: gain of each state, (n, 2 + k).
        scale: written: one over the standard deviation of the innovation, (n,).

    Returns:
        log det Σ.
    """
    if unknown.shape[1] == 0:
        return _gains_of_two(time_s, run, drift, tau_s, offset, decay, gain, scale)
    n, size = len(time_s), 2 + unknown.shape[1]
    p = np.zeros((size, size))
    h = np.ones(size)
    ph = np.zeros(size)
    total = 0.0
    step, kept = -1.0, 0.0  # equal steps have equal decay
    for i in range(n):
        if i > 0 and time_s[i] - time_s[i - 1] != step:
            step = time_s[i] - time_s[i - 1]
            ratio = step / tau_s
            kept = math.exp(-ratio) if ratio < 25.0 else 0.0
        decay[i] = kept if i > 0 else 0.0
        if i == 0 or run[i] != run[i - 1]:
            # A new run: the state of the last one is forgotten.
            drift_left = p[0, 0]
            for a in range(size):
                for b in range(size):
                    p[a, b] = 0.0
            p[0, 0] = drift_left
            p[1, 1] = offset
            for a in range(2, size):
                p[a, a] = run_variance[a - 2]
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
def _gains_of_two(
    time_s: Floats, run: Ints, drift: float, tau_s: float, offset: float, decay: Floats, gain: Floats, scale: Floats
) -> float:
    """`gains` where no run has unknowns: the same steps, written out."""
    p, q, r, total = 0.0, 0.0, 0.0, 0.0
    step, kept = -1.0, 0.0  # equal steps have equal decay
    for i in range(len(time_s)):
        if i > 0 and time_s[i] - time_s[i - 1] != step:
            step = time_s[i] - time_s[i - 1]
            ratio = step / tau_s
            kept = math.exp(-ratio) if ratio < 25.0 else 0.0
        f = kept if i > 0 else 0.0
        decay[i] = f
        if i == 0 or run[i] != run[i - 1]:
            q, r = 0.0, offset
        q *= f
        p = f * f * p + (1.0 - f * f) * drift
        one, two = p + q, q + r
        s = 1.0 + one + two
        gain[i, 0], gain[i, 1] = one / s, two / s
        p -= one * one / s
        q -= one * two / s
        r -= two * two / s
        scale[i] = 1.0 / math.sqrt(s)
        total += math.log(s)
    return total


@njit
def innovations(  # noqa: PLR0912 - one pass, compiled
    run: Ints, unknown: Floats, decay: Floats, gain: Floats, scale: Floats, columns: Floats
) -> None:
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
    if size == 2:
        slow, own = x[0], x[1]
        for i in range(n):
            f, g, h, s, row = decay[i], gain[i, 0], gain[i, 1], scale[i], columns[i]
            kept = 0.0 if i == 0 or run[i] != run[i - 1] else 1.0
            for j in range(p):
                drift, offset = f * slow[j], kept * own[j]
                new = row[j] - (drift + offset)
                slow[j] = drift + g * new
                own[j] = offset + h * new
                row[j] = s * new
        return
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


@njit
def drift_sums(time_s: Floats, tau_s: float, columns: Floats) -> Floats:
    """Multiply columns, (n, p), by the covariance of a drift of variance one, `exp(-|t - t'| / τ)`."""
    n, p = columns.shape
    out = columns.copy()
    ahead = columns.copy()
    for i in range(1, n):
        f = math.exp(-min((time_s[i] - time_s[i - 1]) / tau_s, 700.0))
        for j in range(p):
            out[i, j] += f * out[i - 1, j]
    for i in range(n - 2, -1, -1):
        f = math.exp(-min((time_s[i + 1] - time_s[i]) / tau_s, 700.0))
        for j in range(p):
            ahead[i, j] += f * ahead[i + 1, j]
    for i in range(n):
        for j in range(p):
            out[i, j] += ahead[i, j] - columns[i, j]
    return out


@njit
def likelihood(  # noqa: PLR0912 - one pass, compiled
    time_s: Floats,
    run: Ints,
    unknown: Floats,
    run_variance: Floats,
    left: Floats,
    drift: float,
    tau_s: float,
    offset: float,
) -> tuple[float, float]:
    """`log det Σ` and `yᵀ Σ⁻¹ y` of a series, white variance one: `gains` and `innovations` in one pass.

    Args:
        time_s, run, unknown, run_variance: as in `gains`.
        left: the series y, (n,).
        drift, tau_s, offset: the noise.
    """
    if unknown.shape[1] == 0:
        return _of_two(time_s, run, left, drift, tau_s, offset)
    n, size = len(time_s), 2 + unknown.shape[1]
    p = np.zeros((size, size))
    h, ph, x = np.ones(size), np.zeros(size), np.zeros(size)
    log_det, square = 0.0, 0.0
    step, kept = -1.0, 0.0  # equal steps have equal decay
    for i in range(n):
        if i > 0 and time_s[i] - time_s[i - 1] != step:
            step = time_s[i] - time_s[i - 1]
            ratio = step / tau_s
            kept = math.exp(-ratio) if ratio < 25.0 else 0.0
        f = kept if i > 0 else 0.0
        if i == 0 or run[i] != run[i - 1]:
            drift_left = p[0, 0]
            for a in range(size):
                for b in range(size):
                    p[a, b] = 0.0
            p[0, 0] = drift_left
            p[1, 1] = offset
            for a in range(2, size):
                p[a, a] = run_variance[a - 2]
            for a in range(1, size):
                x[a] = 0.0
        for a in range(1, size):
            p[0, a] *= f
            p[a, 0] = p[0, a]
        p[0, 0] = f * f * p[0, 0] + (1.0 - f * f) * drift
        x[0] *= f
        for a in range(2, size):
            h[a] = unknown[i, a - 2]
        s, v = 1.0, left[i]
        for a in range(size):
            sum_ = 0.0
            for b in range(size):
                sum_ += p[a, b] * h[b]
            ph[a] = sum_
            s += h[a] * sum_
            v -= h[a] * x[a]
        for a in range(size):
            g = ph[a] / s
            x[a] += g * v
            for b in range(size):
                p[a, b] -= g * ph[b]
        log_det += math.log(s)
        square += v * v / s
    return log_det, square


@njit
def _of_two(time_s: Floats, run: Ints, left: Floats, drift: float, tau_s: float, offset: float) -> tuple[float, float]:
    """`likelihood` where no run has unknowns: the same steps, written out."""
    p, q, r, x, y = 0.0, 0.0, 0.0, 0.0, 0.0
    log_det, square = 0.0, 0.0
    step, kept = -1.0, 0.0  # equal steps have equal decay
    for i in range(len(time_s)):
        if i > 0 and time_s[i] - time_s[i - 1] != step:
            step = time_s[i] - time_s[i - 1]
            ratio = step / tau_s
            kept = math.exp(-ratio) if ratio < 25.0 else 0.0
        f = kept if i > 0 else 0.0
        if i == 0 or run[i] != run[i - 1]:
            q, r, y = 0.0, offset, 0.0
        q *= f
        p = f * f * p + (1.0 - f * f) * drift
        x *= f
        one, two = p + q, q + r
        s = 1.0 + one + two
        v = left[i] - x - y
        g, h = one / s, two / s
        x += g * v
        y += h * v
        p -= g * one
        q -= g * two
        r -= h * two
        log_det += math.log(s)
        square += v * v / s
    return log_det, square


@njit
def noise_cost(
    time_s: Floats,
    run: Ints,
    unknown: Floats,
    run_variance: Floats,
    left: Floats,
    freedom: float,
    x: Floats,
    bounds: Floats,
) -> float:
    """−2 log likelihood and priors at logarithms of drift, memory and offset, white variance profiled.

    Args:
        time_s, run, unknown, run_variance, left: as in `likelihood`.
        freedom: readings less unknowns.
        x: logarithms, (2,) or (3,); clipped to the bounds.
        bounds: lowest, highest, centre and spread of the prior (spread 0: none) of each, (3, 4).
    """
    value = np.empty(3)
    prior = 0.0
    for k in range(3):
        at = x[k] if k < len(x) else -1e9
        value[k] = min(max(at, bounds[k, 0]), bounds[k, 1])
        if k < len(x) and bounds[k, 3] > 0.0:
            prior += ((value[k] - bounds[k, 2]) / bounds[k, 3]) ** 2
    offset = math.exp(value[2]) if len(x) > 2 else 0.0
    log_det, square = likelihood(
        time_s, run, unknown, run_variance, left, math.exp(value[0]), math.exp(value[1]), offset
    )
    return log_det + freedom * math.log(max(square, 1e-12) / freedom) + prior


@njit
def rising(cost: Floats, order: Ints) -> None:
    """Write the order of a few values, lowest first, NaN last; equal values stay in their order.

    numpy's `argsort` gives the same; numba takes longer to compile it than all of the search.
    """
    for i in range(len(cost)):
        j = i
        while j > 0 and (cost[i] < cost[order[j - 1]] or (math.isnan(cost[order[j - 1]]) and not math.isnan(cost[i]))):
            order[j] = order[j - 1]
            j -= 1
        order[j] = i


@njit
def walk(  # noqa: PLR0912 - one walk, compiled
    time_s: Floats, run: Ints, unknown: Floats, run_variance: Floats, left: Floats, freedom: float, start: Floats,
    bounds: Floats, evaluations: int,
) -> Floats:  # fmt: skip
    """Nelder and Mead's search from `start`; gives the best place, (2,) or (3,), within the bounds."""
    d = len(start)
    place, cost = np.empty((d + 1, d)), np.empty(d + 1)
    for k in range(d + 1):
        for j in range(d):
            place[k, j] = start[j] + (0.7 if k == j + 1 else 0.0)
        cost[k] = noise_cost(time_s, run, unknown, run_variance, left, freedom, place[k], bounds)
    used = d + 1
    middle, trial, further = np.empty(d), np.empty(d), np.empty(d)
    order = np.empty(d + 1, np.int64)
    while used < evaluations:
        rising(cost, order)
        best, worst, second = order[0], order[d], order[d - 1]
        if cost[worst] - cost[best] < 0.02:
            break
        for j in range(d):
            total = 0.0
            for k in range(d + 1):
                if k != worst:
                    total += place[k, j]
            middle[j] = total / d
            trial[j] = 2.0 * middle[j] - place[worst, j]
        value = noise_cost(time_s, run, unknown, run_variance, left, freedom, trial, bounds)
        used += 1
        if value < cost[best]:
            for j in range(d):
                further[j] = 3.0 * middle[j] - 2.0 * place[worst, j]
            beyond = noise_cost(time_s, run, unknown, run_variance, left, freedom, further, bounds)
            used += 1
            better = beyond < value
            cost[worst] = beyond if better else value
            for j in range(d):
                place[worst, j] = further[j] if better else trial[j]
            continue
        if value < cost[second]:
            cost[worst] = value
            for j in range(d):
                place[worst, j] = trial[j]
            continue
        for j in range(d):
            inner = trial[j] if value < cost[worst] else place[worst, j]
            further[j] = 0.5 * (middle[j] + inner)
        inside = noise_cost(time_s, run, unknown, run_variance, left, freedom, further, bounds)
        used += 1
        if inside < min(value, cost[worst]):
            cost[worst] = inside
            for j in range(d):
                place[worst, j] = further[j]
            continue
        for k in range(d + 1):
            if k != best:
                for j in range(d):
                    place[k, j] = 0.5 * (place[k, j] + place[best, j])
                cost[k] = noise_cost(time_s, run, unknown, run_variance, left, freedom, place[k], bounds)
                used += 1
    best = np.argmin(cost)
    out: Floats = place[best].copy()
    for j in range(d):
        out[j] = min(max(out[j], bounds[j, 0]), bounds[j, 1])
    return out

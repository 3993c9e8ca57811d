"""The noise of each series: white, drift, and an offset of each run; estimated by restricted maximum likelihood.

Without a drift model every method gives false alarms: neighbouring readings share the drift of the hour, and this
shared part looks like any effect that also changes slowly.
"""

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, wraps
from typing import Any, Concatenate, ParamSpec

import numpy as np

from rtec.arrays import Bools, Floats, Ints, robust_scatter
from rtec.estimation.readings import Readings, Series
from rtec.estimation.whitening import drift_sums, gains, innovations
from rtec.wording import ERROR_UNITS, duration, significant

P = ParamSpec("P")

WIDE = 1e5
"""Variance of a run's unknowns over that of the readings: large, so that only the readings determine them."""
USUAL_DRIFT, SPREAD = math.log(1.0), 2.5
"""Weak prior on the drift's variance over the white noise's: log-normal, centre and spread of the logarithm."""
USUAL_OFFSET = math.log(0.3)
START = ((0.2, 0.01), (0.2, 0.05), (2.0, 0.05), (2.0, 0.25), (20.0, 0.25))
"""Start of the search: drift's variance, and time constant as a share of the record."""
STEPS = 60
MANY, STRETCH = 8000, 400
"""Readings of the longest series that is searched whole; of a longer one, stretches of `STRETCH`, `MANY` in total."""
KEPT = 512
"""So many results of each search for a noise are kept."""
DRIFT_BOUNDS = (1e-4, 1e5)
INEXACT = 0.05
"""No law of a machine is more accurate than this: the least white noise, as a share of what it is to explain.

Otherwise quick changes far below any interest would dominate the likelihood of very quiet readings.
"""


@dataclass(frozen=True)
class Noise:
    """Noise of one series.

    Attributes:
        sigma: standard deviation of the white part, in the unit of the readings.
        drift: variance of the drift over σ².
        tau_s: its time constant.
        offset: variance of the runs' offsets over σ²; zero where each run's zero is unknown anyway.
    """

    sigma: float
    drift: float
    tau_s: float
    offset: float

    @property
    def floor(self) -> float:
        """Root mean square of noise alone, in the unit of the readings."""
        return self.sigma * math.sqrt(1.0 + self.drift + self.offset)

    def words(self, name: str, unit: str) -> str:
        """In words."""
        u = ERROR_UNITS[unit]
        drift, offset = self.sigma * math.sqrt(self.drift), self.sigma * math.sqrt(self.offset)
        text = f"{name}: white noise {significant(self.sigma, 2)} {u}"
        if drift > 0.2 * self.sigma:
            text += f", drift {significant(drift, 2)} {u} with a memory of {duration(self.tau_s)}"
        if offset > 0.2 * self.sigma:
            text += f", offset from run to run {significant(offset, 2)} {u}"
        return text


@dataclass(frozen=True)
class Filter:
    """The whitening filter of one series."""

    series: Series
    sigma: float
    decay: Floats
    gain: Floats
    scale: Floats
    log_det: float

    def whiten(self, columns: Floats) -> Floats:
        """Whitened copy of columns, (n, p)."""
        out = np.array(columns, dtype=np.float64, order="C", copy=True)
        innovations(self.series.run, self.series.nuisance, self.decay, self.gain, self.scale / self.sigma, out)
        return out


def make_filter(series: Series, run_variance: Floats, noise: Noise) -> Filter:
    """The filter of a series under a noise."""
    n, k = series.nuisance.shape
    decay, gain, scale = np.empty(n), np.empty((n, 2 + k)), np.empty(n)
    log_det = gains(
        series.time_s,
        series.run,
        series.nuisance,
        noise.drift,
        noise.tau_s,
        noise.offset,
        run_variance,
        decay,
        gain,
        scale,
    )
    return Filter(series, noise.sigma, decay, gain, scale, log_det)


@dataclass(frozen=True)
class Whitener:
    """Whitens columns of all readings, series by series.

    Attributes:
        readings: the readings.
        noises: of each series.
        run_variances: variances of the unknowns of each run over that of the white noise, for each series.
        least: smallest white noise of each series, in its unit; empty for none.
    """

    readings: Readings
    noises: tuple[Noise, ...]
    run_variances: tuple[Floats, ...]
    least: tuple[float, ...] = ()

    @cached_property
    def filters(self) -> tuple[Filter, ...]:
        """One for each series."""
        return tuple(
            make_filter(s, w, n) for s, w, n in zip(self.readings.series, self.run_variances, self.noises, strict=True)
        )

    @cached_property
    def log_det(self) -> float:
        """Log det Σ of all readings."""
        return sum(f.log_det + 2.0 * len(f.series) * math.log(f.sigma) for f in self.filters)

    def __call__(self, columns: Floats) -> Floats:
        """Whiten columns, (m,) or (m, p)."""
        flat = columns.ndim == 1
        whole = columns[:, None] if flat else columns
        parts = [f.whiten(whole[f.series.part]) for f in self.filters]
        out = parts[0] if len(parts) == 1 else np.concatenate(parts)
        return out[:, 0] if flat else out

    def covary(self, columns: Floats) -> Floats:
        """Columns, (m, p), times the covariance of the readings without the unknowns of each run."""
        out = np.empty_like(columns)
        for s, n in zip(self.readings.series, self.noises, strict=True):
            mine = np.ascontiguousarray(columns[s.part])
            sums = np.zeros((int(s.run[-1]) + 1, mine.shape[1]))
            np.add.at(sums, s.run, mine)
            drift = n.drift * drift_sums(s.time_s, n.tau_s, mine)
            out[s.part] = n.sigma**2 * (mine + drift + n.offset * sums[s.run])
        return out

    def with_noises(self, noises: Sequence[Noise]) -> "Whitener":
        """The same readings under other noises."""
        least = self.least or (0.0,) * len(self.run_variances)
        return Whitener(self.readings, tuple(map(_at_least, noises, least)), self.run_variances, self.least)

    @property
    def floor(self) -> Floats:
        """Root mean square of noise alone, (series,)."""
        return np.fromiter((n.floor for n in self.noises), dtype=np.float64)


def least_noise(readings: Readings, left: Floats) -> tuple[float, ...]:
    """The least white noise of each series, given what is to be explained, (m,)."""
    return tuple(INEXACT * math.sqrt(float(np.mean(left[s.part] ** 2))) for s in readings.series)


def _at_least(noise: Noise, sigma: float) -> Noise:
    """A noise whose white part is at least `sigma`; drift and offset keep their size."""
    if noise.sigma >= sigma:
        return noise
    less = (noise.sigma / sigma) ** 2
    return replace(noise, sigma=sigma, drift=max(noise.drift * less, DRIFT_BOUNDS[0]), offset=noise.offset * less)


def _remembered(search: Callable[Concatenate[Series, P], Noise]) -> Callable[Concatenate[Series, P], Noise]:
    """A search that keeps its last results: the steps of a diagnosis ask for the same noise again and again."""
    known: dict[bytes, Noise] = {}

    @wraps(search)
    def found(series: Series, /, *of: P.args, **by_name: P.kwargs) -> Noise:
        whole = (series.time_s, series.run, series.nuisance, *of, *by_name.values())
        digest = hashlib.blake2b(repr([getattr(v, "shape", v) for v in whole]).encode(), digest_size=16)
        for numbers in whole:
            if isinstance(numbers, np.ndarray):
                digest.update(np.ascontiguousarray(numbers).data)
        key = digest.digest()
        noise = known.get(key)
        if noise is None:
            noise = search(series, *of, **by_name)
            for oldest in list(known)[: len(known) - KEPT + 1]:
                known.pop(oldest, None)
            known[key] = noise
        return noise

    return found


def find_noise(readings: Readings, base: Floats, steps: int = STEPS, least: tuple[float, ...] = ()) -> Whitener:
    """Estimate the noise of every series, with the current model's columns as its mean.

    Args:
        readings: the readings.
        base: columns of the model's numbers and of unknown set-up terms, (m, p).
        steps: evaluations of the search, for each series.
        least: smallest white noise of each series; empty for none.
    """
    noises, run_variances = [], []
    for s in readings.series:
        y = readings.values[s.part]
        run_variance = _run_variance(s, y)
        run_variances.append(run_variance)
        noises.append(_reml(s, run_variance, base[s.part], y, steps))
    return Whitener(readings, (), tuple(run_variances), least).with_noises(noises)


CALM = 0.1
"""Variance of nearly no drift, and of nearly no offsets of runs, over the white noise's."""


def without_drift(whitener: Whitener) -> Whitener:
    """Nearly no drift: white noise from the differences of neighbouring readings."""
    noises = []
    for s, now in zip(whitener.readings.series, whitener.noises, strict=True):
        span = max(float(s.time_s[-1] - s.time_s[0]), 1.0)
        sigma = min(_roughness(s, whitener.readings.values[s.part]), now.sigma)
        noises.append(Noise(sigma, CALM, 0.1 * span, CALM if now.offset > 0.0 else 0.0))
    return whitener.with_noises(noises)


def refine(whitener: Whitener, left: Floats, steps: int) -> Whitener:
    """Re-estimate the noises from the residual of a fit, (m,), starting at the current ones."""
    noises = []
    for s, run_variance, now in zip(whitener.readings.series, whitener.run_variances, whitener.noises, strict=True):
        noises.append(_of_residual(s, run_variance, left[s.part], now, steps))
    return whitener.with_noises(noises)


def log_likelihood(whitener: Whitener, white: Floats) -> float:
    """Log likelihood of the whitened residual of a fit, (m,), up to a constant, with the weak priors."""
    priors = sum(_prior(n) for n in whitener.noises)
    return -0.5 * (whitener.log_det + float(white @ white)) + priors


def _run_variance(series: Series, y: Floats) -> Floats:
    """Variances of the unknowns of each run, over that of the white noise, (k,)."""
    size = np.sqrt(np.mean(series.nuisance**2, axis=0)) if series.nuisance.shape[1] else np.zeros(0)
    spread = max(float(np.std(y)) / _roughness(series, y), 10.0)
    return np.asarray(WIDE * spread**2 / np.maximum(size, 1e-12) ** 2, dtype=np.float64)


def _roughness(series: Series, y: Floats) -> float:
    """White noise from the differences of neighbouring readings of a run."""
    step = np.diff(y)[np.diff(series.run) == 0]
    return max(robust_scatter(step) / math.sqrt(2.0), 0.01 * float(np.std(y)), 1e-9)


def _orthonormal(columns: Floats) -> Floats:
    """An orthonormal basis of columns, (n, rank)."""
    size = np.linalg.norm(columns, axis=0)
    kept = columns[:, size > 0] / size[size > 0]
    if not kept.shape[1]:
        return np.asarray(kept)
    u, s, _ = np.linalg.svd(kept, full_matrices=False)
    return np.asarray(u[:, s > 1e-9 * s[0]], dtype=np.float64)


def _has_zero(series: Series) -> bool:
    """Whether the zero of each run is unknown."""
    return bool((np.ptp(series.nuisance, axis=0) == 0.0).any()) if series.nuisance.shape[1] else False


class _Mean:
    """−2 log restricted likelihood of a series whose mean is in the base, white variance profiled."""

    def __init__(self, series: Series, run_variance: Floats, base: Floats, y: Floats) -> None:
        self.series, self.run_variance = series, run_variance
        self.columns = np.concatenate([base, y[:, None]], axis=1)
        self.freedom = max(len(y) - base.shape[1] - series.nuisance.shape[1] * int(series.run[-1] + 1), 3)

    def __call__(self, noise: Noise) -> tuple[float, float]:
        """The value, and the white variance."""
        f = make_filter(self.series, self.run_variance, noise)
        white = f.whiten(self.columns)
        gram = white.T @ white
        p = len(gram) - 1
        log_det, left = 0.0, float(gram[-1, -1])
        if p:
            factor = np.linalg.cholesky(gram[:p, :p] + 1e-10 * np.trace(gram[:p, :p]) / p * np.eye(p))
            log_det = 2.0 * float(np.log(np.diag(factor)).sum())
            along = np.linalg.solve(factor, gram[:p, -1])
            left -= float(along @ along)
        variance = max(left, 1e-12) / self.freedom
        return f.log_det + log_det + self.freedom * math.log(variance), variance


def noise_bounds(series: Series) -> Floats:
    """Lowest, highest, centre and spread of the prior of the logarithms of drift, memory and offset, (3, 4)."""
    span, shortest = series.pace_s
    return np.array(
        [
            [math.log(DRIFT_BOUNDS[0]), math.log(DRIFT_BOUNDS[1]), USUAL_DRIFT, SPREAD],
            # A record shows no memory that is longer than itself.
            [math.log(min(3.0 * shortest, 0.02 * span)), math.log(span), 0.0, 0.0],
            [-9.0, 9.0, USUAL_OFFSET, SPREAD],
        ]
    )


def noise_on_stretches(readings: Readings, columns: Callable[[Readings, Bools], Floats]) -> Whitener:
    """Noise of readings, where long series are searched on stretches.

    Args:
        readings: all readings.
        columns: gives the columns of the mean for some readings, and which of all these are, (m,).
    """
    keep = np.ones(len(readings), dtype=bool)
    for s in readings.series:
        if len(s) > MANY:
            keep[s.part] = False
            keep[s.start + _stretches(len(s))] = True
    few = readings if keep.all() else readings.without(~keep)
    noises = find_noise(few, columns(few, keep)).noises
    run_variances = tuple(_run_variance(s, readings.values[s.part]) for s in readings.series)
    return Whitener(readings, noises, run_variances)


def _stretches(n: int) -> Ints:
    """Stretches of neighbouring readings, evenly over a long series, so that short and long memory show; else all."""
    if n <= MANY:
        return np.arange(n)
    first = np.linspace(0, n - STRETCH, MANY // STRETCH).astype(np.int64)
    return np.unique((first[:, None] + np.arange(STRETCH)).ravel())


@_remembered
def _of_residual(series: Series, run_variance: Floats, left: Floats, now: Noise, steps: int) -> Noise:
    """Noise of a series of residuals without a mean, searched from an approximate noise."""
    from rtec.estimation.whitening import likelihood, walk

    start = [math.log(now.drift), math.log(now.tau_s)] + ([math.log(now.offset)] if now.offset > 0.0 else [])
    freedom = float(max(len(left) - series.nuisance.shape[1] * int(series.run[-1] + 1), 3))
    data = (series.time_s, series.run, series.nuisance, run_variance, np.ascontiguousarray(left))
    few = _stretches(len(left))
    part, share = data, len(few) / len(left)
    if share < 1.0:
        part = (
            series.time_s[few],
            series.run[few],
            np.ascontiguousarray(series.nuisance[few]),
            run_variance,
            data[4][few],
        )
    found = np.exp(walk(*part, freedom * share, np.array(start), noise_bounds(series), steps))
    offset = float(found[2]) if len(found) > 2 else 0.0
    _, square = likelihood(*data, float(found[0]), float(found[1]), offset)
    return Noise(math.sqrt(max(square, 1e-12) / freedom), float(found[0]), float(found[1]), offset)


def _prior(noise: Noise) -> float:
    """Log of the weak priors; they keep bounded a parameter that the readings do not determine."""
    value = -0.5 * ((math.log(noise.drift) - USUAL_DRIFT) / SPREAD) ** 2
    if noise.offset > 0.0:
        value -= 0.5 * ((math.log(noise.offset) - USUAL_OFFSET) / SPREAD) ** 2
    return value


@_remembered
def _reml(series: Series, run_variance: Floats, base: Floats, y: Floats, steps: int) -> Noise:
    cost = _Mean(series, run_variance, _orthonormal(base), y)
    span = max(float(series.time_s[-1] - series.time_s[0]), 1.0)
    offset = 0.0 if _has_zero(series) or series.run[-1] == 0 else 0.1
    starts = [Noise(1.0, d, max(share * span, 1.0), offset) for d, share in START]
    best = min(starts, key=lambda n: cost(n)[0] - 2.0 * _prior(n))
    return _search(cost, best, steps)


def _search(cost: Any, start: Noise, steps: int) -> Noise:
    """Nelder-Mead in the logarithms of drift, time constant and offset."""
    from scipy.optimize import minimize

    (low_d, high_d, *_), (low, high, *_), _ = noise_bounds(cost.series).tolist()

    def noise(x: Floats) -> Noise:
        drift, tau = min(max(float(x[0]), low_d), high_d), min(max(float(x[1]), low), high)
        offset = math.exp(min(max(float(x[2]), -9.0), 9.0)) if len(x) > 2 else 0.0
        return Noise(1.0, math.exp(drift), math.exp(tau), offset)

    def value(x: Floats) -> float:
        n = noise(x)
        return float(cost(n)[0]) - 2.0 * _prior(n)

    x0 = [math.log(start.drift), math.log(start.tau_s)]
    if start.offset > 0.0:
        x0.append(math.log(start.offset))
    simplex = np.array([x0, *(np.array(x0) + 0.7 * np.eye(len(x0)))])
    found = minimize(
        value, x0, method="Nelder-Mead",
        options={"maxfev": steps, "initial_simplex": simplex, "xatol": 0.02, "fatol": 0.02},
    )  # fmt: skip
    best = noise(found.x)
    return Noise(math.sqrt(cost(best)[1]), best.drift, best.tau_s, best.offset)

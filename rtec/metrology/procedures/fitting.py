"""Least squares for the procedures: few parameters, readings in order of time, realistic standard errors.

Consecutive readings have correlated errors. A standard error for independent readings is then too small, so that every
one here is multiplied by the root of the residual's correlation time: n readings count as n / correlation time.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rtec.arrays import Floats
from rtec.errors import MeasurementError

DEPENDENT = 1e-9
"""Columns are confounded if a combination of them is smaller than this share of the largest."""


@dataclass(frozen=True)
class BestLine:
    """A best-fit line and the residual.

    Attributes:
        slope: per unit of position.
        slope_se: its standard error, NaN from fewer than three readings.
        offset: value at position zero.
        residual: reading minus line, (n,).
    """

    slope: float
    slope_se: float
    offset: float
    residual: Floats


@dataclass(frozen=True)
class SeparableFit:
    """A fit that is linear except in θ.

    Attributes:
        values: linear coefficients, (k,).
        theta: non-linear parameters, (q,).
        errors: standard errors, coefficients first, (k + q,), with `correlation`.
        residual: (n,).
        rms: root mean square of the residual.
        correlation: number of consecutive readings that count as one.
    """

    values: Floats
    theta: Floats
    errors: Floats
    residual: Floats
    rms: float
    correlation: float


def best_line(position: Floats, reading: Floats) -> BestLine:
    """Least-squares line, (n,) and (n,).

    Raises:
        MeasurementError: there are fewer than two different positions.
    """
    spread = position - position.mean()
    size = float(spread @ spread)
    if size == 0.0 or len(position) < 2:
        raise MeasurementError("a best-fit line needs readings at two places at least")
    slope = float(spread @ reading) / size
    residual = reading - reading.mean() - slope * spread
    left = len(position) - 2
    error = float(np.sqrt(residual @ residual / left / size)) if left > 0 else float("nan")
    return BestLine(slope, error, float(reading.mean() - slope * position.mean()), residual)


WHITE_SE = 2.0
"""A correlation counts as zero up to this many standard errors of ρ of white readings."""


def correlation_time(residual: Floats) -> float:
    """Number of consecutive readings that count as one: 1 + 2 Σ ρ_k, up to the first ρ_k that is not positive.

    One where white readings may give as much; needed because the sum has only positive terms.
    """
    centred = residual - residual.mean()
    n = len(centred)
    power = np.abs(np.fft.rfft(centred, 2 * n)) ** 2
    covariance = np.fft.irfft(power)[:n]
    if covariance[0] <= 0.0:
        return 1.0
    rho = covariance / covariance[0]
    ends = np.flatnonzero(rho <= 0.0)
    twice = 2.0 * float(rho[1 : ends[0] if len(ends) else n].sum())
    return 1.0 + twice if twice > WHITE_SE * 2.0 / math.sqrt(n) else 1.0


def separable_fit(
    build: Callable[[Floats], tuple[Floats, Floats]],
    reading: Floats,
    starts: Sequence[Floats],
    low: Floats,
    high: Floats,
    *,
    errors: bool = True,
) -> SeparableFit:
    """Fit `reading = offset(θ) + design(θ) · values` by variable projection.

    Args:
        build: θ -> design, (n, k), and offset, (n,).
        reading: (n,), without gaps.
        starts: starts of the search; the best result counts.
        low, high: bounds of θ, (q,).
        errors: compute standard errors; if false, they are NaN and terms may be confounded.

    Raises:
        MeasurementError: there are fewer readings than parameters, or columns are confounded.
    """
    from scipy.optimize import least_squares

    def left(theta: Floats) -> Floats:
        return _fit_at(build, reading, theta)[1]

    found = [least_squares(left, start, bounds=(low, high), x_scale=high - low, max_nfev=80) for start in starts]
    theta = min(found, key=lambda f: float(f.cost)).x if found else np.zeros(0)
    values, residual = _fit_at(build, reading, theta)
    free = len(reading) - len(values) - len(theta)
    if free <= 0:
        raise MeasurementError(f"{len(reading)} readings for {len(values) + len(theta)} numbers; take more")
    rows = correlation_time(residual)
    unit = np.full(len(values) + len(theta), np.nan)
    if errors:
        unit = unit_errors(np.concatenate([build(theta)[0], _slopes(build, values, theta, high - low)], axis=1))
    sigma = float(np.sqrt(residual @ residual / free))
    rms = float(np.sqrt(np.mean(residual**2)))
    return SeparableFit(values, theta, sigma * np.sqrt(rows) * unit, residual, rms, rows)


def _fit_at(build: Callable[[Floats], tuple[Floats, Floats]], reading: Floats, theta: Floats) -> tuple[Floats, Floats]:
    design, offset = build(theta)
    size = np.linalg.norm(design, axis=0)
    values = np.linalg.lstsq(design / np.where(size > 0, size, 1.0), reading - offset, rcond=None)[0]
    values = values / np.where(size > 0, size, 1.0)
    return values, reading - offset - design @ values


def _slopes(build: Callable[[Floats], tuple[Floats, Floats]], values: Floats, theta: Floats, span: Floats) -> Floats:
    columns = []
    for i in range(len(theta)):
        ends = []
        for sign in (1.0, -1.0):
            moved = theta.copy()
            moved[i] += sign * 1e-5 * span[i]
            design, offset = build(moved)
            ends.append(offset + design @ values)
        columns.append((ends[0] - ends[1]) / (2e-5 * span[i]))
    return np.array(columns).reshape(len(theta), -1).T if columns else np.zeros((len(build(theta)[1]), 0))


def unit_errors(design: Floats) -> Floats:
    """Standard errors of the coefficients of a design, (n, k), for independent unit noise, (k,).

    Raises:
        MeasurementError: columns are confounded.
    """
    size = np.linalg.norm(design, axis=0)
    if (size == 0).any():
        raise MeasurementError(f"nothing in these readings shows number {int(np.argmin(size)) + 1} of the fit")
    _, singular, directions = np.linalg.svd(design / size, full_matrices=False)
    if singular[-1] < DEPENDENT * singular[0]:
        raise MeasurementError("these readings do not separate all terms of the fit; measure where the terms differ")
    return np.asarray(np.linalg.norm(directions.T / singular, axis=1) / size, dtype=np.float64)

"""Least squares of several ball-bar tests to the exact length of the bar, and how sure it is."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.metrology.ball_bar.ball_bar_noise import Noise
from rtec.metrology.ball_bar.circle import Circle
from rtec.metrology.ball_bar.design import Design
from rtec.metrology.procedures.fitting import correlation_time, unit_errors

Floats = NDArray[np.float64]
ROUNDS = 3
"""Linear fits in a row, each with the second order that the one before has found; a third changes nothing any more."""


@dataclass(frozen=True)
class Solution:
    """Coefficients of some columns of a design.

    Attributes:
        found: (k,).
        errors: standard errors, (k,), widened by `correlation`.
        sigma_um: standard deviation of the white part of what is left, away from the quadrants.
        correlation: so many readings in a row count as one.
    """

    found: Floats
    errors: Floats
    sigma_um: float
    correlation: float


def solve(design: Design, kept: Sequence[int], reading_um: Floats, circles: Sequence[Circle], noise: Noise) -> Solution:
    """Fit columns of a design to readings.

    Args:
        design: of n readings.
        kept: places of the columns that are fitted; they must be independent.
        reading_um: (n,).
        circles: tests that they are of, in their order.
        noise: its shape.
    """
    columns = noise.whiten(circles, design.columns[:, kept])
    size = np.linalg.norm(columns, axis=0)
    found = np.zeros(len(kept))
    for _ in range(ROUNDS):
        first_order = noise.whiten(circles, (reading_um - design.second_order_um(kept, found))[:, None])[:, 0]
        found = np.linalg.lstsq(columns / size, first_order, rcond=None)[0] / size
    left = first_order - columns @ found
    sigma = float(np.sqrt(left @ left / max(len(left) - len(kept), 1)))
    rows = in_a_row(left, [len(c) for c in circles])
    return Solution(found, sigma * np.sqrt(rows) * unit_errors(columns), sigma, rows)


def in_a_row(left: Floats, lengths: Sequence[int]) -> float:
    """How many readings in a row err together, in the test where that is worst."""
    return max(correlation_time(part) for part in np.split(left, np.cumsum(lengths)[:-1]))

"""The search for causes beyond [BB]'s as it stands: columns made white, and least squares of some of them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtec.metrology.ball_bar.ball_bar_columns import Table
from rtec.metrology.ball_bar.ball_bar_noise import Noise, find_noise

Floats = NDArray[np.float64]
NOISE_UM = 0.02
"""Finer than any ball bar reads: what is smaller than this is not noise to be judged by."""
MORE = 1.2
"""Near the quadrants the noise is one of its own where it is so many times that of the rest."""
SWEEPS = 2


@dataclass(frozen=True)
class Least:
    """Least squares of white columns.

    Attributes:
        found: coefficients, (k,).
        inverse: of the normal matrix, (k, k).
        left: white, (n,).
        sigma: standard deviation of that, µm.
    """

    found: Floats
    inverse: Floats
    left: Floats
    sigma: float


@dataclass(frozen=True)
class Work:
    """The search as it stands.

    Attributes:
        table: columns.
        reading: to first order, (n,).
        noise: of the readings.
        base: [BB]'s columns made white, (n, k).
        own: those of each candidate, for each way to the top of a spike.
        white: readings made white, (n,).
        way: of each candidate, the place among its ways.
    """

    table: Table
    reading: Floats
    noise: Noise
    base: Floats
    own: tuple[tuple[Floats, ...], ...]
    white: Floats
    way: tuple[int, ...]

    @property
    def everything(self) -> tuple[int, ...]:
        """Places of all candidates."""
        return tuple(range(len(self.own)))

    def columns(self, places: Sequence[int]) -> Floats:
        """White columns of [BB]'s parameters and of some candidates."""
        return np.concatenate([self.base, *(self.own[i][self.way[i]] for i in places)], axis=1)

    def plain(self, places: Sequence[int]) -> Floats:
        """The same not made white."""
        return np.concatenate([self.table.base, *(self.table.columns[i][self.way[i]] for i in places)], axis=1)

    def beside(self, places: Sequence[int]) -> tuple[Floats, Floats]:
        """Orthonormal columns of what some candidates make with [BB]'s parameters, and what they leave."""
        basis = np.linalg.qr(self.columns(places))[0]
        return basis, self.white - basis @ (basis.T @ self.white)


def work_of(table: Table, reading: Floats, noise: Noise, way: tuple[int, ...]) -> Work:
    """Make everything white by a noise."""
    flat = [table.base, *(c for ways in table.columns for c in ways), reading[:, None]]
    white = np.split(noise.whiten(table.circles, np.concatenate(flat, axis=1)),
                     np.cumsum([c.shape[1] for c in flat])[:-1], axis=1)  # fmt: skip
    rest = iter(white[1:-1])
    own = tuple(tuple(next(rest) for _ in ways) for ways in table.columns)
    return Work(table, reading, noise, white[0], own, white[-1][:, 0], way)


def least(work: Work, places: Sequence[int]) -> Least:
    """Fit [BB]'s parameters and some candidates."""
    columns = work.columns(places)
    size = np.linalg.norm(columns, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    basis, triangle = np.linalg.qr(columns / size)
    inverse = np.linalg.pinv(triangle) / size[:, None]
    found = inverse @ (basis.T @ work.white)
    left = work.white - columns @ found
    sigma = float(np.sqrt(left @ left / max(len(left) - len(found), 1)))
    return Least(found, inverse @ inverse.T, left, max(sigma, NOISE_UM))


def best_ways(work: Work) -> Work:
    """The way to the top of each spike that leaves least, one spike after another, twice round."""
    spikes = [i for i, c in enumerate(work.own) if len(c) > 1]
    for _ in range(SWEEPS):
        for i in spikes:
            basis, left = work.beside([k for k in work.everything if k != i])
            gains = [gain(basis, left, c) for c in work.own[i]]
            work = replace(work, way=(*work.way[:i], int(np.argmax(gains)), *work.way[i + 1 :]))
    return work


def gain(basis: Floats, left: Floats, own: Floats) -> float:
    """By how much columns lessen the sum of squares that a basis leaves."""
    own = own - basis @ (basis.T @ own)
    return float(left @ own @ np.linalg.lstsq(own, left, rcond=None)[0])


def judged(work: Work, window_deg: float) -> tuple[Noise, Noise]:
    """The noise with every candidate in the mean, the likeliest and the worst that is likely.

    Its shape along the circle, and how much more is left near the quadrants.
    """
    near = np.concatenate([c.near_quadrant(window_deg) for c in work.table.circles])
    columns = work.plain(work.everything)
    left = work.reading - columns @ least(work, work.everything).found
    weight = 1.0
    if near.any() and not near.all():
        spread = [max(float(np.sqrt(np.mean(left[k] ** 2))), NOISE_UM) for k in (near, ~near)]
        weight = 1.0 if spread[0] < MORE * spread[1] else spread[1] / spread[0]
    if float(np.sqrt(np.mean(left**2))) <= NOISE_UM:
        none = Noise(near=weight, window_deg=window_deg)
        return none, none
    return find_noise(work.table.circles, columns, work.reading, weight, window_deg)

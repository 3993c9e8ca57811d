"""Smooths temperatures in time: noise of a sensor decides between thermal rivals that else look alike."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
HALVES_S = (960.0, 480.0, 240.0, 120.0)
"""Halves of the windows that are tried, the widest first."""
ABOUT = 5
"""So many readings about an instant decide whether a line goes through them."""
OFF, ROUGH = 1.25, 2.0
"""A line goes through them where their mean is off by less than so many of its standard deviations, and their mean
square is below so many times the noise's."""
QUANTUM = 0.29
"""Standard deviation of steps of one, 1/√12."""


@dataclass(frozen=True)
class _Window:
    """Readings about each instant, and their sums: the same for every sensor that has read each time."""

    t: Floats
    first: Ints
    last: Ints
    n: Floats
    st: Floats
    stt: Floats

    @classmethod
    def of(cls, t: Floats, first: Ints, last: Ints, weight: Floats) -> "_Window":
        n, st, stt = (_between(x, first, last) for x in (weight, weight * t, weight * t * t))
        return cls(t, first, last, n, st, stt)


@dataclass(frozen=True)
class Windows:
    """Instants, and the windows about them.

    Attributes:
        time_s: not falling, (n,).
    """

    time_s: Floats

    @cached_property
    def whole(self) -> tuple[_Window, ...]:
        """Of sensors that have read each time, the widest first."""
        out = []
        for half_s in HALVES_S:
            t = (self.time_s - self.time_s[0]) / half_s
            first, last = np.searchsorted(t, t - 1.0, "left"), np.searchsorted(t, t + 1.0, "right")
            out.append(_Window.of(t, first, last, np.ones(len(t))))
        return tuple(out)


def smoothed(windows: Windows, value: Floats) -> Floats:
    """Straight line through the readings of a window about each instant; NaN readings are passed over.

    The window is the widest whose lines leave nothing but noise about the instant: wide while a temperature creeps,
    none while it jumps.

    Args:
        windows: about the n instants.
        value: (n,).

    Returns:
        (n,); a NaN reading is filled where it has neighbours.
    """
    good = np.isfinite(value)
    if good.sum() < ABOUT:
        return value
    sigma = noise_of(value[good])
    out, done = value.copy(), np.zeros(len(value), dtype=bool)
    for window in windows.whole:
        line, own = _lines(window, value, good)
        left = np.where(good & np.isfinite(line), value - line, 0.0)
        count = _about(good.astype(np.float64))
        # A wide window's line hardly knows the reading itself; a narrow one's does, and leaves less than the noise.
        share = np.sqrt(np.clip(1.0 - own, 0.05, 1.0))
        mean = np.abs(_about(left)) / np.sqrt(np.maximum(count, 1.0)) / (sigma * share)
        square = _about(left**2) / np.maximum(count, 1.0) / (sigma * share) ** 2
        fits = ~done & np.isfinite(line) & (mean < OFF) & (square < ROUGH)
        out = np.where(fits, line, out)
        done |= fits
    return out


def _about(x: Floats) -> Floats:
    """Sum over the readings about each instant."""
    return np.convolve(x, np.ones(ABOUT), mode="same")


def noise_of(value: Floats) -> float:
    """Noise of a series from how each reading differs from the middle of its neighbours, never below its steps'."""
    bend = value[1:-1] - 0.5 * (value[:-2] + value[2:])
    steps: Floats = np.unique(np.round(np.abs(np.diff(value)), 9))
    quantum = float(steps[1]) if len(steps) > 1 and steps[0] == 0.0 else 0.0
    return float(max(1.4826 * np.median(np.abs(bend)) / np.sqrt(1.5), QUANTUM * quantum, 1e-12))


def _lines(window: _Window, value: Floats, good: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """The line at each instant, and its variance over that of a reading."""
    t, first, last = window.t, window.first, window.last
    mean = float(value[good].mean())
    v = np.where(good, value - mean, 0.0)
    if not good.all():
        window = _Window.of(t, first, last, good.astype(np.float64))
    n, st, stt = window.n, window.st, window.stt
    sv, stv = _between(v, first, last), _between(v * t, first, last)
    with np.errstate(invalid="ignore", divide="ignore"):
        centre = st / n
        spread = stt - n * centre * centre
        level = spread > 1e-6 * np.maximum(n, 1.0)
        slope = np.where(level, (stv - centre * sv) / spread, 0.0)
        line = sv / n + slope * (t - centre) + mean
        own = 1.0 / n + np.where(level, (t - centre) ** 2 / spread, 0.0)
    return line, own


def _between(x: Floats, first: Ints, last: Ints) -> Floats:
    total = np.concatenate([[0.0], np.cumsum(x)])
    return np.asarray(total[last] - total[first])

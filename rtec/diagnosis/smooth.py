"""Smooths temperatures in time: noise of a sensor decides between thermal rivals that else look alike."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
HALF_S = 480.0
"""Half of the window: bodies of machines need longer to change their slope."""


def smoothed(time_s: Floats, value: Floats, half_s: float = HALF_S) -> Floats:
    """Straight line through the readings within ± `half_s`, at its middle; NaN readings are passed over.

    Args:
        time_s: not falling, (n,).
        value: (n,).
        half_s: half of the window, s.

    Returns:
        (n,); where no neighbour has a reading, what was there.
    """
    good = np.isfinite(value)
    if good.sum() < 3:
        return value
    t = (time_s - time_s[0]) / half_s
    first = np.searchsorted(t, t - 1.0, "left")
    last = np.searchsorted(t, t + 1.0, "right")
    mean = float(value[good].mean())
    v = np.where(good, value - mean, 0.0)
    w = good.astype(np.float64)
    n, st, sv, stt, stv = (_between(x, first, last) for x in (w, w * t, v, w * t * t, v * t))
    with np.errstate(invalid="ignore", divide="ignore"):
        centre = st / n
        spread = stt - n * centre * centre
        slope = np.where(spread > 1e-6 * np.maximum(n, 1.0), (stv - centre * sv) / spread, 0.0)
        line = sv / n + slope * (t - centre) + mean
    return np.where((n > 0) & np.isfinite(line), line, value)


def _between(x: Floats, first: NDArray[np.int64], last: NDArray[np.int64]) -> Floats:
    total = np.concatenate([[0.0], np.cumsum(x)])
    return np.asarray(total[last] - total[first])

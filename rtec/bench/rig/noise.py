"""Noise of the rig's instruments: forms that resemble effects, and forms that violate a method's assumptions."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Rng = np.random.Generator

FORMS = ("white", "memory", "wander", "warm_up", "zeros", "bursts", "quantised")
"""White; first-order autoregressive; random walk; warming up and cooling down of the instrument; a zero for each run;
outliers in separate bursts of up to five; a coarse display."""
APART = 20
"""Number of readings for each burst of outliers at most."""


@dataclass(frozen=True)
class DrawnNoise:
    """Noise of one column.

    Attributes:
        values: µm or µrad, (n,).
        wrong: whether each reading is an outlier, (n,).
        step: resolution of the display.
    """

    values: Floats
    wrong: Bools
    step: float = 0.1


def draw(rng: Rng, form: str, time_s: Floats, run: Ints) -> DrawnNoise:
    """Noise of one column; white part 0.3 to 0.8."""
    n, sigma = len(time_s), rng.uniform(0.3, 0.8)
    wrong, step = np.zeros(n, dtype=np.bool_), 0.1
    out = sigma * rng.standard_normal(n)
    first = np.flatnonzero(np.diff(run, prepend=run[0] - 1))
    if form == "memory":
        out += rng.uniform(0.3, 0.9) * _memory(rng, time_s, 60.0 * rng.uniform(8.0, 70.0))
    elif form == "wander":
        walk = np.cumsum(rng.standard_normal(n) * np.sqrt(np.diff(time_s, prepend=time_s[0])))
        out += rng.uniform(0.3, 0.9) * (walk - walk.mean()) / max(float(walk.std()), 1e-12)
    elif form == "warm_up":
        out += rng.choice([-1.0, 1.0]) * rng.uniform(0.8, 2.5) * _heat(rng, time_s)
    elif form == "zeros":
        out += np.repeat(rng.uniform(0.2, 0.5) * rng.standard_normal(len(first)), np.diff([*first, n]))
    elif form == "bursts":
        for block in rng.permutation(n // APART)[: max(n // 120, 2)]:
            at = APART * int(block) + int(rng.integers(0, APART // 2))
            burst = slice(at, at + int(rng.integers(1, 6)))
            out[burst] += rng.choice([-1.0, 1.0]) * rng.uniform(8.0, 60.0)
            wrong[burst] = True
    elif form == "quantised":
        step = rng.uniform(0.4, 1.0)
    return DrawnNoise(out, wrong, step)


def _memory(rng: Rng, time_s: Floats, tau_s: float) -> Floats:
    keep = np.exp(-np.diff(time_s) / tau_s)
    out = np.empty(len(time_s))
    out[0] = rng.standard_normal()
    for i, k in enumerate(keep.tolist(), 1):
        out[i] = k * out[i - 1] + np.sqrt(1.0 - k * k) * rng.standard_normal()
    return out


def _heat(rng: Rng, time_s: Floats) -> Floats:
    """Drift of an instrument that warms up, and cools down after its lamp is switched off."""
    whole = float(time_s[-1] - time_s[0])
    tau, off = whole * rng.uniform(0.06, 0.25), whole * rng.uniform(0.5, 0.75)
    t = time_s - time_s[0]
    rise = 1.0 - np.exp(-np.minimum(t, off) / tau)
    return np.asarray(np.where(t < off, rise, rise * np.exp(-(t - off) / (tau * rng.uniform(0.8, 2.0)))))

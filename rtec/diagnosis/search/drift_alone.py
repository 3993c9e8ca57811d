"""Whether slow drift alone makes a smooth dependence on temperatures and the time, as random draws of it show.

Over a warm-up a temperature is a function of the time, and so is every drift: some curve over the temperature follows
any drift, and held-out runs lie between others. Draws of the noise that was fitted without the curve tell how good a
curve chance makes.
"""

import itertools
import math
from dataclasses import replace

import numpy as np

from rtec.arrays import Floats
from rtec.diagnosis.search.refit import Refits
from rtec.diagnosis.search.screen import Projected
from rtec.diagnosis.search.shapes import FINE, LEAN, LINE, PLANE, Ground, Shape, weigh_all
from rtec.diagnosis.search.unnamed import Shaped
from rtec.estimation.gls import bic_cost, fit_columns
from rtec.estimation.noise import Whitener, without_drift
from rtec.estimation.readings import Readings

DRAWS = 19
"""A curve that is better than that of each draw has a chance of one in twenty."""
TRIED = 2
"""Curves that are fitted together with the noise, of each of two screens."""


def is_slow(shape: Shape, readings: Readings) -> bool:
    """Whether a shape is a curve or a surface over temperatures and the time alone."""
    slow = {"time_s", *readings.machine.sensor_names}
    return shape.period is None and shape.place is None and set(shape.variables) <= slow


def drift_makes(top: Shaped, refits: Refits, rng: np.random.Generator) -> bool:
    """Whether a draw of the noise alone gives as good a curve over temperatures and the time.

    Args:
        top: the curve, or the surface.
        refits: of the readings.
        rng: for the draws.
    """
    if not is_slow(top.shape, refits.readings):
        return False
    keep, readings = refits.subset
    base, noise = refits.prepared.base[keep], refits.current.whitener
    ground = Ground(readings)
    shapes = _curves(top.shape.group, ground)

    def best(values: Floats) -> float:
        given = replace(readings, values=values)
        return _best(Whitener(given, noise.noises, noise.run_variances, noise.least), base, ground, shapes)

    bar = best(readings.values)
    return any(best(drawn) >= bar for drawn in _draws(noise, readings, rng).T)


def _curves(group: str, ground: Ground) -> list[Shape]:
    """Curves and surfaces over temperatures and the time."""
    names = [n for n in ("time_s", *ground.readings.machine.sensor_names) if n in ground.known]
    lines = [Shape(group, (n,), (count,)) for n in names for count in (LINE, FINE)]
    return [*lines, *(Shape(group, p, (f, f)) for p in itertools.combinations(names, 2) for f in (LEAN, PLANE))]


def _best(noise: Whitener, base: Floats, ground: Ground, shapes: list[Shape]) -> float:
    """Log evidence of the best shape, the noise re-estimated with it, over the base alone."""
    values, starts = noise.readings.values, (noise, without_drift(noise))

    def likely(columns: Floats) -> float:
        return max(fit_columns(w, columns).log_likelihood for w in starts)

    picked = {
        w.shape: w.count for s in starts for w in weigh_all(ground, Projected.of(s, base, values), shapes)[:TRIED]
    }
    fitted = (
        likely(np.concatenate([base, ground.columns(s)], axis=1)) - bic_cost(k, len(values)) for s, k in picked.items()
    )
    return max(fitted, default=-math.inf) - likely(base)


def _draws(noise: Whitener, readings: Readings, rng: np.random.Generator) -> Floats:
    """Readings of noise alone, (m, draws): white, drift, and an offset of each run."""
    out = np.zeros((len(readings), DRAWS))
    for s, n in zip(readings.series, noise.noises, strict=True):
        drift = rng.standard_normal((len(s), DRAWS))
        kept = np.exp(-np.diff(s.time_s) / n.tau_s)
        for i, keep in enumerate(kept, 1):
            drift[i] = keep * drift[i - 1] + math.sqrt(1.0 - keep**2) * drift[i]
        offsets = rng.standard_normal((int(s.run[-1]) + 1, DRAWS))[s.run]
        white = rng.standard_normal((len(s), DRAWS))
        out[s.part] = n.sigma * (white + math.sqrt(n.drift) * drift + math.sqrt(n.offset) * offsets)
    return out

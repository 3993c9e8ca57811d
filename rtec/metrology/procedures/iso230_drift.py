"""Drift between the cycles of a positioning test, told apart from repeatability.

ISO 230-2 takes all scatter at a target as repeatability. When the axis warms up during the test, the cycles as a whole
move, and that is no scatter: the same cycle is off in the same way at every target. A two-way layout separates them:
`x_ij - x̄_i = zero of cycle j + stretch of cycle j × position + rest`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
SURE = 0.01
"""A drift is called one when scatter alone would give it in fewer than this share of tests."""


@dataclass(frozen=True)
class CycleDrift:
    """How the cycles move as a whole.

    Attributes:
        cycle_um: mean of x_ij - x̄_i over all targets and directions, one a cycle, (n,).
        stretch_um_per_m: slope of x_ij - x̄_i over position, one a cycle, (n,); zeros for one target.
        range_um: largest minus smallest cycle mean.
        stretch_range_um_per_m: the same for the slopes.
        p: chance that scatter alone gives cycle means this far apart (F test of the two-way layout).
        p_stretch: the same for the slopes; 1 where they cannot be tested.
        R_um: largest 4 s_i of any one direction, as it stands.
        R_without_um: the same once the cycle means are taken out.
        R_without_stretch_um: the same once the slopes are taken out too.
        share: of the squared scatter, what sure movements of whole cycles explain.
        words: the finding, in one or two sentences.
    """

    cycle_um: Floats
    stretch_um_per_m: Floats
    range_um: float
    stretch_range_um_per_m: float
    p: float
    p_stretch: float
    R_um: float
    R_without_um: float
    R_without_stretch_um: float
    share: float
    words: str

    @property
    def is_drift(self) -> bool:
        """Do the cycles move, beyond what scatter explains?"""
        return min(self.p, self.p_stretch) < SURE


def cycle_drift(target_mm: Floats, directions: Sequence[Floats]) -> CycleDrift | None:
    """Separate drift from repeatability.

    Args:
        target_mm: (m,).
        directions: deviations µm, (m, n) each.

    Returns:
        None where readings are missing or there are fewer than two cycles or targets.
    """
    x = np.concatenate(list(directions)) if directions else np.zeros((0, 0))
    if x.size == 0 or np.isnan(x).any() or x.shape[1] < 2 or len(x) < 3:
        return None
    rows, cycles = x.shape
    place = np.tile(target_mm - target_mm.mean(), len(directions))
    off = x - x.mean(axis=1, keepdims=True)
    means = off.mean(axis=0)
    size = float(place @ place)
    slopes = place @ off / size if size > 0 else np.zeros(cycles)
    level = off - means
    flat = level - np.outer(place, slopes)
    free = (cycles - 1, (rows - 1) * (cycles - 1), (rows - 2) * (cycles - 1))
    p = _chance(rows * float(means @ means), free[0], float((level**2).sum()), free[1])
    p_stretch = _chance(size * float(slopes @ slopes), free[0], float((flat**2).sum()), free[2]) if size > 0 else 1.0
    total = float((off**2).sum())
    parts = (rows * float(means @ means), size * float(slopes @ slopes))
    return _told(
        means,
        slopes * 1e3,
        float(np.ptp(target_mm)),
        (p, p_stretch),
        (_largest(off, cycles - 1), _largest(level, free[1] / rows), _largest(flat, free[2] / rows)),
        (parts[0] / total, parts[1] / total) if total > 0 else (0.0, 0.0),
    )


def _largest(residual: Floats, free: float) -> float:
    """Largest 4 s_i; `free`: degrees of freedom of one target."""
    return float(4 * np.sqrt((residual**2).sum(axis=1) / free).max()) if free > 0 else float("nan")


def _chance(between: float, free_between: int, within: float, free_within: int) -> float:
    """Chance of an F value at least this large from scatter alone."""
    from scipy.stats import f

    if between <= 0.0 or free_within <= 0:
        return 1.0
    if within <= 0.0:
        return 0.0
    return float(f.sf(between / free_between / (within / free_within), free_between, free_within))


def _told(
    means: Floats,
    slopes: Floats,
    travel_mm: float,
    chances: tuple[float, float],
    repeat: tuple[float, float, float],
    shares: tuple[float, float],
) -> CycleDrift:
    spread, stretch = float(np.ptp(means)), float(np.ptp(slopes))
    p, p_stretch = chances
    share = sum(s for s, chance in zip(shares, chances, strict=True) if chance < SURE)
    moves = []
    if p < SURE:
        moves.append(f"zero moves by {spread:.2f} µm ({_trend(means)})")
    if p_stretch < SURE:
        moves.append(f"scale by {stretch * travel_mm * 1e-3:.2f} µm over the {travel_mm:g} mm ({_trend(slopes)})")
    if moves:
        left = repeat[2] if p_stretch < SURE else repeat[1]
        words = (
            f"The cycles move as a whole: {' and '.join(moves)}. That is {100 * share:.0f} % of the squared scatter at "
            f"the targets; unidirectional repeatability is {repeat[0]:.2f} µm as the standard counts it and "
            f"{left:.2f} µm with the drift taken out."
        )
        if not any("every" in m for m in moves):
            words += " Warming goes one way; this does not: look for a loose mount or a reference that is lost."
    else:
        words = (
            f"No drift between the cycles beyond scatter (cycle means within {spread:.2f} µm, p = {p:.2f}): "
            "the repeatability is repeatability."
        )
    return CycleDrift(means, slopes, spread, stretch, p, p_stretch, *repeat, share, words)


def _trend(values: Floats) -> str:
    steps = np.diff(values)
    if (steps > 0).all():
        return "rising in every cycle"
    if (steps < 0).all():
        return "falling in every cycle"
    return "not all one way"

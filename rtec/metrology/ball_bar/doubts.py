"""Doubts about ball-bar readings themselves: a ball that was set again between tests, and wrong readings."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rtec.metrology.ball_bar.circle import CircleTest
from rtec.metrology.ball_bar.design import Centre
from rtec.metrology.ball_bar.fit import Fitted, chance_of, fit
from rtec.metrology.ball_bar.noise import NOISE_UM
from rtec.wording import counted, significant, two_numbers

Floats = NDArray[np.float64]

SURE = 1e-3
"""Accepted false-positive rate of a ball that was set again (F test)."""
LESS = 0.9
"""The residual must fall below this share."""
BESIDE = 3
"""Readings to each side with which a reading is compared."""
WRONG = 10.0
"""Deviation from this median, in multiples of its robust standard deviation, from which a reading is wrong."""


def doubts_of(circles: Sequence[CircleTest], fitted: Fitted, window_deg: float, centre: Centre) -> tuple[str, ...]:
    """All doubts, in words.

    Args:
        circles: the tests.
        fitted: their fit.
        window_deg, centre: see `fit`.
    """
    moved = _ball_moved(circles, fitted, window_deg) if centre == "shared" and len(circles) > 1 else ()
    return (*moved, *(w for c, left in zip(circles, fitted.left_um, strict=True) for w in _wrong(c, left, window_deg)))


def _ball_moved(circles: Sequence[CircleTest], fitted: Fitted, window_deg: float) -> tuple[str, ...]:
    """Doubt where a centre for each test leaves much less."""
    bent = fitted.model == "non-linear"
    each = fit(circles, bent=bent, window_deg=window_deg, centre="each", beyond=fitted.beyond)
    before, after = (_residual(circles, f, window_deg) for f in (fitted, each))
    if after > LESS * before or chance_of(fitted, each) >= SURE:
        return ()
    one, two = two_numbers(before, after)
    return (
        f"The tests do not have one centre: with a centre for each the residual falls from {one} to {two} µm. If the "
        "ball on the table was set again between them, give --centre each. If it was not, it moved: measure again.",
    )


def _residual(circles: Sequence[CircleTest], fitted: Fitted, window_deg: float) -> float:
    """Root mean square of a fit's residual away from the quadrants, µm."""
    left = [v[~c.near_quadrant(window_deg)] for c, v in zip(circles, fitted.left_um, strict=True)]
    return float(np.sqrt(np.mean(np.concatenate(left) ** 2)))


def _wrong(circle: CircleTest, left: Floats, window_deg: float) -> tuple[str, ...]:
    """Doubt where single readings deviate far from those before and after them.

    Args:
        circle: the test.
        left: residual of its fit, (n,) µm.
        window_deg: readings nearer than this to a quadrant are not looked at: reversals have peaks there.
    """
    from scipy.ndimage import median_filter

    off = np.zeros(len(left))
    for run in np.unique(circle.run):
        mine = circle.run == run
        off[mine] = left[mine] - median_filter(left[mine], 2 * BESIDE + 1)
    looked = ~circle.near_quadrant(window_deg)
    steps = np.diff(np.unique(circle.reading_um))
    least = max(NOISE_UM, 0.5 * float(np.median(steps)) if len(steps) else 0.0)
    noise = max(1.4826 * float(np.median(np.abs(off[looked]))) if looked.any() else 0.0, least)
    wrong = np.flatnonzero(looked & (np.abs(off) > WRONG * noise))
    if not len(wrong):
        return ()
    worst = wrong[np.argmax(np.abs(off[wrong]))]
    return (
        f"{circle.name} has {counted(len(wrong), 'reading')} far from the neighbouring ones, the farthest by "
        f"{significant(abs(off[worst]), 2)} µm at {np.degrees(circle.angle_rad[worst]) % 360.0:.0f}°. G and the fit "
        "include such readings: remove these rows, or measure again.",
    )

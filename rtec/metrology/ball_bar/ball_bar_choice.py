"""Choice between the two models of [BB], made as its section 6 advises, with what is found beyond them."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from rtec.metrology.ball_bar.circle import Circle
from rtec.metrology.ball_bar.design import Centre
from rtec.metrology.ball_bar.fit import Beyond, Fitted, fit

Choice = Literal["auto", "linear", "non-linear"]
SURE = 1e-3
"""The non-linear model is taken where its advantage would be chance less often than this."""


def chosen(
    circles: Sequence[Circle], model: Choice, window_deg: float, centre: Centre, beyond: Beyond
) -> tuple[Fitted, str]:
    """The model that is taken, fitted, and why in words.

    Args:
        circles: tests of one plane.
        model: which, or "auto".
        window_deg, centre, beyond: see `fit`.
    """
    if model != "auto":
        asked = fit(circles, bent=model == "non-linear", window_deg=window_deg, centre=centre, beyond=beyond)
        return asked, "as asked"
    straight = fit(circles, bent=False, window_deg=window_deg, centre=centre, beyond=beyond)
    bent = fit(circles, bent=True, window_deg=window_deg, centre=centre, beyond=beyond)
    if bent.rank.rank <= straight.rank.rank or (not bent.rank.complete and straight.rank.complete):
        what = "; ".join(" and ".join(s) for s in bent.rank.confounded) or ", ".join(bent.rank.never)
        return straight, f"these tests do not separate the non-linear model's parameters ({what})"
    third, chance = third_harmonic(circles, straight, window_deg)
    if chance < SURE:
        return bent, (
            f"what the linear model leaves has a third harmonic of {third:.2f} µm, which bent guides make and noise "
            f"would not"
        )
    better = _better(straight, bent)
    if better < SURE:
        return bent, (
            f"the error is large enough: the linear model leaves {straight.sigma_um:.3g} µm (standard deviation), the "
            f"non-linear {bent.sigma_um:.3g} µm, more than chance"
        )
    return straight, (
        f"the linear model leaves {straight.sigma_um:.3g} µm, the non-linear one {bent.sigma_um:.3g} µm, and no third "
        f"harmonic beyond noise ({third:.2f} µm): the simpler one is surer"
    )


def third_harmonic(circles: Sequence[Circle], fitted: Fitted, window_deg: float) -> tuple[float, float]:
    """Largest third harmonic in what a fit leaves, µm, and how often noise alone would make one as large."""
    from rtec.metrology.procedures.fitting import correlation_time

    largest, least = 0.0, 1.0
    for circle, left in zip(circles, fitted.left_um, strict=True):
        keep = ~circle.near_quadrant(window_deg)
        angle, values = circle.angle_rad[keep], left[keep]
        waves = np.stack([np.cos(3 * angle), np.sin(3 * angle)], axis=1)
        part = [circle.rows(keep)]
        white = fitted.beyond.noise.whiten(part, np.concatenate([waves, values[:, None]], axis=1))
        found = np.linalg.lstsq(white[:, :2], white[:, 2], rcond=None)[0]
        made = white[:, :2] @ found
        noise = white[:, 2] - made
        power = float(noise @ noise) / len(noise) * correlation_time(noise)
        size = float(np.hypot(*found))
        largest = max(largest, size)
        least = min(least, float(np.exp(-0.5 * (made @ made) / power)) if power > 0 else float(size == 0.0))
    return largest, min(1.0, least * len(circles))


def _better(straight: Fitted, bent: Fitted) -> float:
    """How often chance alone would make the non-linear model so much better (F test)."""
    from scipy.special import fdtrc

    count = bent.rank.rank - straight.rank.rank
    whole = straight.used / bent.correlation
    free = whole - bent.rank.rank
    rss = [f.sigma_um**2 * (f.used - f.rank.rank) for f in (straight, bent)]
    if free <= 1.0 or rss[1] <= 0.0:
        return 1.0
    return float(fdtrc(count, free, max(rss[0] / rss[1] - 1.0, 0.0) * free / count))

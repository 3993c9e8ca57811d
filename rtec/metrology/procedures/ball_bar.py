"""Diagnosis of ball-bar tests after [BB], with the choice between its two models made as its section 6 advises."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rtec.metrology.measurement import Measurement
from rtec.metrology.procedures.ball_bar_circle import Circle, circles_of
from rtec.metrology.procedures.ball_bar_design import SETTING_UP, Centre
from rtec.metrology.procedures.ball_bar_fit import Fitted, fit
from rtec.metrology.procedures.ball_bar_iso import (
    BothWays,
    Harmonic,
    Roundness,
    both_ways,
    harmonics,
    least_squares_circle,
    roundness,
)

Floats = NDArray[np.float64]
Choice = Literal["auto", "linear", "non-linear"]
WINDOW_DEG = 5.0
SURE = 1e-3
"""The non-linear model is taken where its advantage would be chance less often than this."""


@dataclass(frozen=True)
class Share:
    """What one cause does to the circle.

    Attributes:
        group: the cause.
        g_um: circular deviation of its fitted curve alone, in the test where it is largest.
        share: of the sum over all causes and what is left, 0 … 1.
    """

    group: str
    g_um: float
    share: float


@dataclass(frozen=True)
class Spectrum:
    """Harmonics of one full circle, measured and fitted; empty where the arc is not full."""

    name: str
    measured: tuple[Harmonic, ...]
    fitted: tuple[Harmonic, ...]


@dataclass(frozen=True)
class Diagnosis:
    """Everything about some tests of one plane.

    Attributes:
        circles: the tests.
        rounds, pairs: numbers of ISO 230-4.
        fitted: the model that was taken.
        reason: why that one, in words.
        shares: ranked, largest first.
        spectra: harmonics, test by test.
        explained: share of the readings' variance (without the set-up's centre and zero) that the fit explains.
        window_deg: left out about each quadrant.
        near_quadrants: share of the readings that this left out.
    """

    circles: tuple[Circle, ...]
    rounds: tuple[Roundness, ...]
    pairs: tuple[BothWays, ...]
    fitted: Fitted
    reason: str
    shares: tuple[Share, ...]
    spectra: tuple[Spectrum, ...]
    explained: float
    window_deg: float
    near_quadrants: float


def diagnose(
    measurements: Sequence[Measurement],
    model: Choice = "auto",
    window_deg: float = WINDOW_DEG,
    centre: Centre = "shared",
    orders: int = 15,
) -> Diagnosis:
    """Diagnose tests of one plane together.

    Args:
        measurements: of instrument ball_bar, on one machine.
        model: which of [BB]'s models, or the choice of its section 6.
        window_deg: readings nearer than this to a quadrant are not used in the fit.
        centre: does the table-side ball stay where it is from test to test?
        orders: harmonics.

    Raises:
        MeasurementError: other instruments, planes or machines; too few readings.
    """
    circles = circles_of(measurements)
    fitted, reason = _chosen(circles, model, window_deg, centre)
    near = sum(int(c.near_quadrant(window_deg).sum()) for c in circles) / sum(len(c) for c in circles)
    return Diagnosis(
        circles=circles,
        rounds=tuple(roundness(c) for c in circles),
        pairs=both_ways(circles),
        fitted=fitted,
        reason=reason,
        shares=_shares(circles, fitted),
        spectra=tuple(_spectrum(c, fitted.fitted_um(i), orders) for i, c in enumerate(circles)),
        explained=_explained(circles, fitted),
        window_deg=window_deg,
        near_quadrants=near,
    )


def _chosen(circles: Sequence[Circle], model: Choice, window_deg: float, centre: Centre) -> tuple[Fitted, str]:
    if model != "auto":
        return fit(circles, bent=model == "non-linear", window_deg=window_deg, centre=centre), "as asked"
    straight = fit(circles, bent=False, window_deg=window_deg, centre=centre)
    bent = fit(circles, bent=True, window_deg=window_deg, centre=centre)
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
        found = np.linalg.lstsq(waves, values, rcond=None)[0]
        noise = values - waves @ found
        power = float(noise @ noise) / len(noise) * correlation_time(noise) * 2.0 / len(noise)
        size = float(np.hypot(*found))
        largest = max(largest, size)
        least = min(least, float(np.exp(-0.5 * size**2 / power)) if power > 0 else float(size == 0.0))
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


def _shares(circles: Sequence[Circle], fitted: Fitted) -> tuple[Share, ...]:
    sizes = {
        group: max(_g(c, curve) for c, curve in zip(circles, curves, strict=True))
        for group, curves in fitted.parts_um.items()
        if group != SETTING_UP
    }
    sizes["left over"] = max(_g(c, left) for c, left in zip(circles, fitted.left_um, strict=True))
    whole = sum(sizes.values()) or 1.0
    ranked = sorted(sizes.items(), key=lambda item: -item[1])
    return tuple(Share(group, g, g / whole) for group, g in ranked)


def _g(circle: Circle, curve: Floats) -> float:
    return float(np.ptp(least_squares_circle(circle.angle_rad, curve)[3]))


def _spectrum(circle: Circle, fitted: Floats, orders: int) -> Spectrum:
    if not circle.full:
        return Spectrum(circle.name, (), ())
    return Spectrum(
        circle.name, harmonics(circle.angle_rad, circle.reading_um, orders), harmonics(circle.angle_rad, fitted, orders)
    )


def _explained(circles: Sequence[Circle], fitted: Fitted) -> float:
    rest, whole = 0.0, 0.0
    for i, circle in enumerate(circles):
        machine_um = circle.reading_um - fitted.parts_um.get(SETTING_UP, (np.zeros(len(circle)),) * len(circles))[i]
        rest += float(np.sum((fitted.left_um[i] - fitted.left_um[i].mean()) ** 2))
        whole += float(np.sum((machine_um - machine_um.mean()) ** 2))
    return 1.0 - rest / whole if whole > 0 else 0.0

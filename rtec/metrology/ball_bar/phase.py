"""Servo phase: one angle in all tests, as [BB] has it, or one time, which a real lag of an axis is.

Between tests that go round at the same angular speed (feed over radius) the two are one. Else they are not: at one
feed a circle of 120 mm has a phase a quarter larger than one of 150 mm for the same lag, and as one angle the
difference would be called twist, squareness or clearance. Where a delay separates from the phase (other feeds), both
are fitted; else the readings decide, and where they cannot, it is [BB]'s angle.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from rtec.metrology.ball_bar.beyond import candidates
from rtec.metrology.ball_bar.circle import CircleTest
from rtec.metrology.ball_bar.design import APART, Centre, design_of, rank_of, share_left, stacked_design
from rtec.metrology.ball_bar.fit import Fitted, FittedValue, fit
from rtec.metrology.ball_bar.search import NOISE_UM

Phase = Literal["auto", "angle", "time"]
SAME_SPEED = 1e-3
"""Angular speeds nearer than this share of each other are one."""
SURE = 6.0
"""Twice the logarithm of the odds from which on readings decide: 20 to 1."""


@dataclass(frozen=True)
class PhaseChoice:
    """How the servo phase goes from test to test.

    Attributes:
        circles: the tests, each with its `phase_rate`.
        taken: as one angle or one time.
        reason: in words; empty where the two are one, or both are fitted.
        decided: do the readings tell, or was it asked for?
    """

    circles: tuple[CircleTest, ...]
    taken: Literal["angle", "time"] = "angle"
    reason: str = ""
    decided: bool = True


@dataclass(frozen=True)
class Shift:
    """A parameter, and its value if the servo phase were one time."""

    taken: FittedValue
    if_time: float


def servo_phase(
    circles: Sequence[CircleTest], phase: Phase, window_deg: float, centre: Centre, *, dynamic: bool
) -> PhaseChoice:
    """Decide between one angle and one time.

    Args:
        circles: tests of one plane.
        phase: which, or "auto".
        window_deg, centre: see `fit`.
        dynamic: a delay that separates from the phase is fitted beside it.
    """
    angle, time = tuple(circles), by_time(circles)
    if all(abs(c.phase_rate - 1.0) <= SAME_SPEED for c in time):
        return PhaseChoice(angle)
    if phase != "auto":
        return PhaseChoice(time if phase == "time" else angle, phase, "as asked")
    if dynamic and _delay_separates(circles, centre):
        return PhaseChoice(angle)
    fits = {kind: [fit(of, bent=bent, window_deg=window_deg, centre=centre) for bent in (False, True)]
            for kind, of in (("angle", angle), ("time", time))}  # fmt: skip
    least = min((f for both in fits.values() for f in both), key=lambda f: f.sigma_um)
    count = max(least.used / least.correlation, 2.0)
    costs = {kind: min(_cost(f, count) for f in both) for kind, both in fits.items()}
    left = {kind: min(both, key=lambda f: _cost(f, count)).sigma_um for kind, both in fits.items()}
    if costs["time"] < costs["angle"] - SURE:
        words = f"as one time it leaves {left['time']:.3g} µm (standard deviation), as one angle {left['angle']:.3g} µm"
        return PhaseChoice(time, "time", words)
    if costs["angle"] < costs["time"] - SURE:
        words = f"as one angle it leaves {left['angle']:.3g} µm (standard deviation), as one time {left['time']:.3g} µm"
        return PhaseChoice(angle, "angle", words)
    return PhaseChoice(angle, "angle", "these tests do not tell it from one time; so as [BB]", decided=False)


def if_time(circles: Sequence[CircleTest], fitted: Fitted, window_deg: float, centre: Centre) -> tuple[Shift, ...]:
    """What parameters would be if the phase that was taken as one angle were one time; only those that change.

    Args:
        circles: tests of one plane.
        fitted: with the phase as one angle.
        window_deg, centre: see `fit`.
    """
    bent = fitted.model == "non-linear"
    other = fit(by_time(circles), bent=bent, window_deg=window_deg, centre=centre, beyond=fitted.beyond)
    pairs = zip(fitted.values, other.values, strict=True)
    return tuple(
        Shift(one, two.value) for one, two in pairs if one.name != "phase" and abs(two.value - one.value) > one.se
    )


def by_time(circles: Sequence[CircleTest]) -> tuple[CircleTest, ...]:
    """The tests with the servo phase as one time."""
    return tuple(replace(c, phase_rate=c.omega_rad_s / circles[0].omega_rad_s) for c in circles)


def _delay_separates(circles: Sequence[CircleTest], centre: Centre) -> bool:
    design = design_of(circles, bent=True, centre=centre)
    known = design.columns[:, list(rank_of(design.columns, [c.name for c in design.labels]).kept)]
    delay = next(c for c in candidates(circles) if c.name == "delay")
    return share_left(known, stacked_design(delay.make(0.0), circles)) >= APART


def _cost(fitted: Fitted, count: float) -> float:
    """Schwarz' criterion for so many independent readings."""
    rank = fitted.rank.rank
    return count * 2.0 * float(np.log(max(fitted.sigma_um, NOISE_UM))) + rank * float(np.log(count))

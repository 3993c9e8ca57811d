"""Servo: the lag of both axes, and whether their phase is one angle in all tests or one time.

A position loop of gain K_v without feed-forward lags by 1/K_v and makes a circle too small by ½ a / K_v². The size
gives K_v: two feeds separate this gain error from a scale error. The lag moves clearance and every other reversal error
away from the commanded quadrant. The readings about the quadrants decide whether the machine lags or its circle is only
too small.

In [BB] the servo phase is one angle; a real lag of an axis is one time. In tests with the same angular speed (feed over
radius) both are the same. Otherwise they differ: at one feed a circle of 120 mm has a phase a quarter larger than one
of 150 mm for the same lag, and a fit with one angle would attribute the difference to twist, squareness or clearance.
Where the tests separate a delay from the phase (several feeds), both are fitted. Otherwise the readings decide; where
they cannot, the phase is [BB]'s angle, and the intervals include both answers.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from rtec.arrays import Floats
from rtec.metrology.ball_bar.beyond import candidates
from rtec.metrology.ball_bar.circle import CircleTest
from rtec.metrology.ball_bar.design import APART, Centre, design_of, independent_share, stacked_design
from rtec.metrology.ball_bar.fit import Fitted, FittedValue, fit, solve
from rtec.metrology.ball_bar.noise import NOISE_UM, WHITE
from rtec.metrology.ball_bar.search import SURE_SE, clearance_of, residual_of_all
from rtec.wording import significant

Kind = Literal["angle", "time"]
Phase = Literal["auto", "angle", "time"]
SAME_SPEED = 1e-3
"""Angular speeds that differ by less than this share count as one."""
SURE = 6.0
"""Twice the logarithm of the odds at which the readings decide: 20 to 1."""


SLOWEST_S = 1.0 / 15.0
"""Lag of the slowest position loop in use."""
PLAIN = 0.3
"""Gain errors of two loops without feed-forward differ by less than this share of them, apart from noise."""


@dataclass(frozen=True)
class LoopLag:
    """Lag of both axes behind the command.

    Attributes:
        circles: the tests at the angles that the machine had reached.
        time_s: lag; 0 where the readings show none.
        unsure_s: the lag may be larger by up to this.
    """

    circles: tuple[CircleTest, ...]
    time_s: float
    unsure_s: float


@dataclass(frozen=True)
class PhaseChoice:
    """How the servo phase depends on the test.

    Attributes:
        circles: the tests, each with its `phase_rate`.
        taken: "angle" or "time", the one that is the same in all tests.
        reason: in words; empty where both are the same or both are fitted.
        other: the tests with the other choice, where the readings do not decide.
    """

    circles: tuple[CircleTest, ...]
    taken: Kind = "angle"
    reason: str = ""
    other: tuple[CircleTest, ...] = ()

    @property
    def decided(self) -> bool:
        """Whether the readings or the user decided."""
        return not self.other


@dataclass(frozen=True)
class Shift:
    """A parameter with the servo phase as one angle, and its value as one time."""

    angle: FittedValue
    time: float


def servo_phase(
    circles: Sequence[CircleTest],
    phase: Phase,
    guides: Sequence[bool],
    window_deg: float,
    centre: Centre,
    *,
    dynamic: bool,
) -> PhaseChoice:
    """Decide between one angle and one time.

    Args:
        circles: tests of one plane.
        phase: "angle", "time" or "auto".
        guides: models of the guides that are possible, the most general one last: False straight, True bent.
        window_deg, centre: see `fit`.
        dynamic: fit a delay beside the phase where the tests separate them.
    """
    kinds = {"angle": tuple(circles), "time": by_time(circles)}
    if all(abs(c.phase_rate - 1.0) <= SAME_SPEED for c in kinds["time"]):
        return PhaseChoice(kinds["angle"])
    if phase != "auto":
        return PhaseChoice(kinds[phase], phase, "as asked")
    if dynamic and _delay_separates(circles, centre):
        return PhaseChoice(kinds["angle"])
    fits = {k: [fit(of, bent=bent, window_deg=window_deg, centre=centre) for bent in guides] for k, of in kinds.items()}
    least = min((f for of in fits.values() for f in of), key=lambda f: f.sigma_um)
    count = max(least.used / least.correlation, 2.0)
    # A twist gives the same readings as the difference of angle and time: the most general guides decide.
    general = _cost(fits["time"][-1], count) - _cost(fits["angle"][-1], count)
    any_ = min(_cost(f, count) for f in fits["time"]) - min(_cost(f, count) for f in fits["angle"])
    taken: Kind = "time" if (general if abs(general) > SURE else any_) < -SURE else "angle"
    other: Kind = "angle" if taken == "time" else "time"
    if abs(general) > SURE:
        one, two = (significant(fits[k][-1].sigma_um) for k in (taken, other))
        words = f"as one {taken} the residual is {one} µm (standard deviation), as one {other} {two} µm"
        return PhaseChoice(kinds[taken], taken, words)
    words = f"straight guides make it one {taken}, but with bent guides these tests do not tell"
    if abs(any_) <= SURE:
        words = "these tests do not tell it from one time; so as [BB]"
    return PhaseChoice(kinds[taken], taken, words, other=kinds[other])


def loop_lag(circles: Sequence[CircleTest], still: Fitted, window_deg: float, centre: Centre) -> LoopLag:
    """Lag of the axes, from the gain errors of their loops.

    Args:
        circles: tests of one plane.
        still: fit of [BB]'s parameters away from the quadrants.
        window_deg, centre: see `fit`.
    """
    here = tuple(circles)
    gains = _gains(here, window_deg, centre)
    if gains is None:
        return LoopLag(here, 0.0, SLOWEST_S)
    (one, other), errors = gains
    most = float(np.sqrt(2e-6 * max(one + 2.0 * errors[0], other + 2.0 * errors[1], 0.0)))
    weight = 1.0 / errors**2
    gain, se = float(weight @ (one, other) / weight.sum()), float(1.0 / np.sqrt(weight.sum()))
    if gain < SURE_SE * se or abs(one - other) > SURE_SE * float(np.hypot(*errors)) + PLAIN * gain:
        return LoopLag(here, 0.0, min(most, SLOWEST_S))
    late = float(np.sqrt(2e-6 * gain))
    unsure, moved = 2e-6 * se / late, tuple(c.later(late) for c in circles)
    clearance = clearance_of(still, circles)
    if residual_of_all(moved, clearance, unsure, centre) < residual_of_all(circles, clearance, 0.0, centre):
        return LoopLag(moved, late, unsure)
    return LoopLag(here, 0.0, 0.0)


def _gains(
    circles: Sequence[CircleTest], window_deg: float, centre: Centre
) -> tuple[tuple[float, float], Floats] | None:
    """Gain errors of both loops, µm per m/s², and their standard errors; None where the tests do not show them."""
    servo = [c for x in candidates(circles) if x.effect in ("inertia", "servo_lag") for c in x.make(0.0)]
    used = [c.rows(~c.near_quadrant(window_deg)) for c in circles]
    design = design_of(used, bent=True, centre=centre, more=servo)
    kept = list(design.by_readings.kept)
    names = [c.name for c in servo if c.name.startswith("gain_")]
    open_ = {n for s in design.by_readings.confounded for n in s} | set(design.by_readings.never)
    places = [design.names.index(n) for n in names]
    if len(names) != 2 or open_ & set(names) or not set(places) <= set(kept):
        return None
    solved = solve(design, kept, np.concatenate([c.reading_um for c in used]), used, WHITE)
    at = [kept.index(i) for i in places]
    return (float(solved.coefficients[at[0]]), float(solved.coefficients[at[1]])), solved.errors[at]


def either(one: Fitted, other: Fitted) -> Fitted:
    """The first of two fits, with intervals and standard errors that include the other one."""
    known = {v.name: v for v in (*other.values, *other.combinations)}
    values = tuple(_either(v, known.get(v.name, v)) for v in one.values)
    combinations = tuple(_either(v, known.get(v.name, v)) for v in one.combinations)
    return replace(one, values=values, combinations=combinations)


def shifts(angle: Fitted, time: Fitted) -> tuple[Shift, ...]:
    """Parameters that differ between the two choices."""
    pairs = zip(angle.values, time.values, strict=True)
    return tuple(Shift(a, b.value) for a, b in pairs if a.name != "phase" and abs(b.value - a.value) > a.se)


def _either(one: FittedValue, two: FittedValue) -> FittedValue:
    se = float(np.hypot(max(one.se, two.se), two.value - one.value))
    return replace(one, se=se, low=min(one.low, two.low), high=max(one.high, two.high))


def by_time(circles: Sequence[CircleTest]) -> tuple[CircleTest, ...]:
    """The tests with the servo phase as one time: `phase_rate` is the ratio of angular speeds."""
    return tuple(replace(c, phase_rate=c.omega_rad_s / circles[0].omega_rad_s) for c in circles)


def _delay_separates(circles: Sequence[CircleTest], centre: Centre) -> bool:
    design = design_of(circles, bent=True, centre=centre)
    known = design.columns[:, list(design.by_readings.kept)]
    delay = next(c for c in candidates(circles) if c.name == "delay")
    return independent_share(known, stacked_design(delay.make(0.0), circles)) >= APART


def _cost(fitted: Fitted, count: float) -> float:
    """Schwarz' criterion (BIC) for `count` independent readings."""
    rank = fitted.rank.rank
    return count * 2.0 * float(np.log(max(fitted.sigma_um, NOISE_UM))) + rank * float(np.log(count))

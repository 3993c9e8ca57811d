"""Diagnosis of ball-bar tests: [BB]'s parameters and what they leave out, found together; and which test to add.

The choice between the two models of [BB] follows its section 6, with what is found beyond them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rtec.metrology.ball_bar.causes import same_feed
from rtec.metrology.ball_bar.circle import CircleTest, circles_of
from rtec.metrology.ball_bar.design import SETTING_UP, Centre, NotLookedFor, table_of, with_setup
from rtec.metrology.ball_bar.fit import Beyond, Fitted, fit
from rtec.metrology.ball_bar.iso230_4 import (
    BothWays,
    CircleHarmonic,
    Roundness,
    both_ways,
    harmonics,
    least_squares_circle,
    roundness,
)
from rtec.metrology.ball_bar.phase import Phase, PhaseChoice, Shift, by_time, if_time, servo_phase
from rtec.metrology.ball_bar.search import SearchResult, search
from rtec.metrology.measurement import Measurement
from rtec.parallel import one_blas_thread
from rtec.wording import significant

SAME_MM = 1.0
FASTER = 3.0
FAST_MM_MIN = 6000.0
"""From here on the other feed is the slower one."""


@dataclass(frozen=True)
class NextTest:
    """One more test.

    Attributes:
        test: in words.
        feed_mm_min: of it.
        names: causes that it separates.
    """

    test: str
    feed_mm_min: float
    names: tuple[str, ...]


def wanted(
    circles: Sequence[CircleTest], left_out: Sequence[NotLookedFor], centre: Centre, *, in_time: bool = False
) -> tuple[NextTest, ...]:
    """Tests, one at a time added to the given ones, that show causes which these do not; each cause once.

    Args:
        circles: the given tests.
        left_out: causes that they do not show.
        centre: see `design_of`.
        in_time: the servo phase is taken as one time in all tests.
    """
    open_ = [x.candidate.name for x in left_out if not x.candidate.missing]
    out = []
    for words, circle in _ideas(circles) if open_ else ():
        if any(_same_test(circle, c) for c in circles):
            continue
        # A spike has its own name at each feed; those are not what a new test is for.
        shown = _shown((*circles, circle), centre, in_time=in_time)
        names = tuple(n for n in open_ if n in shown)
        if names:
            out.append(NextTest(words, circle.setup.feed_mm_min, names))
            open_ = [n for n in open_ if n not in names]
    return tuple(out)


def _shown(circles: Sequence[CircleTest], centre: Centre, *, in_time: bool) -> set[str]:
    """Names of the causes that some tests show."""
    if not in_time:
        return {c.name for c in table_of(circles, centre).tried}
    # A delay is told from one angle, not from one time, which is the same thing.
    one_angle = _shown([replace(c, phase_rate=1.0) for c in circles], centre, in_time=False)
    return {c.name for c in table_of(by_time(circles), centre).tried} | (one_angle & {"delay"})


def _same_test(one: CircleTest, other: CircleTest) -> bool:
    a, b = one.setup, other.setup
    return (
        a.direction == b.direction
        and same_feed(a.feed_mm_min, b.feed_mm_min)
        and abs(a.radius_mm - b.radius_mm) < SAME_MM
        and abs(a.height_mm - b.height_mm) < SAME_MM
    )


def _ideas(circles: Sequence[CircleTest]) -> Iterator[tuple[str, CircleTest]]:
    first = circles[0]
    setup = first.setup
    feed = setup.feed_mm_min * (FASTER if setup.feed_mm_min * FASTER <= FAST_MM_MIN else 1.0 / FASTER)
    yield f"{first.name} again at {feed:g} mm/min", with_setup(first, feed_mm_min=float(f"{feed:.3g}"))
    other = "cw" if setup.sense > 0 else "ccw"
    yield f"{first.name} again {other}", with_setup(first, direction=other)
    flat = next((c for c in circles if abs(c.setup.height_mm) < 1e-9), None)
    if flat is not None:
        length = flat.setup.length_mm
        # At the same angular speed a lag of an axis is the same angle.
        feed = float(f"{0.8 * flat.setup.feed_mm_min:.3g}")
        leaning = with_setup(flat, height_mm=round(0.6 * length, 1), radius_mm=round(0.8 * length, 1), feed_mm_min=feed)
        where = f"height {0.6 * length:.0f} mm, radius {0.8 * length:.0f} mm, {feed:g} mm/min"
        words = f"{flat.name} again with {where}"
        yield words, leaning


Choice = Literal["auto", "linear", "non-linear"]
SURE = 1e-3
"""The non-linear model is taken where its advantage would be chance less often than this."""


def chosen(
    circles: Sequence[CircleTest], model: Choice, window_deg: float, centre: Centre, beyond: Beyond
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
            f"the residual of the linear model has a third harmonic of {third:.2f} µm, which bent guides cause and "
            "noise does not"
        )
    better = _better(straight, bent)
    if better < SURE:
        return bent, (
            f"the error is large enough: the residual of the linear model is {significant(straight.sigma_um)} µm "
            f"(standard deviation), of the non-linear {significant(bent.sigma_um)} µm, a difference beyond noise"
        )
    return straight, (
        f"the residual of the linear model is {significant(straight.sigma_um)} µm, of the non-linear one "
        f"{significant(bent.sigma_um)} µm, and there is no third harmonic beyond noise ({third:.2f} µm): the simpler "
        "model is taken"
    )


def third_harmonic(circles: Sequence[CircleTest], fitted: Fitted, window_deg: float) -> tuple[float, float]:
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


Floats = NDArray[np.float64]
WINDOW_DEG = 5.0
LEFT = "residual"
"""Name among the shares of what no cause explains."""


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
    measured: tuple[CircleHarmonic, ...]
    fitted: tuple[CircleHarmonic, ...]


@dataclass(frozen=True)
class BallBarDiagnosis:
    """Everything about some tests of one plane.

    Attributes:
        circles: the tests.
        rounds, pairs: numbers of ISO 230-4.
        fitted: the model that was taken.
        reason: why that one, in words.
        shares: ranked, largest first.
        spectra: harmonics, test by test.
        explained: share of the readings' variance (without the set-up's centre and zero) that the fit explains.
        explained_bb: that [BB]'s parameters alone would, fitted away from the quadrants.
        window_deg: about each quadrant; readings there are not used, or judged by a noise of their own.
        near_quadrants: share of the readings there.
        found: what was looked for beyond [BB]'s parameters, what was found, and what could not be.
        centre: as asked.
        dynamic: was anything beyond [BB]'s parameters looked for?
        phase: the servo phase taken as one angle in all tests, or as one time, and why.
    """

    circles: tuple[CircleTest, ...]
    rounds: tuple[Roundness, ...]
    pairs: tuple[BothWays, ...]
    fitted: Fitted
    reason: str
    shares: tuple[Share, ...]
    spectra: tuple[Spectrum, ...]
    explained: float
    explained_bb: float
    window_deg: float
    near_quadrants: float
    found: SearchResult = field(default_factory=SearchResult)
    centre: Centre = "shared"
    dynamic: bool = True
    phase: PhaseChoice = field(default_factory=lambda: PhaseChoice(()))

    @cached_property
    def wanted(self) -> tuple[NextTest, ...]:
        """Further tests that would show what these do not."""
        with one_blas_thread():
            return wanted(self.circles, self.found.left_out, self.centre, in_time=self.phase.taken == "time")

    @cached_property
    def if_time(self) -> tuple[Shift, ...]:
        """Parameters that depend on whether the servo phase is one angle or one time, where these tests do not tell."""
        if self.phase.decided:
            return ()
        with one_blas_thread():
            return if_time(self.circles, self.fitted, self.window_deg, self.centre)


def diagnose(
    measurements: Sequence[Measurement],
    model: Choice = "auto",
    window_deg: float = WINDOW_DEG,
    centre: Centre = "shared",
    orders: int = 15,
    *,
    dynamic: bool = True,
    phase: Phase = "auto",
) -> BallBarDiagnosis:
    """Diagnose tests of one plane together.

    Args:
        measurements: of instrument ball_bar, on one machine.
        model: which of [BB]'s models, or the choice of its section 6.
        window_deg: readings nearer than this to a quadrant are not used in the fit; where something beyond [BB]'s
            parameters is found they are, with a noise of their own.
        centre: does the table-side ball stay where it is from test to test?
        orders: harmonics.
        dynamic: look for causes beyond [BB]'s parameters.
        phase: is the servo phase one angle in all tests, or one time? It matters where feed over radius differs.

    Raises:
        MeasurementError: other instruments, planes or machines; too few readings.
    """
    with one_blas_thread():
        servo = servo_phase(circles_of(measurements), phase, window_deg, centre, dynamic=dynamic)
        return _diagnose(servo, model, window_deg, centre, orders, dynamic)


def _diagnose(
    phase: PhaseChoice, model: Choice, window_deg: float, centre: Centre, orders: int, dynamic: bool
) -> BallBarDiagnosis:
    circles = phase.circles
    still = fit(circles, bent=False, window_deg=window_deg, centre=centre)
    found = search(circles, still, window_deg, centre) if dynamic else SearchResult()
    fitted, reason = chosen(circles, model, window_deg, centre, found.beyond)
    bb = chosen(circles, model, window_deg, centre, Beyond())[0] if found.beyond.picks else fitted
    near = sum(int(c.near_quadrant(window_deg).sum()) for c in circles) / sum(len(c) for c in circles)
    return BallBarDiagnosis(
        circles=circles,
        rounds=tuple(roundness(c) for c in circles),
        pairs=both_ways(circles),
        fitted=fitted,
        reason=reason,
        shares=_shares(circles, fitted),
        spectra=tuple(_spectrum(c, fitted.fitted_um(i), orders) for i, c in enumerate(circles)),
        explained=_explained(circles, fitted, fitted),
        explained_bb=_explained(circles, bb, fitted),
        window_deg=window_deg,
        near_quadrants=near,
        found=found,
        centre=centre,
        dynamic=dynamic,
        phase=phase,
    )


def _shares(circles: Sequence[CircleTest], fitted: Fitted) -> tuple[Share, ...]:
    sizes = {
        group: max(_g(c, curve) for c, curve in zip(circles, curves, strict=True))
        for group, curves in fitted.parts_um.items()
        if group != SETTING_UP
    }
    sizes[LEFT] = max(_g(c, left) for c, left in zip(circles, fitted.left_um, strict=True))
    whole = sum(sizes.values()) or 1.0
    ranked = sorted(sizes.items(), key=lambda item: -item[1])
    return tuple(Share(group, g, g / whole) for group, g in ranked)


def _g(circle: CircleTest, curve: Floats) -> float:
    return float(np.ptp(least_squares_circle(circle.angle_rad, curve)[3]))


def _spectrum(circle: CircleTest, fitted: Floats, orders: int) -> Spectrum:
    if not circle.full:
        return Spectrum(circle.name, (), ())
    return Spectrum(
        circle.name, harmonics(circle.angle_rad, circle.reading_um, orders), harmonics(circle.angle_rad, fitted, orders)
    )


def _explained(circles: Sequence[CircleTest], fitted: Fitted, best: Fitted) -> float:
    """By one fit; the set-up's own part is always taken from the best one."""
    rest, whole = 0.0, 0.0
    for i, circle in enumerate(circles):
        machine_um = circle.reading_um - best.parts_um.get(SETTING_UP, (np.zeros(len(circle)),) * len(circles))[i]
        rest += float(np.sum((fitted.left_um[i] - fitted.left_um[i].mean()) ** 2))
        whole += float(np.sum((machine_um - machine_um.mean()) ** 2))
    return 1.0 - rest / whole if whole > 0 else 0.0

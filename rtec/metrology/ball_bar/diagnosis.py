"""Diagnosis of ball-bar tests: a joint fit of [BB]'s parameters and causes beyond them; and which test to add.

The choice between the two models of [BB] follows its section 6, with the causes beyond them in the fit.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np

from rtec.arrays import Floats
from rtec.metrology.ball_bar.causes import same_feed
from rtec.metrology.ball_bar.circle import CircleTest, circles_of
from rtec.metrology.ball_bar.design import SETTING_UP, Centre, NotLookedFor, table_of, with_setup
from rtec.metrology.ball_bar.doubts import doubts_of
from rtec.metrology.ball_bar.fit import (
    NAMED_SE,
    Beyond,
    Fitted,
    FittedValue,
    chance_of,
    fit,
    mean_squares,
    weight_of,
)
from rtec.metrology.ball_bar.iso230_4 import (
    BothWays,
    CircleHarmonic,
    Roundness,
    both_ways,
    harmonics,
    least_squares_circle,
    roundness,
)
from rtec.metrology.ball_bar.noise import NOISE_UM
from rtec.metrology.ball_bar.phase import (
    LoopLag,
    Phase,
    PhaseChoice,
    Shift,
    by_time,
    either,
    loop_lag,
    servo_phase,
    shifts,
)
from rtec.metrology.ball_bar.search import CausesFound, search
from rtec.metrology.measurement import Measurement
from rtec.parallel import one_blas_thread
from rtec.result import Result
from rtec.wording import significant

SAME_MM = 1.0
FASTER = 3.0
FAST_MM_MIN = 6000.0
"""Above this the other feed is a slower one."""


@dataclass(frozen=True)
class NextTest:
    """One more test.

    Attributes:
        test: description in words.
        feed_mm_min: feed of the test.
        names: causes that it separates.
    """

    test: str
    feed_mm_min: float
    names: tuple[str, ...]


def next_tests(
    circles: Sequence[CircleTest], left_out: Sequence[NotLookedFor], centre: Centre, *, in_time: bool = False
) -> tuple[NextTest, ...]:
    """Further tests that show causes which the given ones do not; each is added alone, each cause occurs once.

    Args:
        circles: the given tests.
        left_out: causes that they do not show.
        centre: see `design_of`.
        in_time: the servo phase is the same time in all tests.
    """
    open_ = [x.candidate.name for x in left_out if not x.candidate.missing and not x.rival]
    out = []
    for words, circle in _ideas(circles) if open_ else ():
        if any(_same_test(circle, c) for c in circles):
            continue
        # A spike has its own name at each feed; a new test is not for these.
        shown = _shown((*circles, circle), centre, in_time=in_time)
        names = tuple(n for n in open_ if n in shown)
        if names:
            out.append(NextTest(words, circle.setup.feed_mm_min, names))
            open_ = [n for n in open_ if n not in names]
    return tuple(out)


def _shown(circles: Sequence[CircleTest], centre: Centre, *, in_time: bool) -> set[str]:
    """Names of the causes that some tests show."""
    if not in_time:
        return {c.name for c in table_of(circles, centre).separated}
    # A delay is separated from a phase that is one angle; a phase that is one time is the same as a delay.
    one_angle = _shown([replace(c, phase_rate=1.0) for c in circles], centre, in_time=False)
    return {c.name for c in table_of(by_time(circles), centre).separated} | (one_angle & {"delay"})


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
        # At the same angular speed the lag of an axis is the same angle.
        feed = float(f"{0.8 * flat.setup.feed_mm_min:.3g}")
        leaning = with_setup(flat, height_mm=round(0.6 * length, 1), radius_mm=round(0.8 * length, 1), feed_mm_min=feed)
        where = f"height {0.6 * length:.0f} mm, radius {0.8 * length:.0f} mm, {feed:g} mm/min"
        words = f"{flat.name} again with {where}"
        yield words, leaning


Choice = Literal["auto", "linear", "non-linear"]
SURE = 1e-3
"""Accepted false-positive rate for the non-linear model (F test)."""


def chosen(
    circles: Sequence[CircleTest], model: Choice, window_deg: float, centre: Centre, beyond: Beyond
) -> tuple[Fitted, str]:
    """The fit of the chosen model, and the reason for the choice in words.

    Args:
        circles: tests of one plane.
        model: the model, or "auto".
        window_deg, centre, beyond: see `fit`.
    """
    if model != "auto":
        requested = fit(circles, bent=model == "non-linear", window_deg=window_deg, centre=centre, beyond=beyond)
        return requested, "as asked"
    straight = fit(circles, bent=False, window_deg=window_deg, centre=centre, beyond=beyond)
    bent = fit(circles, bent=True, window_deg=window_deg, centre=centre, beyond=beyond)
    if bent.rank.rank <= straight.rank.rank:
        return straight, "these tests show no bend of a guide"
    third, chance = third_harmonic(circles, straight, window_deg)
    if chance < SURE:
        return bent, (
            f"the residual of the linear model has a third harmonic of {third:.2f} µm, which bent guides or curved "
            "positioning errors cause and noise does not"
        )
    better = chance_of(straight, bent)
    if better < SURE:
        return bent, (
            f"the error is large enough: the residual of the linear model is {significant(straight.sigma_um)} µm "
            f"(standard deviation), of the non-linear {significant(bent.sigma_um)} µm, a difference beyond noise"
        )
    return _averaged(straight, bent), (
        f"the residual of the linear model is {significant(straight.sigma_um)} µm, of the non-linear one "
        f"{significant(bent.sigma_um)} µm, and there is no third harmonic beyond noise ({third:.2f} µm): the simpler "
        "model is taken"
    )


def third_harmonic(circles: Sequence[CircleTest], fitted: Fitted, window_deg: float) -> tuple[float, float]:
    """Largest third harmonic of a fit's residual, µm, and the probability that noise alone gives one as large."""
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
        power = max(float(noise @ noise) / len(noise), NOISE_UM**2) * correlation_time(noise)
        size = float(np.hypot(*found))
        largest = max(largest, size)
        least = min(least, float(np.exp(-0.5 * (made @ made) / power)))
    return largest, min(1.0, least * len(circles))


def _averaged(straight: Fitted, bent: Fitted) -> Fitted:
    """The linear model where bends are possible but not significant: weighted mean of both models for each parameter.

    The standard error includes the difference between the two. Parameters that the tests do not separate from a bend
    are marked as such.
    """
    count = bent.rank.rank - straight.rank.rank
    gained = straight.used / bent.correlation * float(np.log(max(mean_squares(straight, bent), 1.0)))
    weight = weight_of(gained, count)
    known = {v.name: v for v in (*bent.values, *bent.combinations)}
    values = tuple(_mean(v, known[v.name], weight) if v.name in known else v for v in straight.values)
    combinations = tuple(_mean(v, known[v.name], weight) if v.name in known else v for v in straight.combinations)
    return replace(straight, values=values, combinations=combinations)


def _mean(one: FittedValue, two: FittedValue, weight: float) -> FittedValue:
    if not np.isfinite(one.value):
        return one
    if not np.isfinite(two.value):
        return replace(one, with_=tuple(dict.fromkeys([*one.with_, *two.with_])))
    apart, wide = two.value - one.value, 0.5 * (one.high - one.low) / one.se if one.se > 0.0 else 0.0
    value = one.value + weight * apart
    se = float(np.sqrt((1.0 - weight) * one.se**2 + weight * two.se**2 + weight * (1.0 - weight) * apart**2))
    return replace(one, value=value, se=se, low=value - wide * se, high=value + wide * se)


WINDOW_DEG = 5.0
RESIDUAL = "residual"
"""Name of the share that no cause explains."""


@dataclass(frozen=True)
class Share:
    """Share of one cause in the error of the circle.

    Attributes:
        group: the cause.
        g_um: circular deviation of its fitted curve alone, in the test where it is largest.
        share: share of the readings' mean square (without the set-up's part), 0 … 1. The residual has the part that the
            fit does not explain; the causes divide the rest in proportion to their own mean squares.
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
class BallBarDiagnosis(Result):
    """Result of the diagnosis of some tests of one plane.

    Attributes:
        circles: the tests.
        rounds, pairs: characteristics of ISO 230-4.
        fitted: the chosen model.
        reason: reason for the choice, in words.
        shares: shares of the causes, largest first.
        spectra: harmonics, test by test.
        explained: share of the readings' variance (without the set-up's centre and zero) that the fit explains.
        explained_bb: share that [BB]'s parameters alone explain, fitted away from the quadrants.
        window_deg: half-width about each quadrant; readings there are not used, or have a noise of their own.
        near_quadrants: share of the readings there.
        found: candidates beyond [BB]'s parameters: significant ones, others, and those that could not be tested.
        centre: the argument of that name.
        dynamic: whether candidates beyond [BB]'s parameters were tested.
        phase: whether the servo phase is one angle or one time in all tests, and why.
        changed: parameters that differ between the two, where these tests do not decide.
        lag_s: lag of both axes behind the command; 0 where the readings show none.
        doubts: about the readings themselves, in words.
    """

    page_maker: ClassVar[str] = "rtec.report.ball_bar:ball_bar_page"

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
    found: CausesFound = field(default_factory=CausesFound)
    centre: Centre = "shared"
    dynamic: bool = True
    phase: PhaseChoice = field(default_factory=lambda: PhaseChoice(()))
    changed: tuple[Shift, ...] = ()
    lag_s: float = 0.0
    doubts: tuple[str, ...] = ()

    @cached_property
    def wanted(self) -> tuple[NextTest, ...]:
        """Further tests that show causes which these do not."""
        with one_blas_thread():
            return next_tests(self.circles, self.found.left_out, self.centre, in_time=self.phase.taken == "time")

    @property
    def named(self) -> Share | None:
        """The largest cause with a significant parameter or combination; None where there is none."""
        sure = {v.group for v in (*self.fitted.values, *self.fitted.combinations) if abs(v.value) > NAMED_SE * v.se}
        return next((s for s in self.shares if s.group in sure), None)

    def facts(self) -> dict[str, Any]:
        """The result as plain data; keys as in the documented JSON."""
        return {
            "plane": self.circles[0].setup.plane,
            "tests": [
                {
                    "name": c.name, "n": len(c), "left_out": c.left_out, "direction": c.setup.direction,
                    "radius_mm": c.setup.radius_mm, "height_mm": c.setup.height_mm, "feed_mm_min": c.setup.feed_mm_min,
                }
                for c in self.circles
            ],
            "iso_230_4": self.rounds,
            "both_senses": self.pairs,
            "model": self.fitted.model,
            "reason": self.reason,
            "rank": self.fitted.rank,
            "servo_phase": self._phase_facts(),
            "parameters": {
                v.name: {
                    "value": v.value, "se": v.se, "low": v.low, "high": v.high, "unit": v.unit, "title": v.title,
                    "cause": v.group, "not_separated_from": list(v.with_), "note": v.note,
                }
                for v in self.fitted.values
            },
            "combinations": [
                {
                    "terms": dict(v.terms), "title": v.title, "value": v.value, "se": v.se, "low": v.low,
                    "high": v.high, "unit": v.unit, "cause": v.group, "not_separated_from": list(v.with_),
                }
                for v in self.fitted.combinations
            ],
            "height_of_table_ball": self.fitted.heights,
            "largest_cause": self.named.group if self.named else None,
            "shares": self.shares,
            "beyond": self._beyond_facts() if self.dynamic else None,
            "explained": self.explained,
            "explained_by_bb_alone": self.explained_bb,
            "left_um": self.fitted.sigma_um,
            "window_deg": self.window_deg,
            "near_quadrants": self.near_quadrants,
            "harmonics": self.spectra,
            "doubts": list(self.doubts),
        }  # fmt: skip

    def rows(self) -> Sequence[Mapping[str, Any]]:
        """One row a parameter."""
        return [{"name": name, **facts} for name, facts in self.facts()["parameters"].items()]

    def _phase_facts(self) -> dict[str, Any]:
        """Whether the servo phase is one angle in all tests, or one time."""
        return {
            "taken_as": self.phase.taken,
            "decided": self.phase.decided,
            "reason": self.phase.reason,
            "lag_ms": 1e3 * self.lag_s,
            "if_one_angle": {s.angle.name: s.angle.value for s in self.changed},
            "if_one_time": {s.angle.name: s.time for s in self.changed},
        }

    def _beyond_facts(self) -> dict[str, Any]:
        """Results for the candidates beyond [BB]'s parameters."""
        return {
            "found": [
                {
                    "name": p.candidate.name, "title": p.candidate.title, "group": p.candidate.group,
                    "effect": p.candidate.effect, "chance": p.chance,
                }
                for p in self.found.beyond.picks
            ],
            "not_found": [
                {"name": n.candidate.name, "title": n.candidate.title, "effect": n.candidate.effect,
                 "would_be_found_from": n.limit, "unit": n.unit, "together_with": [x.name for x in n.with_]}
                for n in self.found.not_found
            ],
            "not_looked_for": [
                {"name": n.candidate.name, "title": n.candidate.title, "why": n.why,
                 "not_separated_from": list(n.twins), "does_as_well": n.rival}
                for n in self.found.left_out
            ],
            "tests_to_add": [
                {"test": w.test, "feed_mm_min": w.feed_mm_min, "separates": list(w.names)} for w in self.wanted
            ],
        }  # fmt: skip


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
        measurements: measurements with instrument ball_bar on one machine.
        model: one of [BB]'s models, or "auto": the choice of its section 6.
        window_deg: the fit does not use readings nearer than this to a quadrant; if a cause beyond [BB]'s parameters is
            significant, it uses them with a noise of their own.
        centre: "shared" if the table-side ball stays in place from test to test, else "each".
        orders: number of harmonics.
        dynamic: test causes beyond [BB]'s parameters.
        phase: whether the servo phase is one angle in all tests or one time; it matters where feed over radius differs.

    Raises:
        MeasurementError: instruments, planes or machines differ, or there are too few readings.
    """
    with one_blas_thread():
        guides = (False, True) if model == "auto" else (model == "non-linear",)
        servo = servo_phase(circles_of(measurements), phase, guides, window_deg, centre, dynamic=dynamic)
        return _diagnose(servo, model, window_deg, centre, orders, dynamic)


def _diagnose(
    phase: PhaseChoice, model: Choice, window_deg: float, centre: Centre, orders: int, dynamic: bool
) -> BallBarDiagnosis:
    commanded = phase.circles
    still = fit(commanded, bent=False, window_deg=window_deg, centre=centre)
    lag = loop_lag(commanded, still, window_deg, centre) if dynamic else LoopLag(commanded, 0.0, 0.0)
    circles = lag.circles
    if dynamic:
        found = search(circles, still, window_deg, centre, lag.unsure_s)
    else:
        found = CausesFound(left_out=tuple(x for x in table_of(circles, centre).left_out if x.candidate.like))
    fitted, reason = chosen(circles, model, window_deg, centre, found.beyond)
    changed: tuple[Shift, ...] = ()
    if not phase.decided:
        others = tuple(replace(c, phase_rate=p.phase_rate) for c, p in zip(circles, phase.other, strict=True))
        other, why = chosen(others, model, window_deg, centre, found.beyond)
        if other.model != fitted.model:
            # The two phases may disagree about a bend: both fits then have bent guides.
            reason = reason if fitted.model == "non-linear" else why
            fitted, other = (
                f if f.model == "non-linear" else chosen(of, "non-linear", window_deg, centre, found.beyond)[0]
                for f, of in ((fitted, circles), (other, others))
            )
        angle, time = (fitted, other) if phase.taken == "angle" else (other, fitted)
        changed, fitted = shifts(angle, time), either(fitted, other)
    for instead in found.instead:
        fitted = either(fitted, chosen(circles, fitted.model, window_deg, centre, instead)[0])
    curved = tuple(x.candidate.axis for x in found.left_out if x.candidate.like in x.twins)
    if curved and fitted.model == "non-linear":
        # What is the same in every reading differs in centre and perpendicularity.
        other = fit(
            circles, bent=True, window_deg=window_deg, centre=centre, beyond=replace(found.beyond, curved=curved)
        )
        fitted = either(fitted, other)
    fitted = _with_twins(fitted, found)
    bb = chosen(circles, model, window_deg, centre, Beyond())[0] if found.beyond.picks else fitted
    near = sum(int(c.near_quadrant(window_deg).sum()) for c in circles) / sum(len(c) for c in circles)
    return BallBarDiagnosis(
        circles=commanded,
        rounds=tuple(roundness(c) for c in commanded),
        pairs=both_ways(commanded),
        fitted=fitted,
        reason=reason,
        shares=_shares(circles, fitted),
        spectra=tuple(_spectrum(c, fitted.fitted_um(i), orders) for i, c in enumerate(commanded)),
        explained=_explained(circles, fitted, fitted),
        explained_bb=_explained(circles, bb, fitted),
        window_deg=window_deg,
        near_quadrants=near,
        found=found,
        centre=centre,
        dynamic=dynamic,
        phase=phase,
        changed=changed,
        lag_s=lag.time_s,
        doubts=doubts_of(circles, fitted, window_deg, centre),
    )


def _with_twins(fitted: Fitted, found: CausesFound) -> Fitted:
    """The fit with, at each parameter, the causes from which these tests do not separate it."""
    twins: dict[str, list[str]] = {}
    for other in found.left_out:
        for name in other.twins:
            twins.setdefault(name, []).append(other.candidate.name)
    values = (replace(v, with_=tuple(dict.fromkeys([*v.with_, *twins.get(v.name, ())]))) for v in fitted.values)
    combinations = (
        replace(v, with_=tuple(x.candidate.name for x in found.left_out if x.goes_into(dict(v.terms))))
        for v in fitted.combinations
    )
    return replace(fitted, values=tuple(values), combinations=tuple(combinations))


def _shares(circles: Sequence[CircleTest], fitted: Fitted) -> tuple[Share, ...]:
    curves = {group: of for group, of in fitted.parts_um.items() if group != SETTING_UP}
    power = {group: sum(float(np.sum((c - c.mean()) ** 2)) for c in of) for group, of in curves.items()}
    whole, explained = sum(power.values()) or 1.0, min(max(_explained(circles, fitted, fitted), 0.0), 1.0)
    out = [
        Share(group, max(_g(c, curve) for c, curve in zip(circles, of, strict=True)), explained * power[group] / whole)
        for group, of in curves.items()
    ]
    residual = max(_g(c, left) for c, left in zip(circles, fitted.left_um, strict=True))
    out.append(Share(RESIDUAL, residual, 1.0 - sum(s.share for s in out)))
    return tuple(sorted(out, key=lambda s: -s.g_um))


def _g(circle: CircleTest, curve: Floats) -> float:
    return float(np.ptp(least_squares_circle(circle.angle_rad, curve)[3]))


def _spectrum(circle: CircleTest, fitted: Floats, orders: int) -> Spectrum:
    if not circle.full:
        return Spectrum(circle.name, (), ())
    return Spectrum(
        circle.name, harmonics(circle.angle_rad, circle.reading_um, orders), harmonics(circle.angle_rad, fitted, orders)
    )


def _explained(circles: Sequence[CircleTest], fitted: Fitted, best: Fitted) -> float:
    """Share of the variance that one fit explains; the set-up's part is always that of the best fit."""
    rest, whole = 0.0, 0.0
    for i, circle in enumerate(circles):
        machine_um = circle.reading_um - best.parts_um.get(SETTING_UP, (np.zeros(len(circle)),) * len(circles))[i]
        rest += float(np.sum((fitted.left_um[i] - fitted.left_um[i].mean()) ** 2))
        whole += float(np.sum((machine_um - machine_um.mean()) ** 2))
    return 1.0 - rest / whole if whole > 0 else 0.0

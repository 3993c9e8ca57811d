"""Joint least-squares fit of causes to several ball-bar tests, with the exact length of the bar.

The fit gives each parameter with its standard error, its interval, and a note on its meaning.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from rtec.arrays import Bools, Floats
from rtec.errors import MeasurementError
from rtec.metrology.ball_bar.beyond import HALF_WAYS, WIDTH, ExtraCause
from rtec.metrology.ball_bar.causes import ALIKE_FEED, At, Cause, if_it_turns, same_feed
from rtec.metrology.ball_bar.circle import CircleTest
from rtec.metrology.ball_bar.design import (
    SETTING_UP,
    BarDesign,
    Centre,
    Rank,
    design_of,
    determined,
    stacked_design,
    unseen_of,
)
from rtec.metrology.ball_bar.noise import NOISE_UM, WHITE, AngleNoise
from rtec.metrology.procedures.fitting import correlation_time
from rtec.wording import significant

Number = tuple[float, float]
"""A value and its standard error."""
UNKNOWN: Number = (float("nan"), float("nan"))


@dataclass(frozen=True)
class FittedValue:
    """A fitted parameter.

    Attributes:
        name, title, unit, group: as `Cause`.
        value: NaN where it is not determined.
        se: standard error.
        low, high: 95 % confidence interval.
        with_: parameters from which it is not separated: then it is not determined alone, or its value includes causes
            that cannot be distinguished from it at one feed.
        note: its meaning in words, such as its size at the feeds of the tests.
        terms: names and factors of a combination of parameters, where only this combination is determined.
    """

    name: str
    title: str
    unit: str
    group: str
    value: float
    se: float
    low: float
    high: float
    with_: tuple[str, ...] = ()
    note: str = ""
    terms: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class OfHeight:
    """Parameters that are confounded with the height of the table ball.

    Attributes:
        names: names of the parameters.
        height_um: change of the height that gives the fitted readings of these parameters, as far as a height can.
        known_um: standard uncertainty of the height.
    """

    names: tuple[str, ...]
    height_um: float
    known_um: float


def of_cause(cause: Cause, number: Number | None, wide: float, rank: Rank, note: str = "") -> FittedValue:
    """The size of one cause as a parameter.

    Args:
        cause: the cause.
        number: value and standard error; None where it was not fitted.
        wide: standard errors in half of a 95 % interval.
        rank: has the parameters from which it is not separated.
        note: its meaning in words.
    """
    together = tuple(n for group in rank.confounded if cause.name in group for n in group if n != cause.name)
    return _value((cause.name, cause.title, cause.unit, cause.group), number or UNKNOWN, wide, together, note)


def of_wave(candidate: ExtraCause, sine: Number, cosine: Number, wide: float) -> tuple[FittedValue, FittedValue]:
    """Amplitude and phase of a wave."""
    (s, es), (c, ec) = sine, cosine
    size = float(np.hypot(s, c))
    se = float(np.hypot(s * es, c * ec) / size) if size > 0 else float(np.hypot(es, ec))
    turn_se = float(np.rad2deg(np.hypot(c * es, s * ec)) / size**2) if size > 0 else float("nan")
    phase = float(np.rad2deg(np.arctan2(c, s)))
    note = f"one wave every {candidate.wave_mm:g} mm"
    if candidate.effect == "coupling_misalignment":
        # [BB 22]: amplitude p γ² / 8π.
        gamma = np.rad2deg(np.sqrt(8.0 * np.pi * size * 1e-3 / (2.0 * candidate.wave_mm)))
        note += f"; as of shafts {gamma:.1f}° out of line [BB 22]"
    name, title, group = candidate.name, candidate.title, candidate.group
    return (
        _value((f"{name}_amplitude", f"{title}, amplitude", "um", group), (size, se), wide, (), note),
        _value((f"{name}_phase", f"{title}, phase at position 0", "deg", group), (phase, turn_se), wide, (), ""),
    )


def of_width(
    candidate: ExtraCause, way_mm: float, way_se: float, circles: Sequence[CircleTest], wide: float
) -> FittedValue:
    """Width of a spike at half its height, as travel of the axis; the note has it as an angle and as a time."""
    words = {}
    for c in circles:
        if candidate.feed_mm_min and not same_feed(c.setup.feed_mm_min, candidate.feed_mm_min, ALIKE_FEED):
            continue
        ends = [np.arccos(max(1.0 - u * way_mm / c.setup.radius_mm, -1.0)) for u in HALF_WAYS]
        angle = float(ends[1] - ends[0])
        words[c.name] = f"{np.rad2deg(angle):.1f}°, {1e3 * angle / c.omega_rad_s:.0f} ms"
    called = (f"{candidate.name}_width", f"{candidate.title}, width at half height", "mm", candidate.group)
    return _value(called, (WIDTH * way_mm, WIDTH * way_se), wide, (), _by_test(words))


def note_of(cause: Cause, numbers: Mapping[str, Number], circles: Sequence[CircleTest]) -> str:
    """Size of a servo parameter at the feeds of the tests; direction in which a squareness inclines an axis."""
    value = numbers.get(cause.name, UNKNOWN)[0]
    if not np.isfinite(value) or value == 0.0:
        return ""
    if cause.name == "squareness" or cause.name.startswith("perpendicularity"):
        return _leans(cause, value, circles[0])
    if cause.name.startswith("yaw_"):
        place = [letter.lower() for letter in circles[0].setup.letters].index(cause.name[-1])
        other = if_it_turns(circles[0], place) * value
        return (
            "" if abs(other - value) < 0.5 * abs(value) else f"{other:+.4g} 1/km if the carriage turns with its guide"
        )
    if cause.name == "phase":
        words = {c.name: f"{significant(1e-3 * value * c.phase_rate / c.omega_rad_s)} ms" for c in circles}
    elif cause.name == "delay":
        words = {c.name: f"{significant(1e3 * value * c.omega_rad_s)} µrad" for c in circles}
    elif cause.name.startswith("gain_"):
        radius = {c.name: -value * c.omega_rad_s**2 * c.setup.radius_mm * 1e-3 for c in circles}
        words = {name: f"radius {significant(um, 2, sign=True)} µm" for name, um in radius.items()}
    else:
        return ""
    loop = ""
    if cause.name.startswith("gain_") and value > 0.0:
        # A first-order loop without feed-forward makes the circle too small by ½ τ² a, K_v = 1/τ.
        loop = f"; as of a position loop of K_v = {1e3 / np.sqrt(2.0 * value):.0f} 1/s without feed-forward"
    return _by_test(words) + loop


def _leans(cause: Cause, value: float, circle: CircleTest) -> str:
    """Direction in which a rotation inclines an axis, `ε × d`, in words: the sign of a rotation is easily misread."""
    a, b, n = circle.setup.letters
    unit = dict(zip("XYZ", np.eye(3), strict=True))
    turn = value * unit["XYZ"["ABC".index(cause.component[1])]]
    if cause.name == "squareness":
        less = float(np.cross(turn, unit[a]) @ unit[b]) > 0.0
        return f"the angle between +{a} and +{b} is {'less' if less else 'more'} than 90°"
    own = cause.name[-1].upper()
    return f"towards +{own} the line {'climbs' if float(np.cross(turn, unit[own]) @ unit[n]) > 0.0 else 'falls'} in {n}"


def _by_test(words: Mapping[str, str]) -> str:
    """The texts by test; one that is the same for all tests occurs once."""
    names: dict[str, list[str]] = {}
    for name, said in words.items():
        names.setdefault(said, []).append(name)
    return "; ".join(f"{said} in {', '.join(of)}" for said, of in names.items())


def quantile(free: float) -> float:
    """Standard errors in half of a 95 % interval."""
    from scipy.special import stdtrit

    return float(stdtrit(free, 0.975))


def _value(
    called: tuple[str, str, str, str], number: Number, wide: float, together: tuple[str, ...], note: str
) -> FittedValue:
    value, se = (float(v) for v in number)
    return FittedValue(*called, value, se, value - wide * se, value + wide * se, together, note)


ROUNDS = 3
"""Gauss-Newton steps to the exact length of the bar; a fourth does not change the result."""


AGAINST = 3.0
"""Prior against a further cause: its reduction of the sum of squares, in variances, must exceed its parameters by this
to make both models equally likely."""
USUAL_UM = 1.0
"""Typical size of a cause's curve on a circle, largest minus smallest."""
NAMED_SE = 4.0
"""A cause with more standard errors than this may be named."""
LEAST_UM = 1e-6
"""Lower bound of the noise, so that priors keep their weight when the residual is zero."""


@dataclass(frozen=True)
class Solution:
    """Coefficients of some columns of a design.

    Attributes:
        coefficients: (k,).
        covariance: (k, k), multiplied by `correlation`; includes the priors.
        sigma_um: standard deviation of the white part of the residual, away from the quadrants.
        correlation: number of consecutive readings that count as one.
        columns, residual: whitened, (n, k) and (n,).
    """

    coefficients: Floats
    covariance: Floats
    sigma_um: float
    correlation: float
    columns: Floats
    residual: Floats

    @property
    def errors(self) -> Floats:
        """Standard errors, (k,)."""
        return np.sqrt(np.diag(self.covariance))


def solve(
    design: BarDesign, kept: Sequence[int], reading_um: Floats, circles: Sequence[CircleTest], noise: AngleNoise
) -> Solution:
    """Fit columns of a design to readings.

    Args:
        design: of n readings.
        kept: places of the columns that are fitted; they must be independent.
        reading_um: readings, (n,).
        circles: tests of the readings, in their order.
        noise: shape of the noise.
    """
    prior = np.array([design.labels[i].prior for i in kept])
    # A prior is one more reading of its parameter, weighted by its uncertainty relative to the readings' noise.
    before = np.diag(1.0 / prior)[np.isfinite(prior)]

    def residual(values: Floats) -> Floats:
        made = design.columns[:, kept] @ values + design.second_order_um(kept, values)
        return noise.whiten(circles, (reading_um - made)[:, None])[:, 0]

    def spread(white: Floats) -> Number:
        sigma = float(np.sqrt(white @ white / max(len(white) - len(kept) + len(before), 1)))
        return sigma, in_a_row(white, [len(c) for c in circles])

    coefficients = np.zeros(len(kept))
    white = residual(coefficients)
    columns = noise.whiten(circles, design.columns[:, kept])
    size = np.linalg.norm(columns, axis=0)
    sigma, rows = spread(white - columns @ (np.linalg.lstsq(columns / size, white, rcond=None)[0] / size))
    for _ in range(ROUNDS):
        scale = max(sigma * np.sqrt(rows), LEAST_UM)
        whole = np.concatenate([columns, scale * before]) / size
        step = np.linalg.lstsq(whole, np.append(white, -scale * before @ coefficients), rcond=None)[0] / size
        coefficients = coefficients + step
        white = residual(coefficients)
        columns = noise.whiten(circles, design.slopes(kept, coefficients))
        size = np.linalg.norm(columns, axis=0)
        sigma, rows = spread(white)
    scale = max(sigma * np.sqrt(rows), LEAST_UM)
    triangle = np.linalg.qr(np.concatenate([columns, scale * before]) / size, mode="r")
    inverse = np.linalg.solve(triangle, np.eye(len(kept))) / size[:, None]
    return Solution(coefficients, sigma**2 * rows * inverse @ inverse.T, sigma, rows, columns, white)


def weight_of(gained: float, count: int) -> float:
    """Akaike weight of a model with further parameters, with the prior `AGAINST` it.

    Args:
        gained: its reduction of the sum of squares, in variances of the noise.
        count: number of its further parameters.
    """
    return 1.0 / (1.0 + math.exp(min(0.5 * (count + AGAINST - gained), 500.0)))


def allowing(solved: Solution, more: Sequence[Floats], circles: Sequence[CircleTest], noise: AngleNoise) -> Solution:
    """A solution that allows for causes which are not significant but possible (Bayesian model averaging).

    Each parameter is its mean over all models: no further cause, or one of these sets of causes, each with its
    probability. The covariance includes the differences between the models, so that a cause hidden by the noise does
    not make another one look too certain. All models have the same prior probability, and the prior size of a cause is
    `USUAL_UM`: where the readings would show far less, the noise can hide little.

    Args:
        solved: the solution without further causes.
        more: columns of each set, (n, m) each.
        circles, noise: see `solve`.
    """
    power = max(solved.sigma_um, LEAST_UM) ** 2 * solved.correlation
    evidence, apart, within = [0.0], [np.zeros(len(solved.coefficients))], [solved.covariance]
    for columns in more:
        range_ = np.ptp(columns, axis=0)
        if not (range_ > LEAST_UM).all():
            continue
        # In units of its usual size a cause is 0 ± 1 before the readings.
        white = noise.whiten(circles, columns * (USUAL_UM / range_))
        shift = -solved.covariance @ (solved.columns.T @ white) / power
        precision = np.eye(white.shape[1]) + white.T @ (white + solved.columns @ shift) / power
        after, slope = np.linalg.inv(precision), white.T @ solved.residual / power
        sizes = after @ slope
        evidence.append(0.5 * (float(sizes @ slope) - float(np.linalg.slogdet(precision)[1])))
        apart.append(shift @ sizes)
        within.append(solved.covariance + shift @ after @ shift.T)
    weight = np.exp(np.array(evidence) - max(evidence))
    weight /= weight.sum()
    mean = weight @ apart
    away = np.array(apart) - mean
    covariance = np.einsum("m,mij->ij", weight, within) + (away.T * weight) @ away
    return replace(solved, coefficients=solved.coefficients + mean, covariance=covariance)


def in_a_row(left: Floats, lengths: Sequence[int]) -> float:
    """Number of consecutive readings whose errors are correlated, in the worst test."""
    return max(correlation_time(part) for part in np.split(left, np.cumsum(lengths)[:-1]))


STEP = 1e-3
"""Relative change of the distance to a spike's top, for a derivative."""


@dataclass(frozen=True)
class Pick:
    """A significant cause beyond [BB]'s.

    Attributes:
        candidate: the candidate.
        way_mm: distance from the reversal to the top of a spike.
        heights_um: heights of that spike, one for each end where the axis reverses on an arc.
        chance: probability that noise alone gives as much, over all candidates together.
    """

    candidate: ExtraCause
    way_mm: float = 0.0
    heights_um: tuple[float, ...] = ()
    chance: float = 0.0


@dataclass(frozen=True)
class Beyond:
    """The causes beyond [BB]'s parameters in a fit, and its use of readings near the quadrants.

    Attributes:
        picks: the causes.
        noise: noise of the readings.
        clearance_um: clearance of both axes; readings where an axis is still crossing it are not used.
        late_s: largest time by which the axes may reach the reversal later than commanded.
        beside: causes that are not separated from a pick; without them the pick is not determined.
        dropped: tested causes that are not significant: each alone, and each pair that hide each other, as both may be
            present where neither is significant.
        curved: see `causes`.
    """

    picks: tuple[Pick, ...] = ()
    noise: AngleNoise = WHITE
    clearance_um: tuple[float, float] = (0.0, 0.0)
    late_s: float = 0.0
    beside: tuple[Cause, ...] = ()
    dropped: tuple[tuple[Cause, ...], ...] = ()
    curved: tuple[int, ...] = ()


@dataclass(frozen=True)
class Fitted:
    """A joint fit of all tests.

    Attributes:
        model: "linear" or "non-linear".
        values: every parameter of the model.
        combinations: determined combinations of the parameters that are not determined alone.
        rank: what these tests separate.
        heights: parameters that are not separated from the height of the table ball.
        parts_um: fitted reading of each group in each test at all readings of its arc, (n,) each, by group; groups that
            are not separated are one.
        left_um: residual, measured minus fitted, of each test, (n,) each.
        sigma_um: standard deviation of the residual in the readings that were used.
        used: number of those readings.
        correlation: number of consecutive readings that count as one.
        beyond: causes beyond [BB]'s parameters in the fit.
    """

    model: Literal["linear", "non-linear"]
    values: tuple[FittedValue, ...]
    combinations: tuple[FittedValue, ...]
    heights: tuple[OfHeight, ...]
    rank: Rank
    parts_um: dict[str, tuple[Floats, ...]]
    left_um: tuple[Floats, ...]
    sigma_um: float
    used: int
    correlation: float
    beyond: Beyond = Beyond()

    def value(self, name: str) -> FittedValue:
        """One parameter by its name."""
        return {v.name: v for v in self.values}[name]

    def fitted_um(self, test: int) -> Floats:
        """Fitted readings of one test, µm, (n,)."""
        return np.asarray(np.sum([p[test] for p in self.parts_um.values()], axis=0), dtype=np.float64)


def fit(
    circles: Sequence[CircleTest],
    *,
    bent: bool,
    window_deg: float,
    centre: Centre = "shared",
    beyond: Beyond | None = None,
) -> Fitted:
    """Fit one of [BB]'s two models, alone or with causes beyond it.

    Args:
        circles: tests of one plane.
        bent: the non-linear model with its 15 parameters, else the linear one with 10.
        window_deg: readings nearer than this to a quadrant are not used, unless there are causes beyond [BB]'s.
        centre: see `design_of`.
        beyond: those causes.

    Raises:
        MeasurementError: the fit would use too few readings.
    """
    beyond = beyond or Beyond()
    more = [*(c for p in beyond.picks for c in causes_of(p)), *beyond.beside]
    keep = [_used(c, window_deg, beyond) for c in circles]
    used = tuple(c.rows(k) for c, k in zip(circles, keep, strict=True))
    whole = design_of(circles, bent=bent, centre=centre, more=more, curved=beyond.curved)
    near = whole.rows(np.concatenate(keep))
    reading = np.concatenate([c.reading_um for c in used])
    kept = list(near.rank.kept)
    if len(reading) - len(kept) < len(kept):
        raise MeasurementError(
            f"{len(reading)} readings farther than {window_deg:g}° from the quadrants, for {len(kept)} parameters; "
            "take a smaller window or more readings"
        )
    solved = solve(near, kept, reading, used, beyond.noise)
    fitted = {k: (float(v), 0.0) for k, v in zip(kept, solved.coefficients, strict=True)}
    solved = allowing(solved, [stacked_design(of, used) for of in beyond.dropped], used, beyond.noise)
    numbers = {k: (float(v), float(se)) for k, v, se in zip(kept, solved.coefficients, solved.errors, strict=True)}
    wide = quantile(max(len(reading) / solved.correlation - len(kept), 1.0))
    values = _values(near, numbers, wide, circles, beyond)
    joined = _joined(near, values)
    combinations = _combinations(near, kept, solved, wide, joined)
    values = tuple(replace(v, group=joined.get(v.group, v.group)) for v in values)
    heights = _heights(near, numbers, joined)
    parts = _parts(circles, whole, fitted, joined)
    after = tuple(c.reading_um - np.sum([p[i] for p in parts.values()], axis=0) for i, c in enumerate(circles))
    return Fitted(
        "non-linear" if bent else "linear", values, combinations, heights, near.rank, parts, after, solved.sigma_um,
        len(reading), solved.correlation, beyond,
    )  # fmt: skip


def chance_of(simple: Fitted, richer: Fitted) -> float:
    """Probability that noise alone makes a model with more parameters so much better (F test)."""
    from scipy.special import fdtrc

    count, ratio = richer.rank.rank - simple.rank.rank, mean_squares(simple, richer)
    free = simple.used / richer.correlation - richer.rank.rank
    if free <= 1.0:
        return 1.0
    return float(fdtrc(count, free, max(ratio - 1.0, 0.0) * free / count))


def mean_squares(simple: Fitted, richer: Fitted) -> float:
    """Ratio of the residual sums of squares of two models of the same readings."""
    rss = [max(f.sigma_um, NOISE_UM) ** 2 * (f.used - f.rank.rank) for f in (simple, richer)]
    return rss[0] / rss[1]


def _used(circle: CircleTest, window_deg: float, beyond: Beyond) -> Bools:
    """The readings of a test that a fit uses, (n,)."""
    if not beyond.picks:
        return ~circle.near_quadrant(window_deg)
    return ~circle.taking_up(beyond.clearance_um, beyond.late_s)


def causes_of(pick: Pick) -> tuple[Cause, ...]:
    """Causes of a pick; for a spike also the change with the distance to its top."""
    of = pick.candidate.make(pick.way_mm)
    return (*of, _longer(pick)) if pick.candidate.kind == "spike" else of


def _longer(pick: Pick) -> Cause:
    """Derivative of a spike by the logarithm of the distance to its top, at the fitted heights."""
    longer, shorter = (pick.candidate.make(pick.way_mm * (1.0 + sign * STEP)) for sign in (1.0, -1.0))

    def shape(at: At) -> Floats:
        out = np.zeros(len(at.circle))
        for height, up, down in zip(pick.heights_um, longer, shorter, strict=True):
            if up.shape is not None and down.shape is not None:
                out += height * (up.shape(at) - down.shape(at)) / (2.0 * STEP)
        return out

    of = longer[0]
    return Cause(f"{pick.candidate.name}_way", "", "1", of.group, of.component, shape)


def _joined(design: BarDesign, values: Sequence[FittedValue]) -> dict[str, str]:
    """Groups that are shown as one because the readings do not separate them, each with the joint name."""
    sure = {v.name for v in values if abs(v.value) > NAMED_SE * v.se}
    out: dict[str, str] = {}
    for names in design.by_readings.confounded:
        groups = dict.fromkeys(c.group for c in design.labels if c.name in names and _of_machine(c))
        if groups and not sure & {c.name for c in design.labels if c.name in names and _of_machine(c)}:
            name = f"{' or '.join(groups)}, not separated" if len(groups) > 1 else f"{next(iter(groups))} or the set-up"
            out |= dict.fromkeys(groups, name)
    return out


def _of_machine(cause: Cause) -> bool:
    return cause.group != SETTING_UP and cause.centre is None


def _combinations(
    design: BarDesign, kept: Sequence[int], solved: Solution, wide: float, joined: Mapping[str, str]
) -> tuple[FittedValue, ...]:
    """Determined combinations of the machine's parameters in each set that the readings do not separate."""
    out = []
    for names in design.by_readings.confounded:
        places = [i for i, c in enumerate(design.labels) if c.name in names]
        of = [i for i in places if _of_machine(design.labels[i]) and design.labels[i].group in joined]
        for factors in determined(design.columns[:, places], [places.index(i) for i in of]):
            terms = [(design.labels[i], float(f"{f:.9g}")) for i, f in zip(of, factors, strict=True) if f != 0.0]
            if len(terms) < 2:
                continue
            row = np.zeros(len(kept))
            for cause, factor in terms:
                place = design.labels.index(cause)
                if place in kept:
                    row[kept.index(place)] = factor
            value, se = float(row @ solved.coefficients), float(np.sqrt(max(float(row @ solved.covariance @ row), 0.0)))
            first = terms[0][0]
            called = (_sum((c.name, f) for c, f in terms), _sum((c.title, f) for c, f in terms), first.unit)
            found = _value((*called, joined[first.group]), (value, se), wide, (), "")
            out.append(replace(found, terms=tuple((c.name, f) for c, f in terms)))
    return tuple(out)


def _heights(design: BarDesign, numbers: Mapping[int, Number], joined: Mapping[str, str]) -> tuple[OfHeight, ...]:
    out = []
    for names in design.by_readings.confounded:
        places = [i for i, c in enumerate(design.labels) if c.name in names]
        heights = [k for k, i in enumerate(places) if math.isfinite(design.labels[i].prior)]
        # Parameters that are already confounded with an unknown length of the bar do not count for the height.
        hidden = {n for s in design.rank.confounded for n in s}
        of = [k for k, i in enumerate(places) if design.labels[i].group in joined
              and _of_machine(design.labels[i]) and design.names[i] not in hidden]  # fmt: skip
        if not heights or not of:
            continue
        unseen = unseen_of(design.columns[:, places])
        values = np.array([numbers.get(i, UNKNOWN)[0] for i in places])[of]
        way = np.linalg.lstsq(unseen[of], np.nan_to_num(values), rcond=None)[0]
        first = heights[0]
        out.append(OfHeight(
            tuple(design.names[places[k]] for k in of), -float(unseen[first] @ way), design.labels[places[first]].prior
        ))  # fmt: skip
    return tuple(out)


def _sum(terms: Iterable[tuple[str, float]]) -> str:
    """A combination as text; the first factor is one."""
    out = ""
    for name, factor in terms:
        times = "" if abs(factor) == 1.0 else f"{abs(factor):.4g} × "
        out += f" {'-' if factor < 0.0 else '+'} {times}{name}" if out else name
    return out


def _parts(
    circles: Sequence[CircleTest], whole: BarDesign, numbers: dict[int, Number], joined: Mapping[str, str]
) -> dict[str, tuple[Floats, ...]]:
    second = whole.second_order_um(list(numbers), np.array([v for v, _ in numbers.values()]))
    ends = np.cumsum([len(c) for c in circles])[:-1]
    out: dict[str, Floats] = {SETTING_UP: second}  # a large centre offset makes nearly all of it
    for i, (value, _) in numbers.items():
        label = whole.labels[i]
        group = joined.get(label.group, label.group) if _of_machine(label) else SETTING_UP
        out[group] = out.get(group, np.zeros(len(whole.columns))) + value * whole.columns[:, i]
    return {group: tuple(np.split(curve, ends)) for group, curve in out.items()}


def _values(
    design: BarDesign, numbers: dict[int, Number], wide: float, circles: Sequence[CircleTest], beyond: Beyond
) -> tuple[FittedValue, ...]:
    rank = design.rank
    open_ = {name for names in rank.confounded for name in names}
    sure = {i: number for i, number in numbers.items() if design.names[i] not in open_}
    named = {design.names[i]: number for i, number in sure.items()}
    special = {c.name: p for p in beyond.picks if p.candidate.kind != "plain" for c in causes_of(p)}
    out = []
    for i, label in enumerate(design.labels):
        if label.name not in special:
            out.append(of_cause(label, sure.get(i), wide, rank, note_of(label, named, circles)))
    for pick in beyond.picks:
        of = [named.get(c.name, UNKNOWN) for c in causes_of(pick)]
        if pick.candidate.kind == "wave":
            out += of_wave(pick.candidate, of[0], of[1], wide)
        elif pick.candidate.kind == "spike":
            out += [of_cause(c, n, wide, rank) for c, n in zip(pick.candidate.make(pick.way_mm), of, strict=False)]
            change, se = of[-1]
            way = pick.way_mm * float(np.exp(change))
            out.append(of_width(pick.candidate, way, way * se, circles, wide))
    return tuple(out)

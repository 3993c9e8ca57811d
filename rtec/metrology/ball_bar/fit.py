"""Least-squares fit of causes to several ball-bar tests at once, to the exact length of the bar.

The fit gives each parameter with its standard error and interval, and what it comes to in words.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

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
from rtec.metrology.ball_bar.noise import WHITE, AngleNoise
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
        with_: parameters that it is not separated from: by itself it is then not determined, or its value is what it
            does together with causes that one feed does not show.
        note: what it comes to, in words.
        terms: of a combination of parameters, the only thing that is determined of them: names and factors.
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
    """Parameters that a height of the table ball takes the place of.

    Attributes:
        names: of the parameters.
        height_um: a ball that is so much higher makes what is fitted of them, as far as a height can.
        known_um: standard uncertainty of the height.
    """

    names: tuple[str, ...]
    height_um: float
    known_um: float


def of_cause(cause: Cause, number: Number | None, wide: float, rank: Rank, note: str = "") -> FittedValue:
    """A parameter that is one cause's size.

    Args:
        cause: which.
        number: value and standard error; None where it was not fitted.
        wide: standard errors in half of a 95 % interval.
        rank: tells what it is not separated from.
        note: in words.
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
    """Width of a spike at half its height, on the axis' way; the note has it as an angle and as a time."""
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
    """What a servo's parameter comes to at the feeds of the tests; which way a squareness leans."""
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
        # A loop of first order without feed-forward is ½ τ² a short, K_v = 1/τ.
        loop = f"; as of a position loop of K_v = {1e3 / np.sqrt(2.0 * value):.0f} 1/s without feed-forward"
    return _by_test(words) + loop


def _leans(cause: Cause, value: float, circle: CircleTest) -> str:
    """Which way an axis leans that is turned so: `ε × d`; the sign of a turn alone says it to nobody."""
    a, b, n = circle.setup.letters
    unit = dict(zip("XYZ", np.eye(3), strict=True))
    turn = value * unit["XYZ"["ABC".index(cause.component[1])]]
    if cause.name == "squareness":
        less = float(np.cross(turn, unit[a]) @ unit[b]) > 0.0
        return f"the angle between +{a} and +{b} is {'less' if less else 'more'} than 90°"
    own = cause.name[-1].upper()
    return f"towards +{own} the line {'climbs' if float(np.cross(turn, unit[own]) @ unit[n]) > 0.0 else 'falls'} in {n}"


def _by_test(words: Mapping[str, str]) -> str:
    """What was said of each test, the same words once."""
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


Floats = NDArray[np.float64]
ROUNDS = 3
"""Steps to the exact length of the bar, each along the slopes where the last one ended; a fourth changes nothing."""


AGAINST = 3.0
"""A further cause has to lessen the sum of squares by so many variances more than its parameters to be as likely."""
USUAL_UM = 1.0
"""A cause that is there makes about so much of a circle, largest minus smallest."""
NAMED_SE = 4.0
"""A cause of so many standard errors may be named by itself."""
LEAST_UM = 1e-6
"""Noise below this is none; what is known before the readings then still counts."""


@dataclass(frozen=True)
class Solution:
    """Coefficients of some columns of a design.

    Attributes:
        found: (k,).
        covariance: (k, k), widened by `correlation`; with what was known before the readings.
        sigma_um: standard deviation of the white part of what is left, away from the quadrants.
        correlation: so many readings in a row count as one.
        columns, residual: made white, (n, k) and (n,).
    """

    found: Floats
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
        reading_um: (n,).
        circles: tests that they are of, in their order.
        noise: its shape.
    """
    prior = np.array([design.labels[i].prior for i in kept])
    # What is known before is one more reading of that parameter, as sure as it is against the readings' noise.
    before = np.diag(1.0 / prior)[np.isfinite(prior)]

    def residual(values: Floats) -> Floats:
        made = design.columns[:, kept] @ values + design.second_order_um(kept, values)
        return noise.whiten(circles, (reading_um - made)[:, None])[:, 0]

    def spread(left: Floats) -> Number:
        sigma = float(np.sqrt(left @ left / max(len(left) - len(kept) + len(before), 1)))
        return sigma, in_a_row(left, [len(c) for c in circles])

    found = np.zeros(len(kept))
    left = residual(found)
    columns = noise.whiten(circles, design.columns[:, kept])
    size = np.linalg.norm(columns, axis=0)
    sigma, rows = spread(left - columns @ (np.linalg.lstsq(columns / size, left, rcond=None)[0] / size))
    for _ in range(ROUNDS):
        scale = max(sigma * np.sqrt(rows), LEAST_UM)
        whole = np.concatenate([columns, scale * before]) / size
        step = np.linalg.lstsq(whole, np.append(left, -scale * before @ found), rcond=None)[0] / size
        found = found + step
        left = residual(found)
        columns = noise.whiten(circles, design.slopes(kept, found))
        size = np.linalg.norm(columns, axis=0)
        sigma, rows = spread(left)
    scale = max(sigma * np.sqrt(rows), LEAST_UM)
    triangle = np.linalg.qr(np.concatenate([columns, scale * before]) / size, mode="r")
    inverse = np.linalg.solve(triangle, np.eye(len(kept))) / size[:, None]
    return Solution(found, sigma**2 * rows * inverse @ inverse.T, sigma, rows, columns, left)


def weight_of(gained: float, count: int) -> float:
    """Weight of a model with so many parameters more: Akaike's, at odds that speak against it beforehand.

    Args:
        gained: by how many variances of the noise it lessens the sum of squares.
        count: of its further parameters.
    """
    return 1.0 / (1.0 + math.exp(min(0.5 * (count + AGAINST - gained), 500.0)))


def allowing(solved: Solution, more: Sequence[Floats], circles: Sequence[CircleTest], noise: AngleNoise) -> Solution:
    """A solution that allows for causes which are not beyond chance and may be there all the same.

    Each parameter is its mean over all that may be: nothing further, or one of these sets of causes, each with its
    probability; the covariance holds how far they are apart. What noise hides of one cause then does not make another
    one surer than it is. Before the readings all are at even odds, and a cause that is there makes about `USUAL_UM` of
    a circle: where the readings would show far less, there is little that noise can hide.

    Args:
        solved: with nothing further.
        more: columns of each set, (n, m) each.
        circles, noise: see `solve`.
    """
    power = max(solved.sigma_um, LEAST_UM) ** 2 * solved.correlation
    evidence, apart, within = [0.0], [np.zeros(len(solved.found))], [solved.covariance]
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
    return replace(solved, found=solved.found + mean, covariance=covariance)


def in_a_row(left: Floats, lengths: Sequence[int]) -> float:
    """How many readings in a row err together, in the test where that is worst."""
    return max(correlation_time(part) for part in np.split(left, np.cumsum(lengths)[:-1]))


STEP = 1e-3
"""Share by which the way to a spike's top is changed to see what that does."""


@dataclass(frozen=True)
class Pick:
    """A cause beyond [BB]'s that the readings show.

    Attributes:
        candidate: which.
        way_mm: from the reversal to the top, where it is a spike.
        heights_um: of that spike at each end where the axis turns round on an arc.
        chance: how often noise alone would make as much of it, all that was looked for taken together.
    """

    candidate: ExtraCause
    way_mm: float = 0.0
    heights_um: tuple[float, ...] = ()
    chance: float = 0.0


@dataclass(frozen=True)
class Beyond:
    """What is fitted beyond [BB]'s parameters, and how readings near the quadrants are then used.

    Attributes:
        picks: the causes.
        noise: of the readings.
        clearance_um: of both axes; readings where an axis still crosses it are not used.
        late_s: it may do so by so much later.
        beside: causes that are not separated from a pick: nothing of the pick is determined without them.
        dropped: causes that were looked for and are not beyond chance, each by itself, and every two that hide each
            other: both may be there where neither shows.
    """

    picks: tuple[Pick, ...] = ()
    noise: AngleNoise = WHITE
    clearance_um: tuple[float, float] = (0.0, 0.0)
    late_s: float = 0.0
    beside: tuple[Cause, ...] = ()
    dropped: tuple[tuple[Cause, ...], ...] = ()


@dataclass(frozen=True)
class Fitted:
    """A fit of all tests together.

    Attributes:
        model: "linear" or "non-linear".
        values: every parameter that was asked for.
        combinations: of those that are not determined one by one.
        rank: what these tests separate.
        heights: where the height of the table ball and parameters are not separated.
        parts_um: by group, the fitted reading of each test at all readings of its arc, (n,) each; groups that are not
            separated are one.
        left_um: measured minus fitted, likewise.
        sigma_um: standard deviation of the residual in the readings that were used.
        used: number of those.
        correlation: so many of them count as one.
        beyond: what is fitted beyond [BB]'s parameters.
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
        """Everything fitted in one test, (n,)."""
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
        window_deg: readings nearer than this to a quadrant are not used; with causes beyond [BB]'s they are.
        centre: see `design_of`.
        beyond: those causes.

    Raises:
        MeasurementError: too few readings are left.
    """
    beyond = beyond or Beyond()
    more = [*(c for p in beyond.picks for c in causes_of(p)), *beyond.beside]
    keep = [_used(c, window_deg, beyond) for c in circles]
    used = tuple(c.rows(k) for c, k in zip(circles, keep, strict=True))
    whole = design_of(circles, bent=bent, centre=centre, more=more)
    near = whole.rows(np.concatenate(keep))
    reading = np.concatenate([c.reading_um for c in used])
    kept = list(near.rank.kept)
    if len(reading) - len(kept) < len(kept):
        raise MeasurementError(
            f"{len(reading)} readings farther than {window_deg:g}° from the quadrants, for {len(kept)} parameters; "
            "take a smaller window or more readings"
        )
    solved = solve(near, kept, reading, used, beyond.noise)
    fitted = {k: (float(v), 0.0) for k, v in zip(kept, solved.found, strict=True)}
    solved = allowing(solved, [stacked_design(of, used) for of in beyond.dropped], used, beyond.noise)
    numbers = {k: (float(v), float(se)) for k, v, se in zip(kept, solved.found, solved.errors, strict=True)}
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


def _used(circle: CircleTest, window_deg: float, beyond: Beyond) -> NDArray[np.bool_]:
    """The readings of a test that a fit uses, (n,)."""
    if not beyond.picks:
        return ~circle.near_quadrant(window_deg)
    return ~circle.taking_up(beyond.clearance_um, beyond.late_s)


def causes_of(pick: Pick) -> tuple[Cause, ...]:
    """Causes of a pick; of a spike also what a longer way to its top does."""
    of = pick.candidate.make(pick.way_mm)
    return (*of, _longer(pick)) if pick.candidate.kind == "spike" else of


def _longer(pick: Pick) -> Cause:
    """A spike's change with the logarithm of its way, at the heights that were found."""
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
    """Groups that are shown as one because the readings do not separate them, each with the name of them all."""
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
    """What is determined of the machine's parameters in each set that the readings do not separate."""
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
            value, se = float(row @ solved.found), float(np.sqrt(max(float(row @ solved.covariance @ row), 0.0)))
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
        # What a bar of unknown length hides is not there for the height to hide.
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
    """A combination as it is written; the first factor is one."""
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

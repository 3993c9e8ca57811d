"""Least-squares fit of causes to several ball-bar tests at once, to the exact length of the bar.

Least squares of several ball-bar tests to the exact length of the bar, and how sure it is.

Noise of ball-bar readings: white, and a part that wanders along the circle; and readings made white by it.

    reading = signal + w + g        w independent from reading to reading, variance 1 (over `near`² at the quadrants)
    g along the way ζ:              Ornstein-Uhlenbeck, variance d, forgets within τ: cov = d exp(-|Δζ| / τ)

A Kalman filter's innovations over their standard deviations are the readings made white, in one pass. d and τ are
those of the largest restricted likelihood, with everything that is looked for in the mean: what a fit of forty
parameters has swallowed of a slow noise is accounted for, which the correlation of what is left would not show.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtec.errors import MeasurementError
from rtec.jit import njit
from rtec.metrology.ball_bar.beyond import Candidate
from rtec.metrology.ball_bar.causes import At, Cause
from rtec.metrology.ball_bar.circle import Circle
from rtec.metrology.ball_bar.design import SETTING_UP, Centre, Design, design_of
from rtec.metrology.ball_bar.rank import Rank, rank_of
from rtec.metrology.ball_bar.values import UNKNOWN, Number, Value, note_of, of_cause, of_wave, of_width, quantile
from rtec.metrology.procedures.fitting import correlation_time, unit_errors

Floats = NDArray[np.float64]
SHARES = (0.1, 1.0, 10.0)
WAYS_RAD = (0.05, 0.2, 0.8, 3.0)
"""Where the search for d and τ begins."""
LOWEST, HIGHEST = np.log([1e-3, 0.01]), np.log([1e3, 6.0])
STEPS = 24
LIKELY = 4.0
"""Minus twice the logarithm of the likelihood: a noise that is worse by less than this may be the true one."""


@dataclass(frozen=True)
class Noise:
    """Shape of the noise; its size is left open.

    Attributes:
        share: d, variance of the part that wanders over that of the white one.
        way_rad: τ.
        near: at the quadrants the white part is so much smaller than elsewhere: 1, or less where it is larger.
        window_deg: how far the quadrants reach.
    """

    share: float = 0.0
    way_rad: float = 1.0
    near: float = 1.0
    window_deg: float = 5.0

    def whiten(self, circles: Sequence[Circle], columns: Floats) -> Floats:
        """Columns over all readings of the tests, (n, p), made white, (n, p)."""
        return self._filter(circles, columns)[0]

    def _filter(self, circles: Sequence[Circle], columns: Floats) -> tuple[Floats, float]:
        out = np.ascontiguousarray(columns, dtype=np.float64).copy()
        white = np.concatenate([np.where(c.near_quadrant(self.window_deg), self.near**-2.0, 1.0) for c in circles])
        return out, float(_whiten(out, _apart_rad(circles), white, self.share, self.way_rad))

    def cost(self, circles: Sequence[Circle], columns: Floats, reading: Floats) -> float:
        """Minus twice the restricted likelihood, less what is the same for all noises."""
        both, log_det = self._filter(circles, np.concatenate([columns, reading[:, None]], axis=1))
        size = np.linalg.norm(both[:, :-1], axis=0)
        normal = (both[:, :-1] / size).T @ (both / np.append(size, 1.0))
        lower = np.linalg.cholesky(normal[:, :-1])
        made = np.linalg.solve(lower, normal[:, -1])
        left = max(float(both[:, -1] @ both[:, -1] - made @ made), 1e-300)
        free = float(len(reading) - columns.shape[1])
        return log_det + 2.0 * float(np.log(np.diag(lower) * size).sum()) + free * math.log(left / free)


WHITE = Noise()


def find_noise(
    circles: Sequence[Circle], columns: Floats, reading: Floats, near: float, window_deg: float
) -> tuple[Noise, Noise]:
    """The noise of the largest restricted likelihood, and the slowest large one that is still likely.

    A wandering noise shows only a few of its turns on a circle, so how large it is stays uncertain; what is to be more
    than chance must be so beside the second one, too.

    Args:
        circles: tests.
        columns: everything that the readings may hold, independent, (n, p).
        reading: (n,).
        near: as in `Noise`.
        window_deg: likewise.
    """
    from scipy.optimize import minimize

    plain = Noise(0.0, 1.0, near, window_deg)

    def noise(x: Floats) -> Noise:
        inside = np.exp(np.clip(x, LOWEST, HIGHEST))
        return replace(plain, share=float(inside[0]), way_rad=float(inside[1]))

    tried: list[tuple[float, Noise]] = [(plain.cost(circles, columns, reading), plain)]

    def cost(x: Floats) -> float:
        tried.append((noise(x).cost(circles, columns, reading), noise(x)))
        return tried[-1][0]

    starts = [np.log([share, way]) for share in SHARES for way in WAYS_RAD]
    start = min(starts, key=cost)
    minimize(cost, start, method="Nelder-Mead", options={"maxfev": STEPS, "initial_simplex": _simplex(start)})
    least, best = min(tried, key=lambda t: t[0])
    likely = [n for value, n in tried if value < least + LIKELY]
    return best, max(likely, key=lambda n: n.share * n.way_rad)


def _simplex(start: Floats) -> Floats:
    return np.asarray(start + np.diag([0.0, 1.0, 0.7])[:, 1:], dtype=np.float64)


def _apart_rad(circles: Sequence[Circle]) -> Floats:
    """Way from the reading before, (n,); infinity where a test or a run begins."""
    out = []
    for c in circles:
        apart = np.abs(np.diff(c.angle_rad, prepend=np.inf))
        out.append(np.where(np.diff(c.run, prepend=c.run[0]) != 0, np.inf, apart))
    return np.concatenate(out)


@njit
def _whiten(columns: Floats, apart: Floats, white: Floats, share: float, way: float) -> float:
    """Whiten in place, (n, p); gives log det of the covariance."""
    n, p = columns.shape
    held = np.zeros(p)
    variance, total = 0.0, 0.0
    for i in range(n):
        ratio = apart[i] / way
        decay = math.exp(-ratio) if ratio < 25.0 else 0.0
        variance = decay * decay * variance + (1.0 - decay * decay) * share
        whole = variance + white[i]
        gain, scale = variance / whole, 1.0 / math.sqrt(whole)
        variance *= white[i] / whole
        total += math.log(whole)
        for j in range(p):
            before = decay * held[j]
            fresh = columns[i, j] - before
            held[j] = before + gain * fresh
            columns[i, j] = fresh * scale
    return total


ROUNDS = 3
"""Linear fits in a row, each with the second order that the one before has found; a third changes nothing any more."""


@dataclass(frozen=True)
class Solution:
    """Coefficients of some columns of a design.

    Attributes:
        found: (k,).
        errors: standard errors, (k,), widened by `correlation`.
        sigma_um: standard deviation of the white part of what is left, away from the quadrants.
        correlation: so many readings in a row count as one.
    """

    found: Floats
    errors: Floats
    sigma_um: float
    correlation: float


def solve(design: Design, kept: Sequence[int], reading_um: Floats, circles: Sequence[Circle], noise: Noise) -> Solution:
    """Fit columns of a design to readings.

    Args:
        design: of n readings.
        kept: places of the columns that are fitted; they must be independent.
        reading_um: (n,).
        circles: tests that they are of, in their order.
        noise: its shape.
    """
    columns = noise.whiten(circles, design.columns[:, kept])
    size = np.linalg.norm(columns, axis=0)
    found = np.zeros(len(kept))
    for _ in range(ROUNDS):
        first_order = noise.whiten(circles, (reading_um - design.second_order_um(kept, found))[:, None])[:, 0]
        found = np.linalg.lstsq(columns / size, first_order, rcond=None)[0] / size
    left = first_order - columns @ found
    sigma = float(np.sqrt(left @ left / max(len(left) - len(kept), 1)))
    rows = in_a_row(left, [len(c) for c in circles])
    return Solution(found, sigma * np.sqrt(rows) * unit_errors(columns), sigma, rows)


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

    candidate: Candidate
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
    """

    picks: tuple[Pick, ...] = ()
    noise: Noise = WHITE
    clearance_um: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Fitted:
    """A fit of all tests together.

    Attributes:
        model: "linear" or "non-linear".
        values: every parameter that was asked for.
        rank: what these tests separate.
        parts_um: by group, the fitted reading of each test at all readings of its arc, (n,) each.
        left_um: measured minus fitted, likewise.
        sigma_um: standard deviation of what is left in the readings that were used.
        used: number of those.
        correlation: so many of them count as one.
        beyond: what is fitted beyond [BB]'s parameters.
    """

    model: str
    values: tuple[Value, ...]
    rank: Rank
    parts_um: dict[str, tuple[Floats, ...]]
    left_um: tuple[Floats, ...]
    sigma_um: float
    used: int
    correlation: float
    beyond: Beyond = Beyond()

    def value(self, name: str) -> Value:
        """One parameter by its name."""
        return {v.name: v for v in self.values}[name]

    def fitted_um(self, test: int) -> Floats:
        """Everything fitted in one test, (n,)."""
        return np.asarray(np.sum([p[test] for p in self.parts_um.values()], axis=0), dtype=np.float64)


def fit(
    circles: Sequence[Circle], *, bent: bool, window_deg: float, centre: Centre = "shared", beyond: Beyond | None = None
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
    more = [c for p in beyond.picks for c in causes_of(p)]
    used = used_rows(circles, window_deg, beyond)
    near = design_of(used, bent=bent, centre=centre, more=more)
    reading = np.concatenate([c.reading_um for c in used])
    rank = rank_of(near.columns, [c.name for c in near.labels])
    kept = list(rank.kept)
    if len(reading) - len(kept) < len(kept):
        raise MeasurementError(
            f"{len(reading)} readings farther than {window_deg:g}° from the quadrants, for {len(kept)} parameters; "
            "take a smaller window or more readings"
        )
    solved = solve(near, kept, reading, used, beyond.noise)
    numbers = {k: (float(v), float(se)) for k, v, se in zip(kept, solved.found, solved.errors, strict=True)}
    wide = quantile(max(len(reading) / solved.correlation - len(kept), 1.0))
    whole = design_of(circles, bent=bent, centre=centre, more=more)
    parts = _parts(circles, whole, numbers)
    after = tuple(c.reading_um - np.sum([p[i] for p in parts.values()], axis=0) for i, c in enumerate(circles))
    values = _values(near, numbers, wide, rank, circles, beyond)
    name = "non-linear" if bent else "linear"
    return Fitted(name, values, rank, parts, after, solved.sigma_um, len(reading), solved.correlation, beyond)


def used_rows(circles: Sequence[Circle], window_deg: float, beyond: Beyond) -> tuple[Circle, ...]:
    """The readings that a fit uses."""
    if not beyond.picks:
        return tuple(c.rows(~c.near_quadrant(window_deg)) for c in circles)
    return tuple(c.rows(~c.taking_up(beyond.clearance_um)) for c in circles)


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


def _parts(circles: Sequence[Circle], whole: Design, numbers: dict[int, Number]) -> dict[str, tuple[Floats, ...]]:
    second = whole.second_order_um(list(numbers), np.array([v for v, _ in numbers.values()]))
    ends = np.cumsum([len(c) for c in circles])[:-1]
    out: dict[str, Floats] = {SETTING_UP: second}  # a large centre offset makes nearly all of it
    for i, (value, _) in numbers.items():
        group = SETTING_UP if whole.labels[i].centre is not None else whole.labels[i].group
        out[group] = out.get(group, np.zeros(len(whole.columns))) + value * whole.columns[:, i]
    return {group: tuple(np.split(curve, ends)) for group, curve in out.items()}


def _values(
    design: Design, numbers: dict[int, Number], wide: float, rank: Rank, circles: Sequence[Circle], beyond: Beyond
) -> tuple[Value, ...]:
    named = {design.labels[i].name: number for i, number in numbers.items()}
    special = {c.name: p for p in beyond.picks if p.candidate.kind != "plain" for c in causes_of(p)}
    out = []
    for i, label in enumerate(design.labels):
        if label.name not in special:
            out.append(of_cause(label, numbers.get(i), wide, rank, note_of(label, named, circles)))
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

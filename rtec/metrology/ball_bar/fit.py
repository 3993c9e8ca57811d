"""Least-squares fit of causes to several ball-bar tests at once, to the exact length of the bar."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.errors import MeasurementError
from rtec.metrology.ball_bar.ball_bar_noise import WHITE, Noise
from rtec.metrology.ball_bar.ball_bar_solve import solve
from rtec.metrology.ball_bar.beyond import Candidate
from rtec.metrology.ball_bar.causes import At, Cause
from rtec.metrology.ball_bar.circle import Circle
from rtec.metrology.ball_bar.design import SETTING_UP, Centre, Design, design_of
from rtec.metrology.ball_bar.rank import Rank, rank_of
from rtec.metrology.ball_bar.values import UNKNOWN, Number, Value, note_of, of_cause, of_wave, of_width, quantile

Floats = NDArray[np.float64]
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

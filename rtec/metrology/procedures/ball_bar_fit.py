"""Least-squares fit of [BB]'s causes to several ball-bar tests at once, to the exact length of the bar."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.errors import MeasurementError
from rtec.metrology.procedures.ball_bar_causes import Cause
from rtec.metrology.procedures.ball_bar_circle import Circle
from rtec.metrology.procedures.ball_bar_design import SETTING_UP, Centre, design_of
from rtec.metrology.procedures.ball_bar_rank import Rank, rank_of
from rtec.metrology.procedures.fitting import correlation_time, unit_errors

Floats = NDArray[np.float64]
ROUNDS = 3
"""Linear fits in a row, each with the second order that the one before has found; a third changes nothing any more."""


@dataclass(frozen=True)
class Value:
    """A fitted parameter.

    Attributes:
        name, title, unit, group: as `Cause`.
        value: NaN where it cannot be found.
        se: standard error.
        low, high: 95 % confidence interval.
        with_: parameters that it cannot be separated from; the value is then what they do together.
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
    """

    model: str
    values: tuple[Value, ...]
    rank: Rank
    parts_um: dict[str, tuple[Floats, ...]]
    left_um: tuple[Floats, ...]
    sigma_um: float
    used: int
    correlation: float

    def value(self, name: str) -> Value:
        """One parameter by its name."""
        return {v.name: v for v in self.values}[name]

    def fitted_um(self, test: int) -> Floats:
        """Everything fitted in one test, (n,)."""
        return np.asarray(np.sum([p[test] for p in self.parts_um.values()], axis=0), dtype=np.float64)


def fit(circles: Sequence[Circle], *, bent: bool, window_deg: float, centre: Centre = "shared") -> Fitted:
    """Fit one of [BB]'s two models.

    Args:
        circles: tests of one plane.
        bent: the non-linear model with its 15 parameters, else the linear one with 10.
        window_deg: readings nearer than this to a quadrant are not used.
        centre: see `design_of`.

    Raises:
        MeasurementError: too few readings are left.
    """
    used = [c.rows(~c.near_quadrant(window_deg)) for c in circles]
    near = design_of(used, bent=bent, centre=centre)
    reading = np.concatenate([c.reading_um for c in used])
    rank = rank_of(near.columns, [c.name for c in near.labels])
    kept = list(rank.kept)
    free = len(reading) - len(kept)
    if free < len(kept):
        raise MeasurementError(
            f"{len(reading)} readings farther than {window_deg:g}° from the quadrants, for {len(kept)} parameters; "
            "take a smaller window or more readings"
        )
    columns = near.columns[:, kept]
    size = np.linalg.norm(columns, axis=0)
    found = np.zeros(len(kept))
    for _ in range(ROUNDS):
        first_order = reading - near.second_order_um(kept, found)
        found = np.linalg.lstsq(columns / size, first_order, rcond=None)[0] / size
    left = first_order - columns @ found
    ends = np.cumsum([len(c) for c in used])[:-1]
    rows = max(correlation_time(part) for part in np.split(left, ends))
    sigma = float(np.sqrt(left @ left / free))
    errors = sigma * np.sqrt(rows) * unit_errors(columns)
    wide = _quantile(max(len(reading) / rows - len(kept), 1.0))
    numbers = {k: (float(v), float(se)) for k, v, se in zip(kept, found, errors, strict=True)}
    values = tuple(_value(label, numbers.get(i), wide, _with(label.name, rank)) for i, label in enumerate(near.labels))
    parts = _parts(circles, bent, centre, numbers)
    after = tuple(c.reading_um - np.sum([p[i] for p in parts.values()], axis=0) for i, c in enumerate(circles))
    name = "non-linear" if bent else "linear"
    return Fitted(name, values, rank, parts, after, sigma, len(reading), rows)


def _parts(
    circles: Sequence[Circle], bent: bool, centre: Centre, numbers: dict[int, tuple[float, float]]
) -> dict[str, tuple[Floats, ...]]:
    whole = design_of(circles, bent=bent, centre=centre)
    second = whole.second_order_um(list(numbers), np.array([v for v, _ in numbers.values()]))
    ends = np.cumsum([len(c) for c in circles])[:-1]
    out: dict[str, Floats] = {SETTING_UP: second}  # a large centre offset makes nearly all of it
    for i, (value, _) in numbers.items():
        group = SETTING_UP if whole.labels[i].centre is not None else whole.labels[i].group
        out[group] = out.get(group, np.zeros(len(whole.columns))) + value * whole.columns[:, i]
    return {group: tuple(np.split(curve, ends)) for group, curve in out.items()}


def _value(label: Cause, number: tuple[float, float] | None, wide: float, together: tuple[str, ...]) -> Value:
    value, se = number or (float("nan"), float("nan"))
    return Value(
        label.name, label.title, label.unit, label.group, float(value), float(se),
        float(value - wide * se), float(value + wide * se), together,
    )  # fmt: skip


def _with(name: str, rank: Rank) -> tuple[str, ...]:
    return tuple(n for group in rank.confounded if name in group for n in group if n != name)


def _quantile(free: float) -> float:
    from scipy.special import stdtrit

    return float(stdtrit(free, 0.975))

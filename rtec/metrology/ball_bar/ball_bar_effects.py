"""Effects of the catalogue as shapes for a ball-bar test: one basis function along an axis of the plane."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.effects import Effect, State, effect_class
from rtec.errors import MeasurementError
from rtec.machine import Axis
from rtec.metrology.ball_bar.causes import At, Shape
from rtec.metrology.ball_bar.circle import Circle
from rtec.metrology.instruments.ball_bar import axis_along

Floats = NDArray[np.float64]
SAME_FEED = 1e-3
"""Feeds nearer than this share of each other are one."""
ALIKE_FEED = 0.25
"""Feeds nearer than this stick alike: those that only go with the radius are not looked at by themselves."""


def axis_of(circle: Circle, place: int) -> Axis:
    """The axis that moves along the plane's first (0) or second (1) letter.

    Raises:
        MeasurementError: none does.
    """
    letter = circle.setup.letters[place]
    axis = axis_along(circle.machine, letter)
    if axis is None:
        raise MeasurementError(f"{circle.name}: machine {circle.machine.name!r} has no axis along {letter}")
    return axis


def along(circle: Circle, name: str, place: int, towards: str = "", **more: Any) -> Effect:
    """An effect of the catalogue along the plane's first or second axis, positioning unless it moves it sideways.

    Args:
        circle: a test of the plane.
        name: of the effect.
        place: 0 or 1.
        towards: letter of the direction that it moves the ball in; empty: its own.
        more: further keys of the effect.
    """
    axis = axis_of(circle, place)
    component = f"E{towards or circle.setup.letters[place]}{axis.name}"
    table = {"effect": name, "component": component, "axis": axis.name, **more}
    return effect_class(name, "ball bar").model_validate(table)


def shape_of(
    effect: Effect,
    column: int = 0,
    *,
    gain: float = 1.0,
    theta: Mapping[str, float] | None = None,
    middle: int | None = None,
) -> Shape:
    """`gain` times one basis function of an effect.

    Args:
        effect: of `along`.
        column: which basis function.
        gain: times it.
        theta: its non-linear parameters.
        middle: 0 or 1: the position of that axis counts from the first test's centre, not from the machine's zero.
    """

    def shape(at: At) -> Floats:
        state = at.circle.state if middle is None else _counted(at, middle)
        return np.asarray(effect.basis(at.circle.machine, state, theta or {})[column] * gain, dtype=np.float64)

    return shape


def _counted(at: At, place: int) -> State:
    """The state with an axis' position as though the centre were the middle of its travel, where shapes count from."""
    axis = axis_of(at.circle, place)
    position = (at.p, at.q)[place] + 0.5 * (axis.travel_mm[0] + axis.travel_mm[1])
    state = at.circle.state
    return State(state.machine, state.time_s, {**state.channels, axis.channel: position})


def feeds_of(circles: Sequence[Circle], share: float = SAME_FEED) -> list[float]:
    """Feeds of some tests, mm/min, each once, rising; `share`: see `same_feed`."""
    out: list[float] = []
    for c in circles:
        if not any(same_feed(c.setup.feed_mm_min, f, share) for f in out):
            out.append(c.setup.feed_mm_min)
    return sorted(out)


def same_feed(one: float, other: float, share: float = SAME_FEED) -> bool:
    """Are two feeds nearer to each other than a share of them?"""
    return abs(one - other) <= share * max(abs(one), abs(other))

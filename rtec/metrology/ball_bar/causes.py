"""Causes of ball-bar readings, one parameter each, and their columns in any test.

A cause is a component error with a shape; the machine's chain and the bar's geometry turn it into a reading. Shapes and
lever arms count from the centre of the first test's circle: scale, squareness and bend are the values there, and the
centre offset does not depend on them. On a machine that carries X on Y, with the ball at the tool in the plane of Y's
guide, the columns are those of [BB Table 1]; on others the arms are the machine's own. An effect of the catalogue along
an axis of the plane gives shapes, too.

Clearance δ is symmetric, `e = -½ δ d`, so that the centre is midway between both flanks. [BB 20] counts from the flank
of motion to minus, where its table has 0: its centre offset is this one minus ½ δ. Its δ is minus the reversal value B
of ISO 230-2.

Symbols: `p`, `q` positions along the plane's first and second letter from that centre, mm; `d` direction of motion;
`ζ` angle, `s` sense.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rtec.arrays import Floats
from rtec.effects import Effect, State, effect_class
from rtec.errors import MeasurementError
from rtec.machine import Axis
from rtec.metrology.ball_bar.circle import CircleTest
from rtec.metrology.instruments.ball_bar import axis_along

UNITS = {
    "um": "µm",
    "um_per_m": "µm/m",
    "urad": "µrad",
    "per_km": "1/km",
    "urad_per_m": "µrad/m",
    "ms": "ms",
    "um_s2_per_m": "µm per m/s²",
    "um_per_m2": "µm/m²",
    "deg": "°",
    "mm": "mm",
}
"""Units of parameters, as people read them."""


@dataclass(frozen=True)
class At:
    """Positions `p`, `q` of a test's readings, mm, (n,) each, and the test."""

    circle: CircleTest
    p: Floats
    q: Floats


Shape = Callable[[At], Floats]
"""Component error for one unit of a cause, µm or µrad, (n,)."""


@dataclass(frozen=True)
class Cause:
    """One parameter.

    Attributes:
        name: short and fixed, for programs.
        title: for people.
        unit: of the parameter.
        group: causes of one group are shown as one.
        component: component error that it feeds; empty for the centre of the set-up.
        shape: that component error for one unit, µm or µrad.
        centre: 0 or 1: a centre offset along the plane's first or second letter.
        square: term with the square of the parameter, where it is as large as other second orders.
        also: further component errors that the same parameter feeds, each with its shape.
        prior: standard uncertainty about zero before any reading; infinite where nothing is known.
    """

    name: str
    title: str
    unit: str
    group: str
    component: str = ""
    shape: Shape | None = None
    centre: int | None = None
    square: Shape | None = None
    also: tuple[tuple[str, Shape], ...] = ()
    prior: float = math.inf


def causes(circle: CircleTest, *, bent: bool, curved: Collection[int] = ()) -> tuple[Cause, ...]:
    """The 10 parameters of [BB]'s linear model, or (`bent`) the 15 of the non-linear one, named for a plane.

    The perpendicularity of the first axis contains its own pitch and the roll of the axis that carries it; the
    squareness contains the yaw. [BB] shows that no ball bar separates them.

    Args:
        circle: a test of the plane.
        bent: with the guides' bends and the twist.
        curved: places (0 or 1) of axes of which a curved positioning error takes the place of the other axis' bend in
            the plane; one unit makes the same third harmonic.
    """
    machine, (a, b, n) = circle.machine, circle.setup.letters
    turns = dict(zip("XYZ", "ABC", strict=True))
    axis = {d: getattr(axis_along(machine, d), "name", "") for d in (a, b)}
    plain = (
        Cause(f"centre_{a}".lower(), f"centre offset {a}", "um", "centre offset", centre=0),
        Cause(f"centre_{b}".lower(), f"centre offset {b}", "um", "centre offset", centre=1),
        Cause(f"clearance_{a}".lower(), f"clearance (backlash) {a}", "um", f"clearance {a}", f"E{a}{axis[a]}",
              lambda at: -0.5 * at.circle.way(0)),
        Cause(f"clearance_{b}".lower(), f"clearance (backlash) {b}", "um", f"clearance {b}", f"E{b}{axis[b]}",
              lambda at: -0.5 * at.circle.way(1)),
        Cause(f"scale_{a}".lower(), f"position scale {a}", "um_per_m", f"scale {a}", f"E{a}{axis[a]}",
              lambda at: at.p * 1e-3),
        Cause(f"scale_{b}".lower(), f"position scale {b}", "um_per_m", f"scale {b}", f"E{b}{axis[b]}",
              lambda at: at.q * 1e-3),
        Cause(f"perpendicularity_{a}".lower(), f"perpendicularity of {a} to {n}", "urad", f"perpendicularity {a}",
              f"E{turns[b]}0{axis[a]}", lambda at: np.ones(len(at.p))),
        Cause(f"perpendicularity_{b}".lower(), f"perpendicularity of {b} to {n}", "urad", f"perpendicularity {b}",
              f"E{turns[a]}0{axis[b]}", lambda at: np.ones(len(at.p))),
        Cause("squareness", f"squareness {a}-{b}", "urad", "squareness",
              f"E{turns[n]}0{axis[a]}", lambda at: np.ones(len(at.p))),
        Cause("phase", f"servo phase mismatch {a}-{b}", "urad", "servo phase", f"E{a}{axis[a]}",
              _ahead, square=_ahead_square),
    )  # fmt: skip
    if not bent:
        return plain
    yaws = [
        Cause(f"yaw_{a}".lower(), f"bend of {a} in the plane (yaw)", "per_km", f"bend {a} in plane",
              f"E{b}{axis[a]}", lambda at: -0.5 * at.p**2 * 1e-3),
        Cause(f"yaw_{b}".lower(), f"bend of {b} in the plane (yaw)", "per_km", f"bend {b} in plane",
              f"E{a}{axis[b]}", lambda at: -0.5 * at.q**2 * 1e-3),
    ]  # fmt: skip
    for place, letter in enumerate((a, b)):
        if place in curved:
            # cos³ ζ and -cos ζ sin² ζ have the same third harmonic, ¼ cos 3ζ.
            component = f"E{letter}{axis[letter]}"
            yaws[1 - place] = replace(
                yaws[1 - place], component=component, shape=square_of(place, CURVE_PER_BEND * 1e-6)
            )
    return (
        *plain,
        *yaws,
        Cause(f"pitch_{a}".lower(), f"bend of {a} along {n} (pitch)", "per_km", f"bend {a} out of plane",
              f"E{n}{axis[a]}", lambda at: 0.5 * at.p**2 * 1e-3),
        Cause(f"pitch_{b}".lower(), f"bend of {b} along {n} (pitch)", "per_km", f"bend {b} out of plane",
              f"E{n}{axis[b]}", lambda at: -0.5 * at.q**2 * 1e-3),
        _twist(circle),
    )  # fmt: skip


CURVE_PER_BEND = 500.0
"""Curved positioning error, µm/m², that makes the third harmonic of a bend of 1 1/km of the other axis."""


def square_of(place: int, gain: float) -> Shape:
    """`gain` times the square of the position along the plane's first (0) or second (1) letter."""
    return lambda at: gain * (at.p, at.q)[place] ** 2


def if_it_turns(circle: CircleTest, place: int) -> float:
    """Bend of a guide whose carriage turns with the arc, for one unit of the bend of one whose carriage only shifts.

    A carriage that follows a rigid arc turns by the arc's slope. Where it carries the other axis of the plane, this
    turn moves the tool twice as far in the opposite direction, and the bend changes its sign.

    Args:
        circle: a test of the plane.
        place: 0 or 1: which axis.
    """
    cause = next(c for c in causes(circle, bent=True) if c.name == f"yaw_{circle.setup.letters[place]}".lower())
    a, b, n = circle.setup.letters
    hand = float(np.cross(*(np.eye(3)["XYZ".index(d)] for d in (a, b))) @ np.eye(3)["XYZ".index(n)])
    sign = hand if place == 1 else -hand
    turn: Shape = lambda at: sign * (at.p, at.q)[place]  # noqa: E731 - a shape like the others
    turning = replace(cause, also=((f"E{'ABC'['XYZ'.index(n)]}{axis_of(circle, place).name}", turn),))
    shifts, turns = ((tip_um(c, circle, circle) * circle.bar_mm).sum(axis=1) for c in (cause, turning))
    return float(shifts @ shifts / (turns @ shifts))


def _twist(circle: CircleTest) -> Cause:
    """Roll of the axis that is nearer to the workpiece and carries the other: only this roll has an arm.

    It moves the tool along the third direction by κ p q in a right-handed plane, whichever axis it is.
    """
    chain, letters = circle.machine.chain, circle.setup.letters
    names = [axis_of(circle, place).name for place in (0, 1)]
    rolls = [f"E{'ABC'['XYZ'.index(letters[place])]}{names[place]}" for place in (0, 1)]
    column = 1 + circle.machine.axis_names.index(names[1])
    first = bool(np.abs(chain.terms[:, chain.components.index(rolls[0]), column]).max() > 0.0)
    own = letters[0] if first else letters[1]
    shape: Shape = (lambda at: at.p * 1e-3) if first else (lambda at: -at.q * 1e-3)
    return Cause("twist", f"twist of the guide of {own} (roll)", "urad_per_m", f"twist {own}",
                 rolls[0] if first else rolls[1], shape)  # fmt: skip


def _ahead(at: At) -> Floats:
    """The first axis one µrad ahead on the circle, µm."""
    circle = at.circle
    gain = -1e-3 * circle.phase_rate * circle.setup.sense * circle.setup.radius_mm
    return np.asarray(gain * np.sin(circle.angle_rad), dtype=np.float64)


def _ahead_square(at: At) -> Floats:
    gain = -0.5e-9 * at.circle.phase_rate**2 * at.circle.setup.radius_mm
    return np.asarray(gain * np.cos(at.circle.angle_rad), dtype=np.float64)


def tip_um(cause: Cause, circle: CircleTest, origin: CircleTest, *, square: bool = False) -> Floats:
    """Displacement of the ball at the tool relative to the ball on the table for one unit of a cause, µm, (n, 3).

    Args:
        cause: the cause.
        circle: the test.
        origin: the test from whose centre shapes and lever arms count.
        square: give the term with the square of the parameter instead.
    """
    setup, shape = circle.setup, cause.square if square else cause.shape
    out = np.zeros((len(circle), 3))
    if cause.centre is not None and not square:
        out[:, setup.rows[cause.centre]] = -1.0
    fed = [] if shape is None else [(cause.component, shape)]
    if not square:
        fed += cause.also
    if not fed:
        return out
    first, second = setup.rows[:2]
    p, q = circle.on_circle_mm
    p = setup.centre_mm[first] - origin.setup.centre_mm[first] + p
    q = setup.centre_mm[second] - origin.setup.centre_mm[second] + q
    for component, of in fed:
        out += _arms(component, circle, origin) * of(At(circle, p, q))[:, None]
    return out


def _arms(component: str, circle: CircleTest, origin: CircleTest) -> Floats:
    """Displacement of the tip for one unit of a component error, (n, 3), or (3,) where it is the same everywhere."""
    chain = circle.machine.chain
    terms = chain.terms[:, chain.components.index(component)]
    # A turn's arms count from the origin, too; a shift's are the same everywhere.
    if component[1] in "ABC":
        return np.asarray((circle.pose_mm - _centre_pose(origin)) @ terms[:, 1:].T, dtype=np.float64)
    return np.asarray(terms[:, 0], dtype=np.float64)


def _centre_pose(circle: CircleTest) -> Floats:
    """Axis positions at the centre of a test, (axes,)."""
    machine = circle.machine
    out = np.zeros(len(machine.axes))
    for letter, place in zip("XYZ", circle.setup.centre_mm, strict=True):
        axis = axis_along(machine, letter)
        if axis is not None:
            out[machine.axes.index(axis)] = place
    return out


SAME_FEED = 1e-3
"""Feeds that differ by less than this share count as one feed."""
ALIKE_FEED = 0.25
"""Feeds that differ by less than this share have the same spikes: feeds that only follow the radius get no own ones."""


def axis_of(circle: CircleTest, place: int) -> Axis:
    """The axis that moves along the plane's first (0) or second (1) letter.

    Raises:
        MeasurementError: no axis does.
    """
    letter = circle.setup.letters[place]
    axis = axis_along(circle.machine, letter)
    if axis is None:
        raise MeasurementError(f"{circle.name}: machine {circle.machine.name!r} has no axis along {letter}")
    return axis


def along(circle: CircleTest, name: str, place: int, towards: str = "", **more: Any) -> Effect:
    """An effect of the catalogue along the plane's first or second axis: positioning, or straightness with `towards`.

    Args:
        circle: a test of the plane.
        name: name of the effect.
        place: 0 or 1: which axis.
        towards: letter of the direction in which it moves the ball; empty: the axis' own.
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
        effect: an effect from `along`.
        column: which basis function.
        gain: factor.
        theta: non-linear parameters of the effect.
        middle: 0 or 1: the position of that axis counts from the first test's centre, not from the machine's zero.
    """

    def shape(at: At) -> Floats:
        state = at.circle.state if middle is None else _counted(at, middle)
        return np.asarray(effect.basis(at.circle.machine, state, theta or {})[column] * gain, dtype=np.float64)

    return shape


def _counted(at: At, place: int) -> State:
    """The state with an axis' position shifted so that the centre is the middle of its travel."""
    axis = axis_of(at.circle, place)
    position = (at.p, at.q)[place] + 0.5 * (axis.travel_mm[0] + axis.travel_mm[1])
    state = at.circle.state
    return State(state.machine, state.time_s, {**state.channels, axis.channel: position})


def feeds_of(circles: Sequence[CircleTest], share: float = SAME_FEED) -> list[float]:
    """Different feeds of some tests, mm/min, rising; `share`: see `same_feed`."""
    out: list[float] = []
    for c in circles:
        if not any(same_feed(c.setup.feed_mm_min, f, share) for f in out):
            out.append(c.setup.feed_mm_min)
    return sorted(out)


def same_feed(one: float, other: float, share: float = SAME_FEED) -> bool:
    """Whether two feeds differ by less than a share of them."""
    return abs(one - other) <= share * max(abs(one), abs(other))

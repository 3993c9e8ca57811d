"""Parameters that tests are to determine: coefficients of effects, a ball bar's parameters, its ball's place."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from rtec.diagnosis.words import labels
from rtec.effects import Effect, effect_class
from rtec.errors import ModelError
from rtec.machine import Machine
from rtec.metrology.ball_bar.causes import Cause, causes
from rtec.metrology.ball_bar.circle import CircleTest, circle_of
from rtec.metrology.instruments.ball_bar import BallBar, BallBarSetup
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect

Stays = Literal["shared", "each"]
Place = tuple[str, ...]
"""Plane of a table-side ball and its place in it."""
USUAL = {"um": 5.0, "um_per_m": 20.0, "urad": 20.0, "per_km": 0.1, "urad_per_m": 50.0}
"""Usual sizes of a ball bar's parameters, by unit."""
USUAL_CENTRE_UM = 10.0
ROUND_MM = 0.01


@dataclass(frozen=True)
class Part:
    """A multiple of one coefficient of an effect, at given non-linear parameters or else at their start."""

    effect: Effect
    coefficient: int = 0
    factor: float = 1.0
    theta: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Ball:
    """A table-side ball whose place is unknown in one direction of the plane.

    Attributes:
        place: of the ball.
        direction: 0 or 1: the plane's first or second letter.
    """

    place: Place
    direction: int


@dataclass(frozen=True)
class OfBallBar:
    """A parameter of `rtec ballbar`: its cause, and the test whose centre shapes and arms count from."""

    cause: Cause
    origin: CircleTest


@dataclass(frozen=True)
class Planned:
    """A parameter that the tests are to determine.

    Attributes:
        name: for people.
        unit: of it.
        typical: its usual size.
        parts: effects of one unit of it.
        ball: for the place of a table-side ball.
        bar: where a ball bar in its plane has a column of its own for it.
        of: name of its effect; empty where it is not of one.
    """

    name: str
    unit: str
    typical: float
    parts: tuple[Part, ...] = ()
    ball: Ball | None = None
    bar: OfBallBar | None = None
    of: str = ""


def label(effect: Effect) -> str:
    """Effect, component, and what it depends on."""
    keys = ("axis", "other", "sensor", "front", "back")
    extra = [str(getattr(effect, k)) for k in keys if getattr(effect, k, None)]
    return f"{effect.effect}({', '.join([effect.component, *extra])})"


def names_of(effects: Sequence[FittedEffect]) -> list[str]:
    """Names of effects, as `label`; equal ones get the arguments or numbers in which they differ."""
    out = [label(f.effect) for f in effects]
    for name in {n for n in out if out.count(n) > 1}:
        rows = [i for i, n in enumerate(out) if n == name]
        for i, full in zip(rows, labels([effects[i] for i in rows]), strict=True):
            out[i] = name + full.removeprefix(effects[i].label)
    return out


def planned(asked: Sequence[Effect | FittedEffect | Planned], machine: Machine) -> tuple[Planned, ...]:
    """Parameters in question; an effect represents each of its coefficients.

    Raises:
        ModelError: one of them is given twice.
    """
    effects = [FittedEffect(a, {}) if isinstance(a, Effect) else a for a in asked if not isinstance(a, Planned)]
    _refuse_twice([(label(f.effect), (f.effect, dict(f.theta))) for f in effects])
    each = iter(zip(effects, names_of(effects), strict=True))
    out = [p for a in asked for p in ([a] if isinstance(a, Planned) else _of_effect(*next(each), machine))]
    _refuse_twice([(p.name, p.name) for p in out])
    return tuple(out)


def _refuse_twice(named: Sequence[tuple[str, object]]) -> None:
    """Raise an error where two things, each with its name, are the same."""
    things = [thing for _, thing in named]
    twice = next((name for i, (name, thing) in enumerate(named) if thing in things[:i]), None)
    if twice:
        raise ModelError(f"plan: {twice} is given twice")


def _of_effect(fitted: FittedEffect, of: str, machine: Machine) -> Iterator[Planned]:
    coefficients = fitted.effect.coefficients(machine)
    for i, p in enumerate(coefficients):
        name = of if len(coefficients) == 1 else f"{of} {p.name}"
        yield Planned(name, p.unit, p.typical, (Part(fitted.effect, i, theta=fitted.theta),), of=of)


def ball_place(measurement: Measurement, stays: Stays) -> Place | None:
    """The table-side ball of a measurement, where its place is unknown; None where it has none or its place is known.

    Args:
        measurement: any.
        stays: "shared": balls of one plane at one centre are one and the same; "each": every test has its own.
    """
    instrument = measurement.instrument
    if not isinstance(instrument, BallBar) or instrument.setup.centre != "setup":
        return None
    setup = instrument.setup
    if stays == "each":
        return (setup.plane, measurement.name)
    return (setup.plane, *(f"{round(setup.centre_mm[row] / ROUND_MM)}" for row in setup.rows[:2]))


def centres(measurements: Sequence[Measurement], stays: Stays = "shared") -> tuple[Planned, ...]:
    """Deviation of the table-side ball of each ball bar from the centre, in both directions of the plane."""
    out: dict[tuple[Place, int], Planned] = {}
    for m in measurements:
        place = ball_place(m, stays)
        if place is not None and isinstance(m.instrument, BallBar):
            for i, letter in enumerate(m.instrument.setup.letters[:2]):
                where = f", {m.name}" if stays == "each" else _where(m.instrument.setup)
                name = f"centre offset {letter}{where}"
                out.setdefault((place, i), Planned(name, "um", USUAL_CENTRE_UM, (), Ball(place, i)))
    # A single ball needs no place in its name.
    several = stays == "each" or len({place for place, _ in out}) > 1
    return tuple(p if several else replace(p, name=p.name.partition(",")[0]) for p in out.values())


def _where(setup: BallBarSetup) -> str:
    a, b = (setup.centre_mm[row] for row in setup.rows[:2])
    return f", {setup.plane} at {a:g}, {b:g}"


def ball_bar_set(
    measurements: Sequence[Measurement], *, bent: bool, stays: Stays = "shared", rolls: bool = False
) -> tuple[Planned, ...]:
    """The parameters of `rtec ballbar`: 10 of the linear model or 15 of the non-linear one, [BB §3].

    Args:
        measurements: ball-bar tests of one plane.
        bent: the non-linear model.
        stays: whether the table-side ball stays where it is from test to test.
        rolls: the constant roll of the carrying axis (ψy of [BB]) as a parameter beside the perpendicularity (φx).

    Raises:
        MeasurementError: a test of another instrument.
    """
    origin = circle_of(measurements[0])
    return (
        *centres(measurements, stays),
        *(
            Planned(c.title, c.unit, USUAL[c.unit], tuple(_parts(c, origin)), bar=OfBallBar(c, origin))
            for c in (*causes(origin, bent=bent), *(_roll(origin) if rolls else ()))
            if c.centre is None
        ),
    )


def _roll(origin: CircleTest) -> Iterator[Cause]:
    """The constant roll of the second axis, which carries the first on [BB]'s machine."""
    of = {c.name: c for c in causes(origin, bent=True)}
    shape = next(c.shape for name, c in of.items() if name.startswith("perpendicularity"))
    axis = of["twist"].component[2:]
    yield replace(of["twist"], name="roll", title=f"constant roll of {axis}", unit="urad", shape=shape)


def _parts(cause: Cause, origin: CircleTest) -> Iterator[Part]:
    """The same parameter as effects, for other instruments."""
    kind, setup, own = cause.name.split("_")[0], origin.setup, cause.component[2:]
    machine = origin.machine
    if kind == "scale":
        yield Part(_effect("scale", cause, axis=own))
    elif kind == "clearance":
        yield Part(_effect("backlash", cause, axis=own), factor=-1.0)  # δ is minus the reversal value
    elif kind == "phase":
        speed_mm_s = setup.feed_mm_min / 60.0
        yield Part(_effect("servo_lag", cause, axis=own), factor=1e-3 * setup.radius_mm / speed_mm_s)
    elif kind == "twist":
        yield Part(_effect("guide_twist", cause, axis=own), factor=-1.0)
    elif kind == "roll":
        yield Part(_effect("polynomial_position", cause, axis=own, degrees=(0,)))
    elif kind in ("yaw", "pitch"):
        axis = machine.axis(own)
        middle = setup.centre_mm["XYZ".index(axis.direction)]
        text = f"k*({axis.channel} - ({middle:.6f}))**2*0.5e-3"
        sign = 1.0 if cause.name == f"pitch_{setup.letters[0].lower()}" else -1.0
        yield Part(_effect("expression", cause, expression=text, linear={"k": "per_km"}), factor=sign)
    else:
        yield Part(_effect("squareness", cause))


def _effect(name: str, cause: Cause, **arguments: Any) -> Effect:
    table: Mapping[str, Any] = {"effect": name, "component": cause.component, **arguments}
    return effect_class(name, "plan").model_validate(table)

"""Tests that might be added: those possible with the usual instruments, and their duration."""

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rtec.diagnosis.plan.plan import Extra
from rtec.diagnosis.plan.tests import dry
from rtec.errors import RtecError
from rtec.machine import Axis, Machine
from rtec.metrology.instruments.ball_bar import BallBar, BallBarSetup, axis_along
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.sim.campaign.settings import Settings
from rtec.tomlfile import validated

BESIDE_MM = 200.0
SET_UP_H = {
    "laser_linear": 0.5, "laser_angular": 0.5, "straightness": 0.5, "squareness": 0.5, "level": 0.25,
    "ball_bar": 0.15, "grid_encoder": 0.75, "tool_tip": 0.25, "spindle_drift": 0.5,
}  # fmt: skip
"""Hours to set up and align an instrument: usual figures, for ranking only."""
AGAIN_H = 0.02
"""Hours for the same set-up once more with another programme."""
RAISE_H = 0.1
"""Hours for a ball bar with its table-side ball raised or lowered."""
BARS_MM = (50.0, 100.0, 150.0)
RAISED = 0.2
"""Height of a raised ball, as a share of the bar's length: 30 mm for a bar of 150 mm, as in [BB Table 2]."""
PLANES = ("XY", "YZ", "XZ")
PLATE_MM = 160.0
PLACES = (0.5, 0.15, 0.85)
"""Places of a plate, as shares of each travel: the middle, then towards the ends."""
COLD = {"protocol": "cold"}


@dataclass(frozen=True)
class Idea:
    """A test in words: name, instrument and set-up, settings of the simulation, hours of setting up."""

    name: str
    instrument: str
    setup: Mapping[str, Any]
    axis: str | None = None
    component: str | None = None
    settings: Mapping[str, Any] = dataclasses.field(default_factory=lambda: dict(COLD))
    set_up_h: float | None = None


def extra_tests(machine: Machine, given: Sequence[Measurement] = ()) -> list[Extra]:
    """Tests that fit a machine, with the usual instruments.

    Args:
        machine: of the tests.
        given: existing tests: another circle about the same ball is proposed before one elsewhere.
    """
    ideas = itertools.chain(
        (i for axis in machine.axes for i in _along(axis, machine)),
        _circles(machine, given),
        _plates(machine),
        (Idea("tool-tip probing over the workspace, cold", "tool_tip", {}),),
        (
            Idea(
                "drift probes, spindle on and off over 8 h", "spindle_drift", _probes(), settings={"protocol": "drift"}
            ),
        ),
    )
    taken = {m.name for m in given}
    made = (_made(i, machine) for i in ideas if i.name not in taken)
    return [m for m in made if m is not None]


def _probes() -> dict[str, Any]:
    from rtec.sim.campaign.settings import DRIFT_PROBES

    return {"probe": dict(DRIFT_PROBES)}


def _along(axis: Axis, machine: Machine) -> Iterator[Idea]:
    name, cold = axis.name, {"protocol": "cold", "cycles": 2}
    yield Idea(f"laser along {name}, both ways, cold", "laser_linear", {}, name, None, cold)
    for across in "XYZ".replace(axis.direction, ""):
        at = [BESIDE_MM if letter == across else 0.0 for letter in "XYZ"]
        where = f"beam {BESIDE_MM:g} mm from the tool along {across}"
        yield Idea(
            f"laser along {name}, both ways, cold, {where}", "laser_linear", {"beam_offset_mm": at}, name, None, cold
        )
    warm = {"protocol": "warm_up", "cycles": 2}
    yield Idea(f"laser along {name} through a warm-up", "laser_linear", {}, name, None, warm)
    for letter in "ABC":
        component, roll = f"E{letter}{name}", letter == axis.direction.translate(TURNS)
        if not roll:
            what = {"A": "about X", "B": "about Y", "C": "about Z"}[letter]
            yield Idea(f"angular laser along {name}, {what}, cold", "laser_angular", {}, name, component, cold)
        elif axis.direction != "Z":  # a level does not see a rotation about the vertical
            yield Idea(f"level along {name}, roll, cold", "level", {}, name, component, cold)
    for letter in "XYZ":
        if letter != axis.direction:
            component = f"E{letter}{name}"
            yield Idea(f"straightness of {name} in {letter}, cold", "straightness", {}, name, component, cold)
    others = [a.name for a in machine.axes if a.name != name]
    for other in others:
        setup = {"reference_axis": other}
        yield Idea(f"square between {name} and {other}, cold", "squareness", setup, name, None, cold)


TURNS = str.maketrans("XYZ", "ABC")
TURN_DEG = 360.0


def _circles(machine: Machine, given: Sequence[Measurement]) -> Iterator[Idea]:
    """Circles about an existing ball: the other sense, another height, another feed; else a new one."""
    bars = [m.instrument.setup for m in given if isinstance(m.instrument, BallBar)]
    cheapest: dict[tuple[str, tuple[float, ...]], Idea] = {}
    for idea in (idea for setup in bars for idea in _again(setup, bars)):
        key = idea.name, tuple(idea.setup["centre_mm"])
        if key not in cheapest or (idea.set_up_h or 0.0) < (cheapest[key].set_up_h or 0.0):
            cheapest[key] = idea
    names = [name for name, _ in cheapest]
    for (name, centre), idea in cheapest.items():
        where = f", centre {', '.join(f'{v:g}' for v in centre)} mm" if names.count(name) > 1 else ""
        yield dataclasses.replace(idea, name=name + where)
    for plane in PLANES:
        if all(set(s.plane) != set(plane) for s in bars):
            yield from _first(machine, plane)


def _again(setup: BallBarSetup, bars: Sequence[BallBarSetup]) -> Iterator[Idea]:
    lengths = (setup.length_mm**2 - (RAISED * setup.length_mm) ** 2) ** 0.5
    heights = ((0.0, round(setup.length_mm, 3)), (round(RAISED * setup.length_mm, 3), round(lengths, 3)))
    levels = [(setup.height_mm, setup.radius_mm), *(h for h in heights if abs(h[0] - setup.height_mm) > 1.0)]
    for height, radius in levels:
        same = height == setup.height_mm
        for direction in ("ccw", "cw"):
            new = _changed(setup, height, radius, direction)
            if not any(_alike(new, s) for s in bars):
                yield _circle(new, AGAIN_H if same else RAISE_H)
    feed = round(setup.feed_mm_min * (0.3 if setup.feed_mm_min > 2000.0 else 3.0), 1)
    yield _circle(setup.model_copy(update={"feed_mm_min": feed}), AGAIN_H, f", feed {feed:g} mm/min")


def _changed(setup: BallBarSetup, height_mm: float, radius_mm: float, direction: str) -> BallBarSetup:
    """The same arc at another height or in the other sense, then from its other end.

    Its angular speed is the same: a lag of an axis is then the same angle at both heights.
    """
    end = setup.start_deg + setup.sense * setup.arc_deg
    changes = {
        "height_mm": height_mm,
        "radius_mm": radius_mm,
        "direction": direction,
        "feed_mm_min": round(setup.feed_mm_min * radius_mm / setup.radius_mm, 1),
        "start_deg": setup.start_deg if direction == setup.direction or setup.arc_deg == TURN_DEG else end,
    }
    return setup.model_copy(update=changes)


def _alike(one: BallBarSetup, other: BallBarSetup) -> bool:
    keys = ("plane", "height_mm", "direction")
    return all(getattr(one, k) == getattr(other, k) for k in keys)


def _circle(setup: BallBarSetup, hours: float, more: str = "") -> Idea:
    name = f"ball bar {setup.plane}, {setup.direction}, height {setup.height_mm:g} mm{more}"
    return Idea(name, "ball_bar", setup.model_dump(), set_up_h=hours)


def _first(machine: Machine, plane: str) -> Iterator[Idea]:
    axes = [axis_along(machine, d) for d in plane]
    if any(a is None for a in axes):
        return
    room = min(0.45 * (a.travel_mm[1] - a.travel_mm[0]) for a in axes if a is not None)
    bar = max((b for b in BARS_MM if b <= room), default=None)
    if bar is None:
        return
    centre = [_at(machine, d, PLACES[0]) for d in "XYZ"]
    usual = {"plane": plane, "centre_mm": centre, "feed_mm_min": 1000.0}
    for height, direction in itertools.product((0.0, RAISED * bar), ("ccw", "cw")):
        radius = (bar**2 - height**2) ** 0.5
        setup = BallBarSetup.model_validate(
            {**usual, "radius_mm": round(radius, 3), "height_mm": height, "direction": direction}
        )
        yield _circle(setup, SET_UP_H["ball_bar"])


def _plates(machine: Machine) -> Iterator[Idea]:
    """A grid plate in the middle, and moved along one direction at a time."""
    for plane in PLANES:
        axes = [axis_along(machine, d) for d in plane]
        if all(a is not None for a in axes):
            moved = [a.travel_mm[1] - a.travel_mm[0] for a in machine.axes if a in axes]
            travel = min(PLATE_MM, 0.8 * min(moved))
            for middle in _middles(machine, travel):
                yield plate(plane, middle, travel)


def plate(plane: str, middle_mm: Sequence[float], travel_mm: float = PLATE_MM) -> Idea:
    """A set-up of the grid encoder: all paths at two feeds."""
    at = ", ".join(f"{v:g}" for v in middle_mm)
    paths = {"travel_mm": travel_mm, "step_mm": 2.0, "feeds_mm_min": [1000.0, 5000.0]}
    return Idea(
        f"grid encoder {plane}, middle at {at} mm", "grid_encoder", {"plane": plane, "origin_mm": list(middle_mm)},
        settings={**COLD, "path": paths},
    )  # fmt: skip


def _middles(machine: Machine, travel_mm: float) -> Iterator[tuple[float, float, float]]:
    yield tuple(_at(machine, d, PLACES[0], travel_mm) for d in "XYZ")  # type: ignore[misc]
    for moved, share in itertools.product("XYZ", PLACES[1:]):
        if axis_along(machine, moved) is not None:
            yield tuple(_at(machine, d, share if d == moved else PLACES[0], travel_mm) for d in "XYZ")  # type: ignore[misc]


def _at(machine: Machine, direction: str, share: float, room_mm: float = 0.0) -> float:
    """Place along a direction that leaves room for a path about it, mm; zero where nothing moves."""
    axis = axis_along(machine, direction)
    if axis is None:
        return 0.0
    low, high = axis.travel_mm
    half = 0.5 * min(room_mm, high - low)
    return round(min(max(low + share * (high - low), low + half), high - half), 1)


def _made(idea: Idea, machine: Machine) -> Extra | None:
    """The test, where the instrument fits the machine."""
    try:
        instrument = make_instrument(idea.instrument, idea.setup, idea.axis, idea.component, machine, "plan")
        measurement = dry(machine, instrument, validated(Settings, dict(idea.settings), "plan"), idea.name)
    except RtecError:
        return None
    hours = float(measurement.time_s[-1] - measurement.time_s[0]) / 3600.0
    set_up = SET_UP_H.get(idea.instrument, 0.5) if idea.set_up_h is None else idea.set_up_h
    return Extra(idea.name, dataclasses.replace(measurement, name=idea.name), hours + set_up)

"""What measurements can see: component errors, and axes that moved."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtec.arrays import Floats
from rtec.effects import Effect, Parameter
from rtec.effects.base import component_kind
from rtec.effects.geometry import Squareness
from rtec.effects.thermal import PART_OF_RANGE, SLACK
from rtec.machine import Axis, Machine
from rtec.machine.chain import component_unit
from rtec.metrology.measurement import Measurement

MOVES, FINELY_MM = 0.01, 0.02
"""An axis moves if it covers more than this share of its travel. The axis that an instrument follows also moves if it
covers more than this distance: fine steps over a few periods of a scale or turns of a screw."""
SAME_MM, PLACES_ACROSS = 0.02, 200
"""Positions within this distance are one place; within less where so many would not fit into the way."""
SAME_RPM = 30.0
"""Speeds of the spindle within this are one."""
NO_ARM = 1e-12
SAME_ARM = 1e-6
"""Lever arms within this relative difference are one."""
ONE = 1e-6
"""A lever arm of one, to rounding."""
SAMPLE = 2000
"""Number of instants at which lever arms are evaluated."""


def longest_arms(measurement: Measurement) -> Floats:
    """Longest lever arm of each component on any reading, (components,)."""
    rows = np.unique(np.linspace(0, len(measurement) - 1, SAMPLE).astype(np.int64))
    pose = measurement.state().positions_mm()[rows]
    return np.asarray(np.abs(measurement.instrument.arms(measurement.machine, pose)).max(axis=(0, 1)))


def longest_s(measurements: Sequence[Measurement]) -> float:
    """Duration of the longest measurement, s."""
    return max((float(m.time_s[-1] - m.time_s[0]) for m in measurements if len(m)), default=0.0)


def within_record(effect: Effect, measurements: Sequence[Measurement], share: float = 1.0) -> list[Parameter]:
    """Non-linear parameters of an effect, in order; bounds and grid are limited to what measurements show.

    A longer lag than the record hardly changes in it, and its coefficient may have any size. The exponent of a speed
    stays at its start where a spindle turned at one speed only. A temperature at which a screw is slack is well within
    the range of its sensor.

    Args:
        effect: the effect.
        measurements: of its machine.
        share: longest delay as a share of the longest measurement.
    """
    longest, out, machine = share * longest_s(measurements), [], measurements[0].machine
    for p in effect.nonlinear(machine):
        if p.unit == "s" and p.low > 0.0:  # a delay; an instant may be any
            high = min(p.high, max(longest, 2.0 * p.low))
            p = replace(p, high=high, grid=tuple(v for v in p.grid if v <= high) or p.grid[:1])  # noqa: PLW2901
        if p.name == "p" and "spindle_rpm" in effect.channels(machine) and not _speeds(measurements):
            p = replace(p, low=p.start, high=p.start, grid=(p.start,))  # noqa: PLW2901
        if p is SLACK:
            p = _within_range(p, effect.channels(machine)[-1], measurements)  # noqa: PLW2901
        out.append(p)
    return out


def _within_range(p: Parameter, sensor: str, measurements: Sequence[Measurement]) -> Parameter:
    """A temperature that readings must show from both sides, bounded so."""
    degc = np.concatenate([m.channels[sensor] for m in measurements if sensor in m.channels])
    low, high = float(np.nanmin(degc)), float(np.nanmax(degc))
    part = PART_OF_RANGE * (high - low)
    return replace(p, low=low + part, high=high - part, start=0.5 * (low + high))


def _speeds(measurements: Sequence[Measurement]) -> bool:
    """Whether the spindle turned at several speeds."""
    turning = [np.abs(m.channels["spindle_rpm"]) for m in measurements if "spindle_rpm" in m.channels]
    speeds = np.concatenate([np.zeros(0), *(v[v > SAME_RPM] for v in turning)])
    return bool(np.ptp(speeds) > SAME_RPM) if speeds.size else False


@dataclass(frozen=True)
class VisibleComponent:
    """A component error that the readings can see.

    Attributes:
        name: of the component.
        axis: the axis whose motion has this error; None for a fixed link.
        moves: whether that axis moved; where it did not, only changes with temperature are seen.
    """

    name: str
    axis: Axis | None
    moves: bool


def visible_components(measurements: Sequence[Measurement]) -> list[VisibleComponent]:
    """Component errors that the measurements can see: those read directly, then of moving axes, then the spindle's.

    An instrument that names its component reads that one; errors that it sees through lever arms are for other
    instruments. Among fixed links only the spindle's errors are candidates, or without a link of that name those of the
    first link that they see, of the work chain first: constant errors of one link or another look the same.
    """
    machine = measurements[0].machine
    between = moved_between(measurements)
    moving = between | {a.name for a in machine.axes if any(moves(m, a) for m in measurements)}
    found: dict[str, None] = {}
    for m in measurements:
        direct = m.instrument.component
        if direct is not None:
            found[direct] = None
    for m in measurements:
        if m.instrument.component is None:
            found |= dict.fromkeys(_through_arms(m, machine, between))
    datum = _datum(measurements)
    return [VisibleComponent(c, axis_of(c, machine), _axis_name(c, machine) in moving) for c in found if c not in datum]


def _datum(measurements: Sequence[Measurement]) -> set[str]:
    """Angles of lines of travel that a square takes as its reference: the squareness error is the other axis' angle.

    Where one square takes the one axis as its reference and another the other, neither is.
    """
    machine, referred, carried = measurements[0].machine, set(), set()
    for m in measurements:
        other = getattr(m.instrument.setup, "reference_axis", None)
        if other is None or m.instrument.axis is None or m.instrument.component is not None:
            continue
        lines = {machine.axis(a).direction for a in (m.instrument.axis, other)}
        normal = "ABC"["XYZ".index(min(set("XYZ") - lines))]
        referred.add(f"E{normal}0{other}")
        carried.add(f"E{normal}0{m.instrument.axis}")
    return referred - carried


def read_directly(measurements: Sequence[Measurement]) -> dict[str, bool]:
    """Component errors that a reading shows directly, not through a lever arm; and whether a file names them.

    These are components that a file names. Where it names none, they are every shift (or every angle, of readings in
    µrad) of an axis that moved, or of a fixed link, that moves a reading one to one wherever the axes are. An
    instrument that shows none in this way (a ball bar, whose direction turns) shows all that it sees.
    """
    machine = measurements[0].machine
    out: dict[str, bool] = {}
    for m in measurements:
        if m.instrument.component is not None:
            out[m.instrument.component] = True
            continue
        rows = np.unique(np.linspace(0, len(m) - 1, SAMPLE).astype(np.int64))
        arms = np.abs(m.instrument.arms(machine, m.state().positions_mm()[rows]))
        units = ["urad" if c.endswith("urad") else "um" for c in m.instrument.columns()]
        one = np.abs(arms - 1.0).max(axis=1) < ONE
        seen, shown = _through_arms(m, machine), []
        for name in seen:
            alike = np.array([u == component_unit(name) for u in units])
            if (one[:, machine.components.index(name)] & alike).any():
                shown.append(name)
        for name in shown or seen:
            out.setdefault(name, False)
    return out


def behind_arm(component: str, shown: Collection[str], arms: Callable[[str], Floats]) -> bool:
    """Whether a component is an angle that is read only at one lever arm, as a shift along the same axis.

    Args:
        component: in question.
        shown: components that the readings show directly.
        arms: lever arm of a component at each reading.
    """
    direct = [arms(c) for c in shown if c[2:] == component[2:]]
    if component in shown or not direct or component_unit(component) != "urad":
        return False
    mine = arms(component)[np.any(direct, axis=0)]
    return bool(mine.size) and float(np.ptp(mine)) < SAME_ARM * float(np.abs(mine).max())


def lever_arms(measurements: Sequence[Measurement]) -> Callable[[str], Floats]:
    """Gives the lever arm of a component at some readings of every column of measurements, (readings,)."""
    machine, parts = measurements[0].machine, []
    for m in measurements:
        rows = np.unique(np.linspace(0, len(m) - 1, SAMPLE).astype(np.int64))
        arms = m.instrument.arms(machine, m.state().positions_mm()[rows])
        parts.append(arms.reshape(-1, arms.shape[-1]))
    whole = np.concatenate(parts)
    return lambda component: np.asarray(whole[:, machine.components.index(component)])


def lines_shown(measurements: Sequence[Measurement]) -> set[str]:
    """Angles of axes' lines that measurements see with an instrument that is made to show a squareness."""
    machine = measurements[0].machine
    made = [m for m in measurements if m.instrument.name in Squareness.about.seen_by]
    return {c for m in made for c in _through_arms(m, machine) if component_kind(c, machine) == "axis_angle"}


def moved_between(measurements: Sequence[Measurement]) -> set[str]:
    """Axes that only differ between files, such as of a plate that was read at two places of one."""
    machine, out = measurements[0].machine, set()
    for axis in machine.axes:
        if any(moves(m, axis) for m in measurements):
            continue
        at = [float(np.median(m.channels[axis.channel])) for m in measurements if axis.channel in m.channels]
        if at and max(at) - min(at) > MOVES * (axis.travel_mm[1] - axis.travel_mm[0]):
            out.add(axis.name)
    return out


def _through_arms(m: Measurement, machine: Machine, between: Collection[str] = ()) -> list[str]:
    there = longest_arms(m) > NO_ARM
    moving = {a.name for a in machine.axes if moves(m, a)}
    seen = {c[3:] for c, ok in zip(machine.components, there, strict=True) if ok}
    links = {*moving, _spindle(machine, seen)}
    # Of an axis that only differs between files an angle shows by its arm; a shift is a zero of each file.
    turning = [f"E{letter}{axis}" for axis in between for letter in "ABC"]
    names = [
        c
        for c, ok in zip(machine.components, there, strict=True)
        if ok and ((_axis_name(c, machine) or c[3:]) in links or c in turning)
    ]
    # A fixed link before the axes: for shifts that only follow a temperature, the spindle is the likelier cause.
    return sorted(names, key=lambda c: (_axis_name(c, machine) is not None, machine.components.index(c)))


def _spindle(machine: Machine, seen: Collection[str]) -> str:
    """The spindle's link, or without one of that name the first fixed link that an instrument sees."""
    fixed = [n for n in (*machine.work_chain, *machine.tool_chain) if n not in machine.axis_names and n in seen]
    named = [n for n in fixed if "spindle" in n.lower() or n.lower() == "s"]
    return (named or fixed or [""])[0]


def moves(measurement: Measurement, axis: Axis, rows: NDArray[np.intp] | slice = slice(None)) -> bool:
    """Whether an axis moved far enough to be seen.

    Args:
        measurement: of its machine.
        axis: the axis.
        rows: which rows count; by default all.
    """
    position = measurement.channels.get(axis.channel)
    if position is None:
        return False
    least = MOVES * (axis.travel_mm[1] - axis.travel_mm[0])
    if measurement.instrument.axis == axis.name:
        least = min(least, FINELY_MM)
    return float(np.ptp(position[rows])) > least


def same_place_mm(measurement: Measurement) -> Floats:
    """Distance along each axis within which two positions are one place, mm, (axes,).

    Of the axis that an instrument follows in steps of micrometres, at one place of it or at several, it is smaller than
    the steps.
    """
    out = np.full(len(measurement.machine.axes), SAME_MM)
    for i, axis in enumerate(measurement.machine.axes):
        if measurement.instrument.axis == axis.name and moves(measurement, axis):
            out[i] = min(SAME_MM, _way_mm(measurement.channels[axis.channel]) / PLACES_ACROSS)
    return out


def _way_mm(position_mm: Floats) -> float:
    """The way over which an axis went in fine steps, mm: of the median reading that belongs to such a way.

    Between two ways the axis jumps. Where most readings belong to none, it is the whole way.
    """
    first = np.concatenate([[0], np.flatnonzero(np.abs(np.diff(position_mm)) > SAME_MM) + 1])
    spans = np.maximum.reduceat(position_mm, first) - np.minimum.reduceat(position_mm, first)
    counts = np.diff(first, append=len(position_mm))
    fine = spans > FINELY_MM
    if 2 * int(counts[fine].sum()) < len(position_mm):
        return float(np.ptp(position_mm))
    return float(np.median(np.repeat(spans[fine], counts[fine])))


def _axis_name(component: str, machine: Machine) -> str | None:
    name = component[2:].removeprefix("0")
    return name if name in machine.axis_names else None


def axis_of(component: str, machine: Machine) -> Axis | None:
    """The axis of `EXX` and `EC0X`; None for a fixed link's component."""
    name = _axis_name(component, machine)
    return None if name is None else machine.axis(name)

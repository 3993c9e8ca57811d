"""What the measurements can see: component errors, axes that moved, temperatures that varied."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.characterise.source import Source
from rtec.machine import Axis, Machine

Floats = NDArray[np.float64]

TAU_S = (150.0, 300.0, 600.0, 1200.0, 2400.0, 4800.0, 9600.0, 19200.0)
MOVES = 0.01
"""An axis that moves by at least this share of its travel is seen."""
NO_ARM = 1e-12
REAL_K = 0.5
"""Temperatures that vary by less are not a cause but the sensor's noise."""
INNER = (1.0, 99.0)
"""Percentiles between which a temperature's variation is taken: single wrong readings do not count."""
REAL_RPM = 1.0


@dataclass(frozen=True)
class Seen:
    """A component error that the readings can see.

    Attributes:
        name: of the component.
        axis: whose motion it is; None for a fixed link.
        moves: whether that axis moved; where it did not, only changes with temperature are seen.
    """

    name: str
    axis: Axis | None
    moves: bool


def seen_components(sources: Sequence[Source]) -> list[Seen]:
    """Component errors that the measurements can see: read directly first, then by moving axes, then of the spindle.

    An instrument that names its component is believed to read that one: its lever arms to others are for those that
    another instrument reads. Among fixed links only the spindle's errors are candidates, or where there is no link of
    that name those of the first link of the work chain: constant errors of one link or another look the same.
    """
    machine = sources[0].measurement.machine
    moving = {a.name for a in machine.axes if any(moves(s, a) for s in sources)}
    found: dict[str, None] = {}
    for source in sources:
        direct = source.measurement.instrument.component
        if direct is not None:
            found[direct] = None
    for source in sources:
        if source.measurement.instrument.component is None:
            found |= dict.fromkeys(_through_arms(source, machine))
    return [Seen(c, axis_of(c, machine), _axis_name(c, machine) in moving) for c in found]


def reads(source: Source, component: str) -> bool:
    """Whether an instrument's reading moves with a component error at all."""
    return bool(source.longest_arms[source.measurement.machine.components.index(component)] > NO_ARM)


def _through_arms(source: Source, machine: Machine) -> list[str]:
    there = source.longest_arms > NO_ARM
    moving = {a.name for a in machine.axes if moves(source, a)}
    links = {*moving, _spindle(machine)}
    names = [
        c for c, ok in zip(machine.components, there, strict=True) if ok and (_axis_name(c, machine) or c[3:]) in links
    ]
    # A fixed link before the axes: of shifts that only follow a temperature, the spindle's is the likelier name.
    return sorted(names, key=lambda c: (_axis_name(c, machine) is not None, machine.components.index(c)))


def _spindle(machine: Machine) -> str:
    fixed = [n for n in (*machine.work_chain, *machine.tool_chain) if n not in machine.axis_names]
    named = [n for n in fixed if "spindle" in n.lower() or n.lower() == "s"]
    return (named or fixed or [""])[0]


def moves(source: Source, axis: Axis) -> bool:
    """Whether an axis moved by enough to be seen."""
    position = source.measurement.channels.get(axis.channel)
    return position is not None and float(np.ptp(position)) > MOVES * (axis.travel_mm[1] - axis.travel_mm[0])


def _axis_name(component: str, machine: Machine) -> str | None:
    name = component[2:].removeprefix("0")
    return name if name in machine.axis_names else None


def axis_of(component: str, machine: Machine) -> Axis | None:
    """The axis of `EXX` and `EC0X`; None for a fixed link's component."""
    name = _axis_name(component, machine)
    return None if name is None else machine.axis(name)


def varying_sensors(sources: Sequence[Source]) -> tuple[list[str], list[str]]:
    """Sensors that every measurement has and that vary by at least 0.5 K, and why others are not among them."""
    good: list[str] = []
    why: list[str] = []
    still: dict[str, float] = {}
    for sensor in sources[0].measurement.machine.sensor_names:
        series = [s.measurement.channels.get(sensor) for s in sources]
        if any(v is None for v in series):
            missing = [s.measurement.name for s, v in zip(sources, series, strict=True) if v is None]
            if len(missing) < len(series):
                why.append(f"{sensor} is not used: {', '.join(missing)} did not record it")
            continue
        whole = np.concatenate([v for v in series if v is not None])
        if not np.isfinite(whole).all():
            why.append(f"{sensor} is not used: {int((~np.isfinite(whole)).sum())} of its readings are missing")
        elif (varied := float(np.ptp(np.percentile(whole, INNER)))) < REAL_K:
            still[sensor] = varied
        else:
            good.append(sensor)
    return good, [*why, *_still(still)]


def _still(varied_k: dict[str, float]) -> list[str]:
    """One sentence for all sensors that hardly varied."""
    if not varied_k:
        return []
    are = "is" if len(varied_k) == 1 else "are"
    said = ", ".join(f"{name} ({k:.2f} K)" for name, k in varied_k.items())
    return [f"{said} {are} not used: varied by less than {REAL_K:g} K (98 % of the readings)"]


def lags_s(sources: Sequence[Source]) -> list[float]:
    """Time constants worth trying: longer than two readings apart, shorter than half of the longest measurement."""
    span = max(float(s.measurement.time_s[-1] - s.measurement.time_s[0]) for s in sources)
    steps = [np.diff(s.measurement.time_s) for s in sources]
    apart = min((float(np.median(d[d > 0])) for d in steps if (d > 0).any()), default=np.inf)
    return [tau for tau in TAU_S if 2 * apart <= tau <= span / 2]


def speed_varies(sources: Sequence[Source]) -> bool:
    """Whether every measurement recorded the spindle's speed, and it changed."""
    series = [s.measurement.channels.get("spindle_rpm") for s in sources]
    there = [v for v in series if v is not None]
    whole = np.concatenate(there) if there else np.zeros(1)
    return len(there) == len(series) and bool(np.isfinite(whole).all() and np.ptp(whole) > REAL_RPM)


def both_ways(axis: Axis, sources: Sequence[Source]) -> bool:
    """Whether an axis moved both ways in any measurement."""
    for s in sources:
        if axis.channel in s.measurement.channels or axis.direction_channel in s.measurement.channels:
            d = s.state.value(axis.direction_channel)
            if (d > 0).any() and (d < 0).any():
                return True
    return False


def visited(axis: Axis, sources: Sequence[Source]) -> tuple[float, float]:
    """Lowest and highest position of an axis in the measurements, mm."""
    there = [s.measurement.channels[axis.channel] for s in sources if axis.channel in s.measurement.channels]
    return min(float(p.min()) for p in there), max(float(p.max()) for p in there)


def gone_along(axis: Axis, sources: Sequence[Source]) -> bool:
    """Whether an axis went over half of what was visited of it in some one run.

    Patches that each have a zero of their own (plates on a grid, say) show slopes and bends where they lie. A curve
    made of pieces would take any height between them.
    """
    low, high = visited(axis, sources)
    for s in sources:
        if axis.channel in s.measurement.channels:
            place, edges = s.measurement.channels[axis.channel], s.blocks.run_edges
            longest = np.maximum.reduceat(place, edges[:-1]) - np.minimum.reduceat(place, edges[:-1])
            if float(longest.max()) >= 0.5 * (high - low):
                return True
    return False

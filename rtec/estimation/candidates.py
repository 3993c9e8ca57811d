"""Candidates of a search: every effect of the registry, for every component error that the readings see."""

import itertools
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rtec.arrays import Floats
from rtec.effects import Effect, Parameter, State
from rtec.effects.base import Surroundings, component_kind
from rtec.effects.cyclic import GROWTHS, PITCH_MM, Cyclic, CyclicPole
from rtec.effects.registry import SKIPPED, all_effects, instances, lacking
from rtec.effects.thermal import AxisExpansion, BedBending, ColumnTilt, MountExpansion
from rtec.effects.time_data import MissedCounts
from rtec.errors import ModelError
from rtec.estimation.readings import Readings
from rtec.estimation.visible import (
    VisibleComponent,
    axis_of,
    visible_components,
    within_record,
)
from rtec.machine import Machine
from rtec.machine.chain import component_unit
from rtec.model import FittedEffect

GRID = 6
"""Grid of a non-linear parameter where the effect gives none."""
INSTANTS = 160
PAUSE, PAUSES = 3.0, 80
"""A pause is this many times the usual time between readings; number of the longest pauses in the grid."""
MOST_PERIODS, FINE = 6000, 2.5
"""Periods in the grid, at most, and how many for each turn more along the travel: neighbours differ by 0.4 turns over
the whole of it. Of an axis so long that these do not reach the shortest period, the shortest ones are not tried."""
OF_FEET = (ColumnTilt, MountExpansion)
"""What turns a fixed part: its heat."""
ONE_ARM = 1e-3
"""Lever arms within this relative difference are equal."""
SAME_ARMS = 1e-9
"""Lever arms whose cosine is this near to one are the same but for a factor."""
LETTERS, OF_AN_AXIS = 3, ("nut", "screw", "scale", "motor", "fix", "bearing")
"""Fewest letters of a part's name that the name of its sensor has; what a sensor of an axis may be on."""
STRETCHES, PASSED = 4, 0.03
"""A temperature was read on the way where each of so many equal parts of its range has this share of the readings."""
MOST = 48
"""Combinations of non-linear parameters in the grid, at most."""
REAL = {"degc": 0.3, "rpm": 30.0, "kg": 5.0, "n": 5.0, "mm": 0.05, "mm_s": 0.5, "other": 1e-9}
"""A smaller change is noise of the channel, not a motion."""


@dataclass(frozen=True)
class EffectCandidate:
    """An effect that the model may lack.

    Attributes:
        effect: with its arguments.
        thetas: grid of its non-linear parameters; one empty mapping where it has none.
    """

    effect: Effect
    thetas: tuple[Mapping[str, float], ...]


@dataclass(frozen=True)
class Untried:
    """An effect that cannot be a candidate for a component (empty: for any), and why."""

    effect: str
    component: str
    why: str


def library(
    readings: Readings, only: Sequence[str] | None = None, there: Sequence[FittedEffect] | None = None
) -> tuple[list[EffectCandidate], list[Untried]]:
    """All candidates, and the effects that cannot be one.

    Args:
        readings: all readings.
        only: names of effects; None for all.
        there: effects of the model. An immediate effect of a temperature may be delayed as well; a wave of constant
            size may also grow with a channel. None: not for a model; of fixed links that are the same in these
            readings then the first has its effects, whatever their names.
    """
    out: list[EffectCandidate] = []
    untried: list[Untried] = []
    kinds = all_effects()
    shown, there = visible(readings, there), there or ()
    feet = _feet(readings, shown)
    for seen in (*shown, *feet):
        around = surroundings(readings, seen)
        for name, kind in kinds.items():
            if (only is not None and name not in only) or (seen in feet and kind not in OF_FEET):
                continue
            usual = [e for e in instances(kind, around) if not _of_position(e, seen, readings)]
            known = [f for f in there if type(f.effect) is kind and f.effect.component == seen.name]
            late = [e for e in map(_late, (f.effect for f in known)) if e is not None and e not in usual]
            shift = _read_as_shift(seen, shown, readings) if kind is ColumnTilt else None
            shifts = [e.model_copy(update={"component": shift}) for e in usual] if shift is not None else []
            found = [_candidate(e, readings) for e in [*usual, *late, *shifts]]
            found += [EffectCandidate(e, (f.theta,)) for f in known for e in _grown(f.effect, around)]
            out += [c for c in found if c is not None]
            why = lacking(kind, around)
            if not any(found) and why:
                untried.append(Untried(name, seen.name, why))
    # A plug-in that failed for one component is skipped for all.
    skipped = {name: SKIPPED[kind] for name, kind in kinds.items() if kind in SKIPPED}
    untried = [u for u in untried if u.effect not in skipped]
    untried += [Untried(name, "", f"the plug-in is skipped: {fault}") for name, fault in skipped.items()]
    return [c for c in out if type(c.effect) not in SKIPPED], untried


def simple_effects(readings: Readings) -> list[Effect]:
    """Effects of the catalogue that have one number, and no other parameter."""
    machine = readings.machine
    effects = [c.effect for c in library(readings)[0]]
    return [e for e in effects if len(e.coefficients(machine)) == 1 and not e.nonlinear(machine)]


def _of_position(effect: Effect, seen: VisibleComponent, readings: Readings) -> bool:
    """Whether an effect is an angle that grows linearly, jumps or warms, and shifts read it at one lever arm only.

    These readings cannot distinguish it from a scale, a squareness or a straightness; each of them is a candidate too.
    An angle by heat is none for shifts at several arms either: it would stand for a screw that grows, whose temperature
    nobody recorded. Where a sensor of the axis was recorded, the screw is a candidate by that. Nor is an angle that
    jumps: where shifts are read, the set-up jumped.
    """
    grows = 1 in getattr(effect, "degrees", ()) or isinstance(effect, BedBending | AxisExpansion | MissedCounts)
    if not (grows or type(effect) is MountExpansion) or component_unit(seen.name) != "urad":
        return False
    arms = readings.arms(seen.name)
    mine = [arms[s.part] for s in readings.series if arms[s.part].any()]
    shifts = all(s.unit == "um" for s in readings.series if arms[s.part].any())
    one_arm = float(np.ptp(np.concatenate(mine))) < ONE_ARM * float(np.abs(np.concatenate(mine)).max())
    by_others = isinstance(effect, AxisExpansion) and not on_part(effect.axis, [effect.sensor])
    return shifts and (isinstance(effect, BedBending | MissedCounts) or by_others or one_arm)


def _read_as_shift(seen: VisibleComponent, shown: Sequence[VisibleComponent], readings: Readings) -> str | None:
    """The shift of the same part that these readings cannot distinguish from an angle; None where they can.

    Where another link stands for the part, it is that of the link.
    """
    if component_unit(seen.name) != "urad":
        return None
    mine, part = _shape(readings, seen.name), part_of(seen.name)
    shifts = [c for c in shown if component_unit(c.name) == "um" and (part_of(c.name) == part or c.axis is None)]
    alike = (c.name for c in shifts if abs(float(mine @ _shape(readings, c.name))) > 1.0 - ONE_ARM)
    return min(alike, key=lambda name: part_of(name) != part, default=None)


def visible(readings: Readings, there: Sequence[FittedEffect] | None = ()) -> list[VisibleComponent]:
    """Component errors that the readings see; also the angles of the axes that stand and carry the spindle.

    A column tilts about its foot, which may be at any axis of its chain. Angles that move all readings as another
    component does are left out: these readings cannot distinguish them. Of fixed links that are the same in these
    readings one stands for all: that of effects of the model, a spindle, or one that a sensor has its name from.

    Args:
        readings: the readings.
        there: effects of the model; None to leave the first link of each.
    """
    found, machine = visible_components(readings.measurements), readings.machine
    if there is not None:
        found = [_stands_for_all(readings, c, there) for c in found]
    fixed = {c.name[3:] for c in found if c.axis is None}
    carrying = {n for chain in (machine.work_chain, machine.tool_chain) if fixed & set(chain) for n in chain}
    tilts = (f"E{angle}{a.name}" for a in machine.axes if a.name in carrying for angle in "ABC")
    return found + [VisibleComponent(n, axis_of(n, machine), moves=False) for n in _apart(readings, tilts, found)]


def _stands_for_all(readings: Readings, seen: VisibleComponent, there: Sequence[FittedEffect]) -> VisibleComponent:
    """A fixed link's error, or that of the link which stands best for all that are the same in these readings."""
    machine, part = readings.machine, part_of(seen.name)
    if seen.axis is not None or seen.name in {m.instrument.component for m in readings.measurements}:
        return seen
    known, sensors = {f.effect.component for f in there}, machine.sensor_names
    fits = is_spindle(part) or on_part(part, sensors)

    def better(name: str) -> bool:
        return name in known or (not fits and on_part(part_of(name), sensors))

    fixed = [
        c for c in machine.components if c != seen.name and c[1:3] == seen.name[1:3] and axis_of(c, machine) is None
    ]
    if seen.name in known or not any(map(better, fixed)):
        return seen
    same = [c for c in same_components(readings, seen.name) if c in fixed and better(c)]
    best = min(same, key=lambda c: c not in known, default=seen.name)  # the first of those that are best
    return replace(seen, name=best)


def same_components(readings: Readings, component: str) -> list[str]:
    """Other component errors in the same direction that move all readings as one does, but for a factor."""
    mine = _shape(readings, component)
    others = [c for c in readings.machine.components if c != component and c[1] == component[1]]
    return [c for c in others if abs(float(mine @ _shape(readings, c))) > 1.0 - SAME_ARMS]


def same_effects(readings: Readings, effect: Effect, there: Sequence[FittedEffect] = ()) -> list[str]:
    """Components of other parts on which an effect would be the same in these readings: at most one of each part.

    Only of what acts on a part between tool and work as a whole: its heat, its load, the speed or the time, wherever
    the axes are. First the parts that the effect's sensors have their names from, then those of the model, then links.
    """
    machine, channels = readings.machine, effect.channels(readings.machine)
    if not channels or {c for a in machine.axes for c in a.moving_channels} & set(channels):
        return []
    known, sensors = {f.effect.component for f in there}, [c for c in channels if c in machine.sensor_names]
    out: dict[str, str] = {}
    for name in same_components(readings, effect.component):
        if part_of(name) != part_of(effect.component) and _feeds(effect, name, machine):
            out.setdefault(part_of(name), name)

    def order(name: str) -> tuple[bool, bool, bool]:
        return not on_part(part_of(name), sensors), name not in known, axis_of(name, machine) is not None

    return sorted(out.values(), key=order)


def _feeds(effect: Effect, component: str, machine: Machine) -> bool:
    """Whether an effect may be of a component: as in a search, and what tilts a part may be the roll of an axis too."""
    kind = component_kind(component, machine)
    fed = kind in effect.feeds or (kind == "roll" and "tilt" in effect.feeds)
    if not fed or getattr(effect, "axis", None) is not None:
        return False
    try:
        effect.model_copy(update={"component": component}).check(machine, "diagnose")
    except ModelError:
        return False
    return True


def part_of(component: str) -> str:
    """The axis or link that has a component error: X of `EXX` and `EC0X`, wheel of `EX0wheel`."""
    return component[2:].removeprefix("0")


def is_spindle(link: str) -> bool:
    """Whether a link is the spindle by its name."""
    return "spindle" in link.lower() or link.lower() == "s"


def on_part(part: str, sensors: Iterable[str]) -> bool:
    """Whether one of the sensors is on a part by its name: `T_wheel`, `T_col_front` of a column, `T_xnut` of X."""
    name = part.lower()
    words = [w for s in sensors for w in re.split(r"[^a-z]+", s.lower()) if len(w) > 1 or w == name]
    if len(name) < LETTERS:
        return any(w.removeprefix(name) in ("", *OF_AN_AXIS) for w in words if w.startswith(name))
    return any(w == name or (len(w) >= LETTERS and (name.startswith(w) or w.startswith(name))) for w in words)


def away_from(machine: Machine, sensor: str, axis: str, varying: Sequence[str]) -> int:
    """How far a sensor is from an axis, by its name: 0 on it, or where none is; 1 on no axis while others are on this
    one; 2 on another axis.

    Args:
        machine: of both.
        sensor, axis: their names.
        varying: names of all sensors that may be chosen.
    """

    def own(name: str) -> bool:
        others = [a.name for a in machine.axes if a.name != axis]
        return not machine.of_another_axis(name, axis) and any(machine.of_another_axis(name, a) for a in others)

    if machine.of_another_axis(sensor, axis):
        return 2
    return int(not own(sensor) and any(map(own, varying)))


def _feet(readings: Readings, found: Sequence[VisibleComponent]) -> list[VisibleComponent]:
    """Turns of fixed parts, such as a column or a rotary table; only where readings in two directions see them.

    One direction cannot distinguish them from turns of an axis; the ratio of two shows where the foot is.

    Args:
        readings: the readings.
        found: other components that they see.
    """
    machine = readings.machine
    fixed = [n for n in (*machine.work_chain, *machine.tool_chain) if n not in machine.axis_names]
    names = [f"E{angle}0{n}" for n in fixed for angle in "ABC"]

    def in_two_directions(name: str) -> bool:
        arms = readings.arms(name)
        seen = [s for s in readings.series if s.unit == "um" and arms[s.part].any()]
        return len({(readings.measurements[s.source].instrument.axis, s.column) for s in seen}) > 1

    apart = _apart(readings, (n for n in names if n in machine.components and in_two_directions(n)), found)
    return [VisibleComponent(name, None, moves=False) for name in apart]


def _apart(readings: Readings, names: Iterable[str], found: Sequence[VisibleComponent]) -> list[str]:
    """Components that readings see, and whose lever arms differ from those of others and of each other."""
    out, shapes = [], [_shape(readings, c.name) for c in found]
    for name in names:
        shape = _shape(readings, name) if name in readings.machine.components else np.zeros(len(readings))
        if shape.any() and all(abs(float(shape @ s)) < 1.0 - ONE_ARM for s in shapes):
            out.append(name)
            shapes.append(shape)
    return out


def _shape(readings: Readings, component: str) -> Floats:
    """Lever arms of a component on all readings, as a vector of length one, (m,); zero where it is not seen."""
    arms = readings.arms(component)
    length = float(np.linalg.norm(arms))
    return arms / length if length > 0.0 else arms


def surroundings(readings: Readings, seen: VisibleComponent) -> Surroundings:
    """Channels and ranges that an effect can use, from the readings that see a component."""
    machine = readings.machine
    arms = readings.arms(seen.name)
    parts = sorted({s.source for s in readings.series if np.abs(arms[s.part]).max(initial=0.0) > 0.0})
    sources = [(readings.measurements[i], readings.states[i]) for i in parts]
    spans = {name: _span([s for _, s in sources], name) for name in _names(machine, seen)}
    known = {name: span for name, span in spans.items() if span is not None}
    varying = {name: (low, high) for name, (low, high) in known.items() if high - low > real(machine, name)}
    times = [m.time_s for m, _ in sources]
    steps = [np.diff(t) for t in times]
    return Surroundings(
        machine=machine,
        component=seen.name,
        axis=seen.axis if seen.moves else None,
        sensors=tuple(s for s in machine.sensor_names if s in varying),
        still=tuple(s for s in machine.sensor_names if s in known and s not in varying),
        channels=varying,
        span_s=max((float(t[-1] - t[0]) for t in times), default=0.0),
        step_s=min((float(np.median(d[d > 0])) for d in steps if (d > 0).any()), default=1.0),
        places_mm={a.channel: np.concatenate([s.value(a.channel) for _, s in sources]) for a in machine.axes},
        cut=any(m.instrument.name == "work_piece" for m, _ in sources),
    )


def real(machine: Machine, channel: str) -> float:
    """Smallest change of a channel that counts as a motion, in its unit."""
    if channel in machine.sensor_names:
        return REAL["degc"]
    if channel in {a.channel for a in machine.axes}:
        return REAL["mm"]
    head = channel.split("_", maxsplit=1)[0]
    kinds = {"spindle": "rpm", "load": "kg", "force": "n", "v": "mm_s", "a": "mm_s", "s": "mm", "feed": "mm_s"}
    return REAL[kinds.get(head, "other")]


def _names(machine: Machine, seen: VisibleComponent) -> list[str]:
    out = [*machine.sensor_names, "spindle_rpm", "load_kg", "force_n", "time_s", "feed_mm_min"]
    for axis in machine.axes:
        out += [axis.channel, axis.direction_channel, axis.velocity_channel, axis.acceleration_channel]
        out.append(axis.since_reversal_channel)
    del seen
    return out


def _span(states: Sequence[State], name: str) -> tuple[float, float] | None:
    """Lowest and highest value of a channel; None where one of the measurements did not record all of it."""
    values = []
    for state in states:
        try:
            value = np.asarray(state.value(name), dtype=np.float64)
        except ModelError:
            return None
        if not np.isfinite(value).all():
            return None
        values.append(value)
    if not values:
        return None
    return min(float(v.min()) for v in values), max(float(v.max()) for v in values)


def _late(effect: Effect) -> Effect | None:
    """The same effect, delayed behind its temperature; None where it has no delay, or is delayed already."""
    return effect.model_copy(update={"lag": True}) if getattr(effect, "lag", None) is False else None


def _grown(effect: Effect, around: Surroundings) -> list[Effect]:
    """The same wave, its size proportional to a channel that varies; empty for anything but a wave of constant size."""
    if not isinstance(effect, Cyclic) or effect.grows_with is not None:
        return []
    channels = [*around.sensors, *(c for c in GROWTHS if c in around.channels)]
    return [effect.model_copy(update={"grows_with": c}) for c in channels]


def _candidate(effect: Effect, readings: Readings) -> EffectCandidate | None:
    """An effect with its grid; None where it does not fit the machine.

    At targets at equal steps a long wave looks like a short one near the step, and that is the more usual of the two.
    """
    try:
        effect.check(readings.machine, "diagnose")
    except ModelError:
        return None
    if isinstance(effect, AxisExpansion) and effect.stretched and not _warms_through(readings.channel(effect.sensor)):
        return None
    parameters = within_record(effect, readings.measurements)
    if isinstance(effect, CyclicPole) and _fold_mm(readings) > 0.0:
        parameters = [replace(p, high=min(p.high, PITCH_MM)) for p in parameters]
    return EffectCandidate(effect, tuple(_thetas(parameters, readings)))


def _warms_through(degc: Floats) -> bool:
    """Whether a temperature was read on the way from cold to warm: a cold and a warm run show no kink between them."""
    edges = np.linspace(float(np.nanmin(degc)), float(np.nanmax(degc)), STRETCHES + 1)
    return bool((np.histogram(degc[np.isfinite(degc)], edges)[0] >= PASSED * len(degc)).all())


def _thetas(parameters: Sequence[Parameter], readings: Readings) -> Iterator[Mapping[str, float]]:
    grids = [_grid(p, readings) for p in parameters]
    while len(grids) > 1 and np.prod([len(g) for g in grids]) > MOST:
        longest = max(range(len(grids)), key=lambda i: len(grids[i]))
        grids[longest] = grids[longest][::2]
    for values in itertools.product(*grids):
        yield {p.name: float(v) for p, v in zip(parameters, values, strict=True)}


def _grid(parameter: Parameter, readings: Readings) -> tuple[float, ...]:
    if parameter.grid:
        return parameter.grid
    if parameter.unit == "s" and parameter.name.startswith("t0"):
        return _instants(readings)
    low, high = parameter.low, parameter.high
    if parameter.name == "period" and parameter.unit == "mm":
        return _periods(max(low, _fold_mm(readings)), high, _longest_travel_mm(readings))
    if not np.isfinite([low, high]).all() or low >= high:
        return (parameter.start,)
    if low > 0.0:
        return tuple(np.geomspace(low, high, GRID + 2)[1:-1].tolist())
    return tuple(np.linspace(low, high, GRID + 2)[1:-1].tolist())


def _longest_travel_mm(readings: Readings) -> float:
    axes = [a.channel for a in readings.machine.axes]
    return max(float(np.ptp(s.value(c))) for s in readings.states for c in axes)


def _fold_mm(readings: Readings) -> float:
    """Waves at evenly spaced targets fold onto longer ones below this period; zero where targets are uneven."""
    steps = []
    for state in readings.states:
        for axis in readings.machine.axes:
            apart = np.diff(np.unique(np.round(state.value(axis.channel), 4)))
            if len(apart) > 4 and np.std(apart) < 0.02 * np.mean(apart):
                steps.append(2.02 * float(np.mean(apart)))
    return max(steps, default=0.0)


def _periods(low_mm: float, high_mm: float, span_mm: float) -> tuple[float, ...]:
    """Periods even in frequency, as fine as the span can resolve."""
    high_mm = min(high_mm, 0.5 * span_mm)
    if span_mm <= 0.0 or high_mm <= low_mm:
        return (0.5 * (low_mm + high_mm),)
    most = min(FINE * span_mm * (1.0 / low_mm - 1.0 / high_mm), MOST_PERIODS - 2.0)
    return tuple((1.0 / np.linspace(1.0 / high_mm, 1.0 / high_mm + most / (FINE * span_mm), int(most) + 2)).tolist())


def _instants(readings: Readings) -> tuple[float, ...]:
    """Instants at which an event may have happened: between readings, evenly over them, and in every long pause."""
    times = np.unique(np.concatenate([s.time_s for s in readings.series]))
    between, apart = 0.5 * (times[1:] + times[:-1]), np.diff(times)
    if not len(between):
        return (0.0,)
    keep = np.linspace(0, len(between) - 1, min(INSTANTS, len(between)) + 2).astype(np.int64)[1:-1]
    pauses = np.argsort(-apart, kind="stable")[:PAUSES]
    pauses = pauses[apart[pauses] > PAUSE * np.median(apart)]
    return tuple(between[np.unique(np.concatenate([keep, pauses]))].tolist())

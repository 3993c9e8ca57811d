"""Edits of the recorded channels that only a file can need, and the residual of the model with each."""

import itertools
import math
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np

from rtec.arrays import Bools, Floats
from rtec.diagnosis.doubts.doubt import Doubt, Kind
from rtec.effects import State
from rtec.effects.cyclic import Cyclic
from rtec.effects.expression import Expression
from rtec.errors import ModelError
from rtec.estimation import floor
from rtec.estimation.candidates import REAL
from rtec.estimation.changed_delay import AS_GOOD
from rtec.estimation.columns import ordered
from rtec.estimation.gls import solve
from rtec.estimation.readings import Readings, Series
from rtec.machine import Axis
from rtec.metrology.measurement import Measurement
from rtec.metrology.travel import BEYOND
from rtec.model import FittedEffect, Model
from rtec.wording import significant, sizes

SHIFT, SHIFTS, SMOOTH = 0.25, 101, 41
"""How far an origin may have moved, as a share of the travel; number of places in the grid, and where no effect of the
model is a wave or a formula along the axis."""
GROWS = "something that grows shifts the readings as much"
SENSORS_LATE = "the sensors warm up that much later than their parts"
FAR_LESS = 0.75
"""Or, with the model's own numbers refitted, below this share of what the edit leaves."""
THIN, HOPEFUL = 200, 0.95
"""Fewest readings for the first search of the place. It goes on only where that leaves less than this share of the
residual: a fault of the record leaves far less."""
WHOLE_HOUR = 0.05
"""A clock is off by a whole number of hours to within this part of one."""
LATE, LATES = 1 / 3, 41
"""How far the clock of the temperatures may be off, as a share of the record, and number of instants in the grid."""
CHANNEL_FACTORS = (60.0, 1 / 60.0, 1000.0, 1e-3, 25.4, 1 / 25.4, 10.0, 0.1, 5.0, 0.2, 2.0, 0.5, -1.0)
NO_UNIT = (5.0, 0.2, 2.0, 0.5)
"""Factors that no unit of length has: of a position the model's own numbers, out of date, look so."""
CLOCK = "time_s"
RATES = ((60.0, "minutes"), (3600.0, "hours"), (1e-3, "milliseconds"), (1e3, "thousands of seconds"))
OTHER_RATES, APART = (0.25, 4.0), 1.5
"""Units that a time may be in. A rate is asked about where rates that no unit has, this many times it, leave more than
the second factor of what it leaves: a delay that only disappeared, or that never ends, does not tell the rate."""
ABOVE, NEAR_FIT, HALF = 1.5, 1.15, 0.5
"""A model holds no longer where its residual is this many times what it usually is; an edit reaches that within the
second factor. A sensor shows its fault where at least this share of a jump is not the machine's."""
FELL = 8.0
"""A sensor that came off jumps by this many times its largest other step between two readings."""
HELD = 2
"""A sensor may be called lost only where the model met at least this many runs before."""


Replaced = Mapping[str, Callable[[State], Floats]]
"""Channels replaced: of each, what it becomes from the state of a measurement."""


def with_channels(state: State, channels: Replaced) -> State:
    """A state with some channels replaced."""
    changed = {**state.channels, **{c: make(state) for c, make in channels.items() if c != CLOCK}}
    time_s = channels[CLOCK](state) if CLOCK in channels else state.time_s
    return State(state.machine, time_s, changed, state.reference_degc)


@dataclass(frozen=True)
class Edit:
    """An edit of the recorded channels, and the residual of the model with it.

    Attributes:
        residual: of the model with the edit.
        kind, edit, suspect, check: what it is, in words.
        channels: what it replaces.
        times: what it multiplies the readings by.
        unless: what else does the same, in words; empty for nothing.
        rival: what else does the same if an effect describes the readings as well; empty for that effect alone.
        of_unit: whether it multiplies a channel by a factor that a unit has.
        whole_hours: whether it moves a clock by a whole number of hours, as a time zone does.
    """

    residual: float
    kind: Kind
    edit: str
    suspect: str
    check: str
    channels: Replaced = field(default_factory=dict)
    times: float = 1.0
    unless: str = ""
    rival: str = ""
    of_unit: bool = False
    whole_hours: bool = False

    @property
    def fatal(self) -> bool:
        """Whether nothing else does the same."""
        return not self.unless

    def doubt(self, before: float, unit: str) -> Doubt:
        """The doubt in words; `before` is the residual without the edit."""
        here, there = sizes(self.times * self.residual, before)
        message = f"with {self.edit} the model leaves {here} instead of {there} {unit}: {self.suspect}."
        if not self.fatal:
            message = f"{message[:-1]}, unless {self.unless}."
        return Doubt(self.kind, message, f"Check {self.check} before a new effect is blamed.", fatal=self.fatal)


def _swapped(pairs: Iterable[tuple[str, str]]) -> Replaced:
    """Channels exchanged in pairs."""
    out: dict[str, Callable[[State], Floats]] = {}
    for one, two in pairs:
        out |= {one: lambda s, c=two: s.channels[c], two: lambda s, c=one: s.channels[c]}  # type: ignore[misc]
    return out


def _fell(m: Measurement, name: str, run: float) -> bool:
    """Whether a sensor jumps from one reading to the next, into a run, far more than anywhere else: it came off."""
    steps, at = np.abs(np.diff(m.channels[name])), int(np.argmax(m.run == run)) - 1
    return bool(steps[at] > FELL * max(np.delete(steps, at).max(initial=0.0), REAL["degc"]))


def _celsius(fahrenheit: Floats) -> Floats:
    return (fahrenheit - 32.0) / 1.8


class Edits:
    """Edits that only a file can need: a channel in another unit, two labels exchanged, an axis homed elsewhere."""

    def __init__(self, model: Model, readings: Readings, scale: Floats, parts: Sequence[Floats] | None = None) -> None:
        self.model, self.readings, self.scale = model, readings, scale
        machine = model.machine
        self.read = {c for f in model.effects for c in f.effect.channels(machine)}
        self.parts = [self._part(f, readings) for f in model.effects] if parts is None else parts
        # Of effects of the model: where the lever arm is not zero, and the contribution over it, (m,) each.
        self._by_arm: dict[int, tuple[Bools, Floats]] = {}

    def _only(self, keep: Bools) -> "Edits":
        """The same with some of the readings, (m,)."""
        if keep.all():
            return self
        there = np.array([keep[s.part].any() for s in self.readings.series])
        parts = [p[keep] for p in self.parts]
        return Edits(self.model, self.readings.without(~keep), self.scale[there], parts)

    @cached_property
    def _thin(self) -> "Edits":
        """The same with fewer readings, for a first search on a grid."""
        return self._only(np.arange(len(self.readings)) % max(len(self.readings) // THIN, 1) == 0)

    def possible(self) -> list[Edit]:
        """Every edit that is possible here."""
        return [
            *self._factors(), *self._fahrenheit(), *self._exchanged(), *self._axes_exchanged(), *self._moved(),
            *self._turned(), *self._late(), *self._other_rate(),
        ]  # fmt: skip

    def residuals(self, edits: Sequence[Replaced]) -> Floats:
        """Root mean square of the residual with some channels replaced, (edits,); infinite where that is impossible.

        Args:
            edits: of each, the replacement of a channel, from the state of a measurement.
        """
        out, kept = np.full(len(edits), np.inf), [self.left(e) for e in edits]
        there = [i for i, left in enumerate(kept) if left is not None]
        if not there:
            return out
        whole = floor.cleaned(self.readings, np.stack([left for left in kept if left is not None], axis=1))
        for i, left in zip(there, whole.T, strict=True):
            out[i] = floor.pooled(self.readings, floor.rms_by_series(self.readings, left), self.scale)
        return out

    def left(self, channels: Replaced) -> Floats | None:
        """Residual of the model with some channels replaced, (m,); None where that is impossible."""
        states = []
        for state in self.readings.states:
            if any(c not in state.channels for c in channels if c != CLOCK):
                return None
            states.append(with_channels(state, channels))
        changed_readings = self.readings.with_states(states)
        left = self.readings.values.copy()
        # Lever arms and directions depend on the positions, and delays on the time.
        moved = [a for a in self.model.machine.axes if a.channel in channels]
        edited = {*channels, *(c for a in moved for c in a.moving_channels)}
        try:
            for i, (fitted, part) in enumerate(zip(self.model.effects, self.parts, strict=True)):
                if CLOCK in channels or edited & set(fitted.effect.channels(self.model.machine)):
                    left -= self._part(fitted, changed_readings)
                else:
                    left -= self._at_arms(i, changed_readings) if moved else part
        except ModelError:
            return None
        return left if np.isfinite(left).all() else None

    def by_offsets(self, first: int) -> tuple[list[tuple[int, str]], Floats]:
        """How the model's prediction changes where a sensor reads 1 K more in one of several files, (m, n).

        Args:
            first: number of the first file; 1 for differences from file 0.

        Returns:
            number of the file and sensor of each column, and the columns; none for a single file.
        """
        source = np.array([s.source for s in self.readings.series])[self.readings.series_of]
        sensors = sorted(self.read & set(self.model.machine.sensor_names))
        names, out = list[tuple[int, str]](), list[Floats]()
        now = self.left({}) if len(self.readings.states) > 1 else None
        for sensor in sensors if now is not None else ():
            warmer = self.left({sensor: lambda s, c=sensor: s.channels[c] + 1.0})  # type: ignore[misc]
            if now is None or warmer is None:
                continue
            for k in range(first, len(self.readings.states)):
                names.append((k, sensor))
                out.append(np.where(source == k, now - warmer, 0.0))
        return names, np.stack(out, axis=1) if out else np.empty((len(self.readings), 0))

    def _part(self, fitted: FittedEffect, readings: Readings) -> Floats:
        with np.errstate(all="ignore"):
            columns = readings.columns(fitted.effect, fitted.theta)
        return np.asarray(columns @ ordered(fitted, readings))

    def _at_arms(self, i: int, moved: Readings) -> Floats:
        """Contribution of an effect that reads no position, with the lever arms of other positions, (m,)."""
        fitted = self.model.effects[i]
        with np.errstate(all="ignore"):
            arms = moved.arms(fitted.effect.component)
        if i not in self._by_arm:
            here = self.readings.arms(fitted.effect.component)
            known = here != 0.0
            self._by_arm[i] = known, np.where(known, self.parts[i] / np.where(known, here, 1.0), 0.0)
        known, by_arm = self._by_arm[i]
        return arms * by_arm if not np.any(arms[~known]) else self._part(fitted, moved)

    def _factors(self) -> Iterator[Edit]:
        for channel in sorted(self.read - {"time_s"}):
            if channel.startswith("d_"):
                continue
            suspect, check = "its unit or its scale in the file may be wrong", "that column"
            factors = [f for f in CHANNEL_FACTORS if self._within_travel(channel, f)]
            factors = [f for f in factors if self._as_warm_as_others(channel, partial(operator.mul, f))]
            times = [{channel: lambda s, c=channel, f=f: f * s.channels[c]} for f in factors]
            still = min(self._without_change(channel), self._without_effects(channel))
            for factor, residual, made in zip(factors, self.residuals(times), times, strict=True):
                if AS_GOOD * float(residual) > still:
                    continue  # it only takes away what the model has by that channel
                by = f"{factor:g}" if abs(factor) >= 1.0 else f"1/{1.0 / factor:g}"
                edit, of_unit = f"{channel} times {by}", factor not in NO_UNIT
                yield Edit(float(residual), "wrong_channel", edit, suspect, check, made, of_unit=of_unit)
            if channel in self.model.machine.sensor_names:
                celsius: Replaced = {channel: lambda s, c=channel: _celsius(s.channels[c])}  # type: ignore[misc]
                residual, edit = self.residuals([celsius])[0], f"{channel} read as °F"
                if AS_GOOD * float(residual) > still or not self._as_warm_as_others(channel, _celsius):
                    continue
                yield Edit(float(residual), "wrong_channel", edit, suspect, check, celsius, of_unit=True)

    def _fahrenheit(self) -> Iterator[Edit]:
        """All temperatures in °F: each is in its sensor's range either way."""
        names = [n for n in self.model.machine.sensor_names if all(n in s.channels for s in self.readings.states)]
        if len(names) < 2 or not self.read & set(names):
            return
        celsius: Replaced = {n: lambda s, c=n: _celsius(s.channels[c]) for n in names}  # type: ignore[misc]
        for name in names:
            low, high = self.model.machine.sensors[self.model.machine.sensor_place(name)].range_degc
            shown = np.concatenate([celsius[name](s) for s in self.readings.states])
            if np.nanmin(shown) < low or np.nanmax(shown) > high:
                return
        still = min(self._without_effects(n) for n in names)
        residual = float(self.residuals([celsius])[0])
        if AS_GOOD * residual <= still:
            suspect = "they may be in °F"
            yield Edit(
                residual, "wrong_channel", "all temperatures read as °F", suspect, "their unit", celsius, of_unit=True
            )

    def _without_change(self, channel: str) -> float:
        """Root mean square of the residual if a channel had its median throughout."""
        values = np.concatenate(
            [s.channels[channel] for s in self.readings.states if channel in s.channels] or [np.zeros(1)]
        )
        median = float(np.nanmedian(values))
        return float(self.residuals([{channel: lambda s: np.full(len(s), median)}])[0])

    def _without_effects(self, channel: str) -> float:
        """Least root mean square of the residual without effects of the model that read a channel."""
        reads = [channel in f.effect.channels(self.model.machine) for f in self.model.effects]
        some = [p for p, r in zip(self.parts, reads, strict=True) if r]
        whole = self.left({})
        if whole is None or not some:
            return math.inf
        left = floor.cleaned(self.readings, np.stack([whole + p for p in (*some, np.sum(some, axis=0))], axis=1))
        return min(floor.pooled(self.readings, floor.rms_by_series(self.readings, v), self.scale) for v in left.T)

    def _as_warm_as_others(self, channel: str, edited: Callable[[Floats], Floats]) -> bool:
        """Whether an edited temperature is one that its sensor can show, and no further from the others than before.

        True of all other channels.
        """
        machine = self.model.machine
        if channel not in machine.sensor_names:
            return True
        states = [s for s in self.readings.states if channel in s.channels]
        low, high = machine.sensors[machine.sensor_place(channel)].range_degc
        shown = np.concatenate([edited(s.channels[channel]) for s in states])
        if np.nanmin(shown) < low or np.nanmax(shown) > high:
            return False
        names = [n for n in machine.sensor_names if n != channel and all(n in s.channels for s in states)]
        others = float(np.median([np.nanmedian(np.concatenate([s.channels[n] for s in states])) for n in names] or [0]))
        was = np.concatenate([s.channels[channel] for s in states])
        return not names or abs(float(np.nanmedian(shown)) - others) < abs(float(np.nanmedian(was)) - others)

    def _within_travel(self, channel: str, factor: float) -> bool:
        """Whether a position times a factor that a unit has is within the travel; true of all other channels.

        Targets cover most of the travel: positions that are within it as they are recorded are not too large.
        """
        axis = next((a for a in self.model.machine.axes if a.channel == channel), None)
        if axis is None:
            return True
        places = [s.channels[channel] for s in self.readings.states if channel in s.channels]
        if factor in NO_UNIT or (abs(factor) < 1.0 and self._in_travel(axis, places)):
            return False
        return self._in_travel(axis, [factor * p for p in places])

    def _in_travel(self, axis: Axis, places: Sequence[Floats]) -> bool:
        """Whether positions are within the travel of an axis, or hardly beyond it."""
        low, high = axis.travel_mm
        beyond = BEYOND * (high - low)
        return all(low - beyond <= float(np.nanmin(p)) and float(np.nanmax(p)) <= high + beyond for p in places)

    def _exchanged(self) -> Iterator[Edit]:
        sensors = [n for n in self.model.machine.sensor_names if all(n in s.channels for s in self.readings.states)]
        suspect = "the two sensors, or their columns, may be exchanged"
        for one, two in itertools.combinations(sensors, 2):
            if {one, two} & self.read:
                swap = {one: lambda s, c=two: s.channels[c], two: lambda s, c=one: s.channels[c]}
                left, edit = float(self.residuals([swap])[0]), f"{one} and {two} exchanged"
                if AS_GOOD * left > min(self._without_effects(one), self._without_effects(two)):
                    continue
                yield Edit(left, "swapped_sensors", edit, suspect, "their labels", swap)

    def _axes_exchanged(self) -> Iterator[Edit]:
        """The positions of two axes exchanged, with their directions or without."""
        axes = [a for a in self.model.machine.axes if all(a.channel in s.channels for s in self.readings.states)]
        for one, two in itertools.combinations(axes, 2):
            places = {a.channel: [s.channels[a.channel] for s in self.readings.states] for a in (one, two)}
            if not {one.channel, two.channel} & self.read or not (
                self._in_travel(one, places[two.channel]) and self._in_travel(two, places[one.channel])
            ):
                continue
            swaps = [_swapped(((one.channel, two.channel),))]
            pairs = zip(one.moving_channels, two.moving_channels, strict=True)
            there = [p for p in pairs if all(c in s.channels for s in self.readings.states for c in p)]
            swaps += [_swapped(there)] if len(there) > 1 else []
            left = self.residuals(swaps)
            best, found = swaps[int(np.argmin(left))], float(np.min(left))
            if AS_GOOD * found > min(self._without_effects(one.channel), self._without_effects(two.channel)):
                continue
            edit = f"{one.channel} and {two.channel} exchanged"
            yield Edit(found, "swapped_axes", edit, "their columns may be exchanged", "both columns", best)

    def _other_rate(self) -> Iterator[Edit]:
        """The time in another unit, where delays make it matter."""
        current = self._current

        def at(rate: float) -> Replaced:
            return {CLOCK: lambda s: rate * s.time_s}

        for rate, unit in RATES:
            found = float(self.residuals([at(rate)])[0])
            if found > HALF * current:
                continue
            if APART * found > float(np.min(self.residuals([at(rate * other) for other in OTHER_RATES]))):
                continue
            by = f"{rate:g}" if rate >= 1.0 else f"1/{1.0 / rate:g}"
            edit, suspect = f"time_s times {by}", f"it may be in {unit}"
            yield Edit(found, "wrong_rate", edit, suspect, "that column", at(rate), of_unit=True)

    def _moved(self) -> Iterator[Edit]:
        for axis in self.model.machine.axes:
            if axis.channel not in self.read:
                continue

            def moved(by_mm: float, channel: str = axis.channel) -> Replaced:
                return {channel: lambda s: s.channels[channel] + by_mm}

            def left(by_mm: float, at: Callable[[float], Replaced] = moved) -> float:
                return float(self.residuals([at(by_mm)])[0])

            low, high = self._room(axis)
            by = self._place(axis, moved, low, high) if high - low >= REAL["mm"] else None
            if by is None:
                continue
            edit = f"{axis.channel} moved by {significant(by, sign=True)} mm"
            suspect = f"{axis.name} may have been homed elsewhere than when the model was made"
            found = left(by)
            apart = self._shifted(axis) > AS_GOOD * found
            where = f"the origin of {axis.name}"
            yield Edit(found, "moved_origin", edit, suspect, where, moved(by), unless="" if apart else GROWS)

    def _place(self, axis: Axis, at: Callable[[float], Replaced], low: float, high: float) -> float | None:
        """The value between two bounds at which an edit of an axis leaves least: on a grid with few readings, then all.

        None where even that leaves so much of the residual that it is no fault of the record.
        """
        from scipy.optimize import minimize_scalar

        along = [f.effect for f in self.model.effects if axis.channel in f.effect.channels(self.model.machine)]
        wavy = any(isinstance(e, Cyclic | Expression) for e in along)
        grid = np.linspace(low, high, SHIFTS if wavy else SMOOTH)
        left = self._thin.residuals([at(v) for v in grid])
        if not left.min() < HOPEFUL * self._thin._current:
            return None
        best = float(grid[np.argmin(left)])
        step = float(grid[1] - grid[0])
        bounds = max(best - step, low), min(best + step, high)
        return float(minimize_scalar(lambda v: self.residuals([at(v)])[0], bounds=bounds, method="bounded").x)

    def _turned(self) -> Iterator[Edit]:
        """An axis whose positions were counted from the other end: x is c - x, and its direction the other one."""
        for axis in self.model.machine.axes:
            if axis.channel not in self.read:
                continue

            def turned(about_mm: float, axis: Axis = axis) -> Replaced:
                out = {axis.channel: lambda s: about_mm - s.channels[axis.channel]}
                for name in (axis.direction_channel, axis.velocity_channel):
                    if all(name in s.channels for s in self.readings.states):
                        out[name] = lambda s, c=name: -s.channels[c]  # type: ignore[misc]
                return out

            (low, high), (first, last) = axis.travel_mm, self._reached(axis)
            beyond = BEYOND * (high - low)
            if last - first < REAL["mm"] or low - beyond + last > high + beyond + first:
                continue
            about = self._place(axis, turned, low - beyond + last, high + beyond + first)
            if about is None:
                continue
            middle, found = self.residuals([turned(low + high), turned(about)])
            about = low + high if middle < AS_GOOD * found else about
            yield Edit(
                float(self.residuals([turned(about)])[0]),
                "turned_axis",
                f"{axis.name} turned round ({axis.channel} read as {about:.4g} mm - {axis.channel})",
                f"{axis.name} may have been counted from its other end",
                f"the direction of {axis.name} in that file",
            )

    def _reached(self, axis: Axis) -> tuple[float, float]:
        """Smallest and largest position of an axis in the readings, mm."""
        places = np.concatenate([s.channels[axis.channel] for s in self.readings.states])
        return float(np.nanmin(places)), float(np.nanmax(places))

    def _late(self) -> Iterator[Edit]:
        """Temperatures by another clock than the readings; where their record has ended, readings are left out."""
        from scipy.optimize import minimize_scalar

        names = sorted(self.read & set(self.model.machine.sensor_names))
        span = max((float(np.ptp(s.time_s)) for s in self.readings.states if len(s)), default=0.0)
        if not names or span <= 0.0:
            return

        def moved(by_s: float) -> Replaced:
            return {n: lambda s, c=n: np.interp(s.time_s + by_s, s.time_s, s.channels[c]) for n in names}  # type: ignore[misc]

        def left(by_s: float, few: "Edits" = self) -> float:
            """Residual with the temperatures moved, no less of the current one than where these are known."""
            there = few._within(by_s)
            now, current = there.residuals([moved(by_s), {}])
            return float(max(now, few._current * now / max(current, 1e-300)))

        grid = np.linspace(-LATE * span, LATE * span, LATES)
        coarse = np.array([left(by, self._thin) for by in grid])
        if not coarse.min() < HOPEFUL * self._thin._current:
            return
        best = float(grid[np.argmin(coarse)])
        step = float(grid[1] - grid[0])
        by = float(minimize_scalar(left, bounds=(best - step, best + step), method="bounded").x)
        way, hours = "earlier" if by > 0.0 else "later", abs(by) / 3600.0
        whole = round(hours) >= 1 and abs(hours - round(hours)) < WHOLE_HOUR
        yield Edit(
            left(by),
            "late_temperatures",
            f"all temperatures moved {60.0 * hours:.0f} min {way}",
            "their clock may not be that of the readings" + (", by time zone or summer time" if whole else ""),
            "the time of both",
            moved(by),
            rival=SENSORS_LATE if by > 0.0 else "",
            whole_hours=whole,
        )

    def lost(self, usual: float) -> Iterator[Edit]:
        """A sensor that shows something else than its part from a run on: an error of its own in each run explains all.

        The model met the runs before, in which the sensor changed about as much. It jumps into the run by a larger
        share of that than any other; the machine does not, and no change of it since then, alike in all runs, explains
        that.

        Args:
            usual: residual of the model where nothing is wrong.
        """
        whole = self.left({})
        names = sorted(self.read & set(self.model.machine.sensor_names))
        if whole is None or not names:
            return
        for i, m in enumerate(self.readings.measurements):
            run = np.concatenate(
                [m.run[s.row] if s.source == i else np.zeros(len(s)) - 1 for s in self.readings.series]
            )
            runs = np.unique(run[run >= 0])
            beyond = self._first_beyond(run, runs, whole, ABOVE * usual)
            for first, name in itertools.product((beyond, beyond - 1), names):  # a delay hides the first run
                if first < HELD:
                    continue
                jump, share = self._jump(i, name, runs[first - 1], runs[first])
                others = (
                    self._jump(i, n, runs[first - 1], runs[first])[1]
                    for n in self.readings.machine.sensor_names
                    if n != name
                )
                most = all(o * np.sign(share) < abs(share) for o in others)
                if abs(jump) < REAL["degc"] or abs(share) > 1.0 / HALF or not most:
                    continue
                fell = _fell(m, name, runs[first])
                left, alike, off = self._off(i, name, run >= runs[first], runs[first:], whole, sloped=fell)
                unmoved = -off / jump
                shows = HALF < unmoved[0] < 1.0 / HALF and (fell or float(np.median(unmoved)) > HALF)
                if shows and left < min(NEAR_FIT * usual, FAR_LESS * alike):
                    yield Edit(
                        left,
                        "lost_sensor",
                        f"{name} of {m.name} unknown from run {int(runs[first])} on",
                        f"it jumps by {significant(jump, 2, sign=True)} K there, which the machine does not show, and "
                        "may have come loose",
                        "that sensor and its cable",
                    )

    def _jump(self, source: int, name: str, last: float, first: float) -> tuple[float, float]:
        """Jump of a sensor of a file from a run to another, K, and over its range before; zero where it is not read."""
        m, shown = self.readings.measurements[source], self.readings.states[source].channels.get(name)
        if shown is None:
            return 0.0, 0.0
        jump = float(np.median(shown[m.run == first]) - np.median(shown[m.run == last]))
        return jump, jump / max(float(np.ptp(shown[m.run < first])), REAL["degc"])

    def _first_beyond(self, run: Floats, runs: Floats, whole: Floats, holds: float) -> int:
        """Which of some runs is the first with which the model no longer holds; 0 for none.

        Args:
            run: run of each reading, negative in other files, (m,).
            runs: the runs of a file, in order.
            whole: residual, (m,).
            holds: up to which the model holds.
        """
        readings = self.readings
        for last in range(1, len(runs)):
            drop = (run > runs[last]) | (run < 0)
            few = readings.without(drop)
            there = np.array([not drop[s.part].all() for s in readings.series])
            left = floor.rms_by_series(few, floor.cleaned(few, whole[~drop]))
            if floor.pooled(few, left, self.scale[there]) > holds:
                return last
        return 0

    def _off(
        self, source: int, name: str, since: Bools, runs: Floats, whole: Floats, *, sloped: bool
    ) -> tuple[float, float, Floats]:
        """Residual if a sensor was off by an amount of its own in each of some runs, and these amounts, K.

        Between them: the residual if the machine changed then, by as much as one amount makes without a delay.

        Args:
            source: number of the file.
            name: the sensor.
            since: readings of these runs, (m,).
            runs: the last runs of the file.
            whole: residual, (m,).
            sloped: whether the amount may also change evenly within each run, as a part warms on without its sensor.
        """
        m, state = self.readings.measurements[source], self.readings.states[source]

        def by(off: Floats) -> Floats:
            changed = self.left({name: lambda s: s.channels[name] + (off if s is state else 0.0)})
            return np.zeros(len(since)) if changed is None else whole - changed

        def left(columns: Floats) -> tuple[float, Floats]:
            errors = solve(columns, read)
            rms = floor.rms_by_series(self.readings, read - columns @ errors)
            return floor.pooled(self.readings, rms, self.scale), errors

        ends = [float(m.time_s[m.run <= r].max()) for r in (float(runs[0]) - 1.0, *runs)]
        within = [(m.time_s > begin) & (m.time_s <= end) for begin, end in itertools.pairwise(ends)]
        own = [by(some.astype(np.float64)) for some in within]
        if sloped:
            middle = [some * (m.time_s - m.time_s[some].mean()) / max(np.ptp(m.time_s[some]), 1.0) for some in within]
            own += [by(evenly) for evenly in middle]
        alike = np.where(since, by(np.ones(len(m))), 0.0)
        flat = floor.cleaned(self.readings, np.stack([*own, alike, whole], axis=1))
        read = flat[:, -1]
        (one, off), (other, _) = left(flat[:, :-2]), left(flat[:, -2:-1])
        return one, other, off[: len(within)]

    def _within(self, by_s: float) -> "Edits":
        """The same with the readings at which moved channels are known."""
        times = [s.time_s for s in self.readings.states]
        out = [
            (t < times[s.source][0] - by_s) | (t > times[s.source][-1] - by_s)
            for s in self.readings.series
            for t in [s.time_s]
        ]
        drop = np.concatenate(out)
        return self if drop.all() else self._only(~drop)

    @cached_property
    def _current(self) -> float:
        """Root mean square of the residual without an edit."""
        return float(self.residuals([{}])[0])

    def _room(self, axis: Axis) -> tuple[float, float]:
        """Smallest and largest shift of an origin, mm: positions stay within the travel."""
        low, high = axis.travel_mm
        reach, beyond = SHIFT * (high - low), BEYOND * (high - low)
        first, last = self._reached(axis)
        return max(-reach, low - beyond - first), min(reach, high + beyond - last)

    def _reads(self, series: Series, axis: Axis) -> bool:
        """Whether the model's prediction of a series depends on the position of an axis."""
        reads = [axis.channel in f.effect.channels(self.model.machine) for f in self.model.effects]
        return any(r and bool(np.any(p[series.part])) for r, p in zip(reads, self.parts, strict=True))

    def _shifted(self, axis: Axis) -> float:
        """Root mean square of the residual beside shifts proportional to the model's prediction along an axis.

        Growth of a part at the mount of the axis shifts the readings of that axis as another origin does.
        """
        here = [f.effect.channels(self.model.machine) for f in self.model.effects]
        names = sorted(
            {c for read in here if axis.channel in read for c in read} & set(self.model.machine.sensor_names)
        )
        left = self.left({})
        if left is None or not names:
            return math.inf
        mine = np.isin(self.readings.series_of, [i for i, s in enumerate(self.readings.series) if self._reads(s, axis)])
        values = [np.where(mine, self.readings.channel(n), 0.0) for n in names]
        columns = floor.cleaned(self.readings, np.stack([*values, left], axis=1))
        shifts = columns[:, :-1]
        rest = columns[:, -1] - shifts @ solve(shifts, columns[:, -1])
        return floor.pooled(self.readings, floor.rms_by_series(self.readings, rest), self.scale)

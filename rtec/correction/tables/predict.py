"""From a model to a table, and what the table cannot express."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import prod

import numpy as np

from rtec.arrays import Floats
from rtec.correction.tables.heidenhain import LEAST_MM, exponent
from rtec.correction.tables.table import NO_PLACES, CompensationTable, HeatLine, TableFormat
from rtec.effects.derived import FAR_MM
from rtec.errors import ConfigError
from rtec.machine import Axis, Machine
from rtec.machine.machine import CONSTANT_CHANNELS
from rtec.model import Model
from rtec.tomlfile import nearest

History = tuple[Floats, Mapping[str, Floats]]
"""Instants, s, rising, (m,), and slow channels at them, (m,) each, for effects that lag; the last instant is now."""
PER_STEP, LEAST = 10, 200
"""Positions in each step of a table at which the model is compared with it."""
FEW, MANY = 21, 200
"""Values at which the model is searched over the range of a channel: one that sets a shape, one with a finer shape."""
GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
LEAST_HEAT_UM = 1e-3
"""An effect of one °C below this, µm, gets no line."""


@dataclass(frozen=True)
class TableResidual:
    """Residual of a table: the part of the model's prediction that it cannot express.

    Attributes:
        what: cause, in words.
        largest_um: largest difference between model and table, µm, where that alone changes.
    """

    what: str
    largest_um: float


def conditions(model: Model, axis: Axis, given: Mapping[str, float]) -> dict[str, float]:
    """A value for each slow channel that the model reads, and for the other axes (the middle of their travel).

    Args:
        model: the model whose channels are needed.
        axis: axis of the table.
        given: by sensor, by other axis, or `spindle_rpm`.

    Raises:
        ConfigError: a name is unknown, or a temperature that the model reads is missing.
    """
    machine = model.machine
    others = [a for a in machine.axes if a.name != axis.name]
    known = {*machine.slow_channels, *(a.name for a in others)}
    for name in given:
        if name not in known:
            raise ConfigError(f"--at {name}: no temperature, spindle_rpm or other axis{nearest(name, known)}")
    allowed = {a.name: a.travel_mm for a in others} | {s.name: s.range_degc for s in machine.sensors}
    for name, value in given.items():
        low, high = allowed.get(name, (0.0, 1e6))
        if not low <= value <= high:
            raise ConfigError(f"--at {name}={value:g}: outside the machine's own range, {low:g} to {high:g}")
    missing = [s for s in machine.sensor_names if s in model.channels and s not in given]
    if missing:
        raise ConfigError(
            f"--at: the model reads {', '.join(missing)}: give --at {','.join(f'{m}=20' for m in missing)}"
        )
    out = {a.name: 0.5 * sum(a.travel_mm) for a in others}
    out |= {name: 0.0 for name in ("spindle_rpm", *CONSTANT_CHANNELS) if name in model.channels}
    return out | dict(given)


def table_axes(machine: Machine, name: str) -> tuple[Axis, Axis, Axis | None]:
    """The axis that moves, the axis that is corrected, and for a plane the second axis that moves.

    Args:
        machine: the machine that has the axes.
        name: an axis; a component as EYX, the error of Y along X; or as EZXY, the error of Z over X and Y.

    Raises:
        ConfigError: the name is none of these.
    """
    names = machine.axis_names
    if name in names:
        return machine.axis(name), machine.axis(name), None
    corrected, moved = name[1:2], name[2:]
    if name[:1] == "E" and corrected in names:
        if moved in names and moved != corrected:
            return machine.axis(moved), machine.axis(corrected), None
        for first in names:
            second = moved.removeprefix(first)
            if second != moved and second in names and second != first:
                return machine.axis(first), machine.axis(corrected), machine.axis(second)
    raise ConfigError(
        f"{name!r} is no axis, no component as EYX (error of Y along X) and none as EZXY (error of Z over X and Y)"
        f"{nearest(name, names)}"
    )


def table_of(
    model: Model,
    axis: Axis,
    corrects: Axis,
    positions_mm: Floats,
    at: Mapping[str, float],
    history: History | None = None,
    second: Axis | None = None,
    second_mm: Floats = NO_PLACES,
) -> CompensationTable:
    """The errors that a model predicts along an axis, or over the plane of two, one value a direction.

    Beyond the travel the last straight line extends to the next point, so that the table is right up to the end of the
    travel.

    Args:
        model: at rest, far from a reversal.
        axis: axis that moves.
        corrects: axis along whose direction the error is taken.
        positions_mm: (n,), rising.
        at: result of `conditions`.
        history: the slow channels until now; not given: they have long been as in `at`.
        second: the other axis that moves.
        second_mm: (m,), its positions, rising.
    """
    predicted = _Predicted(model, axis, corrects, second, history)

    def errors(direction: float) -> Floats:
        def row(changed: Mapping[str, float]) -> Floats:
            known = {**at, **changed}
            return _to_travel(lambda places: predicted.um(places, known, direction), positions_mm, axis)

        if second is None:
            return row({})
        rows = {y: row({second.name: y}) for y in np.clip(second_mm, *second.travel_mm).tolist()}
        edge = np.array(list(rows))
        columns = np.stack(list(rows.values())).T

        def across(column: Floats) -> Floats:
            return _to_travel(lambda places: np.interp(places, edge, column), second_mm, second)

        return np.stack([across(column) for column in columns]).T

    return CompensationTable(
        axis.name,
        corrects.name,
        positions_mm,
        errors(1.0),
        errors(-1.0),
        {k: v for k, v in at.items() if second is None or k != second.name},
        second.name if second else "",
        second_mm,
    )


def with_heat(model: Model, table: CompensationTable) -> CompensationTable:
    """Add the effect of each °C as straight lines; a table between axes gets none, since no control supports that."""
    machine = model.machine
    axis = machine.axis(table.axis)
    if table.second or table.axis != table.corrects:
        return table
    predicted = _Predicted(model, axis, axis, None, None)
    low, high = axis.travel_mm
    reference = 0.0 if low <= 0.0 <= high else low
    places = np.linspace(low, high, 4 * PER_STEP + 1)

    def line(sensor: str) -> HeatLine:
        degc = table.at[sensor]
        warm, cold = (
            np.mean([predicted.um(places, {**table.at, sensor: t}, d) for d in (1.0, -1.0)], axis=0)
            for t in (degc + 0.5, degc - 0.5)
        )
        slope, offset = np.polyfit(places - reference, warm - cold, 1)
        off = np.abs(warm - cold - offset - slope * (places - reference)).max()
        return HeatLine(sensor, reference, float(offset), 1e3 * float(slope), float(off))

    lines = (line(sensor) for sensor in machine.sensor_names if sensor in model.channels)
    half = 0.5 * (high - low)
    return replace(
        table, heat=tuple(h for h in lines if abs(h.offset_um) + 1e-3 * half * abs(h.slope_um_per_m) > LEAST_HEAT_UM)
    )


def residuals(
    model: Model, table: CompensationTable, history: History | None = None, slow: bool = True
) -> list[TableResidual]:
    """The residuals of a table, largest first: at and between its points, heat, speed, other axes; last a constant.

    Each cause is changed alone: a temperature and the speed over the range that the model was fitted in, another axis
    over its travel and in both directions.

    Args:
        model: model that the table expresses.
        table: as the format holds it.
        history: as in `table_of`.
        slow: False: without heat and speed, for a table that is rewritten when they change.
    """
    machine = model.machine
    axis, corrects = machine.axis(table.axis), machine.axis(table.corrects)
    at: dict[str, float | Floats] = dict(table.at)
    second = machine.axis(table.second) if table.second else None
    predicted = _Predicted(model, axis, corrects, second, history)

    def worst(per_step: int) -> float:
        places = _places(table.positions_mm, axis, per_step)
        across = _places(table.second_mm, second, min(per_step, 2)) if second else np.zeros(1)
        every = np.tile(places, len(across))
        known = {**at, table.second: np.repeat(across, len(places))}
        return max(
            float(np.abs(predicted.um(every, known, d) - table.zero_um - np.concatenate(rows)).max())
            for d in (1.0, -1.0)
            for rows in [[table.error_um(places, d, y) for y in across.tolist()]]
        )

    out = [
        TableResidual("at its points (rounding, direction)", worst(1)),
        TableResidual("between its points", worst(PER_STEP)),
    ]
    places = _searched(model, axis.name, *axis.travel_mm, FEW)
    if second:
        across = _some(_searched(model, second.name, *second.travel_mm, FEW))
        places = _some(places)
        at[second.name], places = np.repeat(across, len(places)), np.tile(places, len(across))
    for name, (low, high) in _ranges(model, machine, axis).items():
        if name == table.second or (not slow and name not in machine.axis_names):
            continue
        unit = "°C" if name in machine.sensor_names else "1/min" if name == "spindle_rpm" else "mm"
        out.append(
            TableResidual(
                f"{name} from {low:g} to {high:g} {unit} (table: {table.at.get(name, 0.0):g})",
                max(predicted.change_um(places, at, name, (low, high), d) for d in (1.0, -1.0)),
            )
        )
    constant = [TableResidual("a constant: the format has a zero", abs(table.zero_um))] if table.zero_um else []
    return sorted(out, key=lambda r: -r.largest_um) + constant


def beyond(model: Model, at: Mapping[str, float], moves: Sequence[Axis] = ()) -> list[str]:
    """What is outside the range that the model was fitted in, a sentence each; the loop would hold there.

    Args:
        model: model with its range.
        at: values by sensor, axis, or `spindle_rpm`.
        moves: axes that move over their whole travel.
    """
    channels = {a.name: a.channel for a in model.machine.axes}
    out = []
    for name, value in [*at.items(), *((a.name, end) for a in moves for end in a.travel_mm)]:
        low, high = model.valid_range.get(channels.get(name, name), (-np.inf, np.inf))
        if not low <= value <= high:
            out.append(f"{name} is outside the range of the model ({low:g} to {high:g}): {value:.4g}")
    return out


def checked(table: CompensationTable, form: TableFormat) -> CompensationTable:
    """The table as the format holds it.

    Raises:
        ConfigError: the format cannot hold it.
    """
    why = form.refuses(table)
    if why:
        raise ConfigError(f"{form.title} {why}")
    return form.held(table)


def grids_mm(form: TableFormat, axis: Axis, second: Axis | None, step_mm: float) -> tuple[Floats, Floats]:
    """Even positions that cover the travel of an axis, and of the second axis of a plane (else none).

    Args:
        form: format, which fixes the grid.
        axis: axis of the travel.
        second: second axis of a plane.
        step_mm: distance of the points.

    Raises:
        ConfigError: more points than the format allows.
    """
    limits, axes = form.limits, [axis] if second is None else [axis, second]
    travels = [a.travel_mm for a in axes]
    step_mm = min(step_mm, max(max(-low, high) if limits.grid == "origin" else high - low for low, high in travels))
    if limits.grid == "origin":
        step_mm = max(0.001, round(step_mm, 3))
    elif limits.grid == "steps":
        step_mm = max(1e-4, round(step_mm, 4))
    elif limits.grid == "powers":
        step_mm = LEAST_MM * 2 ** exponent(step_mm)
    ends = []
    for low, high in travels:
        zero = (min(0.0, low), max(0.0, high)) if limits.grid == "origin" else (0.0, high - low)
        ends.append((-_steps(-zero[0] / step_mm), max(_steps(zero[1] / step_mm), 1)))
    count = prod(last - first + 1 for first, last in ends)
    if count > limits.most_points:
        raise ConfigError(
            f"{form.title} takes 2 to {limits.most_points} points, the table has {count}: choose another --grid"
        )

    def places(a: Axis, first: int, last: int) -> Floats:
        low, high = a.travel_mm
        if limits.grid == "travel":
            return np.linspace(low, high, last + 1)
        return (0.0 if limits.grid == "origin" else low) + step_mm * np.arange(first, last + 1, dtype=np.float64)

    grids = [places(a, *end) for a, end in zip(axes, ends, strict=True)]
    return grids[0], grids[1] if second else NO_PLACES


def _steps(ratio: float) -> int:
    return int(np.ceil(ratio - 1e-9))


def _places(points_mm: Floats, axis: Axis, per_step: int) -> Floats:
    """The points within the travel, or about `per_step` places in each step between points, at least `LEAST`.

    Each is elsewhere in its part of the step, by the golden ratio: an error that repeats with a pitch, of which the
    step is a multiple, is seen in all its phases.
    """
    low, high = max(points_mm[0], axis.travel_mm[0]), min(points_mm[-1], axis.travel_mm[1])
    if per_step == 1 or low >= high:
        return np.unique(np.clip(points_mm, low, high))
    parts = np.arange(max(per_step * (len(points_mm) - 1), LEAST))
    share = (parts + GOLDEN * parts % 1.0) / len(parts)
    return np.concatenate([[low], low + (high - low) * share, [high]])


def _to_travel(errors: Callable[[Floats], Floats], points_mm: Floats, axis: Axis) -> Floats:
    """Errors at points; the first point beyond the travel gets the value that makes the line exact at its end."""
    low, high = axis.travel_mm
    values = errors(np.clip(points_mm, low, high)).copy()
    inside = np.flatnonzero((points_mm >= low) & (points_mm <= high))
    if len(inside):
        for beyond, last, end in (
            (slice(inside[-1] + 1, None), inside[-1], high),
            (slice(None, inside[0]), inside[0], low),
        ):
            outer = points_mm[beyond]
            gap = end - points_mm[last]
            if len(outer) and abs(gap) > 1e-9:
                first = outer[np.abs(outer - end).argmin()]
                edge = values[beyond][0]
                values[beyond] = values[last] + (edge - values[last]) * (first - points_mm[last]) / gap
    return values


def _searched(model: Model, channel: str, low: float, high: float, count: int) -> Floats:
    """Values at which the largest error over a range is looked for: its ends, the model's knots, and some between.

    Those between are spread by the golden ratio, so that an error of no period shows them one phase only.
    """
    knots = [
        k for f in model.effects if getattr(f.effect, "axis", "") == channel for k in getattr(f.effect, "knots_mm", ())
    ]
    between = low + (high - low) * (GOLDEN * np.arange(count) % 1.0)
    return np.unique(np.clip(np.r_[low, high, knots, between], low, high))


def _some(places: Floats) -> Floats:
    """A dozen of the places, with both ends: enough for each axis of a plane."""
    return places[np.linspace(0, len(places) - 1, min(len(places), 12)).astype(np.intp)]


def _ranges(model: Model, machine: Machine, axis: Axis) -> dict[str, tuple[float, float]]:
    slow = [name for name in (*machine.sensor_names, "spindle_rpm") if name in model.channels]
    out = {name: model.valid_range[name] for name in slow if name in model.valid_range}
    out |= {a.name: a.travel_mm for a in machine.axes if a.name != axis.name}
    return out


@dataclass(frozen=True)
class _Predicted:
    """Prediction for a table of these axes."""

    model: Model
    axis: Axis
    corrects: Axis
    second: Axis | None
    history: History | None

    def um(self, positions_mm: Floats, at: Mapping[str, float | Floats], direction: float) -> Floats:
        """Errors at positions; for an axis that does not move itself, relative to the middle of the travel."""
        errors = self._error_um(positions_mm, at, direction)
        moving = [self.axis, *([self.second] if self.second else [])]
        if self.corrects.name in [a.name for a in moving]:
            return errors
        middle = {a.name: 0.5 * sum(a.travel_mm) for a in moving}
        there = np.full_like(positions_mm, middle[self.axis.name])
        known = {**at, **middle}
        return errors - 0.5 * (self._error_um(there, known, 1.0) + self._error_um(there, known, -1.0))

    def change_um(
        self,
        positions_mm: Floats,
        at: Mapping[str, float | Floats],
        name: str,
        ends: tuple[float, float],
        direction: float,
    ) -> float:
        """Largest change of the errors, µm, where one channel alone goes over its range."""
        axis = next((a for a in self.model.machine.axes if a.name == name), None)
        values = _searched(self.model, name, *ends, MANY if axis else FEW)
        ways = (1.0, -1.0) if axis and axis.direction_channel in self.model.channels else (1.0,)
        before = self.um(positions_mm, at, direction)

        def change(values: Floats, way: float) -> float:
            n, changed = len(values), {name: np.repeat(values, len(positions_mm))}
            every = {k: np.tile(v, n) if isinstance(v, np.ndarray) else v for k, v in at.items()} | changed
            known = every | ({axis.direction_channel: way} if axis else {})
            after = self.um(np.tile(positions_mm, n), known, direction)
            return float(np.abs(after - np.tile(before, n)).max())

        blocks = [values] if axis else values[:, None]  # an effect of a temperature may lag: one value a call
        return max(change(block, way) for block in blocks for way in ways)

    def _error_um(self, positions_mm: Floats, at: Mapping[str, float | Floats], direction: float) -> Floats:
        """The mean over both directions of each axis whose direction the table does not know."""
        ways = [
            a.direction_channel
            for a in self.model.machine.axes
            if a.name != self.axis.name and a.direction_channel in self.model.channels and a.direction_channel not in at
        ]
        every = [dict(zip(ways, d, strict=True)) for d in itertools.product((1.0, -1.0), repeat=len(ways))]
        return np.asarray(np.mean([self._at_um(positions_mm, {**at, **d}, direction) for d in every], axis=0))

    def _at_um(self, positions_mm: Floats, at: Mapping[str, float | Floats], direction: float) -> Floats:
        model, machine, n = self.model, self.model.machine, len(positions_mm)
        times, before = self.history or (np.zeros(0), {})
        m = len(times)
        time_s = np.r_[times, np.full(n, times[-1] if m else 0.0)]
        positions_mm = np.r_[np.full(m, positions_mm[0]), positions_mm]
        n += m
        channels: dict[str, Floats] = {}
        for a in machine.axes:
            moves = a.name == self.axis.name
            place = np.asarray(at[a.name] if not moves else 0.0)
            channels[a.channel] = positions_mm if moves else np.r_[np.full(m, place.flat[0]), np.full(n - m, place)]
            channels[a.direction_channel] = np.full(n, direction if moves else at.get(a.direction_channel, 1.0))
            channels[a.since_reversal_channel] = np.full(n, FAR_MM)
            channels[a.velocity_channel] = channels[a.acceleration_channel] = np.zeros(n)
        channels |= {name: np.full(n, at.get(name, model.reference_degc)) for name in machine.sensor_names}
        channels |= {name: np.full(n, at.get(name, 0.0)) for name in ("spindle_rpm", *CONSTANT_CHANNELS)}
        for name, values in before.items():
            channels[name][:m] = values
        tip = model.predict(model.state(time_s, channels))
        return np.asarray(tip[m:, "XYZ".index(self.corrects.direction)])

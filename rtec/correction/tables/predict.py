"""From a model to a table, and what the table cannot express."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rtec.correction.tables.table import CompensationTable, Floats, TableFormat
from rtec.effects.derived import FAR_MM
from rtec.errors import ConfigError
from rtec.machine import Axis, Machine
from rtec.machine.machine import CONSTANT_CHANNELS
from rtec.model import Model
from rtec.tomlfile import nearest

History = tuple[Floats, Mapping[str, Floats]]
"""Instants, s, rising, (m,), and slow channels at them, (m,) each, for effects that lag: the last one is now."""
BETWEEN = 10
"""Positions in each step of a table at which the model is compared with it."""


@dataclass(frozen=True)
class TableResidual:
    """What a table leaves of the model's prediction.

    Attributes:
        what: cause, in words.
        largest_um: largest difference between model and table, µm, where that alone changes.
    """

    what: str
    largest_um: float


def conditions(model: Model, axis: Axis, given: Mapping[str, float]) -> dict[str, float]:
    """Give a value for each slow channel that the model reads, and for the other axes (the middle of their travel).

    Args:
        model: whose machine and effects.
        axis: along which the table is.
        given: by sensor, by other axis, or `spindle_rpm`.

    Raises:
        ConfigError: a name that is none, or a temperature that the model reads is not given.
    """
    machine = model.machine
    others = [a for a in machine.axes if a.name != axis.name]
    known = {*machine.slow_channels, *(a.name for a in others)}
    for name in given:
        if name not in known:
            raise ConfigError(f"--at {name}: no temperature, spindle_rpm or other axis{nearest(name, known)}")
    missing = [s for s in machine.sensor_names if s in model.channels and s not in given]
    if missing:
        raise ConfigError(
            f"--at: the model reads {', '.join(missing)}: give --at {','.join(f'{m}=20' for m in missing)}"
        )
    out = {a.name: 0.5 * sum(a.travel_mm) for a in others}
    out |= {name: 0.0 for name in ("spindle_rpm", *CONSTANT_CHANNELS) if name in model.channels}
    return out | dict(given)


def table_axes(machine: Machine, name: str) -> tuple[Axis, Axis]:
    """Give the axis that moves and the one that is corrected, of an axis' name or of a component such as EYX.

    Raises:
        ConfigError: neither.
    """
    if name in machine.axis_names:
        return machine.axis(name), machine.axis(name)
    moved, corrected = name[2:], name[1:2]
    if name[:1] == "E" and {moved, corrected} <= set(machine.axis_names) and moved != corrected:
        return machine.axis(moved), machine.axis(corrected)
    raise ConfigError(
        f"{name!r} is no axis and no component as EYX (error of Y along X){nearest(name, machine.axis_names)}"
    )


def table_of(
    model: Model,
    axis: Axis,
    corrects: Axis,
    positions_mm: Floats,
    at: Mapping[str, float],
    history: History | None = None,
) -> CompensationTable:
    """Give the errors that a model predicts along an axis, one value a direction.

    Args:
        model: at rest, far from a reversal.
        axis: that moves.
        corrects: axis along whose direction the error is taken.
        positions_mm: (n,), rising.
        at: of `conditions`.
        history: of the slow channels until now; not given: they have been as in `at` for long.
    """
    forward, backward = (_error_um(model, axis, corrects, positions_mm, at, d, history) for d in (1.0, -1.0))
    return CompensationTable(axis.name, corrects.name, positions_mm, forward, backward, dict(at))


def residuals(
    model: Model, table: CompensationTable, history: History | None = None, slow: bool = True
) -> list[TableResidual]:
    """Give what the table cannot express, largest first: between its points, direction, heat, speed, other axes.

    Each is tried alone, at the ends of the range that the model was fitted in (of the travel, for axes).

    Args:
        model: what is expressed.
        table: as the format holds it.
        history: as `table_of`.
        slow: False: without heat and speed, for a table that is rewritten when they change.
    """
    machine = model.machine
    axis, corrects = machine.axis(table.axis), machine.axis(table.corrects)
    at = dict(table.at)
    fine = np.linspace(table.positions_mm[0], table.positions_mm[-1], BETWEEN * (len(table.positions_mm) - 1) + 1)

    def worst(places: Floats, changed: Mapping[str, float]) -> float:
        return max(
            float(
                np.abs(
                    _error_um(model, axis, corrects, places, {**at, **changed}, d, history) - table.error_um(places, d)
                ).max()
            )
            for d in (1.0, -1.0)
        )

    own = worst(table.positions_mm, {})
    out = [
        TableResidual("at its points (rounding, direction)", own),
        TableResidual("between its points", worst(fine, {})),
    ]
    for name, (low, high) in _ranges(model, machine, axis).items():
        if not slow and name not in machine.axis_names:
            continue
        unit = "°C" if name in machine.sensor_names else "1/min" if name == "spindle_rpm" else "mm"
        out.append(
            TableResidual(
                f"{name} from {low:g} to {high:g} {unit} (table: {at.get(name, 0.0):g})",
                max(worst(table.positions_mm, {name: value}) for value in (low, high)),
            )
        )
    return sorted(out, key=lambda r: -r.largest_um)


def checked(table: CompensationTable, form: TableFormat) -> CompensationTable:
    """Give the table as the format holds it.

    Raises:
        ConfigError: the format cannot hold it.
    """
    why = form.limits.refuses(table)
    if why:
        raise ConfigError(f"{form.title} {why}")
    return form.limits.held(table)


def grid_mm(axis: Axis, step_mm: float) -> Floats:
    """Give even positions over the travel of an axis, at most `step_mm` apart."""
    low, high = axis.travel_mm
    return np.linspace(low, high, max(2, int(np.ceil((high - low) / step_mm - 1e-9)) + 1))


def _ranges(model: Model, machine: Machine, axis: Axis) -> dict[str, tuple[float, float]]:
    slow = [name for name in (*machine.sensor_names, "spindle_rpm") if name in model.channels]
    out = {name: model.valid_range[name] for name in slow if name in model.valid_range}
    out |= {a.name: a.travel_mm for a in machine.axes if a.name != axis.name}
    return out


def _error_um(
    model: Model,
    axis: Axis,
    corrects: Axis,
    positions_mm: Floats,
    at: Mapping[str, float],
    direction: float,
    history: History | None,
) -> Floats:
    machine, n = model.machine, len(positions_mm)
    times, before = history or (np.zeros(0), {})
    m = len(times)
    time_s = np.r_[times, np.full(n, times[-1] if m else 0.0)]
    positions_mm = np.r_[np.full(m, positions_mm[0]), positions_mm]
    n += m
    channels: dict[str, Floats] = {}
    for a in machine.axes:
        moves = a.name == axis.name
        channels[a.channel] = positions_mm if moves else np.full(n, at[a.name])
        channels[a.direction_channel] = np.full(n, direction if moves else 1.0)
        channels[a.since_reversal_channel] = np.full(n, FAR_MM)
        channels[a.velocity_channel] = channels[a.acceleration_channel] = np.zeros(n)
    channels |= {name: np.full(n, at.get(name, model.reference_degc)) for name in machine.sensor_names}
    channels |= {name: np.full(n, at.get(name, 0.0)) for name in ("spindle_rpm", *CONSTANT_CHANNELS)}
    for name, values in before.items():
        channels[name][:m] = values
    tip = model.predict(model.state(time_s, channels))
    return np.asarray(tip[m:, "XYZ".index(corrects.direction)])

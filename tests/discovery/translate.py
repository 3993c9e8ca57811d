"""From the generator's plain description to the program's own objects."""

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.effects import Effect, effect_class
from rtec.machine import Machine, machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from tests.discovery.generator import machine as plain
from tests.discovery.generator.dataset import Dataset
from tests.discovery.generator.thermal import SENSORS

Floats = NDArray[np.float64]


@cache
def the_machine() -> Machine:
    """The generator's machine, through the door of a machine file."""
    axes: dict[str, Any] = {name: {**table, "counts_per_mm": plain.COUNTS_PER_MM} for name, table in plain.AXES.items()}
    return machine_from(
        {
            "machine": {
                "name": "hidden-mill",
                "tool_chain": list(plain.TOOL_CHAIN),
                "work_chain": list(plain.WORK_CHAIN),
            },
            "axis": axes,
            "link": {name: {"offset_mm": list(offset)} for name, offset in plain.LINKS.items()},
            "temperature": {name: {} for name in SENSORS},
        },
        "generator",
    )


def measurement_of(dataset: Dataset, *, unseen: bool = False) -> Measurement:
    """The measurement; the runs that are left out have no readings unless `unseen` asks for theirs alone."""
    machine, c = the_machine(), dataset.campaign
    axis = c.axis if c.instrument in ("laser_linear", "laser_angular", "straightness") else None
    instrument = make_instrument(c.instrument, c.setup, axis, None, machine, dataset.case.label)
    hide = dataset.unseen != unseen
    readings = {
        column.name: np.where(hide, np.nan, values) for column, values in zip(c.columns, dataset.readings, strict=True)
    }
    return Measurement(
        name=f"{c.kind}-{dataset.case.seed}",
        instrument=instrument,
        machine=machine,
        run=c.run,
        time_s=c.time_s,
        channels=dict(dataset.channels),
        readings=readings,
    )


def base_model(dataset: Dataset, measurement: Measurement) -> Model:
    """The user's model: the known effects, fitted to the readings by least squares with the instrument's unknowns.

    Isolated jumps are left out first, by their distance from the fit.
    """
    effects = [made(k.effect) for k in dataset.base]
    empty = Model(measurement.machine, name="current")
    if not effects:
        return empty
    columns = np.concatenate([readings_of(e, measurement)[None] for e in effects])
    state = measurement.state()
    unknown = [n.values for n in measurement.instrument.nuisance(state, measurement.run)]
    whole = np.concatenate([columns, np.array(unknown)]).reshape(len(effects) + len(unknown), -1).T
    y = measurement.matrix().ravel()
    keep = np.isfinite(y)
    for _ in range(3):
        found = np.linalg.lstsq(whole[keep], y[keep], rcond=None)[0]
        off = np.abs(y - whole @ found)
        keep = np.isfinite(y) & (off < 6.0 * 1.4826 * np.nanmedian(off))
    fitted = tuple(
        FittedEffect(e, {e.coefficients(measurement.machine)[0].name: float(v)}, {})
        for e, v in zip(effects, found, strict=False)
    )
    return Model(measurement.machine, fitted, name="current")


def made(table: Any) -> Effect:
    """An effect from its table."""
    return effect_class(table["effect"], "benchmark").model_validate(dict(table))


def readings_of(effect: Effect, measurement: Measurement) -> Floats:
    """What one unit of an effect with one number adds to every column, (columns, n)."""
    state = measurement.state()
    (basis,) = effect.basis(measurement.machine, state, {})
    arms = measurement.instrument.arms_of(measurement.machine, state.positions_mm(), effect.component)
    return np.asarray(arms * basis)


def said_by(model: Model, measurement: Measurement) -> Floats:
    """What a model predicts of every reading, on the channels as recorded, (columns, n)."""
    state = model.state(measurement.time_s, measurement.channels)
    pose = state.positions_mm()
    out = np.zeros((len(measurement.instrument.columns()), len(state)))
    for fitted, value in zip(model.effects, model.effect_components(state), strict=True):
        out += measurement.instrument.arms_of(model.machine, pose, fitted.effect.component) * value
    return out

"""A trial as objects of rtec: machine, model and measurements."""

import json
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from rtec.bench.rig.campaign import Record
from rtec.bench.trials import Trial
from rtec.effects import effect_class
from rtec.machine import Machine, machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model


@cache
def _machine(text: str) -> Machine:
    return machine_from(json.loads(text), "bench")


def machine_of(trial: Trial) -> Machine:
    """The machine from the trial's machine file."""
    return _machine(json.dumps(trial.machine))


def model_of(trial: Trial) -> Model:
    """The model with the effects that are known."""
    made = tuple(FittedEffect(_effect(table), dict(values), {}) for table, values in trial.base)
    return Model(machine_of(trial), made, name="known")


def _effect(table: Mapping[str, Any]) -> Any:
    return effect_class(table["effect"], "bench").model_validate(dict(table))


def measurements_of(trial: Trial) -> list[Measurement]:
    """The records as measurements."""
    machine = machine_of(trial)
    return [_measurement(r, machine) for r in trial.records]


def _measurement(record: Record, machine: Machine) -> Measurement:
    plan = record.plan
    instrument = make_instrument(plan.instrument, dict(plan.setup), plan.axis, None, machine, record.name)
    return Measurement(
        name=record.name,
        instrument=instrument,
        machine=machine,
        run=np.asarray(plan.run, dtype=np.int64),
        time_s=plan.time_s,
        channels=dict(record.channels),
        readings=dict(record.readings),
    )

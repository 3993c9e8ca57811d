"""Tests from files and planned tests; and the default effects of a question."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rtec.effects import Effect, effect_class
from rtec.effects.effect_list import read_wanted
from rtec.effects.registry import instances
from rtec.errors import ConfigError
from rtec.estimation.candidates import surroundings, visible
from rtec.estimation.readings import read
from rtec.machine import Machine
from rtec.metrology.files.load import load_measurements
from rtec.metrology.instruments.base import Instrument
from rtec.metrology.instruments.registry import INSTRUMENTS, make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model, load_model
from rtec.sim.campaign.campaign import simulate
from rtec.sim.campaign.settings import Settings
from rtec.tomlfile import read_kind, validated

USUAL = (
    "scale",
    "straightness",
    "squareness",
    "parallelism",
    "guide_curvature",
    "guide_twist",
    "backlash",
    "angular_reversal",
    "axis_expansion",
    "spindle_growth",
)
"""Default effects of a question: each once for every component error that the tests see."""


def load_test(path: Path, machine: Machine) -> Measurement:
    """Read a test: a measurement, or a TOML that describes a planned one.

    A planned test has the `[measurement]` and `[setup]` tables of a measurement's TOML, and the tables of
    `rtec simulate --settings` (`[targets]`, `[[phase]]`, …) for where and when.

    Raises:
        RtecError: the file is malformed; the message says where.
    """
    if path.suffix != ".toml" or path.with_suffix(".csv").exists() or path.with_suffix(".parquet").exists():
        table = path if path.suffix != ".toml" else _table_beside(path)
        return load_measurements([table], machine)[0]
    content = read_kind(path, "a measurement")
    head = content.pop("measurement", None)
    if not isinstance(head, Mapping) or not isinstance(head.get("instrument"), str):
        raise ConfigError(f"{path}: [measurement] instrument is missing; one of: {', '.join(INSTRUMENTS)}")
    setup = content.pop("setup", {})
    instrument = make_instrument(
        str(head["instrument"]), setup, head.get("axis"), head.get("component"), machine, str(path)
    )
    return dry(machine, instrument, validated(Settings, content, str(path)), path.stem)


def _table_beside(path: Path) -> Path:
    csv = path.with_suffix(".csv")
    return csv if csv.exists() else path.with_suffix(".parquet")


def dry(machine: Machine, instrument: Instrument, settings: Settings, name: str) -> Measurement:
    """Poses, times and temperatures of a planned test."""
    return simulate(Model(machine, name="nothing"), instrument, settings, 1, name)


def usual_effects(measurements: Sequence[Measurement], names: Sequence[str] = USUAL) -> list[Effect]:
    """Effects in question by default."""
    readings = read(measurements, smooth=False)
    out: list[Effect] = []
    for seen in visible(readings):
        around = surroundings(readings, seen)
        for name in names:
            kind = effect_class(name, "plan")
            first = next(iter(instances(kind, around)), None)
            if first is not None:
                out.append(first)
    return out


def thinned(measurement: Measurement, most: int = 30_000) -> Measurement:
    """Every n-th row, so that planning stays quick: whole runs where there are many."""
    if len(measurement) <= most:
        return measurement
    keep = np.unique(np.linspace(0, len(measurement) - 1, most).astype(np.int64))
    state = measurement.state()
    channels = {n: v[keep] for n, v in measurement.channels.items()}
    for axis in measurement.machine.axes:
        if axis.channel in measurement.channels:
            channels[axis.direction_channel] = state.value(axis.direction_channel)[keep]
    return dataclasses.replace(
        measurement,
        run=measurement.run[keep],
        time_s=measurement.time_s[keep],
        channels=channels,
        readings={n: v[keep] for n, v in measurement.readings.items()},
    )


def wanted_effects(
    text: str | None,
    model: Path | None,
    measurements: Sequence[Measurement],
    machine: Machine,
    option: str = "--effects",
) -> list[FittedEffect]:
    """Effects in question: named in a text, those of a model, or the usual ones; each with its numbers.

    Numbers that are not given are the usual ones.

    Args:
        text: list of effects, as the user typed it.
        model: file of a model.
        measurements: tests.
        machine: of the tests.
        option: what the user typed the list after, for messages.

    Raises:
        ConfigError: no effect remains.
        ModelError: an unknown effect, component or argument.
    """
    out: list[FittedEffect] = []
    if model is not None:
        out += load_model(model, machine).effects
    if text is not None:
        wanted = read_wanted(text, machine, option, with_numbers=True)
        out += [at_usual(e, machine, n) for e, n in zip(wanted.exact, wanted.numbers, strict=True)]
        usual = usual_effects(measurements, wanted.names) if wanted.names else []
        out += [at_usual(e, machine) for e in usual]
    if text is None and model is None:
        out = [at_usual(e, machine) for e in usual_effects(measurements)]
    if not out:
        raise ConfigError(f"plan: these tests see none of the effects in question; name some with {option}")
    return out


def at_usual(effect: Effect, machine: Machine, given: Mapping[str, float] | None = None) -> FittedEffect:
    """An effect at its usual size, non-linear parameters where a search begins; but for the given numbers."""
    numbers = given or {}
    return FittedEffect(
        effect,
        {p.name: numbers.get(p.name, p.typical) for p in effect.coefficients(machine)},
        {p.name: numbers.get(p.name, p.start) for p in effect.nonlinear(machine)},
    )

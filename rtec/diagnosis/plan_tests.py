"""Tests that exist as files, tests that are only planned, and tests that might be added."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtec.diagnosis.candidates import surroundings, visible
from rtec.diagnosis.plan import Extra
from rtec.diagnosis.readings import read
from rtec.effects import Effect, effect_class
from rtec.errors import ConfigError, RtecError
from rtec.machine import Axis, Machine
from rtec.metrology.files import load_measurements
from rtec.metrology.instruments.base import Instrument
from rtec.metrology.instruments.registry import INSTRUMENTS, make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.sim.campaign import simulate
from rtec.sim.campaign_settings import Settings
from rtec.tomlfile import read_toml, validated

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
"""Effects that are asked about where none are named: each once for every component error that the tests see."""
BESIDE_MM = 200.0


def load_test(path: Path, machine: Machine) -> Measurement:
    """Read a test: a measurement, or a TOML that only says what would be measured.

    A planned test has the `[measurement]` and `[setup]` tables of a measurement's TOML, and the tables of
    `rtec simulate --settings` (`[targets]`, `[[phase]]`, …) for where and when.

    Raises:
        RtecError: what is wrong in it.
    """
    if path.suffix != ".toml" or path.with_suffix(".csv").exists() or path.with_suffix(".parquet").exists():
        table = path if path.suffix != ".toml" else _table_beside(path)
        return load_measurements([table], machine)[0]
    content = dict(read_toml(path))
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
    """Poses, times and temperatures of a test that nobody has made yet."""
    return simulate(Model(machine, name="nothing"), instrument, settings, 1, name)


def usual_effects(measurements: Sequence[Measurement], names: Sequence[str] = USUAL) -> list[Effect]:
    """Effects that are asked about where none are named."""
    readings = read(measurements, smooth=False)
    out: list[Effect] = []
    for seen in visible(readings):
        around = surroundings(readings, seen)
        for name in names:
            kind = effect_class(name, "plan")
            first = next(iter(kind.suggest(around)), None)
            if first is not None:
                out.append(first)
    return out


@dataclass(frozen=True)
class _Idea:
    name: str
    instrument: str
    setup: Mapping[str, Any]
    axis: str | None
    component: str | None
    settings: Mapping[str, Any]


def extra_tests(machine: Machine) -> list[Extra]:
    """Tests that can be made on a machine with the usual instruments; those that do not fit it are left out."""
    out = []
    for idea in (i for axis in machine.axes for i in _along(axis, machine)):
        made = _made(idea, machine)
        if made is not None:
            out.append(made)
    whole = _Idea("tool-tip probing over the workspace, cold", "tool_tip", {}, None, None, {"protocol": "cold"})
    drift = _Idea(
        "drift probes, spindle on and off over 8 h", "spindle_drift", _probes(), None, None, {"protocol": "drift"}
    )
    for idea in (whole, drift):
        made = _made(idea, machine)
        if made is not None:
            out.append(made)
    return out


def _probes() -> dict[str, Any]:
    from rtec.sim.campaign_order import DRIFT_PROBES

    return {"probe": dict(DRIFT_PROBES)}


def _along(axis: Axis, machine: Machine) -> Iterator[_Idea]:
    name, cold = axis.name, {"protocol": "cold", "cycles": 2}
    yield _Idea(f"laser along {name}, both ways, cold", "laser_linear", {}, name, None, cold)
    for across in "XYZ".replace(axis.direction, ""):
        at = [BESIDE_MM if letter == across else 0.0 for letter in "XYZ"]
        where = f"beam {BESIDE_MM:g} mm from the tool along {across}"
        yield _Idea(
            f"laser along {name}, both ways, cold, {where}", "laser_linear", {"beam_offset_mm": at}, name, None, cold
        )
    warm = {"protocol": "warm_up", "cycles": 2}
    yield _Idea(f"laser along {name} through a warm-up", "laser_linear", {}, name, None, warm)
    for letter in "ABC":
        component = f"E{letter}{name}"
        what = {"A": "about X", "B": "about Y", "C": "about Z"}[letter]
        yield _Idea(f"angular laser along {name}, {what}, cold", "laser_angular", {}, name, component, cold)
    for letter in "XYZ":
        if letter != axis.direction:
            component = f"E{letter}{name}"
            yield _Idea(f"straightness of {name} in {letter}, cold", "straightness", {}, name, component, cold)
    others = [a.name for a in machine.axes if a.name != name]
    for other in others:
        setup = {"reference_axis": other}
        yield _Idea(f"square between {name} and {other}", "squareness", setup, name, None, cold)


def _made(idea: _Idea, machine: Machine) -> Extra | None:
    """The test, where the instrument fits the machine."""
    try:
        instrument = make_instrument(idea.instrument, idea.setup, idea.axis, idea.component, machine, "plan")
        measurement = dry(machine, instrument, validated(Settings, dict(idea.settings), "plan"), idea.name)
    except RtecError:
        return None
    hours = float(measurement.time_s[-1] - measurement.time_s[0]) / 3600.0
    return Extra(idea.name, dataclasses.replace(measurement, name=idea.name), max(hours, 0.05))


def thinned(measurement: Measurement, most: int = 3000) -> Measurement:
    """Every so many-th row, so that planning stays quick: whole runs where there are many."""
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
    text: str | None, model: Path | None, measurements: Sequence[Measurement], machine: Machine
) -> list[Effect]:
    """What is to be found: named in a text, those of a model, or the usual ones.

    Raises:
        ConfigError: nothing is left to ask about.
        ModelError: an unknown effect, component or argument.
    """
    from rtec.metrology.characterise.wanted import read_wanted
    from rtec.model import load_model

    out: list[Effect] = []
    if model is not None:
        out += [f.effect for f in load_model(model, machine).effects]
    if text is not None:
        wanted = read_wanted(text, machine)
        out += [*wanted.exact, *(usual_effects(measurements, wanted.names) if wanted.names else [])]
    if text is None and model is None:
        out = usual_effects(measurements)
    if not out:
        raise ConfigError("plan: these tests see none of the effects in question; name some with --effects")
    return out

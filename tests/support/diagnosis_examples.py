"""A small machine with two axes and two sensors, and laser measurements of it, for the tests of diagnosis."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from numpy.typing import NDArray

from rtec.cli.main import status
from rtec.machine import Machine, machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from rtec.sim.campaign.campaign import simulate
from rtec.sim.campaign.settings import Settings
from rtec.sim.campaign.truth import effect_from_text
from tests.support.machines import axis

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

TABLE: Mapping[str, Any] = {
    "machine": {"name": "small", "tool_chain": ["Z", "X", "tool"], "work_chain": ["workpiece"]},
    "axis": {
        "X": axis("X", travel_mm=[0.0, 200.0], pitch_mm=5.0),
        "Z": axis("Z", pitch_mm=10.0),
    },
    "link": {"tool": {"offset_mm": [120.0, 0.0, 80.0]}, "workpiece": {"offset_mm": [0.0, 0.0, 0.0]}},
    "temperature": {"T_bed": {}, "T_air": {}},
}
NOISE_UM = 0.3
QUICK = {"targets": {"step_mm": 13.7}, "cycles": 2, "noise": {"white_um": NOISE_UM}}
"""Eighteen runs of thirty readings over a day's warm-up."""


def small_machine() -> Machine:
    """Give the machine."""
    return machine_from(TABLE, "small")


def effects(*texts: str) -> tuple[FittedEffect, ...]:
    """Effects with numbers, each written as for `rtec simulate --effect`."""
    return tuple(effect_from_text(t, small_machine()) for t in texts)


def laser(
    truth: Sequence[str], seed: int, along: str = "X", setup: Mapping[str, Any] | None = None, **more: Any
) -> Measurement:
    """What a laser along an axis reads of a machine with true effects; `more` replaces tables of the settings."""
    return read_by("laser_linear", truth, seed, along, setup, **more)


def read_by(
    name: str, truth: Sequence[str], seed: int, along: str = "X", setup: Mapping[str, Any] | None = None, **more: Any
) -> Measurement:
    """What an instrument along an axis reads of a machine with true effects."""
    machine = small_machine()
    instrument = make_instrument(name, dict(setup or {}), along, None, machine, "test")
    model = Model(machine, effects(*truth), name="truth")
    settings = Settings.model_validate({**QUICK, **more})
    return simulate(model, instrument, settings, seed, f"{name.partition('_')[0]}-{along.lower()}-{seed}")


def recorded_by_laser(
    seed: int, run: Ints, time_s: Floats, channels: dict[str, Floats], reading_um: Floats, **unread: Floats
) -> Measurement:
    """A laser record along X on the small machine: a test's readings, channels, and columns that nothing reads."""
    machine = small_machine()
    return Measurement(
        name=f"laser-{seed}",
        instrument=make_instrument("laser_linear", {}, "X", None, machine, "test"),
        machine=machine,
        run=run,
        time_s=time_s,
        channels=channels,
        readings={"reading_um": reading_um},
        unread=unread,
    )


def write_machine(folder: Path) -> Path:
    """Write the machine file where the commands look for it."""
    path = folder / "machine.toml"
    path.write_text(tomli_w.dumps(TABLE), encoding="utf-8")
    return path


def write_laser(folder: Path, truth: Sequence[str], seed: int, along: str = "X", **more: Any) -> Path:
    """Simulate a laser with the command; give the table; `more` replaces tables of the settings."""
    machine, table = folder / "machine.toml", folder / f"laser-{along.lower()}-{seed}.csv"
    settings = folder / "settings.toml"
    settings.write_text(tomli_w.dumps({**QUICK, **more}), encoding="utf-8")
    words = [
        "simulate", str(machine), "--instrument", "laser_linear", "--axis", along, "--seed", str(seed),
        "--settings", str(settings), "-o", str(table.with_suffix("")),
    ]  # fmt: skip
    for text in truth:
        words += ["--effect", text]
    assert status(words) == 0
    return table

"""Run files for tests: the shipped simulated turning centre with a small model of its own."""

from pathlib import Path
from typing import Any

import tomli_w

from rtec.effects import EFFECTS
from rtec.loop.run_file import Setup, load_setup
from rtec.machine import Machine, load_machine
from rtec.model import FittedEffect, Model, save_model

CONFIGS = Path(__file__).parents[2] / "configs"
PROGRAM = "S2500 M3\nG0 X60 Z320\nG1 X50 F1200\nG1 Z300 F600\nG0 X60 Z320"


def small_model(machine: Machine) -> Model:
    """A model with every kind of term that the loop treats in its own way."""

    def fitted(name: str, values: dict[str, float], theta: dict[str, float] | None = None, **more: Any) -> FittedEffect:
        return FittedEffect(EFFECTS[name].model_validate({"effect": name, **more}), values, theta or {})

    return Model(
        machine,
        (
            fitted("scale", {"k": 30.0}, component="EXX", axis="X"),
            fitted("backlash", {"B": 4.0}, component="EXX", axis="X"),
            fitted("cyclic_screw", {"s1": 1.0, "c1": 0.3}, {"pitch": 10.0}, component="EZZ", axis="Z"),
            fitted("spindle_growth", {"k": -1.2}, component="EX0spindle", sensor="T_spindle_front"),
            fitted("ambient_drift", {"k": 0.4}, {"tau": 900.0}, component="EZ0spindle", sensor="T_bed"),
        ),
    )


def tables(folder: Path, **device: Any) -> dict[str, Any]:
    """Tables of a run file that lies in `folder`; more options of the simulated machine by name."""
    limits = {"warning_um": 60.0, "stop_um": 100.0, "slew_um_s": 50.0, "acceleration_um_s2": 2000.0}
    return {
        "run": {
            "machine": str(CONFIGS / "machines" / "turning-centre.toml"),
            "model": "model.toml",
            "log_folder": str(folder / "logs"),
        },
        "role": {"counts": "box", "temperatures": ["box"], "spindle": "box", "actuator": "box"},
        "device": {
            "box": {
                "driver": "sim",
                "truth": str(CONFIGS / "sim" / "turning-centre.toml"),
                "seed": 3,
                "warm_up_s": 3600.0,
                "warm_up_rpm": 2000.0,
                "program": PROGRAM,
                **device,
            }
        },
        "limits": {"X": limits, "Z": dict(limits)},
    }


def write(folder: Path, content: dict[str, Any]) -> Path:
    """Write a run file and its model; give its path."""
    save_model(small_model(load_machine(Path(content["run"]["machine"]))), folder / "model.toml")
    path = folder / "run.toml"
    path.write_text(tomli_w.dumps(content), encoding="utf-8")
    return path


def setup(folder: Path, **device: Any) -> Setup:
    """Give a setup on the simulated machine."""
    return load_setup(write(folder, tables(folder, **device)))

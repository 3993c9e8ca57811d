"""What is wrong with a machine that LinuxCNC simulates, read from its plant's HAL file, as a model of rtec."""

import re
from pathlib import Path

from rtec.effects.geometry import PiecewisePosition
from rtec.effects.reversal import Backlash
from rtec.effects.thermal import AxisExpansion
from rtec.machine import Machine
from rtec.model import FittedEffect, Model

SETP = re.compile(r"^setp ([\w.-]+) (\S+)$", re.MULTILINE)


def true_model(plant: Path, machine: Machine) -> Model:
    """Give the model whose numbers are those of the plant: screw, play and expansion of each axis."""
    said = {name: float(value) for name, value in SETP.findall(plant.read_text())}
    effects: list[FittedEffect] = []
    for axis in machine.axes:
        a = axis.name.lower()
        knots = sorted(k for k in said if k.startswith(f"{a}-screw.x-val-"))
        values = [1e3 * said[k.replace("x-val", "y-val")] for k in knots]
        at = tuple(said[k] for k in knots)
        own = {"component": f"E{axis.name}{axis.name}", "axis": axis.name}
        screw = PiecewisePosition.model_validate({"effect": "piecewise_position", **own, "knots_mm": at})
        play = Backlash.model_validate({"effect": "backlash", **own})
        growth = AxisExpansion.model_validate({"effect": "axis_expansion", **own, "sensor": f"T_{a}"})
        effects += [
            FittedEffect(screw, {f"at{i}": v for i, v in enumerate(values)}),
            FittedEffect(play, {"B": -1e3 * (said[f"{a}-upper.in1"] - said[f"{a}-lower.in1"])}),
            FittedEffect(growth, {"k": 1e6 * said[f"{a}-strain.in1"]}),
        ]
    ranges = {a.channel: a.travel_mm for a in machine.axes} | {
        f"T_{a.name.lower()}": (15.0, 60.0) for a in machine.axes
    }
    return Model(machine, tuple(effects), name=f"{machine.name}, as its plant is", valid_range=ranges)

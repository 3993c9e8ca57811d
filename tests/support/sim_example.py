"""Machines and truths for the tests of the simulator: the shipped one, and a plain one without any error."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.machine import Machine, load_machine, machine_from
from rtec.sim.campaign.settings import ReadingNoise, Sensors
from rtec.sim.machine import SimulatedMachine
from rtec.sim.truth import Truth, load_truth
from rtec.tomlfile import validated

CONFIGS = Path(__file__).parents[2] / "configs"
MACHINE_FILE = CONFIGS / "machines" / "turning-centre.toml"
TRUTH_FILE = CONFIGS / "sim" / "turning-centre.toml"
MS = 1_000_000
S = 1_000_000_000
QUIET = ReadingNoise(white_um=0.0)
PERFECT = Sensors(offset_degc=0.0, noise_degc=0.0, lag_s=0.0, resolution_degc=0.0)


def shipped() -> tuple[Machine, Truth]:
    return load_machine(MACHINE_FILE), load_truth(TRUTH_FILE)


def plain_machine() -> Machine:
    axis = {"travel_mm": [0.0, 200.0], "counts_per_mm": 1000, "pitch_mm": 5.0}
    data = {
        "machine": {"name": "plain", "tool_chain": ["Z", "X", "tool"], "work_chain": ["spindle"]},
        "axis": {"X": {"direction": "X", **axis}, "Z": {"direction": "Z", **axis}},
        "link": {"tool": {"offset_mm": [120.0, 0.0, 80.0]}},
        "temperature": {"T_head": {"range_degc": [0.0, 90.0]}},
    }
    return machine_from(data, "plain")


def plain_truth(**axis_x: Any) -> Truth:
    """Truth without errors; keys for axis X on top."""
    data = {
        "ambient": {"mean_degc": 20.0},
        "body": {"head": {"capacity_j_per_k": 1000.0, "to_air_w_per_k": 2.0}},
        "spindle": {"w_at_1000_rpm": 100.0, "exponent": 1.5, "shares": {"head": 1.0}},
        "sensor": {"T_head": {"body": "head"}},
        "axis": {"X": axis_x, "Z": {}},
    }
    return validated(Truth, data, "plain")


def plain(**axis_x: Any) -> SimulatedMachine:
    return SimulatedMachine(plain_machine(), plain_truth(**axis_x))


def per_mm(sim: SimulatedMachine) -> NDArray[np.float64]:
    """Counts per mm of every axis."""
    return np.array([a.counts_per_mm for a in sim.machine.axes])


def run_out(machine: SimulatedMachine, text: str) -> None:
    """Run a program and let the axes settle."""
    machine.load_program(text)
    machine.advance_to(machine.time_ns + round(machine.program_s * S) + S)
